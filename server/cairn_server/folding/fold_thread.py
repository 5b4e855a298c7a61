"""The thread that folds: it wakes up when a commit is accepted, and at start for what a crash left over."""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from cairn_map.errors import CairnError, NotFoundError
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.fold_process import FoldProcess, LostProcessError
from cairn_server.folding.fold_turns import GROUP_S
from cairn_server.folding.group_folding import GROUP_MAX, Folded, LocalFolding
from cairn_server.folding.readiness import FoldHealth
from cairn_server.store.store import LEASE_S, FoldLeases, Store
from cairn_server.store.store_rows import MapRow
from cairn_server.upkeep import Upkeep

log = logging.getLogger(__name__)

REST_SHARE, REST_MAX_S = 3.0, 0.5
"""While robots push, each fold is followed by a rest of its map, `REST_SHARE` times its length, at most `REST_MAX_S`.
Commits that come in it are folded together, each cell encoded once: encoding 15 cells takes 30 ms, for one scan or for
200; merging a scan takes 1 ms."""
OFTEN_S = 1.0
"""A map that is folded again within this time has robots that push."""
REST_LOOK_S = 0.05
"""Time between two looks for commits to other maps while those with commits rest."""
POLL_S = 0.2
"""Time between two looks for commits that came by another server of the same store."""
LOOK_MAX = 16
"""Most maps of one page of those that wait, and most that are claimed of a full one."""
CLAIM_MAX = 4
"""Most maps that are claimed of the last page, so that processes that fold together share them by how fast they are."""
PAGES_MAX = 4
"""Most pages of one look: where others fold all that wait, a look costs no more than that."""
LOOK_S = 0.02
"""Time between two looks at a plan in the background."""
CLOCKS_EVERY_S = 60.0
"""Time between two looks at the clocks."""
LIST_EVERY_S = 1.0
"""Time between two lists of all maps that wait, next to other processes and while a fold fails."""
RETRY_S = 5.0
"""Longest wait before a failed fold (a full disk) is tried again; waits double from `FIRST_RETRY_S` on."""
FIRST_RETRY_S = 0.2


