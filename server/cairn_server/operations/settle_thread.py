"""The thread that settles: bytes at rest leave the database, dead objects are deleted, cold cells are read to see
that they are sound.

One server of those that share a database works at it, by a claim. A failure stops nothing else: it is tried again.
"""

import logging
import random
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

from cairn_map.errors import CairnError
from cairn_map.evidence.grid import cell_of_key
from cairn_server.metrics import ServerFigures
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.settling.settler import Moved, Settler
from cairn_server.store.store_rows import MapRow

log = logging.getLogger(__name__)

LOOK_S, LEAST_LOOK_S = 20.0, 0.2
"""Longest and shortest time between two looks for bytes at rest: a short rest is looked for as often as it lasts."""
SCRUB_PER_DAY = 0.01
"""Share of the cold cells that is read in a day to see that they are sound."""
SCRUB_MAX = 16
"""Most cells that are read at one look."""
FAILURES_MAX = 8
"""Failures after which no more maps are settled at one look: a failure of all maps is not found out map by map."""
LARGEST_WAIT_S = 30.0
"""Longest time between two attempts while they fail."""


def look_s_of(settings: Settings) -> float:
    """Time between two looks for bytes at rest."""
    return min(LOOK_S, max(LEAST_LOOK_S, settings.settle_cells_s), max(LEAST_LOOK_S, settings.settle_evidence_s))


class SettleThread:
    """Thread that settles one store until the end of a `with`."""

    def __init__(self, service: Service, settler: Settler) -> None:
        """Take the store and its settings from a service."""
        self._service = service
        self._settler = settler
        self._closing = threading.Event()
        self._failures = 0
        """Count of the duties that failed at this look."""
        self._scrubbed_s = time.monotonic()
        self._due_cells = 0.0
        self._thread = threading.Thread(target=self._run, name="cairn-settle", daemon=True)

    def __enter__(self) -> None:
        """Start."""
        self._thread.start()

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stop after the objects that are on their way."""
        self._closing.set()
        self._thread.join()
        self._settler.close()

    def _run(self) -> None:
        look_s = wait_s = look_s_of(self._service.settings)
        while not self._closing.wait(wait_s):
            self._failures = 0
            self.look()
            wait_s = min(2 * wait_s, LARGEST_WAIT_S) if self._failures else look_s

    @property
    def _figures(self) -> ServerFigures:
        return self._service.figures

    def look(self) -> None:
        """Do once what is to be done, if this server is the one that does it."""
        if not self._goes_on():
            return
        settings, now_s = self._service.settings, self._service.store.age.now_s()
        rows: list[MapRow] = []
        with self._duty("look"):
            rows = self._settler.maps_at_rest(evidence_before_s=now_s - settings.settle_evidence_s)
        # In another order each time, so that maps that fail keep no other one from its turn for ever.
        random.shuffle(rows)
        for row in rows:
            with self._duty("cells", row):
                self._settle_cells(row, now_s)
            with self._duty("evidence", row):
                before_s = now_s - settings.settle_evidence_s
                self._take(row, "evidence", self._settler.settle_evidence(row, before_s=before_s, age_s=now_s))
            if not self._goes_on():
                return
            if self._failures >= FAILURES_MAX:
                break
        with self._duty("delete"):
            while deleted := self._settler.delete_dead(before_s=now_s - settings.objects_grace_s):
                self._figures.objects_deleted.inc(deleted)
                if not self._goes_on():
                    return
        with self._duty("list"):
            if self._settler.is_listing_due(age_s=now_s):
                for _ in self._settler.note_unknown(age_s=now_s):
                    if not self._goes_on():
                        return
        with self._duty("scrub"):
            self._scrub()

    def _goes_on(self) -> bool:
        """True if this server is still the one that settles, and not about to end."""
        may_work = False
        if not self._closing.is_set():
            with self._duty("own"):
                may_work = self._settler.may_work()
        return may_work

    @contextmanager
    def _duty(self, what: str, row: MapRow | None = None) -> Iterator[None]:
        """A duty whose failure is counted and logged, and stops no other one."""
        try:
            yield
        except Exception as exc:
            # Whatever it is, this thread must live: there is no other one.
            self._failures += 1
            self._figures.settle_failures.labels(what).inc()
            place = "" if row is None else f"map {row.name}: "
            trace = None if isinstance(exc, CairnError) else exc
            log.error("%ssettling (%s) failed, to be tried again: %s", place, what, exc, exc_info=trace)

    def _settle_cells(self, row: MapRow, now_s: float) -> None:
        with self._service.store.snapshot(row) as snapshot:
            to_seq = snapshot.seq_before(now_s - self._service.settings.settle_cells_s)
        self._take(row, "cells", self._settler.settle_cells(row, to_seq=to_seq, age_s=now_s))

    def _take(self, row: MapRow, kind: str, moves: Iterator[Moved]) -> None:
        for moved in moves:
            self._note(row, kind, moved)
            if not self._goes_on():
                return

    def _note(self, row: MapRow, kind: str, moved: Moved) -> None:
        self._figures.settled_bytes.labels(kind).inc(moved.size_bytes)
        if moved.pieces:
            log.info("map %s: %d bytes of %s moved to the object store", row.name, moved.size_bytes, kind)

    def _scrub(self) -> None:
        """Read some cold cells, chosen at random; a damaged one is rebuilt, or noted as damaged, as by any reader."""
        now_s = time.monotonic()
        self._due_cells += self._settler.cell_count() * SCRUB_PER_DAY * (now_s - self._scrubbed_s) / 86_400
        self._scrubbed_s = now_s
        while self._due_cells >= 1 and not self._closing.is_set():
            chosen = self._settler.cold_cell(random.random())  # noqa: S311 - no secret
            self._due_cells = min(self._due_cells - 1, SCRUB_MAX)
            if chosen is None:
                return
            row, key = chosen
            try:
                self._service.cells.sound(row, key)
            except AwayError:
                raise
            except CairnError as exc:
                log.error("map %s: cold cell %s: %s", row.name, cell_of_key(key), exc.message)
