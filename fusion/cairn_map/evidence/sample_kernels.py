"""Addition of packed samples into rows of sums, found through a rising list of voxels, and packing of the sums.

    known  [n] voxels, rising      row_of [n] -> r      narrow [r, P] low 32 bits of every sum
                                                        wide   [r, W] all 64 bits of those in `wide_planes`

So most sums take 4 bytes; planes whose sums may need more are wide. Callers guarantee that voxels rise; no checks.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.kernels.integer_kernels import U

Voxels = npt.NDArray[np.uint32]
Rows = npt.NDArray[np.int32]
Sums = npt.NDArray[np.int64]
NarrowSums = npt.NDArray[np.int32]
Planes = npt.NDArray[np.int64]
Magnitudes = npt.NDArray[np.uint64]


@nb.njit(cache=True, nogil=True)
def largest_sums_into(sums: Sums, largest: Magnitudes) -> None:
    """Raise (8 P,) `largest` to the magnitudes in (N, P) sums; eight rows at a time, which is twice as fast."""
    flat = sums.reshape(-1)
    for start in range(U(0), U(flat.shape[0]), U(largest.shape[0])):
        for i in range(min(U(largest.shape[0]), U(flat.shape[0]) - start)):
            largest[i] = max(largest[i], U(abs(flat[start + i])))


@nb.njit(cache=True, nogil=True)
def find_samples_into(voxels: Voxels, sampled: Voxels, known: Voxels, places: Rows) -> int:
    """Write the place of each sampled voxel in the rising `known`, or -1 - the place where it belongs.

    Returns the number of voxels that are not in `known`.
    """
    new = 0
    # Both lists rise, so `place` never goes back.
    place = U(0)
    for n in range(sampled.shape[0]):
        voxel = voxels[U(sampled[n])]
        while place < U(known.shape[0]) and known[place] < voxel:
            place += U(1)
        places[n] = place
        if place == U(known.shape[0]) or known[place] != voxel:
            places[n] = -1 - places[n]
            new += 1
    return new


@nb.njit(cache=True, nogil=True)
def insert_samples_into(voxels: Voxels, sampled: Voxels, places: Rows, new: int, known: Voxels, row_of: Rows) -> None:
    """Insert the voxels that were not found into `known`, with the next free rows; adapts `places`.

    The last `new` entries of `known` and `row_of` are free; the others move up, from the last one on.
    """
    # From the back, so that nothing is overwritten before it is moved. Invariant: `new` voxels are left to insert, and
    # all entries from `end` on have moved up already.
    end = known.shape[0] - new
    row = known.shape[0]
    for n in range(sampled.shape[0] - 1, -1, -1):
        if places[n] < 0:
            # Entries behind the new voxel move up by the number of new voxels up to and including it.
            place = -1 - places[n]
            for i in range(end - 1, place - 1, -1):
                known[i + new] = known[i]
                row_of[i + new] = row_of[i]
            end = place
            new -= 1
            row -= 1
            places[n] = place
            known[place + new] = voxels[sampled[n]]
            row_of[place + new] = row
        places[n] += new  # behind that many new voxels


@nb.njit(cache=True, nogil=True)
def samples_fit(
    samples: Sums,
    sign: int,
    places: Rows,
    row_of: Rows,
    narrow: NarrowSums,
    wide_planes: Planes,
    wide: Sums,
    limit: int,
) -> bool:
    """True if adding sign * samples keeps every sum in [-limit, limit], as every sum and sample itself is."""
    for n in range(samples.shape[0]):
        row = row_of[places[n]] if places[n] >= 0 else -1
        for p in range(samples.shape[1]):
            total = sign * samples[n, p]
            if row >= 0:
                # The narrow sum; of a wide plane all 64 bits instead.
                total += narrow[row, p]
                for w in range(wide_planes.shape[0]):
                    if wide_planes[w] == p:
                        total += wide[row, w] - narrow[row, p]
            if total < -limit or total > limit:  # not abs(): twice the limit wraps around
                return False
    return True


@nb.njit(cache=True, nogil=True)
def add_samples_into(
    samples: Sums,
    sign: int,
    places: Rows,
    row_of: Rows,
    narrow: NarrowSums,
    wide_planes: Planes,
    wide: Sums,
    said: Sums,
) -> None:
    """Add sign * (S, P) samples to their rows, where sums may wrap around; every place is known.

    Their bits are or'ed into (8 P,) `said`, eight rows at a time, which is twice as fast; so the caller learns a bound
    of the largest without another pass.
    """
    S, P, together = U(samples.shape[0]), U(samples.shape[1]), U(8)
    flat = samples.reshape(-1)
    for first in range(U(0), S, together):
        stop = min(first + together, S)
        # Bits of these rows.
        for i in range((stop - first) * P):
            said[i] |= flat[first * P + i]
        # Sums: the low 32 bits of all planes, and all bits of the wide ones.
        for n in range(first, stop):
            row = U(row_of[U(places[n])])
            for p in range(P):
                narrow[row, p] += sign * samples[n, p]
            for w in range(U(wide_planes.shape[0])):
                wide[row, w] += sign * samples[n, U(wide_planes[w])]


@nb.njit(inline="always")
def _is_zero(row: np.uint64, narrow: NarrowSums, wide: Sums) -> bool:
    # or'ed instead of compared one by one: no branch in the loop.
    low, high = np.int32(0), np.int64(0)
    for p in range(U(narrow.shape[1])):
        low |= narrow[row, p]
    for w in range(U(wide.shape[1])):
        high |= wide[row, w]
    return bool(low == 0 and high == 0)


@nb.njit(cache=True, nogil=True)
def count_rows(row_of: Rows, narrow: NarrowSums, wide: Sums) -> int:
    """Number of rows that are not zero."""
    S = 0
    for n in range(row_of.shape[0]):
        S += not _is_zero(U(row_of[n]), narrow, wide)
    return S


@nb.njit(cache=True, nogil=True)
def pack_rows_into(
    known: Voxels,
    row_of: Rows,
    narrow: NarrowSums,
    wide_planes: Planes,
    wide: Sums,
    out_voxels: Voxels,
    out_samples: Sums,
) -> None:
    """Write the voxels of the rows that `count_rows` counted, rising, and their sums."""
    S = U(0)
    for n in range(U(row_of.shape[0])):
        row = U(row_of[n])
        if not _is_zero(row, narrow, wide):
            out_voxels[S] = known[n]
            for p in range(U(narrow.shape[1])):
                out_samples[S, p] = narrow[row, p]
            # Wide planes have all their bits elsewhere.
            for w in range(U(wide_planes.shape[0])):
                out_samples[S, U(wide_planes[w])] = wide[row, w]
            S += U(1)
