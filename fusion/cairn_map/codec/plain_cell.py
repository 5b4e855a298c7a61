"""Plain cells, which nearly all cells are: unsigned, not modelled, small. Their content is read in one pass.

`CellReader` reads stream by stream, so that it can stop early; for a few hundred leaves that is thirty small arrays,
which NumPy takes longer to create than to fill. Both ways give the same content, and refuse the same bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cairn_map.codec import plain_kernels as kernels
from cairn_map.codec.octree.cell_content import (
    CHILD_MASKS,
    HITS,
    LEAF_MASKS,
    MISSES,
    STREAM_HEAD,
    CellContent,
    canonical_bytes,
)
from cairn_map.codec.octree.cell_head import CellHead
from cairn_map.codec.octree.channel_streams import check_count, stream_of_channel
from cairn_map.codec.octree.octree import Octree
from cairn_map.codec.octree.streams import MODELLED, StoredStream
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import PLANES, ChannelKind, planes_and_squares
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX

PLAIN_BYTES_MAX = 1 << 22
"""Raw bytes of a plain cell, at most: to read it in one pass, they are held a second time."""
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


def _check(wrong: int) -> None:
    if wrong != kernels.SOUND:
        raise DamagedDataError(*COMPLAINTS[wrong])


@lru_cache(maxsize=16)
def _numbers(kinds: tuple[ChannelKind, ...]) -> tuple[int, ...]:
    firsts = [(stream_of_channel(c), 1 + len(PLANES[kind])) for c, kind in enumerate(kinds)]
    of_channels = [number for first, count in firsts for number in range(first, first + count)]
    return (CHILD_MASKS, LEAF_MASKS, HITS, MISSES, *of_channels)
