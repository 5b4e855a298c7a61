"""The octree of one cell as flat arrays: masks breadth-first, leaves in Morton order (FORMAT.md section 4).

    child_masks  one byte per inner node, depth by depth, Morton order inside a depth: which children exist
    leaf_masks   likewise, but not for the last depth (all its children are voxels): which children are leaves
    leaf rows    one per leaf, in Morton order over the whole cell: the counts it stands for

Reading depth by depth lets a reader stop early; collapsed leaves make empty air cheap.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes
from cairn_map.codec.octree import octree_kernels as kernels
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.evidence import Evidence


@dataclass(frozen=True, slots=True)
class Octree:
    """Octree of a cell: its masks, and the first voxel and the size in voxels of each leaf."""

    child_masks: Bytes
    leaf_masks: Bytes
    starts: npt.NDArray[np.uint32]
    sizes: npt.NDArray[np.int64]

    @property
    def brick_count(self) -> int:
        """Number of bricks of 8^3 voxels that its leaves touch."""
        return int(kernels.bricks_of_leaves(self.starts, self.sizes))


def build_octree(evidence: Evidence, *, depth: int) -> tuple[Octree, npt.NDArray[np.int64]]:
    """Octree of packed evidence, and the row of `evidence` at which each leaf starts."""
    V = len(evidence)
    room = min(V, 8 ** (depth - 1))
    child_masks, leaf_masks = np.empty((depth, room), np.uint8), np.empty((depth, room), np.uint8)
    masks, rows = np.zeros(depth, np.int64), np.empty(V, np.int64)
    leaves = kernels.build_into(
        evidence.voxels, evidence.counts, evidence.sampled, child_masks, leaf_masks, masks, rows
    )
    rows = rows[:leaves].copy()
    sizes = np.empty(leaves, np.int64)
    np.subtract(rows[1:], rows[:-1], out=sizes[:-1])
    sizes[-1:] = V - rows[-1:]
    octree = Octree(
        np.concatenate([child_masks[d, : masks[d]] for d in range(depth)]),
        np.concatenate([leaf_masks[d, : masks[d]] for d in range(depth - 1)] or [np.empty(0, np.uint8)]),
        evidence.voxels[rows],
        sizes,
    )
    return octree, rows


def parse_octree(child_masks: Bytes, leaf_masks: Bytes, *, depth: int, stop: int | None = None) -> Octree:
    """Octree of its masks; the mirror of `build_octree`.

    Memory is bounded by the masks' length: a byte names at most eight leaves.

    With `stop`, 1 to `depth`, nothing deeper is read: inner nodes at that depth become leaves of their own size, and
    masks of deeper ones may be missing.

    Raises:
        DamagedDataError: masks are missing, left over, empty, or mark a leaf that does not exist.
    """
    stop = depth if stop is None else stop
    firsts = np.zeros(depth + 1, np.int64)
    masks, leaf_count, leaves = kernels.measure_masks(child_masks, leaf_masks, firsts, stop)
    if masks < 0:
        raise DamagedDataError("bad_octree", "the octree's masks are cut off or contradict each other")
    if stop == depth and (masks != len(child_masks) or leaf_count != len(leaf_masks)):
        raise DamagedDataError("bad_octree", "masks are left over after the last depth")
    if stop < depth:
        # Inner nodes at the depth where reading stops are listed as leaves, too.
        last = slice(firsts[stop - 1], masks)
        leaves += int(np.unpackbits(child_masks[last] & ~leaf_masks[last]).sum())
    starts, sizes = np.empty(leaves + 1, np.uint32), np.empty(leaves + 1, np.int64)
    kernels.list_leaves_into(child_masks, leaf_masks, firsts, stop, starts, sizes)
    return Octree(child_masks[:masks], leaf_masks[:leaf_count], starts[:leaves], sizes[:leaves])
