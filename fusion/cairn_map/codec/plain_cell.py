"""Plain cells, which nearly all cells are: unsigned, not modelled. They are read and written in few passes.

`CellReader` reads stream by stream, so that it can stop early, and `cell_code` writes so what a model codes; for a few
hundred leaves that is thirty small arrays, which NumPy takes longer to create than to fill, and for half a million a
dozen passes over all of them. Both ways give the same content and the same bytes, and refuse the same bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints, Words
from cairn_map.codec import plain_kernels as kernels
from cairn_map.codec import plain_stream_kernels as stream_kernels
from cairn_map.codec.octree import octree_kernels
from cairn_map.codec.octree.cell_content import (
    CHILD_MASKS,
    HITS,
    LEAF_MASKS,
    MISSES,
    STREAM_HEAD,
    CellContent,
    canonical_bytes,
    large_empty,
)
from cairn_map.codec.octree.cell_head import CellHead, encode_head
from cairn_map.codec.octree.channel_streams import check_count, stream_of_channel
from cairn_map.codec.octree.octree import Octree
from cairn_map.codec.octree.streams import MODELLED, StoredStream
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import PLANES, ChannelKind, planes_and_squares
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX, Evidence
from cairn_map.evidence.grid import CellKey, Geometry

T = TypeVar("T", bound=np.generic)

PLAIN_BYTES_MAX = 1 << 22
"""Raw bytes of a plain cell that is read, at most: to read it in one pass, they are held a second time."""
COMPLAINTS = {
    kernels.BAD_MASKS: ("bad_octree", "the octree's masks are cut off, left over, or contradict each other"),
    kernels.BAD_LEAVES: ("bad_cell", "the octree has other numbers of voxels or leaves than the head names"),
    kernels.BAD_COLUMN: ("bad_stream", "a column's length is not that of its planes"),
    kernels.BAD_PRESENCE: ("bad_stream", "presence is not one bit for each leaf"),
    kernels.BAD_NUMBER: ("bad_stream", "a number is out of range, or a row of samples says nothing"),
}


@dataclass(frozen=True, slots=True, eq=False)
class PlainCell:
    """Content of a plain cell, and the facts that decide whether its bytes are canonical."""

    content: CellContent
    canonical: bytes
    """Canonical bytes of a cell with these streams."""
    is_fewest: bool
    """True if each column has as few planes as it needs."""


@dataclass(frozen=True, slots=True, eq=False)
class PlainBytes:
    """Canonical bytes of a cell, and its head and raw streams, which lie in them."""

    canonical: memoryview
    head: memoryview
    streams: dict[int, memoryview]
    """Raw streams by number, rising."""


def is_plain(head: CellHead, stored: Mapping[int, StoredStream]) -> bool:
    """True if a cell can be read in one pass."""
    streams = stored.values()
    kinds = tuple(channel.kind for channel in head.geometry.channels)
    return (
        not head.signed
        and ChannelKind.CLASSES not in kinds
        and tuple(stored) == _numbers(kinds)
        and all(stream.coding != MODELLED for stream in streams)
        and sum(stream.raw_bytes for stream in streams) <= PLAIN_BYTES_MAX
    )


def plain_content(head: CellHead, head_bytes: bytes, raw: Mapping[int, bytes], *, sampled_max: int) -> PlainCell:
    """Content of the raw streams of a plain cell, given in the order of their numbers.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: kind `too_large`: more than `sampled_max` leaves have samples.
    """
    # The streams lie in the canonical bytes, each behind a head of its own.
    geometry, leaves = head.geometry, head.leaves
    canonical = canonical_bytes(head_bytes, raw)
    size = np.array([len(stream) for stream in raw.values()], np.int64)
    at = np.cumsum(size + STREAM_HEAD.size) - size + len(head_bytes)
    data, spec = np.frombuffer(canonical, np.uint8), planes_and_squares(geometry.channels)
    # First pass: all sizes and masks; then arrays of the right size, and the second pass.
    firsts = np.zeros(geometry.depth + 1, np.int64)
    wrong, count, is_fewest = kernels.measure_plain(data, at, size, spec, leaves, firsts)
    _check(wrong)
    check_count(count, sampled_max)
    starts, sizes = np.empty(leaves + 1, np.uint32), np.empty(leaves + 1, np.int64)
    counts, sampled = np.empty((leaves, 2), np.int32), np.empty(count, np.int64)
    samples = np.zeros((count, geometry.plane_count), np.int64)
    limits = COUNT_MAX, SUM_MAX
    _check(kernels.read_plain_into(data, at, size, spec, firsts, limits, starts, sizes, counts, sampled, samples))
    starts, sizes = starts[:leaves], sizes[:leaves]
    if int(sizes.sum()) != head.voxels:
        _check(kernels.BAD_LEAVES)
    child_masks, leaf_masks = (data[at[n] : at[n] + size[n]] for n in range(2))
    content = CellContent(Octree(child_masks, leaf_masks, starts, sizes), counts, sampled, samples)
    return PlainCell(content, canonical, is_fewest)


def plain_bytes(key: CellKey, evidence: Evidence, geometry: Geometry) -> PlainBytes | None:
    """Canonical bytes of packed evidence that fits the geometry (`check_fits`); None if it is signed, or of classes."""
    kinds = tuple(channel.kind for channel in geometry.channels)
    if ChannelKind.CLASSES in kinds:
        return None
    # One kind of array, whatever the evidence was made of: each other kind is another kernel to compile.
    voxels, counts = _readable(evidence.voxels), _readable(evidence.counts)
    sampled, samples = _readable(evidence.sampled), _readable(evidence.samples)
    count_bits = stream_kernels.bits_of_counts(counts)
    if min(count_bits) < 0:
        return None
    # Masks, and the row at which each leaf begins.
    depth, V = geometry.depth, len(voxels)
    room = min(V, 8 ** (depth - 1))
    child_masks, leaf_masks = np.empty((depth, room), np.uint8), np.empty((depth, room), np.uint8)
    masks, rows_of_leaves = np.zeros(depth, np.int64), large_empty(V, np.int64)
    leaves = octree_kernels.build_into(voxels, counts, sampled, child_masks, leaf_masks, masks, rows_of_leaves)
    leaf_rows = rows_of_leaves[:leaves]
    # Words of the channels, of which the sizes of their streams follow.
    spec = planes_and_squares(geometry.channels)
    presence = np.zeros((len(spec), (leaves + 7) // 8), np.uint8)
    words = large_empty(geometry.plane_count * len(sampled), np.uint64).reshape(geometry.plane_count, len(sampled))
    rows, bits = np.zeros(len(spec), np.int64), np.zeros(geometry.plane_count, np.uint64)
    if not stream_kernels.sample_words_into(leaf_rows, sampled, samples, spec, presence, words, rows, bits):
        return None
    numbers = _numbers(kinds)
    size, planes = _sizes(masks, leaves, count_bits, presence.shape[1], spec, rows, bits)
    head = encode_head(
        CellHead(key=key, geometry=geometry, voxels=V, leaves=leaves, streams=len(numbers), signed=False)
    )
    # The streams lie in the canonical bytes, each behind a head of its own.
    at = np.cumsum(size + STREAM_HEAD.size) - size + len(head)
    data = large_empty(int(at[-1] + size[-1]), np.uint8)
    stream_kernels.write_plain_into(data, at, planes, leaf_rows, counts, spec, presence, words, rows)
    np.concatenate([child_masks[d, : masks[d]] for d in range(depth)], out=data[at[0] : at[0] + size[0]])
    np.concatenate(
        [leaf_masks[d, : masks[d]] for d in range(depth - 1)] or [data[:0]], out=data[at[1] : at[1] + size[1]]
    )
    canonical = data.data
    canonical[: len(head)] = head
    for number, first, length in zip(numbers, at.tolist(), size.tolist(), strict=True):
        STREAM_HEAD.pack_into(canonical, first - STREAM_HEAD.size, number, length)
    streams = {
        number: canonical[first : first + length]
        for number, first, length in zip(numbers, at.tolist(), size.tolist(), strict=True)
    }
    return PlainBytes(canonical, canonical[: len(head)], streams)


def _sizes(
    masks: Ints, leaves: int, count_bits: tuple[int, int], presence_bytes: int, spec: Ints, rows: Ints, bits: Words
) -> tuple[Ints, Ints]:
    """Length of each stream, bytes, and the number of byte planes of each that is a column."""
    size, planes = [int(masks.sum()), int(masks[:-1].sum())], [0, 0]
    for of_column in count_bits:
        planes.append((of_column.bit_length() + 7) // 8)
        size.append(1 + planes[-1] * leaves)
    columns = iter(bits.tolist())
    for count, length in zip(spec[:, 0].tolist(), rows.tolist(), strict=True):
        planes.append(0)
        size.append(presence_bytes)
        for _ in range(count):
            planes.append((next(columns).bit_length() + 7) // 8)
            size.append(1 + planes[-1] * length)
    return np.array(size, np.int64), np.array(planes, np.int64)


def _readable(array: npt.NDArray[T]) -> npt.NDArray[T]:
    """The same numbers in one piece, to be read only."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


def _check(wrong: int) -> None:
    if wrong != kernels.SOUND:
        raise DamagedDataError(*COMPLAINTS[wrong])


@lru_cache(maxsize=16)
def _numbers(kinds: tuple[ChannelKind, ...]) -> tuple[int, ...]:
    firsts = [(stream_of_channel(c), 1 + len(PLANES[kind])) for c, kind in enumerate(kinds)]
    of_channels = [number for first, count in firsts for number in range(first, first + count)]
    return (CHILD_MASKS, LEAF_MASKS, HITS, MISSES, *of_channels)
