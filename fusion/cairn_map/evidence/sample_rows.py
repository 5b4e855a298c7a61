"""Sums of samples of one cell: rows in order of arrival, and a rising list of the voxels that have one.

    known [n] voxels, rising      row_of [n] -> r      narrow [r, P] sums, 32 bits
                                                       wide   [r, W] sums, 64 bits, of the planes that need them

The list, and not the rows, is kept in order: a few new voxels move 8 bytes of each that follows, not 50.

A plane has 32 bits a sum until a sum may need 64; its column in `narrow` then stays as their low half. A bound of its
magnitudes decides: each diff's samples raise it while they are added; only when it passes the limit are they subtracted
again, and the true sums examined.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError
from cairn_map.evidence import sample_kernels as kernels
from cairn_map.evidence.evidence import SUM_MAX, Evidence

Voxels = npt.NDArray[np.uint32]
Sums = npt.NDArray[np.int64]
Magnitudes = npt.NDArray[np.uint64]
Places = npt.NDArray[np.int32]
Rows = tuple[Voxels, Places, npt.NDArray[np.int32], npt.NDArray[np.int64], Sums]

NARROW_MAX = (1 << 31) - 1


class SampleRows:
    """Sums of samples; the evidence given has voxels rising, and as many planes."""

    __slots__ = ("_bounds", "_known", "_limits", "_narrow", "_row_of", "_wide", "_wide_planes")

    def __init__(self, plane_count: int) -> None:
        self._known = np.zeros(0, np.uint32)
        self._row_of = np.zeros(0, np.int32)
        self._narrow = np.zeros((0, plane_count), np.int32)
        self._wide = np.zeros((0, 0), np.int64)
        self._wide_planes = np.zeros(0, np.int64)
        self._bounds: Magnitudes = np.zeros(plane_count, np.uint64)
        self._limits: Magnitudes = np.full(plane_count, NARROW_MAX, np.uint64)

    def add(self, diff: Evidence, sign: int) -> None:
        """Add sign * samples.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range; nothing was changed.
        """
        places, new = self._find(diff)
        if new:
            rows = len(self._known) + new
            for array in (self._narrow, self._wide, self._row_of, self._known):
                array.resize((rows, *array.shape[1:]), refcheck=False)
            kernels.insert_samples_into(diff.voxels, diff.sampled, places, new, self._known, self._row_of)
        said = self._add(diff, sign, places)
        bounds = self._bounds + said.astype(np.uint64)
        if (said >= 0).all() and (bounds <= self._limits).all():
            self._bounds = bounds
            return
        # A sum may have wrapped around. Subtraction restores the sums exactly; then the bound is found first.
        self._add(diff, -sign, places)
        self._bounds = self._bounds_after(diff, sign, places)
        self._add(diff, sign, places)

    def packed(self) -> tuple[Voxels, Sums]:
        """Voxels whose sums are not all zero, rising, and their sums."""
        S = kernels.count_rows(self._row_of, self._narrow, self._wide)
        out = np.empty(S, np.uint32), np.empty((S, self._narrow.shape[1]), np.int64)
        kernels.pack_rows_into(self._known, self._row_of, self._narrow, self._wide_planes, self._wide, *out)
        return out

    def of_voxels(self, voxels: Voxels) -> tuple[npt.NDArray[np.intp], Sums]:
        """Rows of those of some voxels that have samples, rising, and their sums."""
        places = np.searchsorted(self._known, voxels)
        there = places < len(self._known)
        there[there] = self._known[places[there]] == voxels[there]
        rows = self._row_of[places[there]]
        sums = self._narrow[rows].astype(np.int64)
        sums[:, self._wide_planes] = self._wide[rows]
        return np.flatnonzero(there), sums

    def copy(self) -> "SampleRows":
        """The same sums in arrays of its own."""
        copied = SampleRows.__new__(SampleRows)
        for name in self.__slots__:
            setattr(copied, name, getattr(self, name).copy())
        return copied

    @property
    def rows(self) -> Rows:
        """`known`, `row_of`, `narrow`, the planes that are in `wide`, and `wide`; to be read only."""
        return self._known, self._row_of, self._narrow, self._wide_planes, self._wide

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return sum(array.nbytes for array in (self._known, self._row_of, self._narrow, self._wide))

    def _find(self, diff: Evidence) -> tuple[Places, int]:
        places = np.empty(len(diff.sampled), np.int32)
        return places, kernels.find_samples_into(diff.voxels, diff.sampled, self._known, places)

    def _add(self, diff: Evidence, sign: int, places: Places) -> Sums:
        """Add sign * samples; returns (P,) samples or'ed by plane: negative if one is, else at least the largest."""
        said = np.zeros((8, diff.samples.shape[1]), np.int64)
        rows = (self._row_of, self._narrow, self._wide_planes, self._wide)
        kernels.add_samples_into(diff.samples, sign, places, *rows, said.reshape(-1))
        together: Sums = np.bitwise_or.reduce(said, axis=0)
        return together

    def _bounds_after(self, diff: Evidence, sign: int, places: Places) -> Magnitudes:
        """(P,) bounds of all magnitudes after adding sign * samples; widens planes if 32 bits may not be enough.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range.
        """
        largest = _largest(diff.samples)
        bounds = self._bounds + largest
        if (bounds <= self._limits).all():
            return bounds
        bounds = _largest(self._narrow)
        bounds[self._wide_planes] = _largest(self._wide)
        bounds += largest
        rows = (self._row_of, self._narrow, self._wide_planes, self._wide)
        if (bounds > SUM_MAX).any() and not (
            (largest <= SUM_MAX).all() and kernels.samples_fit(diff.samples, sign, places, *rows, SUM_MAX)
        ):
            raise BadInputError("evidence_overflow", f"sums are at most {SUM_MAX}; one would be more")
        # Early, else every further diff would examine all sums again.
        self._widen(np.nonzero((bounds > NARROW_MAX // 2) & (self._limits == NARROW_MAX))[0])
        return np.minimum(bounds, SUM_MAX, dtype=np.uint64)

    def _widen(self, planes: npt.NDArray[np.int64]) -> None:
        wide = np.empty((len(self._known), len(self._wide_planes) + len(planes)), np.int64)
        wide[:, : len(self._wide_planes)] = self._wide
        wide[:, len(self._wide_planes) :] = self._narrow[:, planes]
        self._wide, self._wide_planes = wide, np.append(self._wide_planes, planes)
        self._limits[planes] = SUM_MAX


def _largest(sums: Sums | npt.NDArray[np.int32]) -> Magnitudes:
    """(P,) the largest magnitude in each plane; 0 if there are no rows."""
    largest = np.zeros((8, sums.shape[1]), np.uint64)
    if sums.size:
        kernels.largest_sums_into(sums.astype(np.int64, copy=False), largest.reshape(-1))
    highest: Magnitudes = largest.max(axis=0)
    return highest
