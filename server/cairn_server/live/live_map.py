"""Live state of one map: recent changes of its cells and log, and the last signs of its robots; all of it bounded.

Changes are kept while there are listeners, so that each listener costs no more than its place among them.
"""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Literal, NamedTuple

from cairn_map.commits.cursor import Cursor
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.live_events import (
    CELLS_MAX,
    CHAIN_DIGITS,
    ENTRIES_MAX,
    MARKS_MAX,
    NAMES_MAX,
    CellsEvent,
    EventPosition,
    HeadMoved,
    LiveEvent,
    LogGrew,
    MarksEvent,
    RobotSign,
)
from cairn_map.wire.mark_messages import MarkEntry
from cairn_map.wire.messages import LogEntry
from cairn_server.store.history import is_proven
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import MapRow, MarkChange, entries_of, removed_commits

Signs = OrderedDict[str, tuple[int, RobotSign]]
"""By branch, with the tick at which it was heard, rising."""
GONE_MAX = 256
"""Most robots that left and are still reported to listeners as gone."""

SIGNS_MAX = 1000
"""Most robots in a `hello`, some 2 kB each at most; events of their own tell of the others."""
PAST_ENTRIES = 1000
"""Most log entries that a returning listener gets in single changes; after more it gets `many`."""
CELLS_KEPT = 1024
SAME_S = 1.0
"""Age by which a sign in the store is newer than the one heard here before it counts as another one."""


class LiveChanges:
    """Newest changes of one map, as read from its store; thread-safe."""

    def __init__(self, store: Store, row: MapRow) -> None:
        self._store = store
        self._row = row
        self._lock = threading.Lock()
        self._head: Cursor | None = None
        self._losses = 0
        """Count of the times that the log lost entries."""
        self._floor = 0
        """Log entry up to which changes may be missing here."""
        self._cells: OrderedDict[CellKey, int] = OrderedDict()
        self._entries: deque[LogEntry] = deque(maxlen=ENTRIES_MAX)
        self._marks: list[MarkChange] = []
        self._marks_floor = 0
        """Log entry up to which changes of marks may be missing here."""

    @property
    def head(self) -> Cursor:
        """Newest state that was read."""
        return self.place()[0]

    @property
    def seq(self) -> int:
        """Log entry of the newest state that was read; -1: none was."""
        head = self._head
        return head.seq if head else -1

    @property
    def losses(self) -> int:
        """Count of the times that the log lost entries which were read: the store was restored."""
        return self.place()[1]

    def place(self) -> tuple[Cursor, int]:
        """Newest state that was read, and `losses` before it."""
        with self._lock:
            assert self._head is not None, "read first"  # noqa: S101 - `Hub.join` does
            return self._head, self._losses

    def read(self) -> None:
        """Read what was folded since the last call."""
        with self._lock, self._store.snapshot(self._row) as snapshot:
            head = snapshot.head
            if self._head is not None and not is_proven(self._head, snapshot):
                self._head = None
                self._losses += 1
            known = self._head.seq if self._head else -1
            start = max(known, head.seq - PAST_ENTRIES, 0)
            if start > known:  # no client listened for long
                self._cells.clear()
                self._entries.clear()
                self._marks.clear()
                self._floor = start
                # A map without marks has none that may be missing.
                oldest = snapshot.marks(after_seq=max(known, 0), limit=1)
                if oldest and oldest[0].seq <= start:
                    self._marks_floor = start
            for cell in sorted(snapshot.cells(after_seq=start), key=lambda cell: cell.lm):
                self._cells[cell.key] = cell.lm
                self._cells.move_to_end(cell.key)
            after = max(start, head.seq - ENTRIES_MAX)
            while after < head.seq:
                self._entries.extend(snapshot.log(after_seq=after, limit=ENTRIES_MAX, names_max=NAMES_MAX))
                after = self._entries[-1].seq
                while len(self._entries) > 1 and sum(len(entry.retracts) for entry in self._entries) > NAMES_MAX:
                    self._entries.popleft()
            self._read_marks(snapshot, start)
            self._head = head
            while len(self._cells) > CELLS_KEPT:
                self._floor = self._cells.popitem(last=False)[1]

    def _read_marks(self, snapshot: Snapshot, start: int) -> None:
        """Read the marks that changed after an entry; of very many only that there are."""
        found = snapshot.marks(after_seq=start, limit=MARKS_MAX + 1)
        self._marks += found
        if len(self._marks) > MARKS_MAX:
            # Marks of one entry are kept or dropped together: an event tells of whole entries.
            is_all = len(found) <= MARKS_MAX
            self._marks_floor = self._marks[-MARKS_MAX - 1].seq if is_all else snapshot.head.seq
            self._marks = [change for change in self._marks if change.seq > self._marks_floor]

    def has_proof(self, seen: EventPosition) -> bool:
        """True if a listener's place is one of this log: not another server's, and not lost in a restore."""
        with self._store.snapshot(self._row) as snapshot:
            chain = snapshot.chain_at(seen.seq) if seen.seq <= snapshot.head.seq else None
        return chain is not None and chain.hex()[:CHAIN_DIGITS] == seen.chain

    def since(self, seen: EventPosition, *, losses: int) -> tuple[list[LiveEvent], EventPosition]:
        """Events after a listener's place, and its place after them; none if the log lost entries since."""
        with self._lock:
            head = self._head
            if head is None or head.seq <= seen.seq or losses != self._losses:
                return [], seen
            # A listener does not say what it knows, and it hears of an entry as it comes.
            entries = [entry.without_receipt() for entry in self._entries if entry.seq > seen.seq]
            marks = [change for change in self._marks if change.seq > seen.seq]
            has_all_marks = seen.seq >= self._marks_floor
            cells: list[tuple[int, int, int, int]] = []
            for key, lm in reversed(self._cells.items()):
                if lm <= seen.seq or len(cells) > CELLS_MAX:
                    break
                i, j, k = cell_of_key(key)
                cells.append((i, j, k, lm))
        is_many = seen.seq < self._floor or len(cells) > CELLS_MAX
        moved = EventPosition(head.seq, head.chain.hex()[:CHAIN_DIGITS], seen.tick)
        events: list[LiveEvent] = []
        if cells or is_many:  # a retract of what never came changes no cell
            events.append(CellsEvent(id=str(seen), cells="many" if is_many else cells))
        if marks or not has_all_marks:
            gone = removed_commits(marks) if has_all_marks else []
            living = (change for change in marks if change.key.commit not in gone)
            came: list[MarkEntry] | Literal["many"] = entries_of(living) if has_all_marks else "many"
            removed = list(map(str, gone))
            events.append(MarksEvent(id=str(seen), marks=came, removed=removed))
        events.append(LogGrew(id=str(seen), entries=entries, left_out=head.seq - seen.seq - len(entries)))
        return [*events, HeadMoved(id=str(moved), cursor=str(head))], moved


