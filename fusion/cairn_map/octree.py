"""The octree of one cell as flat arrays: masks breadth-first, leaves in Morton order.

    child_masks  one byte per inner node, depth by depth, Morton order inside a depth: which children exist
    leaf_masks   likewise, but not for the last depth (all its children are voxels): which children are leaves
    leaf rows    one per leaf, in Morton order over the whole cell: the counts it stands for

Reading depth by depth lets a reader stop early; collapsed leaves make empty air cheap.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map import octree_kernels as kernels
from cairn_map.errors import DamagedDataError
from cairn_map.evidence import Evidence

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Octree:
    """Topology of a cell, and for each leaf its first voxel and its size in voxels."""

    child_masks: Bytes
    leaf_masks: Bytes
    starts: npt.NDArray[np.uint32]
    sizes: npt.NDArray[np.int64]


def build_octree(evidence: Evidence, *, depth: int) -> tuple[Octree, npt.NDArray[np.int64]]:
    """The octree of packed evidence, and the row of `evidence` at which each leaf starts."""
    V = len(evidence.voxels)
    keys = evidence.voxels.copy()
    states = np.arange(V, dtype=np.int64)
    states[evidence.sampled] = kernels.FIXED
    leaf_starts = np.ones(V, np.bool_)
    children: list[Bytes] = []
    leaves: list[Bytes] = []
    for up in range(depth):
        child_masks, leaf_masks = np.empty(len(keys), np.uint8), np.empty(len(keys), np.uint8)
        parents, masks = kernels.collapse_into(
            keys, states, evidence.counts, leaf_starts, child_masks, leaf_masks, up == depth - 1
        )
        keys, states = keys[:parents], states[:parents]
        children.append(child_masks[:masks])
        if up > 0:
            leaves.append(leaf_masks[:masks])
    rows = np.nonzero(leaf_starts)[0]
    sizes = np.diff(np.append(rows, V))
    octree = Octree(_joined(children[::-1]), _joined(leaves[::-1]), evidence.voxels[rows], sizes)
    return octree, rows


def parse_octree(child_masks: Bytes, leaf_masks: Bytes, *, depth: int) -> Octree:
    """The octree that masks describe; the mirror of `build_octree`.

    Memory is bounded by the masks' length: a byte names at most eight leaves.

    Raises:
        DamagedDataError: masks are missing, left over, empty, or mark a leaf that does not exist.
    """
    keys = np.zeros(min(1, len(child_masks)), np.uint32)
    starts: list[npt.NDArray[np.uint32]] = []
    sizes: list[npt.NDArray[np.int64]] = []
    at = leaf_at = 0
    for d in range(depth):
        masks = child_masks[at : at + len(keys)]
        at += len(keys)
        if d == depth - 1:
            leaf = masks
        else:
            leaf = leaf_masks[leaf_at : leaf_at + len(keys)]
            leaf_at += len(keys)
        if len(masks) < len(keys) or len(leaf) < len(keys) or not masks.all() or (leaf & ~masks).any():
            raise DamagedDataError("bad_octree", f"masks of depth {d} are cut off or contradict each other")
        children = np.unpackbits(masks, bitorder="little").astype(np.bool_)
        is_leaf = np.unpackbits(leaf, bitorder="little").astype(np.bool_)
        numbers = ((keys[:, None] << np.uint32(3)) | np.arange(8, dtype=np.uint32)).ravel()
        shift = 3 * (depth - 1 - d)
        found = numbers[is_leaf] << np.uint32(shift)
        starts.append(found)
        sizes.append(np.full(len(found), 1 << shift, np.int64))
        keys = numbers[children & ~is_leaf]
    if at != len(child_masks) or leaf_at != len(leaf_masks):
        raise DamagedDataError("bad_octree", "masks are left over after the last depth")
    all_starts = np.concatenate(starts)
    order = np.argsort(all_starts, kind="stable")
    return Octree(child_masks, leaf_masks, all_starts[order], np.concatenate(sizes)[order])


def _joined(parts: list[Bytes]) -> Bytes:
    return np.concatenate(parts) if parts else np.empty(0, np.uint8)
