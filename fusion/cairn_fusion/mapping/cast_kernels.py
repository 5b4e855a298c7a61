"""Kernels that walk rays through voxels: they mark each voxel of a scan, and bring marks into the order of evidence.

The scratch is a dense index over the bricks of the scan's box and a pool of bricks of 512 marks. The pool cannot
grow in a kernel: it stops before a ray that might not fit and returns the ray to continue with.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Int32s, Ints

Marks = npt.NDArray[np.uint8]
Places = npt.NDArray[np.uint32]

MISS, HIT, END = 1, 2, 4
"""Bits of a mark: a ray passed the voxel, a beam ended in it, the clear part of a beam ended in it."""
SPREAD = np.array([0, 1, 8, 9, 64, 65, 72, 73], np.int64)
"""Morton code of one coordinate of 0 to 7: its three bits, each three places apart."""
AXIS = 73
"""Bits of the first coordinate in a place within a brick."""


@nb.njit(inline="always")
def _brick(x: int | np.int64, y: int | np.int64, z: int | np.int64, dims: Ints) -> int:
    brick: int = ((z >> 3) * dims[1] + (y >> 3)) * dims[0] + (x >> 3)
    return brick


@nb.njit(inline="always")
def _inner(x: int | np.int64, y: int | np.int64, z: int | np.int64) -> int:
    inner: int = SPREAD[x & 7] | (SPREAD[y & 7] << 1) | (SPREAD[z & 7] << 2)
    return inner


@nb.njit(nogil=True)
def _add_brick(b: int, brick_of: Int32s, bricks: Ints, marks: Marks, used: int) -> int:
    """Give a brick of the box the next place in the pool; returns bricks used."""
    brick_of[b] = used
    bricks[used] = b
    marks[used, :] = 0
    return used + 1


@nb.njit(nogil=True)
def _crossings(origin: float, target: float, at: int | np.int64, end: int | np.int64) -> tuple[float, float]:
    """Parameter of the ray at the first border that it crosses along one axis, and its step from border to border."""
    # An axis that never steps is never the next one.
    if at == end:
        return np.inf, 0.0
    d = target - origin
    # The voxels differ by rounding only: step at once.
    if d == 0.0:
        return 0.0, 0.0
    border = at + 1 if end > at else at
    return (border - origin) / d, abs(1.0 / d)


@nb.njit(cache=True, nogil=True)
def carry_into(points: Floats, T: Floats, out: Floats) -> None:
    """Carry (N, 3) points by a transform: in one thread, where BLAS would wake all for a millisecond of work."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for a in range(3):
            out[n, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]


@nb.njit(cache=True, nogil=True)
def clear_ends_into(origin: Floats, points: Floats, margins: Floats, out: Floats) -> int:
    """Ends of the clear parts of beams to (N, 3) points, shorter by (N,) margins; returns how many are not empty."""
    count = 0
    for n in range(points.shape[0]):
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        length = np.sqrt(x * x + y * y + z * z)
        left = length - margins[n]
        if left > 0:
            share = left / length
            out[count, 0] = origin[0] + x * share
            out[count, 1] = origin[1] + y * share
            out[count, 2] = origin[2] + z * share
            count += 1
    return count


@nb.njit(cache=True, nogil=True)
def mark_ends_into(
    ends: Ints, bit: int, dims: Ints, brick_of: Int32s, bricks: Ints, marks: Marks, used: int, firsts: Ints
) -> tuple[int, int]:
    """Mark voxels (box coordinates) with a bit; the pool has room for one brick each.

    Returns bricks used, and how many of the voxels had not been marked so: `firsts` takes the index of each.
    """
    count = 0
    for n in range(ends.shape[0]):
        # A brick comes into the pool with its first mark.
        b = _brick(ends[n, 0], ends[n, 1], ends[n, 2], dims)
        if brick_of[b] < 0:
            used = _add_brick(b, brick_of, bricks, marks, used)
        slot, inner = brick_of[b], _inner(ends[n, 0], ends[n, 1], ends[n, 2])
        if marks[slot, inner] & bit == 0:
            marks[slot, inner] |= bit
            firsts[count] = n
            count += 1
    return used, count


