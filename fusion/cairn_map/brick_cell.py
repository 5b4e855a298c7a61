"""A cell that evidence can be added to: bricks of 8^3 voxels under a dense index.

    brick_of [Morton number of a brick] -> b      counts   [b, 512, 2]      hits, misses
    table_of [b] -> t                             row_of   [t, 512] -> row  only bricks with samples
                                                  samples  [row, P]         sums

`merge` and `unmerge` are exact inverses, in any order, because all of it is integer addition. Both check
first and change nothing when a sum would leave its range. `packed` gives the canonical form back.
"""

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_map import brick_kernels as kernels
from cairn_map.errors import BadInputError
from cairn_map.evidence import COUNT_MAX, SUM_MAX, Evidence, check_fits
from cairn_map.grid import BRICK_DEPTH, Geometry

Scalar = TypeVar("Scalar", bound=np.generic)


class BrickCell:
    """Sums of evidence over one cell; not thread-safe."""

    __slots__ = ("_brick_of", "_bricks", "_counts", "_geometry", "_row_of", "_rows", "_samples", "_table_of", "_tables")

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._brick_of = np.full(8 ** (geometry.depth - BRICK_DEPTH), -1, np.int32)
        self._counts = np.zeros((0, 512, 2), np.int32)
        self._table_of = np.empty(0, np.int32)
        self._row_of = np.empty((0, 512), np.int32)
        self._samples = np.zeros((0, geometry.plane_count), np.int64)
        self._bricks = self._tables = self._rows = 0

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

    def packed(self) -> Evidence:
        """The canonical packed evidence: rising Morton order, no zeros."""
        bricks = np.nonzero(self._brick_of >= 0)[0].astype(np.int32)
        arrays = (bricks, self._brick_of, self._counts, self._table_of, self._row_of, self._samples)
        V, S = kernels.count_rows(*arrays)
        out = Evidence(
            np.empty(V, np.uint32),
            np.empty((V, 2), np.int32),
            np.empty(S, np.uint32),
            np.empty((S, self._geometry.plane_count), np.int64),
        )
        kernels.pack_rows_into(*arrays, out.voxels, out.counts, out.sampled, out.samples)
        return out

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        arrays = (self._brick_of, self._counts, self._table_of, self._row_of, self._samples)
        return sum(array.nbytes for array in arrays)

    def _add(self, diff: Evidence, sign: int) -> None:
        check_fits(diff, self._geometry)
        # Negative sums are legal on the way (a delta may come before what it takes away); the caller that holds a
        # finished state checks it by fingerprint.
        if not kernels.counts_fit(
            diff.voxels, diff.counts, sign, self._brick_of, self._counts, -COUNT_MAX, COUNT_MAX
        ) or not kernels.samples_fit(
            diff.voxels,
            diff.sampled,
            diff.samples,
            sign,
            self._brick_of,
            self._table_of,
            self._row_of,
            self._samples,
            -SUM_MAX,
            SUM_MAX,
        ):
            raise BadInputError("evidence_overflow", "a sum of evidence would leave its range")
        self._allocate(diff)
        kernels.add_counts_into(diff.voxels, diff.counts, sign, self._brick_of, self._counts)
        kernels.add_samples_into(
            diff.voxels,
            diff.sampled,
            diff.samples,
            sign,
            self._brick_of,
            self._table_of,
            self._row_of,
            self._samples,
        )

    def _allocate(self, diff: Evidence) -> None:
        bricks = self._bricks + kernels.count_new_bricks(diff.voxels, self._brick_of)
        self._counts = _grown(self._counts, bricks, fill=0)
        self._table_of = _grown(self._table_of, bricks, fill=-1)
        self._bricks = kernels.allocate_bricks_into(diff.voxels, self._brick_of, self._bricks)
        sampled_bricks = len(np.unique(diff.voxels[diff.sampled] >> np.uint32(9)))
        self._row_of = _grown(self._row_of, self._tables + sampled_bricks, fill=-1)
        self._tables, self._rows = kernels.allocate_rows_into(
            diff.voxels, diff.sampled, self._brick_of, self._table_of, self._row_of, self._tables, self._rows
        )
        self._samples = _grown(self._samples, self._rows, fill=0)


def brick_cell(geometry: Geometry, diffs: Iterable[Evidence] = ()) -> BrickCell:
    """A cell that holds the sum of some diffs."""
    cell = BrickCell(geometry)
    for diff in diffs:
        cell.merge(diff)
    return cell


def sum_evidence(diffs: Iterable[Evidence], geometry: Geometry) -> Evidence:
    """Packed sum of diffs of one cell, in any order the same."""
    return brick_cell(geometry, diffs).packed()


def difference(new: Evidence, old: Evidence, geometry: Geometry) -> Evidence:
    """Packed `new - old` of one cell; may be signed."""
    cell = brick_cell(geometry, [new])
    cell.unmerge(old)
    return cell.packed()


def _grown(array: npt.NDArray[Scalar], needed: int, *, fill: int) -> npt.NDArray[Scalar]:
    """The array with room for `needed` entries; grows by half, so that n additions copy O(n) bytes."""
    if needed <= len(array):
        return array
    grown = np.full((max(needed, len(array) + len(array) // 2, 16), *array.shape[1:]), fill, array.dtype)
    grown[: len(array)] = array
    return grown