def _is_news(sign: RobotSign, known: RobotSign) -> bool:
    """True unless a sign says what is known, of another time by what it takes to write it."""
    return sign.time_s - known.time_s >= SAME_S or sign.model_copy(update={"time_s": known.time_s}) != known


class StoredSign(NamedTuple):
    """Sign of a robot as the store has it."""

    sign: RobotSign
    status_s: float = 0.0
    """Time at which a server heard the status, where several write it."""


class LiveRobots:
    """Last sign of each robot of one map, in the order of hearing; thread-safe."""

    def __init__(self, load: Callable[[], list[StoredSign]]) -> None:
        """`load` reads the store's signs, when they are first needed, and at each `refresh`."""
        self._load = load
        self._lock = threading.Lock()
        self._signs: Signs | None = None
        self._status_s: dict[str, float] = {}
        """Times at which the statuses in the signs were heard, by branch."""
        self._tick = 0

    def refresh(self) -> bool:
        """Read the signs that other servers of the store wrote; True if there is news."""
        with self._lock:
            self._loaded()
            begun = self._tick
        stored = {each.sign.branch: each for each in self._load()}
        with self._lock:
            signs, before = self._loaded(), self._tick
            for branch, (tick, sign) in list(signs.items()):
                # What was heard here since the reading began may be newer than what was read.
                if tick > begun:
                    stored.pop(branch, None)
                elif branch not in stored and not sign.gone:
                    self._leave(sign)
            for branch, each in stored.items():
                own = self._there(signs, branch)
                merged = each.sign if own is None else self._merged(own, each)
                if own is None or _is_news(merged, own):
                    self._status_s[branch] = max(each.status_s, self._status_s.get(branch, 0.0))
                    self._hear(merged)
            return self._tick > before

    def present(self) -> tuple[int, int, list[RobotSign]]:
        """Newest tick, and all registered robots by name, heard up to a tick: the newest one, too.

        Of more than `SIGNS_MAX` robots those that are silent longest; the others were heard after the second tick.
        """
        with self._lock:
            heard = [(tick, sign) for tick, sign in self._loaded().values() if not sign.gone]
            up_to = self._tick if len(heard) <= SIGNS_MAX else heard[SIGNS_MAX - 1][0]
            return self._tick, up_to, sorted((sign for _, sign in heard[:SIGNS_MAX]), key=lambda sign: sign.branch)

    def of(self, branch: str) -> RobotSign | None:
        """Last sign of one robot, if it is registered."""
        with self._lock:
            return self._there(self._loaded(), branch)

    def since(self, tick: int) -> list[tuple[int, RobotSign]]:
        """Signs heard after a tick, oldest first; only the last of each robot."""
        found: list[tuple[int, RobotSign]] = []
        with self._lock:
            for heard, sign in reversed(self._signs.values() if self._signs else ()):
                if heard <= tick:
                    break
                found.append((heard, sign))
        return found[::-1]

    def came(self, sign: RobotSign) -> None:
        """Note that a robot was registered, perhaps again; its earlier reports stay."""
        with self._lock:
            if self._signs is not None:
                old = self._there(self._signs, sign.branch) or sign
                self._hear(old.model_copy(update={"mode": sign.mode, "time_s": sign.time_s}))

    def heard(self, branch: str, **news: object) -> bool:
        """Note a sign of a robot; False if no robot of that name is registered."""
        with self._lock:
            sign = self._there(self._signs, branch)
            if sign is None:
                return False
            now_s = time.time()
            if "status" in news:
                self._status_s[branch] = now_s
            self._hear(sign.model_copy(update={"time_s": now_s, **news}))
            return True

    def left(self, branch: str) -> None:
        """Note that a robot was deregistered."""
        with self._lock:
            sign = self._there(self._signs, branch)
            if sign is not None:
                self._leave(sign)

    def _leave(self, sign: RobotSign) -> None:
        assert self._signs is not None  # noqa: S101 - by its callers
        self._status_s.pop(sign.branch, None)
        self._hear(RobotSign(branch=sign.branch, mode=sign.mode, time_s=time.time(), gone=True))
        gone = [name for name, (_, known) in self._signs.items() if known.gone]
        for name in gone[: max(0, len(gone) - GONE_MAX)]:
            del self._signs[name]

    def _merged(self, own: RobotSign, stored: StoredSign) -> RobotSign:
        """Sign of what was heard here and what others wrote, each part as it was heard last.

        A first status or picture is written at once: what the store lacks went with a registration that ended.
        """
        other = stored.sign
        is_later = other.time_s > own.time_s
        has_status = other.status is not None and stored.status_s <= self._status_s.get(own.branch, 0.0)
        return other.model_copy(
            update={
                "time_s": max(own.time_s, other.time_s),
                "cursor": (other.cursor if is_later else None) or own.cursor,
                "status": own.status if has_status else other.status,
                "view_s": None if other.view_s is None else max(other.view_s, own.view_s or 0.0),
            }
        )

    def _there(self, signs: Signs | None, branch: str) -> RobotSign | None:
        _, sign = signs.get(branch, (0, None)) if signs else (0, None)
        return None if sign is None or sign.gone else sign

    def _loaded(self) -> Signs:
        if self._signs is None:
            self._signs = OrderedDict()
            for sign, status_s in sorted(self._load(), key=lambda stored: stored.sign.time_s):
                self._status_s[sign.branch] = status_s
                self._hear(sign)
        return self._signs

    def _hear(self, sign: RobotSign) -> None:
        assert self._signs is not None  # noqa: S101 - by its callers
        # Microseconds since 1970, so that ticks rise over a restart, too.
        self._tick = max(self._tick + 1, time.time_ns() // 1000)
        self._signs[sign.branch] = (self._tick, sign)
        self._signs.move_to_end(sign.branch)
