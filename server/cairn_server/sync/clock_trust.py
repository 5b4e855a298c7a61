"""Trust in the clock of a server's store: the time that it hands out to robots, and by which epochs are judged.

    trusted     the time is handed out (`Cairn-Time`), and no commit is taken from more than an epoch ahead
    jumped      the time of day left the steady clock by more than an epoch: until it comes back, or an operator says so
    behind      it is before what is known to be past: until it is not

A clock that is not trusted hands out nothing. Epochs are then taken only from robots that registered before, since
they go by an offset of that time; after a jump they are judged by the steady clock, which goes on from it. All others
wait (`bad_clock`): a commit is never dated again, and none is lost.
"""

import threading
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Literal

from cairn_map.commits.ids import Author
from cairn_map.epochs.epoch import BASE, Epoch, begin_s
from cairn_map.errors import ConflictError, UnreachableError
from cairn_server.metrics import RELEASED_S
from cairn_server.store.store import Store
from cairn_server.store.store_age import JUMP_S
from cairn_server.store.store_clock import ClockMark
from cairn_server.store.store_rows import MapRow, Token, registration_name
from cairn_server.sync.checks.push_policy import check_epoch

KEEP_EVERY_S = 60.0
"""Time between two writes of the newest trusted time."""
AGAIN_S = 60.0
"""Time after which a commit is tried again that an untrusted clock cannot judge."""
LONG_LOOK_S = 1.0
"""Half of the time of a look from which on it does not correct what is known."""
TOKENS_S = 5.0
"""Lifetime of the list of tokens by which robots are known while the clock is not trusted."""

Doubt = Literal["jumped", "behind"]


@dataclass(frozen=True, slots=True)
class ClockLook:
    """One look at both clocks."""

    wall_s: float
    steady_s: float
    error_s: float
    """Half of the time that it took: a database answers over a network."""

    @property
    def offset_s(self) -> float:
        """Lead of the time of day over the steady clock."""
        return self.wall_s - self.steady_s


