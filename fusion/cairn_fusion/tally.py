"""A measurement's evidence while it grows: bricks of 8^3 voxels around the head, counted scan by scan.

    brick_of [brick of the box] -> slot       misses   [slot, 512]     every brick that was seen
    table_of [slot] -> table                  hits     [table, 512]    only bricks with hits
                                              row_of   [table, 512] -> row of samples

The box is as large as the sensor reaches from where the first scan was taken, and a little more: the head moves. A scan
that does not fit goes into a new tally. Counts are 16 bits: a measurement has at most 4096 scans, and a scan counts a
voxel once.
"""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_fusion import tally_kernels as kernels
from cairn_fusion.carve import Carving
from cairn_fusion.carve_kernels import carve_into
from cairn_map.errors import BadInputError
from cairn_map.evidence import Evidence
from cairn_map.grid import BRICK_DEPTH, CELL_LIMIT, CellKey, Geometry, voxels_of_points
from cairn_map.morton_kernels import interleave

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Index = npt.NDArray[np.int32]
Counts = npt.NDArray[np.uint16]
Scalar = TypeVar("Scalar", bound=np.generic)

MOVE_M = 1.0
"""How far the head may move within a tally."""
BOX_BRICKS = 1 << 24
"""64 MB of index: 20 m across at 1 cm."""
BOX_BRICKS_MAX = 1 << 27
"""512 MB of index: 40 m at 1 cm."""
ROOM_MIN = 4096
"""Entries of a first array; what is not written costs no memory."""


