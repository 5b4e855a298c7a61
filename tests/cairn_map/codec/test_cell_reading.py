"""Cells read in part, and groups of streams that do not fit each other."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import KEY, MIDDLE, SMALL, as_dict, surface_evidence
from tests.fixtures.map.stored import GROUPS, bodies_of, garbled, recoded, with_streams
from tests.fixtures.map.strategies import RANDOM, SMOOTH, Made
from tests.naive import octree as naive_octree

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.octree.cell_content import evidence_of
from cairn_map.codec.octree.cell_head import decode_head, head_sizes
from cairn_map.codec.octree.channel_streams import stream_of_channel
from cairn_map.codec.octree.streams import MODELLED, STORED, StoredStream, join_streams
from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.evidence.grid import Geometry


def topology(data: bytes, depth: int) -> list[tuple[int, int]]:
    octree = cell_reader(data).topology(depth)
    return list(zip(octree.starts.tolist(), octree.sizes.tolist(), strict=True))


@settings(max_examples=25)
@given(st.one_of(RANDOM, SMOOTH), st.sampled_from(Profile))
def test_topology_is_what_the_evidence_says_whatever_the_other_streams_do(made: Made, profile: Profile) -> None:
    evidence, geometry = made
    root = naive_octree.tree_of(as_dict(evidence), geometry.depth)
    data = encode_cell(KEY, evidence, geometry, profile=profile).data
    for depth in range(1, geometry.depth + 1):
        expected = naive_octree.leaves_above(root, geometry.depth, depth)
        assert topology(data, depth) == expected
        assert topology(garbled(data, lambda number: number <= 2), depth) == expected


def test_sizes_are_read_from_the_fixed_part_of_a_head_alone() -> None:
    head, _ = decode_head(SURFACE)
    assert head_sizes(SURFACE) == (head.geometry.depth, head.voxels, head.leaves)
    with pytest.raises(DamagedDataError):
        head_sizes(SURFACE[:20])


@pytest.mark.parametrize("geometry", [SMALL, MIDDLE])
def test_masks_behind_the_depth_asked_for_are_not_looked_at(geometry: Geometry) -> None:
    evidence = surface_evidence(3, geometry)
    data = recoded(encode_cell(KEY, evidence, geometry).data, level=None)
    for depth in range(1, geometry.depth):
        sound = cell_reader(data).topology(depth)
        child, leaf = len(sound.child_masks), len(sound.leaf_masks)
        masks = [
            stream._replace(body=stream.body[:kept] + bytes(len(stream.body) - kept))
            for stream, kept in ((bodies_of(data)[1], child), (bodies_of(data)[2], leaf))
        ]
        cut = with_streams(data, *masks)
        assert topology(cut, depth) == topology(data, depth)
        with pytest.raises(CairnError):
            cell_reader(cut).octree()


@pytest.mark.parametrize("profile", Profile)
@pytest.mark.parametrize("c", range(len(SMALL.channels)))
def test_a_channel_alone_is_that_of_the_whole_whatever_later_streams_do(profile: Profile, c: int) -> None:
    evidence = surface_evidence(6, SMALL)
    data = encode_cell(KEY, evidence, SMALL, profile=profile).data
    later = garbled(data, lambda number: number < stream_of_channel(c + 1))
    for cell in (data, later):
        reader = cell_reader(cell)
        rows, starts = reader.channel(c), reader.octree().starts
        found = dict(zip(starts[rows.leaves].tolist(), map(tuple, rows.sums.tolist()), strict=True))
        planes = SMALL.planes_of(SMALL.channels[c].name)
        expected = {place: sums[planes] for place, (_, _, sums) in as_dict(evidence).items() if any(sums[planes])}
        assert found == expected


@pytest.mark.parametrize("c", range(len(SMALL.channels)))
def test_a_fast_channel_is_read_without_those_before_it(c: int) -> None:
    data = encode_cell(KEY, surface_evidence(6, SMALL), SMALL).data
    own = garbled(data, lambda number: number < 16 or number // 8 == stream_of_channel(c) // 8)
    found, expected = cell_reader(own).channel(c), cell_reader(data).channel(c)
    assert found.leaves.tolist() == expected.leaves.tolist()
    assert found.sums.tolist() == expected.sums.tolist()


# --- Damage that needs a hand ------------------------------------------------------------------------------------

SURFACE = encode_cell(KEY, surface_evidence(1, SMALL), SMALL, profile=Profile.SMALL).data


def refused(data: bytes) -> CairnError:
    with pytest.raises(CairnError) as caught:
        decode_cell(data)
    return caught.value


@pytest.mark.parametrize("number", [number for group in GROUPS.values() for number in group])
def test_a_raw_length_that_does_not_fit_is_refused(number: int) -> None:
    stream = bodies_of(SURFACE)[number]
    for off in (-1, 1):
        other = StoredStream(number, MODELLED, stream.raw_bytes + off, stream.body)
        assert refused(with_streams(SURFACE, other)).kind in ("bad_stream", "bad_octree", "bad_cell")


@pytest.mark.parametrize("number", [number for group in GROUPS.values() for number in group])
def test_a_group_modelled_in_part_is_refused(number: int) -> None:
    raw = bodies_of(recoded(encode_cell(KEY, surface_evidence(1, SMALL), SMALL).data, level=None))[number]
    assert "modelled in part" in refused(with_streams(SURFACE, raw)).message


@pytest.mark.parametrize("number", [number for group in GROUPS.values() for number in group[1:]])
def test_stored_bytes_of_what_the_first_stream_says_are_refused(number: int) -> None:
    stream = StoredStream(number, MODELLED, bodies_of(SURFACE)[number].raw_bytes, b"\0")
    assert "modelled in part" in refused(with_streams(SURFACE, stream)).message


@pytest.mark.parametrize("first", GROUPS)
@pytest.mark.parametrize("change", ["cut", "longer", "nothing", "a zero before"])
def test_a_group_of_other_length_is_refused(first: int, change: str) -> None:
    """By more than three bytes: up to three that a reader takes for zeros may be left away."""
    stream = bodies_of(SURFACE)[first]
    body = {
        "cut": stream.body[:-8],
        "longer": stream.body + bytes(4),
        "nothing": b"",
        "a zero before": b"\0" + stream.body,
    }[change]
    refused(with_streams(SURFACE, StoredStream(first, MODELLED, stream.raw_bytes, body)))


def test_stored_bytes_that_are_too_few_for_the_leaves_are_refused_on_the_heads_word() -> None:
    """And so before the masks are looked at, which here are none."""
    head, _ = decode_head(SURFACE)
    for first in GROUPS:
        streams = [StoredStream(n, STORED, 0, b"") for group in GROUPS.values() for n in group]
        streams = [
            StoredStream(s.number, MODELLED, 70_000 if first == 1 else 0, b"\1" * 2 if s.number == first else b"")
            if s.number in GROUPS[first]
            else s
            for s in streams
        ]
        data = bytearray(SURFACE[: len(decode_head(SURFACE)[1])])
        data[6], data[24:32] = 8, (20_000).to_bytes(4, "little") * 2
        assert "cannot say" in str(refused(bytes(data) + join_streams(streams)))
    assert head.leaves < 20_000


@settings(max_examples=40)
@given(st.one_of(RANDOM, SMOOTH), st.sampled_from(Profile), st.data())
def test_bricks_alone_hold_what_the_whole_holds_there(made: Made, profile: Profile, data: st.DataObject) -> None:
    evidence, geometry = made
    count = 8 ** (geometry.depth - 3)
    first = data.draw(st.integers(0, count))
    stop = data.draw(st.integers(first, count))
    encoded = encode_cell(KEY, evidence, geometry, profile=profile).data
    part = evidence_of(cell_reader(encoded).bricks(first, stop))
    whole = as_dict(evidence)
    assert as_dict(part) == {place: held for place, held in whole.items() if first << 9 <= place < stop << 9}


def test_bricks_that_no_cell_has_are_refused() -> None:
    reader = cell_reader(encode_cell(KEY, surface_evidence(3, MIDDLE), MIDDLE).data)
    for first, stop in ((-1, 1), (2, 1), (0, 65)):
        with pytest.raises(BadInputError, match="bricks"):
            reader.bricks(first, stop)


def test_samples_behind_the_bricks_asked_for_are_not_looked_at() -> None:
    evidence = surface_evidence(3, MIDDLE)
    data = recoded(encode_cell(KEY, evidence, MIDDLE).data, level=None)
    head = cell_reader(data).head
    # The highest byte of every plane of counts and sums belongs to the last leaf.
    bodies = {number: stream for number, stream in bodies_of(data).items() if number in (3, 4) and stream.body[0] == 1}
    assert bodies
    damaged = with_streams(data, *(s._replace(body=s.body[:-1] + b"\xff") for s in bodies.values()))
    sound = evidence_of(cell_reader(data).bricks(0, 20))
    assert head.voxels > len(sound) > 0
    assert evidence_of(cell_reader(damaged).bricks(0, 20)) == sound
    assert decode_cell(damaged).evidence != evidence
