"""Blocks of 4^3 voxels: the units in which a server reports changes of a cell.

A block's number is a voxel's Morton code without its six lowest bits; so the voxels of a block are one run of rows.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.evidence.evidence import Evidence

Blocks = npt.NDArray[np.uint32]
"""(B,) numbers, rising."""
BLOCK_BITS = 6
"""Bits of a voxel's Morton code within its block."""


def blocks_of(evidence: Evidence) -> Blocks:
    """Blocks that hold a voxel of the evidence."""
    blocks = evidence.voxels >> np.uint32(BLOCK_BITS)
    is_first = np.ones(len(blocks), np.bool_)
    np.not_equal(blocks[1:], blocks[:-1], out=is_first[1:])  # np.diff takes four times as long
    return np.asarray(blocks[is_first])


def of_blocks(evidence: Evidence, blocks: Blocks) -> Evidence:
    """Packed evidence of the voxels in some blocks."""
    return evidence.where(_in_blocks(evidence, blocks))


def without_blocks(evidence: Evidence, blocks: Blocks) -> Evidence:
    """Packed evidence of the voxels outside of some blocks."""
    return evidence.where(~_in_blocks(evidence, blocks))


def _in_blocks(evidence: Evidence, blocks: Blocks) -> npt.NDArray[np.bool_]:
    """(V,) True for voxels in one of the blocks; a table of all block numbers is much faster than searching."""
    count = 1 + max(
        int(evidence.voxels[-1]) >> BLOCK_BITS if len(evidence) else 0, int(blocks[-1]) if len(blocks) else 0
    )
    chosen = np.zeros(count, np.bool_)
    chosen[blocks] = True
    return np.asarray(chosen[evidence.voxels >> np.uint32(BLOCK_BITS)])
