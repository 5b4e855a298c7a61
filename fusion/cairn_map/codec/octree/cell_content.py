"""Content of a cell: its evidence by leaf of the octree, between evidence by voxel and streams of bytes.

evidence  <->  content  <->  raw streams, which are canonical          `channel_streams` for samples
                        <->  modelled streams, which are small         `small_profile`
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_map.codec.octree.octree import Octree, build_octree
from cairn_map.codec.octree.octree_kernels import check_leaves, expand_content_into, leaves_of_rows
from cairn_map.codec.octree.streams import column_planes, encode_column, required
from cairn_map.codec.octree.word_columns import numbers_into, words
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.evidence import COUNT_MAX, Evidence
from cairn_map.evidence.grid import Geometry

T = TypeVar("T", bound=np.generic)

CHILD_MASKS, LEAF_MASKS, HITS, MISSES = 1, 2, 3, 4
BAD_LEAF = "bad_cell", "a leaf says nothing, or a collapsed one holds samples"
STREAM_HEAD = struct.Struct("<BI")
LARGE_PAGES_FROM_BYTES = 1 << 22
WORTH_BYTES = 1 << 20
"""Bytes of evidence from which on large pages are worth it: smaller ones would hold more memory than they need."""


@dataclass(frozen=True, slots=True, eq=False)
class CellContent:
    """An octree, and the counts and samples of its N leaves."""

    octree: Octree
    counts: npt.NDArray[np.int32]
    """(N, 2) hits and misses."""
    sampled: npt.NDArray[np.int64]
    """(S,) leaves that have samples, rising."""
    samples: npt.NDArray[np.int64]
    """(S, P) sums."""

    @property
    def evidence_bytes(self) -> int:
        """Memory of the same content by voxel, as `evidence_of` makes it."""
        return 12 * int(self.octree.sizes.sum()) + 4 * len(self.sampled) + self.samples.nbytes

    def is_collapsed(self, geometry: Geometry) -> bool:
        """True if no eight leaves are left that could be collapsed into one.

        Raises:
            DamagedDataError: a leaf is empty, or one of several voxels has samples.
        """
        octree = self.octree
        sound, collapsed = check_leaves(octree.starts, octree.sizes, self.counts, self.sampled, 8**geometry.depth)
        if not sound:
            raise DamagedDataError(*BAD_LEAF)
        return collapsed


def content_of(evidence: Evidence, geometry: Geometry) -> CellContent:
    """Packed evidence by leaf."""
    octree, rows = build_octree(evidence, depth=geometry.depth)
    # Pairs as one number each: a third of the time of picking rows.
    pairs = np.ascontiguousarray(evidence.counts).view(np.int64)[:, 0]
    counts = pairs[rows].view(np.int32).reshape(-1, 2)
    return CellContent(octree, counts, leaves_of_rows(rows, evidence.sampled), evidence.samples)


def evidence_of(content: CellContent) -> Evidence:
    """Packed evidence of a content; the mirror of `content_of`.

    Raises:
        DamagedDataError: a leaf is empty, or one of several voxels has samples.
    """
    octree, counts, sampled = content.octree, content.counts, content.sampled
    V = int(octree.sizes.sum())
    # In one block, counts first, so that two of them can be read as one number of 64 bits.
    block = large_empty(3 * V + len(sampled), np.uint32)
    pairs, voxels, rows_of_samples = block[: 2 * V], block[2 * V : 3 * V], block[3 * V :]
    evidence = Evidence(voxels, pairs.view(np.int32).reshape(V, 2), rows_of_samples, content.samples)
    rows = (evidence.voxels, evidence.counts, evidence.sampled)
    if not expand_content_into(octree.starts, octree.sizes, counts, sampled, *rows):
        raise DamagedDataError(*BAD_LEAF)
    return evidence


def met_of(content: CellContent) -> CellContent:
    """Content restricted to leaves that were hit or have samples; where much is free, a hundredth of the voxels.

    The masks stay those of the whole octree.
    """
    octree, sampled = content.octree, content.sampled
    is_met = content.counts[:, 0] != 0
    is_met[sampled] = True
    (leaves,) = np.nonzero(is_met)
    part = Octree(octree.child_masks, octree.leaf_masks, octree.starts[leaves], octree.sizes[leaves])
    return CellContent(part, content.counts[leaves], np.searchsorted(leaves, sampled), content.samples)


def large_empty(count: int, kind: type[T]) -> npt.NDArray[T]:
    """(count,) fresh memory, in large pages if it is large: else the page faults take longer than writing it.

    NumPy asks for large pages from 4 MB on. The rest of such a block is never touched, and so costs nothing.
    """
    item_bytes = np.dtype(kind).itemsize
    whole = max(count, LARGE_PAGES_FROM_BYTES // item_bytes) if item_bytes * count >= WORTH_BYTES else count
    return np.empty(whole, kind)[:count]


def canonical_bytes(head: bytes, streams: Mapping[int, bytes]) -> bytes:
    """Bytes over which a cell's digest is taken: its head and its raw streams, each behind its number and length."""
    parts = [head]
    for number, raw in streams.items():
        parts += [STREAM_HEAD.pack(number, len(raw)), raw]
    return b"".join(parts)


def topology_streams(octree: Octree) -> dict[int, bytes]:
    """Raw streams of the masks."""
    return {CHILD_MASKS: octree.child_masks.tobytes(), LEAF_MASKS: octree.leaf_masks.tobytes()}


def count_streams(counts: npt.NDArray[np.int32], *, signed: bool) -> dict[int, bytes]:
    """Raw streams of the leaves' hits and misses."""
    return {
        number: encode_column(words(counts[:, column].astype(np.int64), signed))
        for number, column in ((HITS, 0), (MISSES, 1))
    }


def counts_of_streams(
    streams: dict[int, bytes], *, leaves: int, signed: bool, part: slice | None = None
) -> npt.NDArray[np.int32]:
    """(N, 2) counts of the leaves, or of a part of them; the mirror of `count_streams`.

    Raises:
        DamagedDataError: a stream is missing, of the wrong length, or a count is out of range.
    """
    first, stop = (0, leaves) if part is None else (part.start, part.stop)
    counts = np.empty((stop - first, 2), np.int32)
    for number, column in ((HITS, 0), (MISSES, 1)):
        planes = column_planes(required(streams, number), rows=leaves)[:, first:stop]
        numbers_into(counts[:, column], planes, signed=signed, limit=COUNT_MAX)
    return counts