class Tally:
    """Counts and sums of some scans; not thread-safe."""

    def __init__(self, geometry: Geometry, centre_m: Floats, *, reach_m: float) -> None:
        self.geometry = geometry
        self._centre_m = centre_m
        self._reach_m = reach_m
        low, high = voxels_of_points(np.stack([centre_m - reach_m, centre_m + reach_m]), geometry) >> BRICK_DEPTH
        self.corner: Ints = low << BRICK_DEPTH
        """(3,) the box's first voxel."""
        self.dims: Ints = high - low + 1
        """(3,) bricks of the box."""
        self._brick_of = np.full(int(np.prod(self.dims)), -1, np.int32)
        self._bricks: Index = np.empty(0, np.int32)
        self._misses: Counts = np.empty((0, 512), np.uint16)
        self._table_of: Index = np.empty(0, np.int32)
        self._hits: Counts = np.empty((0, 512), np.uint16)
        self._row_of: Index = np.empty((0, 512), np.int32)
        self._local_of: Index = np.empty((0, 512), np.int32)
        self._samples: Ints = np.empty((0, geometry.plane_count), np.int64)
        self._used = self._tables = self._rows = 0
        self._touched: Ints = np.empty(0, np.int64)

    def holds(self, origin_m: Floats, farthest_m: float) -> bool:
        """Whether a scan from there, which reaches so far, fits."""
        return float(np.abs(origin_m - self._centre_m).max()) + farthest_m <= self._reach_m

    def number_hits(self, points_m: Floats) -> tuple[Index, int]:
        """Number the different voxels that a scan's (N, 3) points hit: (N,) each point's, and how many there are."""
        voxels = kernels.hit_voxels(points_m, self.geometry.voxel_edge_um * 1000, self.corner, self.dims)
        if (voxels < 0).any():
            raise BadInputError("scan_too_large", "a point lies outside the tally's box")
        self._claim(voxels, 9)
        tables = self._tables + min(len(voxels), self._used - self._tables)
        self._hits = _grown(self._hits, tables, self._tables)
        self._row_of = _grown(self._row_of, tables, self._tables)
        self._local_of = _grown(self._local_of, tables, self._tables)
        used = kernels.claim_tables_into(voxels, self._brick_of, self._table_of, self._tables)
        self._hits[self._tables : used] = 0
        self._row_of[self._tables : used] = -1
        self._local_of[self._tables : used] = -1
        self._tables = used
        touched = np.empty(len(voxels), np.int64)
        numbers, count = kernels.number_hits_into(voxels, self._brick_of, self._table_of, self._local_of, touched)
        self._touched = touched[:count]
        return numbers, count

    def add_hits(self, sums: Ints) -> None:
        """Count a hit, and add a row of (U, P) sums, for each voxel that `number_hits` numbered."""
        touched = self._touched
        self._samples = _grown(self._samples, self._rows + len(touched), self._rows)
        self._rows = kernels.add_hits_into(self._hits, self._row_of, self._samples, touched, sums, self._rows)

    def add_misses(self, carving: Carving) -> None:
        """Count a miss in what a view looks through, but not where the present scan hit."""
        self._claim(carving.bricks.astype(np.int64), 0)
        carve_into(
            self._misses,
            self._brick_of[carving.bricks],
            carving.kinds,
            carving.corners_view,
            carving.offsets_view,
            carving.squares,
            carving.lens,
            carving.min_square,
            self._table_of,
            self._local_of,
        )

    def end_scan(self) -> None:
        """Forget which voxels the present scan hit."""
        kernels.forget_hits_into(self._local_of, self._touched)
        self._touched = self._touched[:0]

    def absorb(self, other: "Tally") -> None:
        """Add all of another tally of the same box."""
        self._claim(other._bricks[: other._used].astype(np.int64), 0)
        self._hits = _grown(self._hits, self._tables + other._tables, self._tables)
        self._row_of = _grown(self._row_of, self._tables + other._tables, self._tables)
        self._local_of = _grown(self._local_of, self._tables + other._tables, self._tables)
        self._local_of[self._tables : self._tables + other._tables] = -1
        self._samples = _grown(self._samples, self._rows + other._rows, self._rows)
        self._tables, self._rows = kernels.absorb_into(
            self._brick_of[other._bricks[: other._used]],
            self._misses,
            self._table_of,
            self._hits,
            self._row_of,
            self._samples,
            self._tables,
            self._rows,
            other._misses,
            other._table_of,
            other._hits,
            other._row_of,
            other._samples,
        )

    def packed(self) -> dict[CellKey, Evidence]:
        """Packed evidence of all cells that hold any, rising in number."""
        bricks = self._bricks[: self._used].astype(np.int64)
        dims = self.dims
        xyz = np.stack([bricks % dims[0], bricks // dims[0] % dims[1], bricks // (dims[0] * dims[1])], axis=1)
        xyz += self.corner >> BRICK_DEPTH
        up = self.geometry.depth - BRICK_DEPTH
        cells = interleave((xyz >> up) + CELL_LIMIT)
        numbers = interleave(xyz & ((1 << up) - 1)).astype(np.int32)
        order = np.lexsort((numbers, cells))
        keys, starts = np.unique(cells[order], return_index=True)
        packed = {
            CellKey(int(key)): self._evidence(part.astype(np.int32), numbers[part])
            for key, part in zip(keys, np.split(order, starts[1:]), strict=True)
        }
        return {key: evidence for key, evidence in packed.items() if len(evidence)}

    def _evidence(self, slots: Index, numbers: Index) -> Evidence:
        V, S = kernels.count_known(slots, self._misses, self._table_of, self._hits)
        voxels, counts = np.empty(V, np.uint32), np.empty((V, 2), np.int32)
        sampled, samples = np.empty(S, np.uint32), np.empty((S, self.geometry.plane_count), np.int64)
        rows = kernels.pack_known_into(
            *(slots, numbers, self._misses, self._table_of, self._hits, self._row_of, self._samples),
            *(voxels, counts, sampled, samples),
        )
        return Evidence(voxels, counts, sampled[:rows].copy(), samples[:rows].copy())

    def _claim(self, numbers: Ints, shift: int) -> None:
        """Make sure that bricks have places in the pool."""
        room = self._used + min(len(numbers), len(self._brick_of) - self._used)
        self._bricks = _grown(self._bricks, room, self._used)
        used = kernels.claim_bricks_into(numbers, shift, self._brick_of, self._bricks, self._used)
        self._misses = _grown(self._misses, used, self._used)
        self._table_of = _grown(self._table_of, used, self._used)
        self._misses[self._used : used] = 0
        self._table_of[self._used : used] = -1
        self._used = used


def same_box(one: Tally, other: Tally) -> bool:
    """Whether one can absorb the other."""
    return bool(np.array_equal(one.corner, other.corner) and np.array_equal(one.dims, other.dims))


def tally_around(origin_m: Floats, farthest_m: float, geometry: Geometry, *, max_range_m: float) -> Tally:
    """A tally for a scan from there that reaches so far, and for those that follow if memory allows.

    Raises:
        BadInputError: the scan alone spans more bricks than fit in memory; limit the range or coarsen the map.
    """
    brick_m = 8 * geometry.voxel_edge_m
    for reach_m, bricks_max in ((max_range_m + MOVE_M, BOX_BRICKS), (1.01 * farthest_m + brick_m, BOX_BRICKS_MAX)):
        if (2 * reach_m / brick_m + 2) ** 3 <= bricks_max:
            return Tally(geometry, origin_m, reach_m=reach_m)
    raise BadInputError(
        "scan_too_large",
        f"one scan reaches {farthest_m:.1f} m, too far at {geometry.voxel_edge_m} m voxels; "
        "limit its range or use a coarser map",
    )


def _grown(array: npt.NDArray[Scalar], needed: int, used: int) -> npt.NDArray[Scalar]:
    """The array with room for `needed` entries, of which `used` are kept; doubles, so that copies stay few."""
    if needed <= len(array):
        return array
    grown = np.empty((max(needed, 2 * len(array), ROOM_MIN), *array.shape[1:]), array.dtype)
    grown[:used] = array[:used]
    return grown
