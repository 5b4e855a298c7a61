"""Addition of packed counts into bricks of 8^3 voxels, and packing of the sums. No checks.

Callers guarantee that voxels rise and lie in the cell: so the voxels of a brick are one run of at most 512. A Morton
code without its lowest 9 bits is the number of its brick; these 9 bits are the voxel's place in the brick.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Int32s
from cairn_map.kernels.integer_kernels import U

Voxels = npt.NDArray[np.uint32]
BrickNumbers = npt.NDArray[np.int16]
Pool = npt.NDArray[np.int16] | npt.NDArray[np.int32]

RUN = U(32)
"""Voxels without a gap that are added in one vectorised loop; half and twice as many were slower."""


@nb.njit(inline="always")
def _brick_end(voxels: Voxels, start: int) -> int:
    """Index behind the last voxel of the run that lies in the brick of voxel `start`."""
    brick = voxels[start] >> np.uint32(9)
    # A full brick needs no search.
    if start + 512 <= voxels.shape[0] and voxels[start + 511] >> np.uint32(9) == brick:
        return start + 512
    # Binary search by falling steps, without a branch that the processor could mispredict. Invariant: `last` lies in
    # the brick.
    last = start
    step = 256
    while step > 0:
        ahead = min(last + step, voxels.shape[0] - 1)
        last = ahead if voxels[ahead] >> np.uint32(9) == brick else last
        step >>= 1
    return last + 1


@nb.njit(cache=True, nogil=True)
def count_new_bricks(voxels: Voxels, brick_of: BrickNumbers) -> int:
    """Number of bricks of the voxels that the index lacks."""
    new = 0
    start = 0
    while start < voxels.shape[0]:
        if brick_of[voxels[start] >> np.uint32(9)] < 0:
            new += 1
        start = _brick_end(voxels, start)
    return new


@nb.njit(cache=True, nogil=True)
def number_bricks_into(voxels: Voxels, brick_of: BrickNumbers, used: int) -> None:
    """Number new bricks in order of appearance from `used` on; changes `brick_of`."""
    start = 0
    while start < voxels.shape[0]:
        brick = voxels[start] >> np.uint32(9)
        if brick_of[brick] < 0:
            # The next row of the pool.
            brick_of[brick] = used
            used += 1
        start = _brick_end(voxels, start)


@nb.njit(cache=True, nogil=True)
def largest_count(counts: Pool) -> int:
    """The largest magnitude of (N, 2) counts; 0 if there are none."""
    low, high = np.int32(0), np.int32(0)
    flat = counts.reshape(-1)
    for n in range(flat.shape[0]):
        low = min(low, flat[n])
        high = max(high, flat[n])
    return max(int(high), -int(low))


@nb.njit(cache=True, nogil=True)
def counts_fit(voxels: Voxels, counts: Int32s, sign: int, brick_of: BrickNumbers, pool: Pool, limit: int) -> bool:
    """True if adding sign * counts keeps every sum in [-limit, limit]; bricks that do not exist count as zero."""
    for n in range(voxels.shape[0]):
        brick = brick_of[voxels[n] >> np.uint32(9)]
        for c in range(2):
            total = np.int64(counts[n, c]) * sign
            if brick >= 0:
                total += np.int64(pool[brick, voxels[n] & np.uint32(511), c])
            if abs(total) > limit:
                return False
    return True


@nb.njit(cache=True, nogil=True)
def add_counts_into(voxels: Voxels, counts: Int32s, sign: int, brick_of: BrickNumbers, pool: Pool) -> int:
    """Add sign * counts to the pool, where sums may wrap around; every brick exists.

    Returns all counts or'ed together: negative if one is, else no less than the largest.
    """
    # Flat arrays: entry 2 v is the hits, 2 v + 1 the misses of voxel v; a brick has 1024 entries.
    flat_counts, flat_pool = counts.reshape(-1), pool.reshape(-1)
    factor, said = np.int32(sign), np.int32(0)
    start = 0
    while start < voxels.shape[0]:
        # One brick: the run [n, end) of voxels.
        brick = U(brick_of[voxels[start] >> np.uint32(9)]) << U(10)
        n = U(start)
        start = _brick_end(voxels, start)
        end = U(start)
        while n < end:
            # RUN voxels without a gap are side by side in the pool, too.
            stop = n + RUN
            if stop <= end and voxels[stop - U(1)] - voxels[n] == np.uint32(RUN - U(1)):
                first, voxel = n << U(1), brick + (U(voxels[n] & np.uint32(511)) << U(1))
                for i in range(RUN << U(1)):
                    said |= flat_counts[first + i]
                    flat_pool[voxel + i] += factor * flat_counts[first + i]
                n = stop
                continue
            # Else one by one.
            for m in range(n, min(stop, end)):
                voxel = brick + (U(voxels[m] & np.uint32(511)) << U(1))
                hits, misses = flat_counts[m << U(1)], flat_counts[(m << U(1)) + U(1)]
                said |= hits | misses
                flat_pool[voxel] += factor * hits
                flat_pool[voxel + U(1)] += factor * misses
            n = min(stop, end)
    return int(said)


@nb.njit(cache=True, nogil=True)
def count_packed(brick_of: BrickNumbers, pool: Pool, sampled: Voxels) -> int:
    """Number of voxels with a count, or listed in `sampled`."""
    V = 0
    flat = pool.reshape(-1)
    # Voxels with a hit or a miss; then those listed that have neither.
    for i in range(U(0), U(flat.shape[0]), U(2)):
        V += (flat[i] | flat[i + U(1)]) != 0
    for n in range(sampled.shape[0]):
        voxel = (U(brick_of[sampled[n] >> np.uint32(9)]) << U(10)) + (U(sampled[n] & np.uint32(511)) << U(1))
        V += (flat[voxel] | flat[voxel + U(1)]) == 0
    return V


@nb.njit(cache=True, nogil=True)
def pack_into(
    brick_of: BrickNumbers, pool: Pool, sampled: Voxels, out_voxels: Voxels, out_counts: Int32s, out_rows: Voxels
) -> None:
    """Write the voxels that `count_packed` counted, rising, their counts, and the rows of those of `sampled`."""
    # A merge of two rising lists: bricks in order of their Morton numbers, and `sampled`, of which n is the next.
    V = U(0)
    n = U(0)
    for b in range(brick_of.shape[0]):
        if brick_of[b] < 0:
            continue
        brick = U(brick_of[b])
        for i in range(U(512)):
            voxel = np.uint32(b) << np.uint32(9) | np.uint32(i)
            hits, misses = pool[brick, i, 0], pool[brick, i, 1]
            has_samples = n < U(sampled.shape[0]) and sampled[n] == voxel
            if has_samples:
                out_rows[n] = V
                n += U(1)
            if has_samples or hits | misses != 0:
                out_voxels[V] = voxel
                out_counts[V, U(0)] = hits
                out_counts[V, U(1)] = misses
                V += U(1)
