"""The evidence of one cell, packed: sorted rows, nothing that is zero. The form that is stored, sent and compared.

    voxels   (V,)   uint32  Morton codes inside the cell, rising
    counts   (V, 2) int32   hits, misses
    sampled  (S,)   uint32  rows of `voxels` that have samples, rising
    samples  (S, P) int64   sums, in the order of `Geometry.channels` and their planes

Packed evidence is canonical: a voxel is there if and only if one of its numbers is not zero. Evidence
that robots make is never negative; only the difference between two states of a map may be.
`brick_cell.BrickCell` is the form that adds quickly.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError
from cairn_map.grid import Geometry

COUNT_MAX = (1 << 31) - 1
SUM_MAX = 1 << 62


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Packed evidence of one cell; equal if all four arrays are."""

    voxels: npt.NDArray[np.uint32]
    counts: npt.NDArray[np.int32]
    sampled: npt.NDArray[np.uint32]
    samples: npt.NDArray[np.int64]

    def __hash__(self) -> int:
        return hash((len(self.voxels), len(self.sampled)))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Evidence)
            and np.array_equal(self.voxels, other.voxels)
            and np.array_equal(self.counts, other.counts)
            and np.array_equal(self.sampled, other.sampled)
            and np.array_equal(self.samples, other.samples)
        )

    def __len__(self) -> int:
        return len(self.voxels)

    @property
    def is_signed(self) -> bool:
        """Whether any number is negative: true only of differences."""
        return bool((self.counts < 0).any() or (self.samples < 0).any())


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
    if N and (int(voxels[-1]) >= 8**geometry.depth or (voxels[1:] == voxels[:-1]).any()):
        raise BadInputError("bad_evidence", "places must be different Morton codes inside the cell")
    if (np.abs(counts) > COUNT_MAX).any() or (np.abs(samples) > SUM_MAX).any():
        raise BadInputError("evidence_overflow", f"counts are at most {COUNT_MAX}, sums at most {SUM_MAX}")
    has_samples = (samples != 0).any(axis=1)
    keep = has_samples | (counts != 0).any(axis=1)
    return Evidence(
        np.ascontiguousarray(voxels[keep], dtype=np.uint32),
        np.ascontiguousarray(counts[keep], dtype=np.int32),
        np.nonzero(has_samples[keep])[0].astype(np.uint32),
        np.ascontiguousarray(samples[has_samples], dtype=np.int64),
    )


def largest(evidence: Evidence, geometry: Geometry) -> npt.NDArray[np.int64]:
    """(2 + P,) largest number of each plane; the server sums these to refuse what could overflow."""
    tops = np.zeros(2 + geometry.plane_count, np.int64)
    if len(evidence.voxels):
        tops[:2] = evidence.counts.max(axis=0)
    if len(evidence.sampled):
        tops[2:] = evidence.samples.max(axis=0)
    return tops
