"""Thread that looks for what other servers of the same store did, for the listeners of this one.

    on a hint of a fold  -->  head of that map     -->  Hub.folded
    every second         -->  heads                -->  Hub.folded
                         -->  clock of the store
                         -->  signs of robots      -->  Hub.present_robots
                         <--  own robots' reports that others cannot see yet
    every ten seconds    <--  sign that this server is alive
    every minute         <->  age of the store

A look costs one query of the heads, and two of the robots, of maps that have listeners; without listeners none. Looks
are what counts: a hint that is lost only makes news a second older. Views made ahead hear of folds, too (`FoldNews`).
"""

import logging
import math
import threading
import time
from collections.abc import Callable

from cairn_map.commits.cursor import Cursor
from cairn_map.errors import CairnError
from cairn_server.live.fold_news import FoldNews
from cairn_server.live.hub import Hub
from cairn_server.live.robot_reports import RobotReports
from cairn_server.live.site import Site
from cairn_server.store.replica_notes import SERVER_S, FoldHint, ReplicaNotes
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow

log = logging.getLogger(__name__)

LOOK_EVERY_S = 1.0
SIGN_EVERY_S = SERVER_S / 3
KEEP_AGE_EVERY_S = 60.0
"""Time between two looks at the age that other servers count: a server that does not fold has no other reason to."""
NEWS_EVERY_S = 60.0
"""Time between two looks of `FoldNews` at all maps, while no hints come."""
HINT_PAUSE_S = 0.1
"""Shortest time between two looks, however many hints come."""


class ReplicaWatch:
    """Looks at a store that several servers work on, until closed."""

    def __init__(
        self,
        store: Store,
        notes: ReplicaNotes,
        hub: Hub,
        reports: RobotReports,
        news: FoldNews,
        site: Site,
        *,
        look_at_clock: Callable[[], None] = lambda: None,
        every_s: float = LOOK_EVERY_S,
    ) -> None:
        """Begin; `notes` are the store's, `news` hears of all folds, and `site` tells of this server.

        `look_at_clock` compares the store's clock with this machine's.
        """
        self._store = store
        self._hub = hub
        self._reports = reports
        self._news = news
        self._site = site
        self._look_at_clock = look_at_clock
        self._every_s = every_s
        self._seen: dict[int, Cursor] = {}
        """State of each map that listeners were last woken for."""
        self._hinted: set[int] = set()
        """Numbers of maps with listeners that were folded, by hints since the last look."""
        self._sign_next_s = -math.inf
        self._keep_age_next_s = -math.inf
        self._news_next_s = -math.inf
        self._woken = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-replicas", daemon=True)
        self._hints = notes.fold_hints(self.hint)
        self._thread.start()

    def hint(self, hint: FoldHint | None) -> None:
        """Look at a map soon: a server said that it folded. Called from any thread, never waits."""
        if hint is None:
            self._news.note_loss()
            return
        self._news.note(hint.map)
        if self._hub.lacks(hint.map, hint.seq):
            self._hinted.add(hint.map)
            self._woken.set()

    def close(self) -> None:
        """Stop."""
        self._hints.close()
        self._closing.set()
        self._woken.set()
        self._thread.join()

    def look(self) -> None:
        """Share own reports, and let listeners hear what other servers folded and heard.

        Raises:
            CairnError: the store cannot be read now.
        """
        self._look_at_clock()
        if time.monotonic() >= self._sign_next_s:
            self._sign_next_s = time.monotonic() + SIGN_EVERY_S
            self._site.sign()
        if time.monotonic() >= self._keep_age_next_s:
            self._keep_age_next_s = time.monotonic() + KEEP_AGE_EVERY_S
            self._store.keep_age()
        if time.monotonic() >= self._news_next_s and not self._hints.are_heard:
            self._news_next_s = time.monotonic() + NEWS_EVERY_S
            self._news.note_loss()
        self._reports.flush()
        listened = self._hub.listened_maps()
        self._look_at_heads(listened)
        self._seen = {row.number: self._seen[row.number] for row in listened if row.number in self._seen}
        for row in self._hub.listened_maps():  # without those that are gone
            self._hub.present_robots(row)

    def look_at_hinted(self) -> None:
        """Let listeners hear what other servers folded, by their hints.

        Raises:
            CairnError: the store cannot be read now.
        """
        hinted = {self._hinted.pop() for _ in range(len(self._hinted))}
        self._look_at_heads([row for row in self._hub.listened_maps() if row.number in hinted])

    def _look_at_heads(self, maps: list[MapRow]) -> None:
        if not maps:
            return
        heads = self._store.heads([row.number for row in maps])
        there = {row.number for row, _ in heads}
        for row in maps:
            if row.number not in there:  # another server deleted it
                self._hub.map_gone(row)
        for row, head in heads:
            if self._seen.get(row.number) != head:
                self._seen[row.number] = head
                self._hub.folded(row)

    def _run(self) -> None:
        next_s = time.monotonic() + self._every_s
        while not self._closing.is_set():
            self._woken.wait(max(0.0, next_s - time.monotonic()))
            self._woken.clear()
            if self._closing.is_set():
                return
            try:
                if time.monotonic() >= next_s:
                    next_s = time.monotonic() + self._every_s
                    self.look()
                else:
                    self.look_at_hinted()
            except CairnError as exc:
                log.info("other servers of the store cannot be followed now: %s", exc.message)
            except Exception:
                log.exception("other servers of the store cannot be followed now")
            self._closing.wait(HINT_PAUSE_S)
