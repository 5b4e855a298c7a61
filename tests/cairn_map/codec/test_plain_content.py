"""A cell read or written all at once against the same stream by stream, which is the slow twin: sound or not."""

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import GEOMETRIES, KEY, any_evidence, random_evidence, surface_evidence

from cairn_map.arrays import Ints
from cairn_map.codec import cell_code, cell_reading
from cairn_map.codec.cell_code import EncodedCell, cell_digest, decode_canonical_cell, decode_cell, encode_cell
from cairn_map.codec.cell_reading import CellReader, cell_reader
from cairn_map.codec.octree.cell_content import CellContent
from cairn_map.codec.octree.cell_head import FIXED_PART
from cairn_map.codec.octree.streams import STORED, StoredStream, join_streams
from cairn_map.errors import CairnError
from cairn_map.evidence.brick_cell import difference
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Geometry

Arrays = list[list[int]]
KINDS = {"bad_octree", "bad_cell", "bad_stream", "too_large", "not_canonical"}


def slowly(reader: CellReader) -> CellContent:
    """Read stream by stream."""
    return CellReader(reader.head, reader.head_bytes, reader.stored, reader.sampled_max, is_plain=False).content()


def written_slowly(evidence: Evidence, geometry: Geometry) -> EncodedCell:
    """Write stream by stream."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell_code, "plain_bytes", lambda *_: None)
        return encode_cell(KEY, evidence, geometry)


def arrays_of(content: CellContent) -> Arrays:
    octree = content.octree
    masks = [octree.child_masks, octree.leaf_masks, octree.starts, octree.sizes]
    return [array.tolist() for array in (*masks, content.counts, content.sampled, content.samples)]


def verdict(read: Callable[[CellReader], CellContent], reader: CellReader) -> Arrays | str:
    """Content of the streams, or the error that they are not sound."""
    try:
        return arrays_of(read(reader))
    except CairnError as exc:
        assert exc.kind in KINDS
        return "refused"


def is_canonical(data: bytes) -> bool:
    """True if coding the decoded content gives the bytes again."""
    cell = decode_cell(data)
    again = encode_cell(cell.key, cell.evidence, cell.geometry)
    return again.digest == cell.digest


@pytest.mark.parametrize("geometry", GEOMETRIES, ids=["small", "middle", "plain"])
def test_real_cells_are_the_same_read_at_once(geometry: Geometry) -> None:
    made = [random_evidence(seed, geometry) for seed in range(20)] + [surface_evidence(1, geometry)]
    for evidence in made:
        reader = cell_reader(encode_cell(KEY, evidence, geometry).data)
        assert arrays_of(reader.content()) == arrays_of(slowly(reader))
        assert reader.is_canonical(reader.content())


@given(any_evidence(GEOMETRIES[0]))
def test_numbers_of_every_size_are_the_same_read_at_once(evidence: Evidence) -> None:
    reader = cell_reader(encode_cell(KEY, evidence, GEOMETRIES[0]).data)
    assert arrays_of(reader.content()) == arrays_of(slowly(reader))
    assert reader.is_canonical(reader.content())


@given(st.data())
def test_raw_streams_with_any_bytes_changed_are_refused_by_both_or_read_alike(data: st.DataObject) -> None:
    geometry = data.draw(st.sampled_from(GEOMETRIES))
    reader = cell_reader(encode_cell(KEY, random_evidence(data.draw(st.integers(0, 9)), geometry), geometry).data)
    raw = {number: bytearray(stream.raw()) for number, stream in reader.stored.items()}
    for _ in range(data.draw(st.integers(1, 3))):
        stream = raw[data.draw(st.sampled_from(list(raw)))]
        at = data.draw(st.integers(0, max(0, len(stream) - 1)))
        stream[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=2))
    changed = data.draw(st.sampled_from([reader.head.voxels, reader.head.voxels + 1]))
    head = bytearray(reader.head_bytes)
    head[FIXED_PART.size - 10 : FIXED_PART.size - 6] = struct.pack("<I", changed)
    body = bytes(head) + join_streams([StoredStream(n, STORED, len(r), bytes(r)) for n, r in raw.items()])
    try:
        other = cell_reader(body)
    except CairnError:
        return
    assert verdict(CellReader.content, other) == verdict(slowly, other)
    try:
        canonical = is_canonical(body)
    except CairnError:
        canonical = False
    try:
        decode_canonical_cell(body)
    except CairnError:
        assert not canonical
    else:
        assert canonical


@pytest.mark.parametrize("geometry", GEOMETRIES, ids=["small", "middle", "plain"])
def test_real_cells_are_the_same_written_at_once(geometry: Geometry) -> None:
    made = [random_evidence(seed, geometry) for seed in range(20)]
    made += [surface_evidence(1, geometry), empty_evidence(geometry), difference(made[0], made[1], geometry)]
    for evidence in made:
        slow = written_slowly(evidence, geometry)
        assert encode_cell(KEY, evidence, geometry) == slow
        assert cell_digest(KEY, evidence, geometry) == slow.digest


@given(any_evidence(GEOMETRIES[0]))
def test_numbers_of_every_size_are_the_same_written_at_once(evidence: Evidence) -> None:
    slow = written_slowly(evidence, GEOMETRIES[0])
    assert encode_cell(KEY, evidence, GEOMETRIES[0]) == slow
    # However its arrays lie in memory.
    strided = Evidence(*(np.repeat(array, 2, axis=0)[::2] for array in arrays_in(evidence)))
    assert encode_cell(KEY, strided, GEOMETRIES[0]) == slow


def arrays_in(evidence: Evidence) -> list[Ints]:
    return [evidence.voxels, evidence.counts, evidence.sampled, evidence.samples]


def test_leaves_that_could_be_one_are_found_wherever_they_are() -> None:
    geometry = Geometry(depth=4, channels=())
    rng = np.random.default_rng(0)
    for _ in range(50):
        size = 8 ** int(rng.integers(0, 3))
        starts = np.arange(0, 8**4, size, dtype=np.uint32)
        keep = rng.random(len(starts)) < 0.95
        starts, sizes = starts[keep], np.full(int(keep.sum()), size)
        counts = np.repeat(rng.integers(1, 4, (1 + len(starts) // 6, 2)), 6, axis=0)[: len(starts)].astype(np.int32)
        sampled = np.nonzero(rng.random(len(starts)) < 0.05)[0] if size == 1 else np.empty(0, np.int64)
        parents = starts // (8 * size)
        alike = (
            len(set(map(tuple, counts[mine].tolist()))) == 1 and not np.isin(mine, sampled).any()
            for mine in (np.nonzero(parents == parent)[0] for parent in np.unique(parents))
            if len(mine) == 8 and 8 * size < 8**4
        )
        masks = np.empty(0, np.uint8)
        content = CellContent(cell_reading.Octree(masks, masks, starts, sizes), counts, sampled, np.zeros((0, 0)))
        assert content.is_collapsed(geometry) == (not any(alike))
        assert content.octree.brick_count == len({n >> 9 for s in starts.tolist() for n in range(s, s + size)})
