"""Voxels of bricks that a range image looks through; projectively, octant by octant.

    bricks --`cull_kernels`--> octants that are not seen | free: all of it | mixed
    mixed  --64 voxel centres into the image--> a miss where the centre is nearer than what the pixel saw

A brick costs three loops: where each centre falls, what is there, whether it is nearer. The first and the last are
arithmetic alone, and so become vector instructions; together a voxel takes about a nanosecond.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Counts, Int32s, Singles

ALL_FREE = 0xFF
"""Mask of a brick of which all octants are free; see `cull_kernels`."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def carve_into(
    misses: Counts,
    slots: Int32s,
    masks: Int32s,
    corners_view: Singles,
    offsets_view: Singles,
    squares: Singles,
    lens: Singles,
    min_square: float,
    tables: Int32s,
    struck: Int32s,
) -> None:
    """Count a miss in each voxel that is looked through and was not hit.

    Args:
        misses: (B, 8, 64) of the pool, octants and their voxels in Morton order.
        slots: (K,) places of the bricks in the pool; all different.
        masks: (K,) octants that are free, and octants to be tested voxel by voxel.
        corners_view: (3, K) the centre of each brick's first voxel, camera frame.
        offsets_view: (3, 8, 64) from there to each voxel's centre.
        squares: (H, W) padded image of each pixel's clear range, squared; 0 where it is not clear.
        lens: fx, fy, cx, cy of that image, with half a pixel added to the centre.
        min_square: nothing nearer than this, squared, is free.
        tables: (K,) the brick's row in `struck`; -1 for none.
        struck: (T, 8, 64) 0 where this scan has no hit.
    """
    # By tested octant and voxel: number of the pixel, squared distance of the voxel, squared clear range of the pixel.
    where, squared, limit = np.empty((8, 64), np.uint32), np.empty((8, 64), np.float32), np.empty((8, 64), np.float32)
    where_flat, limit_flat = where.ravel(), limit.ravel()
    height, width = squares.shape
    flat = squares.ravel()
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    nearest = np.float32(min_square)
    for k in range(len(slots)):
        slot, mask, table = slots[k], masks[k], tables[k]
        bx, by, bz = corners_view[0, k], corners_view[1, k], corners_view[2, k]
        # Stage by stage, and without views of rows: those count references, atomically.
        # Stage 1: the pixel that each voxel of a mixed octant falls on.
        tested = 0
        for n in range(8):
            if mask >> n & 256:
                _addresses_into(where, squared, tested, offsets_view, n, bx, by, bz, fx, fy, cx, cy, width, height)
                tested += 1
        # Stage 2: how far that pixel is clear.
        for i in range(64 * tested):
            limit_flat[i] = flat[where_flat[i]]
        # Stage 3: count.
        tested = 0
        for n in range(8):
            if mask >> n & 1:
                _count_free_into(misses, slot, n, table, struck)
            elif mask >> n & 256:
                _count_nearer_into(misses, slot, n, table, struck, squared, limit, tested, nearest)
                tested += 1


@nb.njit(forceinline=True)
def _count_free_into(misses: Counts, slot: int, octant: int, table: int, struck: Int32s) -> None:
    """Count a miss in each voxel of a free octant that this scan did not hit."""
    # A hit wins over a miss of the same scan; a brick without hits needs no test.
    if table < 0:
        for i in range(64):
            misses[slot, octant, i] += np.uint16(1)
    else:
        for i in range(64):
            misses[slot, octant, i] += np.uint16(struck[table, octant, i] == 0)


@nb.njit(forceinline=True)
def _count_nearer_into(
    misses: Counts,
    slot: int,
    octant: int,
    table: int,
    struck: Int32s,
    squared: Singles,
    limit: Singles,
    row: int,
    nearest: np.float32,
) -> None:
    """Count a miss in each voxel of a mixed octant that lies before its pixel's clear range, and was not hit."""
    if table < 0:
        for i in range(64):
            free = (squared[row, i] < limit[row, i]) & (squared[row, i] > nearest)
            misses[slot, octant, i] += np.uint16(free)
    else:
        for i in range(64):
            free = (squared[row, i] < limit[row, i]) & (squared[row, i] > nearest)
            misses[slot, octant, i] += np.uint16(free & (struck[table, octant, i] == 0))


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _addresses_into(
    where: npt.NDArray[np.uint32],
    squared: Singles,
    row: int,
    offsets: Singles,
    octant: int,
    bx: float,
    by: float,
    bz: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
) -> None:
    """Number of the pixel that each voxel centre of an octant falls on, 0 for none, and its squared distance."""
    zero, one = np.float32(0.0), np.float32(1.0)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    for i in range(64):
        # Eq. 5 was done for the brick's first voxel, so the rest is a sum; then Eq. 6.
        x, y, z = bx + offsets[0, octant, i], by + offsets[1, octant, i], bz + offsets[2, octant, i]
        squared[row, i] = x * x + y * y + z * z
        inverse = one / z
        u = min(max(fx * (x * inverse) + cx, zero), right)
        v = min(max(fy * (y * inverse) + cy, zero), bottom)
        # Pixel 0 is on the padded image's border, where nothing is clear: it stands for points behind the camera.
        where[row, i] = np.int32(v) * np.int32(width) + np.int32(u) if z > zero else np.int32(0)
