"""Tallies of a measurement's evidence: dense bricks of 8^3 voxels around the head, counted scan by scan.

    slot_of  [brick of the box] -> slot       misses   [slot, 512]     every brick that was seen
    table_of [brick of the box] -> table      row_of   [table, 512] -> row of hits and samples, only bricks with hits

Hits and misses share nothing, so that one thread can add a scan's hits while another adds another scan's misses.
The box is as large as the sensor reaches from the place of the first scan, and a little more: the head moves. A scan
that does not fit goes into a new tally (`TallyPool`). Counts are 16 bits: a measurement has at most 4096 scans, and a
scan counts a voxel once. All sums are integers, so the evidence does not depend on which thread counts which scan.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from threading import Lock
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from cairn_fusion.mapping import brick_tally_kernels as kernels
from cairn_fusion.mapping.carve_kernels import carve_into
from cairn_fusion.mapping.free_space import Carving, Scratch
from cairn_map.arrays import Counts, Floats, Int32s, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import BRICK_DEPTH, CELL_LIMIT, CellKey, Geometry, voxels_of_points
from cairn_map.kernels.morton_kernels import interleave

Diff = dict[CellKey, Evidence]

Scalar = TypeVar("Scalar", bound=np.generic)
Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]

MOVE_M = 1.0
"""Movement of the head within one tally, metres."""
BOX_BRICKS = 1 << 24
"""64 MB of index: 20 m across at 1 cm."""
BOX_BRICKS_MAX = 1 << 27
"""512 MB of index: 40 m at 1 cm."""
RESERVED = 1 << 26
"""Bytes of a first array: above the 32 MB that glibc may reuse and then clears; untouched pages cost no memory."""


class ScanHits:
    """Voxels that one scan hit, numbered and found by brick; for one thread, and used again for scan after scan."""

    def __init__(self) -> None:
        self._table_of: Int32s = np.empty(0, np.int32)
        self._bricks: Int32s = np.empty(0, np.int32)
        self._struck: Int32s = np.empty((0, 512), np.int32)
        self._used = 0
        self.scratch = Scratch()
        """Memory for the views of the same thread."""
        self.voxels: Ints = np.empty(0, np.int64)
        """(U,) voxels by number: number of the brick in the box times 512, plus place in the brick."""

    def number(self, points_m: Floats, tally: "BrickTally") -> tuple[Int32s, int]:
        """Number the different voxels of a tally's box that (N, 3) points hit: (N,) numbers by point, and their count.

        Raises:
            BadInputError: a point lies outside the box.
        """
        voxels = kernels.hit_voxels(points_m, tally.geometry.voxel_edge_um * 1000, tally.corner, tally.dims)
        if (voxels < 0).any():
            raise BadInputError("scan_too_large", "a point lies outside the tally's box")
        # First the bricks with hits, then a table of numbers for each; both arrays are zeros between scans.
        bricks = int(np.prod(tally.dims))
        self._table_of = _grown(self._table_of, bricks, 0)
        self._bricks = _grown(self._bricks, min(len(voxels), bricks), 0)
        self._used = kernels.claim_into(voxels, 9, self._table_of, self._bricks, 0)
        self._struck = _grown(self._struck, self._used, 0)
        touched = np.empty(len(voxels), np.int64)
        numbers, count = kernels.number_hits_into(voxels, self._table_of, self._struck, touched)
        self.voxels = touched[:count]
        return numbers, count

    def tables_of(self, bricks: Ints) -> tuple[Int32s, Int32s]:
        """(K,) each brick's row of a (T, 512) array that is 0 where no voxel is hit, -1 for none; and that array."""
        return self._table_of[bricks] - np.int32(1), self._struck

    def forget(self) -> None:
        """Make ready for the next scan."""
        kernels.forget_hits_into(self._bricks[: self._used], self._table_of, self._struck, self.voxels)
        self._used, self.voxels = 0, self.voxels[:0]