class ClockTrust:
    """Trust of one server in its store's clock; called from many threads."""

    def __init__(self, store: Store, *, released_s: float = RELEASED_S) -> None:
        """Go on from what the store keeps; `released_s` is the date of this program."""
        self._store = store
        self._clock = store.clock
        self._released_s = released_s
        self._is_shared = store.replicas is not None
        self._lock = threading.RLock()
        # What maps say: the shortest epoch of any, and the begin of the newest that must be past.
        self._maps: dict[int, Epoch] = {}
        self._limit_s = JUMP_S
        self._newest_s = float("-inf")
        for row in store.maps():
            self._note_map(row)
        self._mark = mark = store.clock.kept()
        is_same_boot = mark.boot != "" and mark.boot == store.clock.boot
        self._offset_s: float | None = mark.offset_s if is_same_boot else None
        """Offset that was trusted last; None: none since the steady clock began."""
        self._is_used = is_same_boot
        """True once that offset served a robot: one that did not gives way to any other."""
        self._doubt: Doubt | None = None
        self._kept_s = float("-inf")
        self._tokens: list[Token] = []
        self._tokens_until_s = float("-inf")
        self._last = self._look()
        self._judge(self._last)

    def look(self) -> None:
        """Compare the clocks, and follow what other servers of the store found.

        Raises:
            UnreachableError: the database does not answer now.
        """
        mark, found = self._clock.kept(), self._look()
        with self._lock:
            if self._is_shared:
                self._follow(mark)
            self._judge(found)

    def now_s(self) -> float | None:
        """Time of day now; None while it is not trusted. It waits for no database."""
        with self._lock:
            self._refresh()
            if self._doubt is not None:
                return None
            self._is_used = True
            return self._last.offset_s + self._clock.steady_s()

    def complaint(self) -> str | None:
        """Reason why the clock is not trusted, as `code: what`; None if it is."""
        with self._lock:
            self._refresh()
            return None if self._doubt is None else self._said(self._doubt)

    def doubt_s(self) -> float:
        """Seconds for which the clock has not been trusted, by the age of the store; 0 while it is."""
        with self._lock:
            self._refresh()
            since_age_s = self._mark.since_age_s
        return 0.0 if since_age_s is None else self._store.age.now_s() - since_age_s

    def check_push(self, row: MapRow, author: Author, epoch: Epoch) -> None:
        """Refuse a commit from the future, or one whose epoch cannot be judged now.

        Raises:
            UnreachableError: kind `bad_clock`: to be tried again.
        """
        if epoch == BASE or row.epoch_s is None:
            return
        self._note_map(row)
        now_s = self.now_s()
        if now_s is None:
            now_s = self._time_for(row, author)
        if now_s is not None:
            check_epoch(epoch, row.epoch_s, now_s=now_s)

    def note_push(self, row: MapRow, epoch: Epoch) -> None:
        """Learn of an epoch that is kept: no right clock stands before it."""
        with self._lock:
            if row.epoch_s is not None and epoch > self._maps.get(row.number, BASE):
                self._maps[row.number] = epoch
                # One epoch less: a commit may be of the epoch after that of its arrival.
                self._newest_s = max(self._newest_s, begin_s(Epoch(epoch - 1), row.epoch_s))

    def trust(self, *, by: str, client: str = "") -> float:
        """Trust the time of day as it is, by an operator's word from this address; returns that time.

        Raises:
            ConflictError: kind `clock_behind`: it is before this program was made.
            UnreachableError: the database does not answer now.
        """
        found = self._look()
        if found.wall_s < self._released_s:
            raise ConflictError(
                "clock_behind",
                f"the clock says {_shown(found.wall_s)}, and this program is of {_shown(self._released_s)}: set it "
                "first (NTP, chrony)",
            )
        with self._lock:
            self._end_doubt(found, excused_s=max(found.wall_s, self._newest_s))
        self._store.audit_log.add(by, "trust_clock", f"the time of day is {_shown(found.wall_s)}", client=client)
        return found.wall_s

    def _note_map(self, row: MapRow) -> None:
        if row.epoch_s is None or row.number in self._maps:
            return
        newest = self._store.newest_epoch(row)
        with self._lock:
            is_first = not self._maps
            self._maps.setdefault(row.number, BASE)
            self._limit_s = float(row.epoch_s) if is_first else min(self._limit_s, row.epoch_s)
            self.note_push(row, newest)

    def _look(self) -> ClockLook:
        before_s = self._clock.steady_s()
        wall_s = self._clock.wall_s()
        error_s = (self._clock.steady_s() - before_s) / 2
        return ClockLook(wall_s, before_s + error_s, error_s)

    def _refresh(self) -> None:
        """Look, where that takes a microsecond; a database's clock goes on by the steady one between two looks."""
        if not self._is_shared:
            self._judge(self._look())

    def _judge(self, found: ClockLook) -> None:
        """Come to a doubt, or to none, by a look; under the lock."""
        self._last = found
        doubt = self._doubt_of(found)
        if doubt is None:
            self._adopt(found)
        elif doubt != self._doubt or self._mark.since_age_s is None:
            self._doubt = doubt
            since_age_s = self._mark.since_age_s
            self._keep(
                replace(
                    self._mark,
                    since_age_s=self._store.age.now_s() if since_age_s is None else since_age_s,
                    has_jumped=self._mark.has_jumped or doubt == "jumped",
                )
            )
            self._store.audit("clock_doubt", self._said(doubt))

    def _doubt_of(self, found: ClockLook) -> Doubt | None:
        if self._offset_s is not None and self._is_used:
            if abs(found.offset_s - self._offset_s) > self._limit_s + found.error_s:
                return "jumped"
        elif self._mark.has_jumped:
            return "jumped"  # and no steady clock is left that could tell whether it came back
        newest_s = self._newest_s if self._newest_s > self._mark.excused_s else 0.0
        past_s = max(self._released_s, self._mark.trusted_s - self._limit_s, newest_s)
        return "behind" if found.wall_s < past_s - found.error_s else None

    def _adopt(self, found: ClockLook) -> None:
        """Trust the clock as it is; under the lock."""
        if self._doubt is not None or self._mark.since_age_s is not None:
            self._end_doubt(found)
            self._store.audit("clock_trusted", f"the time of day, {_shown(found.wall_s)}, is trusted again")
            return
        # Small steps are followed: NTP makes them all day. A look that took long says nothing about them.
        if self._offset_s is None or not self._is_used or found.error_s < LONG_LOOK_S:
            self._offset_s = found.offset_s
        if found.steady_s - self._kept_s >= KEEP_EVERY_S:
            self._keep(replace(self._mark, trusted_s=found.wall_s))

    def _end_doubt(self, found: ClockLook, *, excused_s: float | None = None) -> None:
        """Trust the clock from here on, and let other servers of the store do so; under the lock."""
        self._last, self._doubt, self._offset_s = found, None, found.offset_s
        self._keep(
            replace(
                self._mark,
                trusted_s=found.wall_s,
                since_age_s=None,
                has_jumped=False,
                ends=self._mark.ends + 1,
                excused_s=self._mark.excused_s if excused_s is None else excused_s,
            )
        )

    def _keep(self, mark: ClockMark) -> None:
        before = self._mark
        if self._offset_s is not None and self._clock.boot:
            mark = replace(mark, boot=self._clock.boot, offset_s=self._offset_s)
        self._mark, self._kept_s = mark, self._clock.steady_s()
        self._clock.keep(mark, before=before)

    def _follow(self, mark: ClockMark) -> None:
        """Take over what the servers of the store kept; under the lock."""
        if mark.ends > self._mark.ends:  # another one ended the doubt: any clock is trusted from here on
            self._offset_s, self._is_used, self._doubt = None, False, None
        self._mark = mark

    def _time_for(self, row: MapRow, author: Author) -> float | None:
        """Time by which an author's epoch is judged while the clock is not trusted; None: by none.

        Raises:
            UnreachableError: kind `bad_clock`: the author may go by another clock than this server's of before.
        """
        with self._lock:
            since_age_s, doubt, offset_s = self._mark.since_age_s, self._doubt, self._offset_s
        if not self._has_registered(row, author, before_age_s=since_age_s or 0.0):
            raise UnreachableError(
                "bad_clock",
                f"the server's clock is not trusted now, so it cannot judge when {author.robot} measured; an "
                "administrator sets it right (docs/administrator.md, Clock)",
                retry_after_s=AGAIN_S,
            )
        return offset_s + self._clock.steady_s() if doubt == "jumped" and offset_s is not None else None

    def _has_registered(self, row: MapRow, author: Author, *, before_age_s: float) -> bool:
        """True if a robot had its token before an age of the store."""
        with self._lock:
            now_s = self._clock.steady_s()
            is_old = now_s >= self._tokens_until_s
        if is_old:
            tokens = self._store.tokens.all()
            with self._lock:
                self._tokens, self._tokens_until_s = tokens, now_s + TOKENS_S
        name = registration_name(row.name, author.robot)
        return any(
            (token.name == name or (token.robot == author.robot and token.map_number in (row.number, row.names_number)))
            and token.created_age_s < before_age_s
            for token in self._tokens
        )

    def _said(self, doubt: Doubt) -> str:
        return f"clock_{doubt}: it says {_shown(self._last.wall_s)}; {MEANING[doubt]}"


MEANING: dict[Doubt, str] = {
    "jumped": "it jumped. Robots get no time until it comes back, or an administrator says that it is right",
    "behind": "that is long past. Robots get no time until it is set",
}


def _shown(time_s: float) -> str:
    """Time as people read it."""
    try:
        return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        return f"{time_s:.0f} s since 1970"