class FoldThread:
    """Thread that folds all maps of a store until closed."""

    def __init__(
        self,
        store: Store,
        health: FoldHealth,
        damaged: DamagedCells,
        *,
        keep_evidence_s: float,
        on_fold: Callable[[MapRow], None],
        may_forget_s: Callable[[str], float],
        process: FoldProcess | None = None,
        memory: FoldMemory | None = None,
    ) -> None:
        """Start the thread.

        Args:
            store: its pending commits are folded.
            health: notes each fold and failure.
            damaged: record of damaged cells.
            keep_evidence_s: age at which a folded commit's evidence is dropped.
            on_fold: called after each group, with the map.
            may_forget_s: by a map's name, age of the store before which evidence may be dropped.
            process: plans the folds; without one, or once it has ended, this thread does.
            memory: of this thread's own folding.
        """
        self._store = store
        self._health = health
        self._damaged = damaged
        self._on_fold = on_fold
        self.upkeep = Upkeep(store, keep_evidence_s=keep_evidence_s, may_forget_s=may_forget_s)
        self._clocks_next_s = self._list_next_s = 0.0
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._process = process
        self._local = LocalFolding(store, damaged, memory)
        self._holder = secrets.token_hex(8)
        self._rests = _Rests()
        self._claimed_to = -1
        """Number of the map up to which this process has claimed maps in the round under way: each has its turn."""
        self._wake.set()
        self._thread = threading.Thread(target=self._run, name="cairn-fold", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Look for commits to fold now."""
        self._wake.set()

    def is_alive(self) -> bool:
        """True while the thread runs."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop after the fold under way."""
        self._closing.set()
        self._wake.set()
        self._thread.join()
        self._local.close()
        if self._store.leases is not None:
            with suppress(CairnError):  # they end by themselves
                self._store.leases.release(holder=self._holder)
        if self._process is not None:
            self._process.close()
            self._process = None

    def _run(self) -> None:
        retry_s = FIRST_RETRY_S
        while not self._closing.is_set():
            # Commits that came by another server of this store wake nothing here.
            self._wake.wait(min(CLOCKS_EVERY_S if self._store.leases is None else POLL_S, self.upkeep.wait_s()))
            self._wake.clear()
            # A failure is retried without a new commit, after a growing pause.
            if self._fold_all():
                retry_s = FIRST_RETRY_S
            else:
                self._closing.wait(min(retry_s, RETRY_S))
                retry_s = min(2 * retry_s, RETRY_S)
                self._wake.set()

    def _fold_all(self) -> bool:
        """Fold until nothing is pending, one group of each map in turn; False if a map failed.

        A round of all maps that wait may take several looks (`_claimed`): it ends where `_claimed_to` is -1 again.
        """
        failed: set[str] = set()
        planned: list[MapRow] = []  # the one of which commits are planned in the background
        rests = self._rests
        busy = True
        maps: list[MapRow] = []
        # A map that failed is tried again after a pause, with its plan, too.
        while not self._closing.is_set() and (
            busy or rests or self._claimed_to >= 0 or any(row.name not in failed for row in planned)
        ):
            is_amid = self._claimed_to >= 0
            # A plan in the background does not report its end. Nor is a map that rests a reason to let others wait.
            if not (busy or (is_amid and maps)):
                (self._wake if planned else self._closing).wait(LOOK_S if planned else rests.left_s() or REST_LOOK_S)
            # Cleared before the look, so that a commit that comes during it wakes the thread again; and only if it was
            # set: a commit that comes when the wait has just ended would wait for the plan otherwise.
            is_woken = self._wake.is_set()
            if is_woken:
                self._wake.clear()
            is_news = busy or is_amid or is_woken or bool(rests)
            busy = busy and is_amid  # of all looks of a round
            self._watch_clocks(time.monotonic())
            self.upkeep.work()  # here, too: while robots push all the time, this loop has no end
            try:
                maps = self._maps_at_work(planned)
            except Exception:
                log.exception("cannot list the maps")
                return False
            look_s = time.monotonic()
            # One group of each map in turn: a busy map does not hold up the others.
            for row in rests.awake(maps):
                if row.name in failed or self._closing.is_set():
                    continue
                start_s = time.monotonic()
                if self._store.leases is not None and start_s - look_s > LEASE_S / 2 and row not in planned:
                    self._claimed_to = row.number - 1  # its claim may end soon: it is claimed again
                    break
                try:
                    folded = self._fold_group(row, is_news=is_news)
                    busy |= folded.commits > 0
                    if not (folded.is_planning and planned):
                        planned = [row] if folded.is_planning else []
                except NotFoundError as exc:
                    log.info("map %s is not folded any more: %s", row.name, exc.message)
                    continue
                except Exception as exc:
                    # Whatever it is, the other maps go on, and this thread must live: there is no other one.
                    # A `CairnError` says all in its message.
                    log.error("map %s: fold failed, to be tried again: %s", row.name, exc, exc_info=_unexpected(exc))
                    failed.add(row.name)
                    self._health.failed(row.name, exc)
                    continue
                if folded.commits:
                    took_s = time.monotonic() - start_s
                    is_pushed = self._wake.is_set() or self._is_pushed_elsewhere(row, folded, took_s)
                    rests.begin(row, rest_s(took_s, is_pushed=is_pushed))
        return not failed

    def _is_pushed_elsewhere(self, row: MapRow, folded: Folded, took_s: float) -> bool:
        """True if other servers of the store take commits of a map: they do not wake this thread, but its folds tell.

        A group that ended by its bounds left some, which may be folded at once.
        """
        is_whole = folded.commits < GROUP_MAX and took_s < GROUP_S
        return self._store.leases is not None and is_whole and self._rests.is_often(row)

    def _maps_at_work(self, planned: list[MapRow]) -> list[MapRow]:
        """Maps with commits to be folded, and those of which some are planned in the background."""
        if self._store.leases is None:
            waiting = self._store.waiting_maps()
            self._health.waiting(row.name for row in waiting)
        else:
            waiting = self._claimed(self._store.leases)
            if self._health.has_failures() and time.monotonic() >= self._list_next_s:
                self._list_next_s = time.monotonic() + LIST_EVERY_S
                self._health.waiting(row.name for row in self._store.waiting_maps())
        known = {row.number for row in waiting}
        return waiting + [row for row in planned if row.number not in known]

    def _claimed(self, leases: FoldLeases) -> list[MapRow]:
        """The next maps of the round that wait, do not rest and are no other process's; none: look again.

        What a look costs does not grow with the maps that wait.
        """
        found: list[MapRow] = []
        for _ in range(PAGES_MAX):
            seen = self._store.next_waiting(after=self._claimed_to, limit=LOOK_MAX)
            is_last = len(seen) < LOOK_MAX
            new_max = CLAIM_MAX if is_last else LOOK_MAX
            mine = leases.claim(self._rests.awake(seen), holder=self._holder, new_max=new_max)
            found += mine
            if len(mine) >= CLAIM_MAX:
                self._claimed_to = mine[-1].number  # others of these may be free
                break
            self._claimed_to = -1 if is_last else seen[-1].number
            if is_last or len(found) >= CLAIM_MAX:
                break
        return found

    def _watch_clocks(self, now_s: float) -> None:
        """Keep the store's age, and report a jump of the wall clock, at most once in `CLOCKS_EVERY_S`."""
        if now_s < self._clocks_next_s:
            return
        self._clocks_next_s = now_s + CLOCKS_EVERY_S
        jump_s = self._store.age.jump_s()
        if jump_s:
            self._health.clock_jumped(jump_s)
            way = "ahead (or the machine slept)" if jump_s > 0 else "back (or it is not set yet)"
            self._store.audit(
                "clock_jump",
                f"the time of day went {abs(jump_s):.0f} s {way}; nothing is forgotten or stable sooner or later by "
                "it, but tokens with a date count by it: set the clock (NTP, chrony)",
            )
        self._store.keep_age()

    def _fold_group(self, row: MapRow, *, is_news: bool) -> Folded:
        start_s = time.monotonic()
        folded = self._folded(row, is_news=is_news)
        self._health.folded(row.name, folded.commits, time.monotonic() - start_s)
        if folded.waits_for is not None:
            self._health.failed(row.name, folded.waits_for)
        if folded.commits:
            self._on_fold(row)
            log.info(
                "map %s: folded %d commits in %.0f ms", row.name, folded.commits, 1e3 * (time.monotonic() - start_s)
            )
        return folded

    def _folded(self, row: MapRow, *, is_news: bool) -> Folded:
        if self._process is not None:
            try:
                return self._process.fold(row, self._store, self._damaged, is_news=is_news)
            except LostProcessError:
                log.error("the process that folds was killed; folding in the server's own until the next start")
                self._process.close()
                self._process = None
        return self._local.fold(row, is_news=is_news)


class _Rests:
    """Maps that rest after a fold, so that commits come together."""

    def __init__(self) -> None:
        self._until_s: dict[int, float] = {}
        """Steady time at which each rest ends, by the number of the map."""
        self._folded_s: dict[int, float] = {}
        """Steady time of the last fold of each map that was folded of late."""

    def __bool__(self) -> bool:
        return bool(self._until_s)

    def is_often(self, row: MapRow) -> bool:
        """True if a map was folded less than `OFTEN_S` ago."""
        return time.monotonic() - self._folded_s.get(row.number, -OFTEN_S) < OFTEN_S

    def begin(self, row: MapRow, seconds: float) -> None:
        """Note that a map was folded, and let it rest from now on."""
        now_s = time.monotonic()
        self._folded_s = {number: folded_s for number, folded_s in self._folded_s.items() if now_s - folded_s < OFTEN_S}
        self._folded_s[row.number] = now_s
        if seconds > 0:
            self._until_s[row.number] = now_s + seconds

    def awake(self, maps: Sequence[MapRow]) -> list[MapRow]:
        """Those of these maps that do not rest; rests that are over are forgotten."""
        now_s = time.monotonic()
        self._until_s = {number: until_s for number, until_s in self._until_s.items() if until_s > now_s}
        return [row for row in maps if row.number not in self._until_s]

    def left_s(self) -> float:
        """Time until the next rest ends, or until others should be looked for."""
        next_s = min(self._until_s.values(), default=0.0) - time.monotonic()
        return min(max(next_s, 0.0), REST_LOOK_S)


def rest_s(took_s: float, *, is_pushed: bool) -> float:
    """Seconds to rest after folding for `took_s`, if commits came meanwhile (`is_pushed`).

    So pushes have most of a processor, and the commits of one robot that pushes now and then are folded at once.
    """
    return min(REST_SHARE * took_s, REST_MAX_S) if is_pushed else 0.0


def _unexpected(exc: Exception) -> Exception | None:
    return None if isinstance(exc, CairnError) else exc
