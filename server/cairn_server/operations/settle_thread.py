"""The thread that settles: bytes at rest leave the database, dead objects are deleted, cold cells are read to see
that they are sound.

One server of those that share a database works at it, by a claim. A failure stops nothing else: it is tried again.
"""

import logging
import random
import threading
import time
from types import TracebackType

from cairn_map.errors import CairnError
from cairn_map.evidence.grid import cell_of_key
from cairn_server.metrics import ServerFigures
from cairn_server.service import Service
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.settling.settler import Moved, Settler
from cairn_server.store.store_rows import MapRow

log = logging.getLogger(__name__)

LOOK_S = 20.0
"""Longest time between two looks for bytes at rest; a short rest is looked for as often as it lasts."""
LIST_EVERY_S = 86_400.0
"""Time between two listings of all objects, for those that a restored database does not know."""
SCRUB_PER_DAY = 0.01
"""Share of the cold cells that is read in a day to see that they are sound."""
SCRUB_MAX = 16
"""Most cells that are read at one look."""
LARGEST_WAIT_S = 30.0
"""Longest time between two attempts while they fail."""


class SettleThread:
    """Thread that settles one store until the end of a `with`."""

    def __init__(self, service: Service, settler: Settler) -> None:
        """Take the store and its settings from a service."""
        self._service = service
        self._settler = settler
        self._closing = threading.Event()
        self._list_next_s = time.monotonic() + LIST_EVERY_S
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
        settings = self._service.settings
        look_s = min(LOOK_S, max(0.2, settings.settle_cells_s), max(0.2, settings.settle_evidence_s))
        wait_s = look_s
        while not self._closing.wait(wait_s):
            try:
                if self._settler.claim():
                    self._settle()
                wait_s = look_s
            except AwayError as exc:
                wait_s = min(2 * wait_s, LARGEST_WAIT_S)
                self._figures.settle_failures.inc()
                log.error("bytes at rest stay in the database, to be tried again: %s", exc.message)
            except Exception as exc:
                # Whatever it is, this thread must live: there is no other one.
                wait_s = min(2 * wait_s, LARGEST_WAIT_S)
                log.error("settling failed: %s", exc, exc_info=None if isinstance(exc, CairnError) else exc)

    @property
    def _figures(self) -> ServerFigures:
        return self._service.figures

    def _settle(self) -> None:
        settings, store = self._service.settings, self._service.store
        now_s = store.age.now_s()
        for row in self._settler.maps_at_rest(evidence_before_s=now_s - settings.settle_evidence_s):
            with store.snapshot(row) as snapshot:
                to_seq = snapshot.seq_before(now_s - settings.settle_cells_s)
            steps = (
                ("cells", self._settler.settle_cells(row, to_seq=to_seq, age_s=now_s)),
                (
                    "evidence",
                    self._settler.settle_evidence(row, before_s=now_s - settings.settle_evidence_s, age_s=now_s),
                ),
            )
            for kind, moves in steps:
                for moved in moves:
                    self._note(row, kind, moved)
                    if self._closing.is_set() or not self._settler.claim():
                        return
        deleted = self._settler.delete_dead(before_s=now_s - settings.objects_grace_s)
        self._figures.objects_deleted.inc(deleted)
        if time.monotonic() > self._list_next_s:
            self._list_next_s = time.monotonic() + LIST_EVERY_S
            self._settler.note_unknown(age_s=now_s)
        self._scrub()

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
