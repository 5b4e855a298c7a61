"""Thread that looks for what other servers of the same store did, for the listeners of this one.

    every second, or on a hint   -->  folds by others       -->  Hub.folded
                                 -->  signs of robots       -->  Hub.present_robots
                                 <--  own robots' reports that others cannot see yet
    every minute                 <->  age of the store

A look costs one query of the heads, and two of the robots, of maps that have listeners; without listeners none. Looks
are what counts: a hint that is lost only makes news a second older.
"""

import logging
import math
import threading
import time

from cairn_map.commits.cursor import Cursor
from cairn_map.errors import CairnError
from cairn_server.live.hub import Hub
from cairn_server.live.robot_reports import RobotReports
from cairn_server.store.store import Store

log = logging.getLogger(__name__)

LOOK_EVERY_S = 1.0
KEEP_AGE_EVERY_S = 60.0
"""Time between two looks at the age that other servers count: a server that does not fold has no other reason to."""
HINT_PAUSE_S = 0.1
"""Shortest time between two looks, however many hints come."""


class ReplicaWatch:
    """Looks at a store that several servers work on, until closed."""

    def __init__(self, store: Store, hub: Hub, reports: RobotReports, *, every_s: float = LOOK_EVERY_S) -> None:
        self._store = store
        self._hub = hub
        self._reports = reports
        self._every_s = every_s
        self._seen: dict[int, Cursor] = {}
        """State of each map that listeners were last woken for."""
        self._keep_age_next_s = -math.inf
        self._woken = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-replicas", daemon=True)
        self._thread.start()

    def hint(self) -> None:
        """Look soon: another server said that it changed something. Called from any thread, never waits."""
        self._woken.set()

    def close(self) -> None:
        """Stop."""
        self._closing.set()
        self._woken.set()
        self._thread.join()

    def look(self) -> None:
        """Share own reports, and let listeners hear what other servers folded and heard.

        Raises:
            CairnError: the store cannot be read now.
        """
        if time.monotonic() >= self._keep_age_next_s:
            self._keep_age_next_s = time.monotonic() + KEEP_AGE_EVERY_S
            self._store.keep_age()
        self._reports.flush()
        listened = self._hub.listened_maps()
        if not listened:
            self._seen.clear()
            return
        heads = {row.number: head for row, head in self._store.heads(listened)}
        for row in listened:
            head = heads.get(row.number)
            if head is not None and self._seen.get(row.number) != head:
                self._seen[row.number] = head
                self._hub.folded(row)
            self._hub.present_robots(row)

    def _run(self) -> None:
        while not self._closing.is_set():
            self._woken.wait(self._every_s)
            self._woken.clear()
            if self._closing.is_set():
                return
            try:
                self.look()
            except CairnError as exc:
                log.info("other servers of the store cannot be followed now: %s", exc.message)
            except Exception:
                log.exception("other servers of the store cannot be followed now")
            self._closing.wait(HINT_PAUSE_S)
