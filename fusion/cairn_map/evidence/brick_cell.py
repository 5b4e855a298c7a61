"""Sums of one cell in the form to which evidence is added: counts in bricks, samples in rows.

`merge` and `unmerge` are exact inverses, in any order, because both are integer addition. Both check first and change
nothing when a sum would leave its range. `packed` gives the canonical form back.

A `copy` costs nothing until one of the two is changed: they share their arrays, and the one that adds copies them
first.

A cell with `odds` is a reading of evidence by epoch (`reading_cell`): it is read as sums are, and nothing is added to
it. As its rows change, `revise` brings it up to date.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from cairn_map.arrays import Floats, Words32
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_counts import BrickCounts
from cairn_map.evidence.brick_odds import BrickOdds, odds_of_steps, steps_of_odds
from cairn_map.evidence.evidence import Evidence, check_fits
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, known
from cairn_map.evidence.sample_rows import SampleRows


class BrickCell:
    """Sums of evidence over one cell, or a reading of them; not thread-safe."""

    __slots__ = ("_counts", "_geometry", "_is_shared", "_odds", "_samples")

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._odds: BrickOdds | None = None
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
        copied._odds = self._odds
        self._is_shared = copied._is_shared = True
        return copied

    def zeros(self) -> "BrickCell":
        """A cell of the same bricks, all sums zero, in hardly any memory; to be read only."""
        empty = BrickCell(self._geometry)
        empty._counts = self._counts.zeros()
        return empty

    def packed(self) -> Evidence:
        """The canonical packed evidence: rising Morton order, no zeros; of a reading with its log-odds."""
        sampled_voxels, samples = self._samples.packed()
        voxels, counts, sampled = self._counts.packed(sampled_voxels)
        if self._odds is None:
            return Evidence(voxels, counts, sampled, samples)
        bricks, places = self._counts.brick_of[voxels >> np.uint32(9)], voxels & np.uint32(511)
        odds = odds_of_steps(self._odds.steps[bricks, places], self._odds.model)
        return Evidence(voxels, counts, sampled, samples, np.where(known(counts), odds, 0.0))

    def of_voxels(self, voxels: Words32) -> Evidence:
        """Sums of some voxels, rising, also of those that have none; of a reading without its log-odds."""
        sampled, samples = self._samples.of_voxels(voxels)
        return Evidence(voxels, self._counts.of_voxels(voxels), sampled.astype(np.uint32), samples)

    def log_odds(self, model: SensorModel) -> Floats:
        """(B, 512) clamped log-odds of the bricks' voxels; of any value where a voxel is unknown.

        Raises:
            ValueError: the cell is a reading under another sensor model.
        """
        if self._odds is None:
            return model.log_odds(self._counts.pool.reshape(-1, 2)).reshape(-1, 512)
        self._odds.check_model(model)
        return self._odds.values()

    def revise(self, change: Evidence) -> None:
        """Bring a reading up to date.

        Args:
            change: the voxels that read otherwise: by how much their counts and their samples are more than before,
                and in `odds` their log-odds from here on.

        Raises:
            BadInputError: kind `bad_evidence`: this is no reading, or the change is of another geometry;
                `evidence_overflow`: a sum would leave its range. Nothing was changed.
        """
        if self._odds is None or change.odds is None:
            raise BadInputError("bad_evidence", "only a reading is revised, by log-odds")
        self._sum(replace(change, odds=None), 1)
        self._odds.grow(len(self._counts.pool))
        bricks, places = self._counts.brick_of[change.voxels >> np.uint32(9)], change.voxels & np.uint32(511)
        self._odds.steps[bricks, places] = steps_of_odds(change.odds, self._odds.model)

    @property
    def counts(self) -> BrickCounts:
        """Hits and misses, to be read."""
        return self._counts

    @property
    def samples(self) -> SampleRows:
        """Sums of samples, to be read."""
        return self._samples

    @property
    def odds(self) -> BrickOdds | None:
        """Log-odds of a reading, to be read; None: they follow from the counts."""
        return self._odds

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return self._counts.size_bytes + self._samples.size_bytes + (self._odds.steps.nbytes if self._odds else 0)

    def _add(self, diff: Evidence, sign: int) -> None:
        if self._odds is not None:
            raise BadInputError("bad_evidence", "evidence is added to sums, not to a reading of them")
        self._sum(diff, sign)

    def _sum(self, diff: Evidence, sign: int) -> None:
        check_fits(diff, self._geometry)
        diff = _in_rows(diff)
        if self._is_shared:
            self._counts, self._samples, self._is_shared = self._counts.copy(), self._samples.copy(), False
            self._odds = self._odds.copy() if self._odds else None
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


def reading_cell(geometry: Geometry, reading: Evidence, model: SensorModel) -> BrickCell:
    """A cell that holds a reading, its log-odds in steps of 0.001; each voxel's state is exactly that of the reading.

    Args:
        geometry: the map's.
        reading: evidence with `odds`.
        model: sensor model under which it was read.

    Raises:
        BadInputError: kind `bad_evidence`: sums, or of another geometry; `evidence_overflow`.
    """
    cell = BrickCell(geometry)
    cell._odds = BrickOdds(model, 0)
    cell.revise(reading)
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