class BrickTally:
    """Counts and sums of some scans; thread-safe: one thread may add hits while another adds misses."""

    def __init__(self, geometry: Geometry, centre_m: Floats, *, reach_m: float) -> None:
        self.geometry = geometry
        self._centre_m = centre_m
        self._reach_m = reach_m
        low, high = voxels_of_points(np.stack([centre_m - reach_m, centre_m + reach_m]), geometry) >> BRICK_DEPTH
        self.corner: Ints = low << BRICK_DEPTH
        """(3,) the box's first voxel."""
        self.dims: Ints = high - low + 1
        """(3,) bricks of the box."""
        # Two locks, since hits and misses share nothing. Indexes hold places plus one: 0 is none.
        bricks = int(np.prod(self.dims))
        self._misses_lock, self._hits_lock = Lock(), Lock()
        self._slot_of, self._table_of = np.zeros(bricks, np.int32), np.zeros(bricks, np.int32)
        self._seen_bricks: Int32s = np.empty(0, np.int32)
        self._misses: Counts = np.empty((0, 512), np.uint16)
        self._hit_bricks: Int32s = np.empty(0, np.int32)
        self._row_of: Int32s = np.empty((0, 512), np.int32)
        self._sums: Ints = np.empty((0, 1 + geometry.plane_count), np.int64)
        self._slots = self._tables = self._rows = 0

    def holds(self, origin_m: Floats, farthest_m: float) -> bool:
        """True if a scan from this place that reaches so far fits."""
        return float(np.abs(origin_m - self._centre_m).max()) + farthest_m <= self._reach_m

    def add_hits(self, hits: ScanHits, sums: Ints) -> None:
        """Count a hit, and add a row of (U, P) sums, for each voxel that a scan hit."""
        voxels = hits.voxels
        with self._hits_lock:
            # Room for the worst case, then tables for new bricks and rows for new voxels.
            self._hit_bricks = _grown(self._hit_bricks, self._tables + len(voxels), self._tables)
            tables = kernels.claim_into(voxels, 9, self._table_of, self._hit_bricks, self._tables)
            self._row_of = _grown(self._row_of, tables, self._tables)
            rows = np.empty(len(voxels), np.int32)
            used = kernels.claim_rows_into(voxels, self._table_of, self._row_of, rows, self._rows)
            self._sums = _grown(self._sums, used, self._rows)
            self._tables, self._rows = tables, used
            kernels.add_hits_into(self._sums, rows, sums)

    def add_misses(self, hits: ScanHits, carving: Carving) -> None:
        """Count a miss in each voxel that a view looks through, except where the same scan hit."""
        # The scan's own hits need no lock: they belong to this thread.
        tables, struck = hits.tables_of(carving.bricks)
        bricks = carving.bricks
        with self._misses_lock:
            self._seen_bricks = _grown(self._seen_bricks, self._slots + len(bricks), self._slots)
            slots = kernels.claim_into(bricks, 0, self._slot_of, self._seen_bricks, self._slots)
            self._misses = _grown(self._misses, slots, self._slots)
            self._slots = slots
            carve_into(
                self._misses.reshape(-1, 8, 64),
                self._slot_of[bricks] - np.int32(1),
                carving.masks,
                carving.corners_view,
                carving.offsets_view.reshape(3, 8, 64),
                carving.squares,
                carving.lens,
                carving.min_square,
                tables,
                struck.reshape(-1, 8, 64),
            )

    def packed(self, each: Each = map) -> dict[CellKey, Evidence]:
        """Packed evidence of all cells that hold any, rising in number.

        Args:
            each: as `map`, which calls the function for one cell after the other; a pool's may do some in parallel.
        """
        # Stage 1: all bricks with a count, each once, with their coordinates in the map.
        hit = self._hit_bricks[: self._tables]
        bricks = np.concatenate([self._seen_bricks[: self._slots], hit[self._slot_of[hit] == 0]]).astype(np.int64)
        w, h = int(self.dims[0]), int(self.dims[1])
        xyz = np.stack([bricks % w, bricks // w % h, bricks // (w * h)], axis=1) + (self.corner >> BRICK_DEPTH)
        up = self.geometry.depth - BRICK_DEPTH
        # Stage 2: in order of cell and brick. Counted from the box's first cell, both numbers fit one Morton code.
        numbers = interleave(xyz - (self.corner >> self.geometry.depth << up))
        order = np.argsort(numbers)
        xyz, bricks, numbers = xyz[order], bricks[order], numbers[order]
        first = np.flatnonzero(np.diff(numbers >> np.uint64(3 * up), prepend=np.uint64((1 << 64) - 1)))
        keys = [CellKey(int(key)) for key in interleave((xyz[first] >> up) + CELL_LIMIT)]
        inner = (numbers & np.uint64((1 << 3 * up) - 1)).astype(np.int32)
        if not len(keys):
            return {}
        # Stage 3: sizes of all cells' arrays.
        slots, tables = self._slot_of[bricks] - np.int32(1), self._table_of[bricks] - np.int32(1)
        parts = [slice(*ends) for ends in pairwise([*first.tolist(), len(bricks)])]
        counted = [kernels.count_known(slots[part], tables[part], self._misses, self._row_of) for part in parts]
        ends = np.cumsum([(0, 0), *counted], axis=0)
        V, S = ends[-1].tolist()
        # One array for all cells: fresh pages cost more than everything that is written to them.
        voxels, counts = np.empty(V, np.uint32), np.empty((V, 2), np.int32)
        sampled, samples = np.empty(S, np.uint32), np.empty((S, self.geometry.plane_count), np.int64)

        def evidence(n: int) -> Evidence:
            part, of_voxels, of_samples = parts[n], slice(*ends[n : n + 2, 0]), slice(*ends[n : n + 2, 1])
            rows = kernels.pack_known_into(
                slots[part],
                tables[part],
                inner[part],
                self._misses,
                self._row_of,
                self._sums,
                voxels[of_voxels],
                counts[of_voxels],
                sampled[of_samples],
                samples[of_samples],
            )
            own = slice(of_samples.start, of_samples.start + rows)
            return Evidence(voxels[of_voxels], counts[of_voxels], sampled[own], samples[own])

        # Stage 4: the largest first, so that no thread is left with one when the others are done.
        largest_first = sorted((n for n in range(len(keys)) if counted[n][0]), key=lambda n: -counted[n][0])
        packed = zip(largest_first, each(evidence, largest_first), strict=True)
        return {keys[n]: part for n, part in sorted(packed, key=lambda cell: keys[cell[0]])}


def tally_around(origin_m: Floats, farthest_m: float, geometry: Geometry, *, max_range_m: float) -> BrickTally:
    """A tally for a scan from this place that reaches so far, and for those that follow if memory allows.

    Raises:
        BadInputError: the scan alone spans more bricks than fit in memory; limit the range or coarsen the map.
    """
    # As far as the sensor reaches, if memory allows, else just this scan and a brick of room.
    brick_m = 8 * geometry.voxel_edge_m
    for reach_m, bricks_max in ((max_range_m + MOVE_M, BOX_BRICKS), (1.01 * farthest_m + brick_m, BOX_BRICKS_MAX)):
        if (2 * reach_m / brick_m + 2) ** 3 <= bricks_max:
            return BrickTally(geometry, origin_m, reach_m=reach_m)
    raise BadInputError(
        "scan_too_large",
        f"one scan reaches {farthest_m:.1f} m, too far at {geometry.voxel_edge_m} m voxels; "
        "limit its range or use a coarser map",
    )


def _grown(array: npt.NDArray[Scalar], needed: int, used: int) -> npt.NDArray[Scalar]:
    """The array with room for `needed` entries, of which the first `used` are kept and all others are 0.

    At least doubled, so that copies stay few; from `RESERVED` on, because fresh memory is 0 without being written.
    """
    if needed <= len(array):
        return array
    # Zeros come from the system, page by page when first written.
    entry = max(1, array.dtype.itemsize * math.prod(array.shape[1:]))
    grown = np.zeros((max(needed, 2 * len(array), RESERVED // entry), *array.shape[1:]), array.dtype)
    grown[:used] = array[:used]
    return grown


class TallyPool:
    """Evidence of many scans: open tallies, and the sum of those that were closed; thread-safe except for `packed`."""

    def __init__(self, geometry: Geometry, *, max_range_m: float, around_m: Floats | None = None) -> None:
        """Args: around_m: (3,) centre of the first tally, metres; None: the place of the first scan."""
        self._geometry = geometry
        self._max_range_m = max_range_m
        self._around_m = around_m
        self._lock = Lock()
        self._closed = EvidenceMap(geometry)
        self._first: Diff | None = None
        """Evidence that was counted elsewhere, as it came, while it is all there is: a sweep need not be added up."""
        self._users: dict[BrickTally, int] = {}
        """Number of threads that are adding to each open tally."""
        self._idle: list[ScanHits] = []

    def merge(self, diff: Diff) -> None:
        """Add evidence that was counted elsewhere."""
        if not diff:
            return
        with self._lock:
            if self._first is None and not len(self._closed):
                self._first = diff
            else:
                self._settle()
                self._closed.merge(diff)

    @contextmanager
    def around(self, origin_m: Floats, farthest_m: float) -> Iterator[tuple[BrickTally, ScanHits]]:
        """A tally that holds a scan from this place that reaches so far, and hits that no other thread uses meanwhile.

        Raises:
            BadInputError: as `tally_around`.
        """
        # Under the lock only the choice; counting takes the tally's own locks.
        with self._lock:
            tally = next((tally for tally in self._users if tally.holds(origin_m, farthest_m)), None)
            if tally is None:
                self._close_idle()
                tally = self._new_tally(origin_m, farthest_m)
            self._users[tally] = self._users.get(tally, 0) + 1
            hits = self._idle.pop() if self._idle else ScanHits()
        try:
            yield tally, hits
        finally:
            # Also after an error: the next scan needs zeros.
            hits.forget()
            with self._lock:
                self._users[tally] -= 1
                self._idle.append(hits)

    def packed(self, each: Each = map) -> Diff:
        """Packed evidence of all cells that hold any, rising in number; `each` as for `BrickTally.packed`."""
        if len(self._users) == 1 and self._first is None and not len(self._closed):
            # Most measurements end here: all scans in one tally, nothing to add up.
            return next(iter(self._users)).packed(each)
        if self._first is not None and not self._users and not len(self._closed):
            return {key: self._first[key] for key in sorted(self._first) if len(self._first[key])}
        self._settle()
        self._close_idle(each)
        return self._closed.packed()

    def _settle(self) -> None:
        """Add what was counted elsewhere to the sum."""
        if self._first is not None:
            self._closed.merge(self._first)
            self._first = None

    def _new_tally(self, origin_m: Floats, farthest_m: float) -> BrickTally:
        # The first tally at the place that was given, if this scan fits there.
        if self._around_m is not None:
            tally = tally_around(self._around_m, farthest_m, self._geometry, max_range_m=self._max_range_m)
            self._around_m = None
            if tally.holds(origin_m, farthest_m):
                return tally
        return tally_around(origin_m, farthest_m, self._geometry, max_range_m=self._max_range_m)

    def _close_idle(self, each: Each = map) -> None:
        # A tally in use stays open; memory is that of the open ones.
        for tally in [tally for tally, users in self._users.items() if not users]:
            self._closed.merge(tally.packed(each))
            del self._users[tally]
