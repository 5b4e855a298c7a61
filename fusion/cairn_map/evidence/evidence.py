"""Packed evidence of one cell: sorted rows without zeros. The form that is stored, sent and compared.

    voxels   (V,)   uint32  Morton codes inside the cell, rising
    counts   (V, 2) int32   hits, misses
    sampled  (S,)   uint32  rows of `voxels` that have samples, rising
    samples  (S, P) int64   sums, in the order of `Geometry.channels` and their planes
    odds     (V,)   float64 log-odds, if it is a reading of evidence by epoch; None: they follow from the counts
    measured_s  (S, C)  float64 when each channel's samples were measured, if it is a reading that says so

Packed evidence is canonical: a voxel is there if and only if one of its numbers is not zero. Evidence
that robots make is never negative; only the difference between two states of a map may be.
`brick_cell.BrickCell` is the form that adds quickly. A reading is read as sums are, but never added.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import planes_and_squares
from cairn_map.evidence.evidence_kernels import bounds_of_counts, largest_into, sums_without_weight
from cairn_map.evidence.grid import BRICK_DEPTH, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, known, log_odds

Rows = slice | npt.NDArray[np.integer] | npt.NDArray[np.bool_]
EVERY_ROW = slice(None)
COUNT_MAX = (1 << 31) - 1
SUM_MAX = 1 << 62


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Packed evidence of one cell; equal if all arrays are."""

    voxels: npt.NDArray[np.uint32]
    counts: npt.NDArray[np.int32]
    sampled: npt.NDArray[np.uint32]
    samples: npt.NDArray[np.int64]
    odds: Floats | None = None
    """(V,) log-odds clamped from epoch to epoch under one sensor model (rule R1), 0 where unknown; None: of sums."""
    measured_s: Floats | None = None
    """(S, C) first instant of the newest epoch of each channel's samples (rule R4), UTC seconds since 1970; NaN where
    there are none, or none with a time; None: of sums, and of readings whose times were not asked for."""

    def __post_init__(self) -> None:
        V, S = self.voxels.shape[:1], self.sampled.shape[:1]
        arrays = (self.voxels, self.counts, self.sampled, self.samples)
        dtypes = [array.dtype for array in arrays]
        shapes_fit = self.counts.shape == (*V, 2) and self.samples.shape[:-1] == S and len(V) == len(S) == 1
        if not shapes_fit or dtypes != [np.uint32, np.int32, np.uint32, np.int64]:
            raise BadInputError("bad_evidence", f"arrays do not fit: {[(a.dtype.name, a.shape) for a in arrays]}")
        if self.odds is not None and (self.odds.shape != V or self.odds.dtype != np.float64):
            raise BadInputError("bad_evidence", f"odds must be float64 {V}, got {self.odds.dtype} {self.odds.shape}")
        if self.measured_s is not None and self.measured_s.shape[:-1] != S:
            raise BadInputError("bad_evidence", f"measured_s must be {S} by channels, got {self.measured_s.shape}")

    def __hash__(self) -> int:
        return hash((len(self.voxels), len(self.sampled)))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Evidence)
            and np.array_equal(self.voxels, other.voxels)
            and np.array_equal(self.counts, other.counts)
            and np.array_equal(self.sampled, other.sampled)
            and np.array_equal(self.samples, other.samples)
            and (self.odds is None) == (other.odds is None)
            and (self.odds is None or other.odds is None or np.array_equal(self.odds, other.odds))
        )

    def __len__(self) -> int:
        return len(self.voxels)

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        optional = sum(array.nbytes for array in (self.odds, self.measured_s) if array is not None)
        return self.voxels.nbytes + self.counts.nbytes + self.sampled.nbytes + self.samples.nbytes + optional

    @property
    def brick_count(self) -> int:
        """Number of bricks of 8^3 voxels that it touches."""
        bricks = self.voxels >> np.uint32(3 * BRICK_DEPTH)
        return int(np.count_nonzero(bricks[1:] != bricks[:-1])) + min(1, len(bricks))

    @property
    def is_signed(self) -> bool:
        """True if any number is negative, which happens only in differences."""
        return bool((self.counts < 0).any() or (self.samples < 0).any())

    def log_odds(self, model: SensorModel, *, rows: Rows = EVERY_ROW) -> Floats:
        """(N,) clamped log-odds of the voxels in these rows; 0 for unknown ones too.

        A reading has log-odds of its own, under the model that it was made with, which `model` must be.
        """
        return model.log_odds(self.counts[rows]) if self.odds is None else self.odds[rows]

    def probability(self, model: SensorModel, *, rows: Rows = EVERY_ROW) -> Floats:
        """(N,) probability of occupancy of the voxels in these rows; NaN where unknown."""
        p = 1 / (1 + np.exp(-self.log_odds(model, rows=rows)))
        return np.where(known(self.counts[rows]), p, np.nan)

    def occupied(self, model: SensorModel) -> npt.NDArray[np.bool_]:
        """(V,) True where the probability is above `p_occupied`; False for unknown voxels."""
        return known(self.counts) & (self.log_odds(model) > log_odds(model.p_occupied))

    def where(self, keep: npt.NDArray[np.bool_]) -> "Evidence":
        """Packed evidence of the voxels where (V,) `keep` is True."""
        kept = keep[self.sampled]
        new_row = np.cumsum(keep, dtype=np.int64) - 1
        return Evidence(
            self.voxels[keep],
            self.counts[keep],
            new_row[self.sampled[kept]].astype(np.uint32),
            self.samples[kept],
            None if self.odds is None else self.odds[keep],
            None if self.measured_s is None else self.measured_s[kept],
        )


