"""Sums of one cell in the form to which evidence is added: counts in bricks, samples in rows.

`merge` and `unmerge` are exact inverses, in any order, because both are integer addition. Both check first and change
nothing when a sum would leave its range. `packed` gives the canonical form back.

A `copy` costs nothing until one of the two is changed: they share their arrays, and the one that adds copies them
first.
"""

from collections.abc import Iterable

import numpy as np

from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_counts import BrickCounts
from cairn_map.evidence.evidence import Evidence, check_fits
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.sample_rows import SampleRows


class BrickCell:
    """Sums of evidence over one cell; not thread-safe."""

    __slots__ = ("_counts", "_geometry", "_is_shared", "_samples")

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._counts = BrickCounts(geometry.depth)
        self._samples = SampleRows(geometry.plane_count)
        self._is_shared = False

    def merge(self, diff: Evidence) -> None:
        """Add a diff.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range, or `bad_evidence`: it is of another
                geometry; nothing was changed.
        """
        self._add(diff, 1)

    def unmerge(self, diff: Evidence) -> None:
        """Take a diff out again; after it, the cell is what it was before `merge(diff)`.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range, or `bad_evidence`: it is of another
                geometry; nothing was changed.
        """
        self._add(diff, -1)

    def copy(self) -> "BrickCell":
        """The same sums; the first of the two cells that changes copies the arrays."""
        copied = BrickCell.__new__(BrickCell)
        copied._geometry, copied._counts, copied._samples = self._geometry, self._counts, self._samples
        self._is_shared = copied._is_shared = True
        return copied

    def zeros(self) -> "BrickCell":
        """A cell of the same bricks, all sums zero, in hardly any memory; to be read only."""
        empty = BrickCell(self._geometry)
        empty._counts = self._counts.zeros()
        return empty

    def packed(self) -> Evidence:
        """The canonical packed evidence: rising Morton order, no zeros."""
        sampled_voxels, samples = self._samples.packed()
        voxels, counts, sampled = self._counts.packed(sampled_voxels)
        return Evidence(voxels, counts, sampled, samples)

    @property
    def counts(self) -> BrickCounts:
        """Hits and misses, to be read."""
        return self._counts

    @property
    def samples(self) -> SampleRows:
        """Sums of samples, to be read."""
        return self._samples

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return self._counts.size_bytes + self._samples.size_bytes

    def _add(self, diff: Evidence, sign: int) -> None:
        check_fits(diff, self._geometry)
        diff = _in_rows(diff)
        if self._is_shared:
            self._counts, self._samples, self._is_shared = self._counts.copy(), self._samples.copy(), False
        # Negative sums are legal for a while (a delta may arrive before the evidence that it takes away); a caller that
        # holds a finished state checks it by fingerprint.
        self._samples.add(diff, sign)
        try:
            self._counts.add(diff.voxels, diff.counts, sign)
        except BadInputError:
            self._samples.add(diff, -sign)
            raise


def brick_cell(geometry: Geometry, diffs: Iterable[Evidence] = ()) -> BrickCell:
    """A cell that holds the sum of some diffs."""
    cell = BrickCell(geometry)
    for diff in diffs:
        cell.merge(diff)
    return cell


def sum_evidence(diffs: Iterable[Evidence], geometry: Geometry) -> Evidence:
    """Packed sum of diffs of one cell; their order does not matter."""
    return brick_cell(geometry, diffs).packed()


def difference(new: Evidence, old: Evidence, geometry: Geometry) -> Evidence:
    """Packed `new - old` of one cell; may be signed."""
    cell = brick_cell(geometry, [new])
    cell.unmerge(old)
    return cell.packed()


def _in_rows(evidence: Evidence) -> Evidence:
    """The same evidence, its arrays in one piece and row by row, as kernels read them."""
    arrays = (evidence.voxels, evidence.counts, evidence.sampled, evidence.samples)
    if all(array.flags.c_contiguous for array in arrays):
        return evidence
    voxels, counts, sampled, samples = arrays
    return Evidence(
        np.ascontiguousarray(voxels),
        np.ascontiguousarray(counts),
        np.ascontiguousarray(sampled),
        np.ascontiguousarray(samples),
    )