@nb.njit(cache=True, nogil=True)
def mark_misses_into(
    origin: Floats,
    targets: Floats,
    ends: Ints,
    rays: Ints,
    first: int,
    dims: Ints,
    brick_of: Int32s,
    bricks: Ints,
    marks: Marks,
    used: int,
) -> tuple[int, int]:
    """Mark the voxels that rays pass before their end voxel as MISS (Amanatides and Woo 1987).

    `origin` and `targets` are in voxels from the box's corner, `ends` the targets' voxels, `rays` those to cast. An
    axis never steps beyond its end voxel, so a ray arrives there whatever the rounding, and never leaves the box.
    Returns the ray to continue with (their number when all are done) and the bricks used.
    """
    x0, y0, z0 = np.int64(np.floor(origin[0])), np.int64(np.floor(origin[1])), np.int64(np.floor(origin[2]))
    own_brick, own_inner = _brick(x0, y0, z0, dims), _inner(x0, y0, z0)
    row, layer = dims[0], dims[0] * dims[1]
    for r in range(first, rays.shape[0]):
        # Stage 1: step, first border and voxels left on each axis; and how many bricks the ray can pass at most.
        n = rays[r]
        x_left, y_left, z_left = abs(ends[n, 0] - x0), abs(ends[n, 1] - y0), abs(ends[n, 2] - z0)
        bricks_passed = 1 + abs((ends[n, 0] >> 3) - (x0 >> 3))
        bricks_passed += abs((ends[n, 1] >> 3) - (y0 >> 3)) + abs((ends[n, 2] >> 3) - (z0 >> 3))
        if used + bricks_passed > marks.shape[0]:
            return r, used
        x_next, x_step = _crossings(origin[0], targets[n, 0], x0, ends[n, 0])
        y_next, y_step = _crossings(origin[1], targets[n, 1], y0, ends[n, 1])
        z_next, z_step = _crossings(origin[2], targets[n, 2], z0, ends[n, 2])
        # The place within a brick is stepped as it is, one coordinate's bits alone: adding carries over the other
        # bits as if they were not there. From `*_border` on the next brick begins, `*_brick` farther in the index.
        x_up, y_up, z_up = ends[n, 0] >= x0, ends[n, 1] >= y0, ends[n, 2] >= z0
        x_add, x_border, x_brick = (-AXIS, 0, 1) if x_up else (-1, AXIS, -1)
        y_add, y_border, y_brick = (-(AXIS << 1), 0, row) if y_up else (-2, AXIS << 1, -row)
        z_add, z_border, z_brick = (-(AXIS << 2), 0, layer) if z_up else (-4, AXIS << 2, -layer)
        # Stage 2: voxel by voxel. `left` falls by one each time, so the loop ends at the end voxel.
        b, inner, slot = own_brick, own_inner, np.int64(-1)
        while x_left + y_left + z_left > 0:
            if slot < 0:
                if brick_of[b] < 0:
                    used = _add_brick(b, brick_of, bricks, marks, used)
                slot = np.int64(brick_of[b])
            marks[slot, inner] |= MISS
            # The axis whose border comes first; of two the one before.
            if x_next <= y_next and x_next <= z_next:
                place = ((inner & AXIS) + x_add) & AXIS
                inner = (inner & ~AXIS) | place
                if place == x_border:
                    b, slot = b + x_brick, np.int64(-1)
                x_left -= 1
                x_next = x_next + x_step if x_left > 0 else np.inf
            elif y_next < x_next and y_next <= z_next:
                place = ((inner & (AXIS << 1)) + y_add) & (AXIS << 1)
                inner = (inner & ~(AXIS << 1)) | place
                if place == y_border:
                    b, slot = b + y_brick, np.int64(-1)
                y_left -= 1
                y_next = y_next + y_step if y_left > 0 else np.inf
            else:
                place = ((inner & (AXIS << 2)) + z_add) & (AXIS << 2)
                inner = (inner & ~(AXIS << 2)) | place
                if place == z_border:
                    b, slot = b + z_brick, np.int64(-1)
                z_left -= 1
                z_next = z_next + z_step if z_left > 0 else np.inf
    return rays.shape[0], used


@nb.njit(cache=True, nogil=True)
def count_seen_into(slots: Ints, marks: Marks, counts: Ints) -> None:
    """Count the voxels of each brick of the pool that were passed or hit."""
    for b in range(len(slots)):
        seen = np.int64(0)
        for i in range(512):
            seen += np.int64((marks[slots[b], i] & (MISS | HIT)) != 0)
        counts[b] = seen


@nb.njit(cache=True, nogil=True)
def pack_seen_into(slots: Ints, numbers: Places, marks: Marks, places: Places, counts: Int32s) -> None:
    """Write the voxels that were passed or hit, brick by brick, with a hit or else a miss each."""
    kept = np.empty(512, np.uint32)
    # Unsigned: Numba counts signed numbers from the end if they are negative, and tests for it each time.
    at = np.uint64(0)
    for b in range(len(slots)):
        slot, first = slots[b], np.uint32(numbers[b]) << np.uint32(9)
        # Each place is written, and counts only if it was seen: no branch that could be guessed wrong.
        seen = np.uint64(0)
        for i in range(512):
            kept[seen] = i
            seen += np.uint64((marks[slot, i] & (MISS | HIT)) != 0)
        for n in range(seen):
            hit = np.int32(marks[slot, kept[n]] >> 1 & 1)
            places[at + n] = first | kept[n]
            counts[at + n, 0] = hit
            counts[at + n, 1] = 1 - hit
        at += seen
