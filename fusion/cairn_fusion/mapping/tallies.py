"""Scans being counted by any number of threads: the tallies that are open, and the sum of those that were closed.

All of it is integers, so which thread counts which scan, and when, changes nothing.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

from cairn_fusion.mapping.tally import Each, ScanHits, Tally, tally_around
from cairn_map.arrays import Floats
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry

Diff = dict[CellKey, Evidence]


class Tallies:
    """Evidence of many scans; thread-safe but for `packed`. Memory: see `tally`."""

    def __init__(self, geometry: Geometry, *, max_range_m: float, around_m: Floats | None = None) -> None:
        """Args: around_m: (3,) where the first tally is to be centred; None: where the first scan was taken."""
        self._geometry = geometry
        self._max_range_m = max_range_m
        self._around_m = around_m
        self._lock = Lock()
        self._closed = EvidenceMap(geometry)
        self._users: dict[Tally, int] = {}
        """How many threads are adding to each open tally."""
        self._idle: list[ScanHits] = []

    def merge(self, diff: Diff) -> None:
        """Add evidence that was counted elsewhere."""
        with self._lock:
            self._closed.merge(diff)

    @contextmanager
    def around(self, origin_m: Floats, farthest_m: float) -> Iterator[tuple[Tally, ScanHits]]:
        """A tally that holds a scan from there that reaches so far, and a scratch that no other thread uses meanwhile.

        Raises:
            BadInputError: as `tally_around`.
        """
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
            hits.forget()
            with self._lock:
                self._users[tally] -= 1
                self._idle.append(hits)

    def packed(self, each: Each = map) -> Diff:
        """Packed evidence of all cells that hold any, rising in number; `each` as for `Tally.packed`."""
        if len(self._users) == 1 and not len(self._closed):
            # Most measurements end here: all scans in one tally, nothing to add up.
            return next(iter(self._users)).packed(each)
        self._close_idle(each)
        return self._closed.packed()

    def _new_tally(self, origin_m: Floats, farthest_m: float) -> Tally:
        if self._around_m is not None:
            tally = tally_around(self._around_m, farthest_m, self._geometry, max_range_m=self._max_range_m)
            self._around_m = None
            if tally.holds(origin_m, farthest_m):
                return tally
        return tally_around(origin_m, farthest_m, self._geometry, max_range_m=self._max_range_m)

    def _close_idle(self, each: Each = map) -> None:
        for tally in [tally for tally, users in self._users.items() if not users]:
            self._closed.merge(tally.packed(each))
            del self._users[tally]
