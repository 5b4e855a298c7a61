"""What was folded into one map of late: which cells changed and when, the newest log entries, the head. Bounded.

Kept for as long as there are listeners, so that each of them costs a number: how far it is.
"""

import threading
from collections import OrderedDict, deque

from cairn_map.commits.cursor import Cursor
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.live_events import (
    CELLS_MAX,
    CHAIN_DIGITS,
    ENTRIES_MAX,
    CellsChanged,
    HeadMoved,
    LiveEvent,
    LogGrew,
    Seen,
)
from cairn_map.wire.messages import LogEntry
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow

PAST_ENTRIES = 1000
"""Who comes back after more entries than this is told `many`."""
CELLS_KEPT = 1024


class LiveChanges:
    """The newest changes of one map, as read from its store; thread-safe."""

    def __init__(self, store: Store, row: MapRow) -> None:
        self._store = store
        self._row = row
        self._lock = threading.Lock()
        self._head: Cursor | None = None
        self._floor = 0
        """Of what changed at or before this entry, not everything is known."""
        self._cells: OrderedDict[CellKey, int] = OrderedDict()
        self._entries: deque[LogEntry] = deque(maxlen=ENTRIES_MAX)

    @property
    def head(self) -> Cursor:
        """The newest state that was read."""
        with self._lock:
            assert self._head is not None, "read first"  # noqa: S101 - `Hub.join` does
            return self._head

    def read(self) -> None:
        """Read what was folded since the last time."""
        with self._lock, self._store.snapshot(self._row) as snapshot:
            head = snapshot.head.cursor
            known = self._head.seq if self._head else -1
            start = max(known, head.seq - PAST_ENTRIES, 0)
            if start > known:  # nobody listened for long
                self._cells.clear()
                self._entries.clear()
                self._floor = start
            for cell in sorted(snapshot.cells(after_seq=start), key=lambda cell: cell.lm):
                self._cells[cell.key] = cell.lm
                self._cells.move_to_end(cell.key)
            after = max(start, head.seq - ENTRIES_MAX)
            self._entries.extend(snapshot.log(after_seq=after, limit=ENTRIES_MAX))
            self._head = head
            while len(self._cells) > CELLS_KEPT:
                self._floor = self._cells.popitem(last=False)[1]

    def has_proof(self, seen: Seen) -> bool:
        """Whether a listener's place is one of this log: no other server's, and not lost in a restore."""
        with self._store.snapshot(self._row) as snapshot:
            chain = snapshot.chain_at(seen.seq) if seen.seq <= snapshot.head.cursor.seq else None
        return chain is not None and chain.hex()[:CHAIN_DIGITS] == seen.chain

    def since(self, seen: Seen) -> tuple[list[LiveEvent], Seen]:
        """What a listener at this place has not been told, and where it is once it was."""
        with self._lock:
            head = self._head
            if head is None or head.seq <= seen.seq:
                return [], seen
            entries = [entry for entry in self._entries if entry.seq > seen.seq]
            cells: list[tuple[int, int, int, int]] = []
            for key, lm in reversed(self._cells.items()):
                if lm <= seen.seq or len(cells) > CELLS_MAX:
                    break
                i, j, k = cell_of_key(key)
                cells.append((i, j, k, lm))
        is_many = seen.seq < self._floor or len(cells) > CELLS_MAX
        moved = Seen(head.seq, head.chain.hex()[:CHAIN_DIGITS], seen.tick)
        events: list[LiveEvent] = []
        if cells or is_many:  # a retract of what never came changes no cell
            events.append(CellsChanged(id=str(seen), cells="many" if is_many else cells))
        events.append(LogGrew(id=str(seen), entries=entries, left_out=head.seq - seen.seq - len(entries)))
        return [*events, HeadMoved(id=str(moved), cursor=str(head))], moved