def empty_evidence(geometry: Geometry) -> Evidence:
    """No evidence at all: the zero of addition."""
    return Evidence(
        np.empty(0, np.uint32),
        np.empty((0, 2), np.int32),
        np.empty(0, np.uint32),
        np.empty((0, geometry.plane_count), np.int64),
    )


def packed_evidence(
    places: npt.NDArray[np.uint32],
    counts: npt.NDArray[np.integer],
    samples: npt.NDArray[np.integer],
    geometry: Geometry,
) -> Evidence:
    """Evidence from one row per voxel in any order, zeros included.

    Args:
        places: (N,) Morton codes inside the cell, all different.
        counts: (N, 2) hits and misses.
        samples: (N, P) sums; rows of zeros mean "no sample".
        geometry: of the map.

    Raises:
        BadInputError: wrong shapes, a place outside the cell or twice, a number outside its type.
    """
    N = len(places)
    if counts.shape != (N, 2) or samples.shape != (N, geometry.plane_count):
        raise BadInputError(
            "bad_evidence",
            f"expected counts ({N}, 2), samples ({N}, {geometry.plane_count}); got {counts.shape}, {samples.shape}",
        )
    order = np.argsort(places, kind="stable")
    voxels, counts, samples = places[order], counts[order], samples[order]
    if N and (int(voxels[0]) < 0 or int(voxels[-1]) >= 8**geometry.depth or (voxels[1:] == voxels[:-1]).any()):
        raise BadInputError("bad_evidence", "places must be different Morton codes inside the cell")
    # Not np.abs: the magnitude of the least integer is itself, and negative.
    if any((array > top).any() or (array < -top).any() for array, top in ((counts, COUNT_MAX), (samples, SUM_MAX))):
        raise BadInputError("evidence_overflow", f"counts are at most {COUNT_MAX}, sums at most {SUM_MAX}")
    has_samples = (samples != 0).any(axis=1)
    keep = has_samples | (counts != 0).any(axis=1)
    return Evidence(
        np.ascontiguousarray(voxels[keep], dtype=np.uint32),
        np.ascontiguousarray(counts[keep], dtype=np.int32),
        np.nonzero(has_samples[keep])[0].astype(np.uint32),
        np.ascontiguousarray(samples[has_samples], dtype=np.int64),
    )


def largest(counts: npt.NDArray[np.int32], samples: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(2 + P,) largest number of each plane, all numbers at least 0; the server adds these up to exclude overflow."""
    tops = np.zeros(2 + samples.shape[1], np.int64)
    tops[:2] = bounds_of_counts(counts)[1:3]
    largest_into(samples, tops[2:])
    return tops


def check_fits(evidence: Evidence, geometry: Geometry) -> None:
    """Refuse what is no packed sum of a geometry: kernels check nothing, and would write out of bounds.

    Raises:
        BadInputError: kind `bad_evidence`: voxels or sampled rows that do not rise, a voxel outside the cell, a sampled
            row that is not there, other planes, or a reading.
    """
    if evidence.odds is not None:
        raise BadInputError(
            "bad_evidence", "expected sums of evidence, got a reading, which cannot be added or encoded"
        )
    unsorted = not (_rise(evidence.voxels) and _rise(evidence.sampled))
    outside = len(evidence) > 0 and int(evidence.voxels[-1]) >= 8**geometry.depth
    missing = len(evidence.sampled) > 0 and int(evidence.sampled[-1]) >= len(evidence)
    planes = evidence.samples.shape[1]
    if unsorted or outside or missing or planes != geometry.plane_count:
        raise BadInputError(
            "bad_evidence",
            f"evidence does not fit a cell of depth {geometry.depth} with {geometry.plane_count} planes; "
            f"it has {planes} planes, unsorted rows: {unsorted}, voxels outside: {outside}, "
            f"samples without voxel: {missing}",
        )


def _rise(numbers: npt.NDArray[np.uint32]) -> bool:
    return bool((numbers[1:] > numbers[:-1]).all())


def every_sum_has_weight(samples: npt.NDArray[np.int64], geometry: Geometry) -> bool:
    """True if each channel's sums come with a weight, as those of real samples do; means divide by it."""
    return not sums_without_weight(samples, planes_and_squares(geometry.channels))
