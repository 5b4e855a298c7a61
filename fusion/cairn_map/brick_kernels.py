"""Adding packed rows into bricks of 8^3 voxels, and reading them back; all loops, no checks (callers check).

A cell keeps a dense index `brick_of` (Morton number of a brick -> its number in the pool, or -1). Counts are
dense per brick; samples are rows, found through a per-brick table `row_of`, because only about one voxel in
ten of a surface brick has any.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

Voxels = npt.NDArray[np.uint32]
Index = npt.NDArray[np.int32]
Counts = npt.NDArray[np.int32]
Samples = npt.NDArray[np.int64]


@nb.njit(cache=True, nogil=True)
def count_new_bricks(voxels: Voxels, brick_of: Index) -> int:
    """How many bricks the (rising) voxels need that the index does not have."""
    new = 0
    last = np.int64(-1)
    for n in range(voxels.shape[0]):
        b = np.int64(voxels[n] >> np.uint32(9))
        if b != last:
            last = b
            if brick_of[b] < 0:
                new += 1
    return new


@nb.njit(cache=True, nogil=True)
def allocate_bricks_into(voxels: Voxels, brick_of: Index, used: int) -> int:
    """Number new bricks in order of appearance from `used` on; changes `brick_of`, returns bricks used."""
    last = np.int64(-1)
    for n in range(voxels.shape[0]):
        b = np.int64(voxels[n] >> np.uint32(9))
        if b != last:
            last = b
            if brick_of[b] < 0:
                brick_of[b] = used
                used += 1
    return used


@nb.njit(cache=True, nogil=True)
def counts_fit(voxels: Voxels, counts: Counts, sign: int, brick_of: Index, pool: Counts, low: int, high: int) -> bool:
    """Whether adding sign * counts keeps every sum in [low, high]; bricks that do not exist count as zero."""
    for n in range(voxels.shape[0]):
        b = brick_of[np.int64(voxels[n] >> np.uint32(9))]
        inner = np.int64(voxels[n] & np.uint32(511))
        for c in range(2):
            v = np.int64(counts[n, c]) * sign
            if b >= 0:
                v += np.int64(pool[b, inner, c])
            if v < low or v > high:
                return False
    return True


@nb.njit(cache=True, nogil=True)
def add_counts_into(voxels: Voxels, counts: Counts, sign: int, brick_of: Index, pool: Counts) -> None:
    """Add sign * counts to the pool; every brick exists."""
    for n in range(voxels.shape[0]):
        b = brick_of[np.int64(voxels[n] >> np.uint32(9))]
        inner = np.int64(voxels[n] & np.uint32(511))
        pool[b, inner, 0] += np.int32(sign * counts[n, 0])
        pool[b, inner, 1] += np.int32(sign * counts[n, 1])


@nb.njit(cache=True, nogil=True)
def allocate_rows_into(
    voxels: Voxels, sampled: Voxels, brick_of: Index, table_of: Index, row_of: Index, tables: int, rows: int
) -> tuple[int, int]:
    """Give every sampled voxel a row and its brick a table; changes `table_of`, `row_of`; returns tables, rows used.

    `row_of` must have room for one more table per sampled brick, filled with -1.
    """
    for n in range(sampled.shape[0]):
        v = voxels[sampled[n]]
        b = brick_of[np.int64(v >> np.uint32(9))]
        if table_of[b] < 0:
            table_of[b] = tables
            tables += 1
        t = table_of[b]
        inner = np.int64(v & np.uint32(511))
        if row_of[t, inner] < 0:
            row_of[t, inner] = rows
            rows += 1
    return tables, rows


@nb.njit(cache=True, nogil=True)
def samples_fit(
    voxels: Voxels,
    sampled: Voxels,
    samples: Samples,
    sign: int,
    brick_of: Index,
    table_of: Index,
    row_of: Index,
    pool: Samples,
    low: int,
    high: int,
) -> bool:
    """Whether adding sign * samples keeps every sum in [low, high]."""
    for n in range(sampled.shape[0]):
        v = voxels[sampled[n]]
        inner = np.int64(v & np.uint32(511))
        b = brick_of[np.int64(v >> np.uint32(9))]
        row = -1
        if b >= 0 and table_of[b] >= 0:
            row = row_of[table_of[b], inner]
        for p in range(samples.shape[1]):
            total = sign * samples[n, p]
            if row >= 0:
                total += pool[row, p]
            if total < low or total > high:
                return False
    return True


@nb.njit(cache=True, nogil=True)
def add_samples_into(
    voxels: Voxels,
    sampled: Voxels,
    samples: Samples,
    sign: int,
    brick_of: Index,
    table_of: Index,
    row_of: Index,
    pool: Samples,
) -> None:
    """Add sign * samples to the pool; every row exists."""
    for n in range(sampled.shape[0]):
        v = voxels[sampled[n]]
        row = row_of[table_of[brick_of[np.int64(v >> np.uint32(9))]], np.int64(v & np.uint32(511))]
        for p in range(samples.shape[1]):
            pool[row, p] += sign * samples[n, p]


@nb.njit(inline="always")
def _row_is_set(row: int, samples: Samples) -> bool:
    if row < 0:
        return False
    for p in range(samples.shape[1]):
        if samples[row, p] != 0:
            return True
    return False


@nb.njit(cache=True, nogil=True)
def count_rows(
    bricks: Index, brick_of: Index, counts: Counts, table_of: Index, row_of: Index, samples: Samples
) -> tuple[int, int]:
    """Voxels with any number that is not zero, and voxels with samples, in the listed bricks."""
    V = 0
    S = 0
    for n in range(bricks.shape[0]):
        b = brick_of[bricks[n]]
        t = table_of[b]
        for inner in range(512):
            row = int(row_of[t, inner]) if t >= 0 else -1
            has = _row_is_set(row, samples)
            if has:
                S += 1
            if has or counts[b, inner, 0] != 0 or counts[b, inner, 1] != 0:
                V += 1
    return V, S


@nb.njit(cache=True, nogil=True)
def pack_rows_into(
    bricks: Index,
    brick_of: Index,
    counts: Counts,
    table_of: Index,
    row_of: Index,
    samples: Samples,
    out_voxels: Voxels,
    out_counts: Counts,
    out_sampled: Voxels,
    out_samples: Samples,
) -> None:
    """Write the rows that `count_rows` counted, in rising Morton order, to the four output arrays."""
    V = 0
    S = 0
    for n in range(bricks.shape[0]):
        b = brick_of[bricks[n]]
        t = table_of[b]
        for inner in range(512):
            row = int(row_of[t, inner]) if t >= 0 else -1
            has = _row_is_set(row, samples)
            if has:
                out_sampled[S] = V
                for p in range(samples.shape[1]):
                    out_samples[S, p] = samples[row, p]
                S += 1
            if has or counts[b, inner, 0] != 0 or counts[b, inner, 1] != 0:
                out_voxels[V] = np.uint32(bricks[n]) << np.uint32(9) | np.uint32(inner)
                out_counts[V, 0] = counts[b, inner, 0]
                out_counts[V, 1] = counts[b, inner, 1]
                V += 1
