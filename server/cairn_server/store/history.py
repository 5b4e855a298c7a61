"""Identity of a map's history, and the commits in each state of it.

The log's chain at an entry proves every entry up to it. A store may be restored, or fail over to a copy that lost its
newest entries, while a server remembers more than is left. Then entries are numbered again, and a cell reaches the same
digest by other commits. So a cached value of a state is named by the chain at its entry, and code that goes on from a
state asks first whether it is still in the log.

    seq       0 ........ 1000 ........ 2000 .... 2417
    marks                  V             V                 stored: the vector at about each thousandth entry
    vector at 2417                       V + ids folded since
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from cairn_map.commits.cursor import ENTRY_FOLD, Cursor, first_chain
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import ChainedEntry, Head

MARK_EVERY = 1000
"""Log entries between two stored vectors."""
STATES_MAX = 4
"""States of one map whose vectors are kept: the newest ones, and that of the newest commits that are stable."""
MAPS_MAX = 64
"""Maps whose vectors are kept."""


def is_proven(cursor: Cursor, snapshot: Snapshot) -> bool:
    """True if a cursor is a state of this log, at or before the snapshot's (SYNC.md rule 1)."""
    return cursor.seq <= snapshot.head.seq and snapshot.chain_at(cursor.seq) == cursor.chain


def head_of(snapshot: Snapshot) -> Head:
    """State of a snapshot, with the commits in it."""
    return Head(cursor=snapshot.head, vector=snapshot.vector_at(snapshot.head.seq))


def crosses_mark(base: Cursor, head: Cursor) -> bool:
    """True if the vector at `head` is to be stored by the fold that leads there from `base`."""
    return head.seq // MARK_EVERY > base.seq // MARK_EVERY


class ChainedLog(Protocol):
    """Log of one map in one state."""

    def chain_at(self, seq: int) -> bytes | None:
        """`Snapshot.chain_at`."""
        ...

    def chained(self, *, after_seq: int, limit: int) -> Sequence[ChainedEntry]:
        """`Snapshot.chained`."""
        ...


class MarkedLog(ChainedLog, Protocol):
    """Log of one map in one state, with its marks."""

    def newest_mark(self, seq: int) -> int:
        """Entry of the newest mark at or before one; 0: there is none."""
        ...

    def mark(self, seq: int) -> VersionVector:
        """Vector of the mark at an entry."""
        ...


def folded_ids(log: ChainedLog, *, after_seq: int, to_seq: int) -> Iterator[CommitId]:
    """Ids of the commits folded by the log entries after one, up to another one."""
    # Only `+` puts an id into the vector; what is taken out again stays in it.
    while after_seq < to_seq:
        entries = log.chained(after_seq=after_seq, limit=min(MARK_EVERY, to_seq - after_seq))
        if not entries:
            return
        yield from (entry.commit for entry in entries if entry.kind == ENTRY_FOLD)
        after_seq = entries[-1].seq


def vector_in(log: MarkedLog, seq: int, known: tuple[int, VersionVector] = (0, EMPTY)) -> VersionVector:
    """Ids of the commits folded at or before an entry.

    Args:
        log: of the map.
        seq: the entry.
        known: an earlier entry, and the vector there.
    """
    mark_seq = log.newest_mark(seq)
    at, vector = (mark_seq, log.mark(mark_seq)) if mark_seq > known[0] else known
    return vector.with_commits(folded_ids(log, after_seq=at, to_seq=seq))


class ReadChains:
    """Chains at entries of the log in one snapshot, each read once: a reply asks for it with every changed cell."""

    def __init__(self, head: Cursor, layer_digest: bytes) -> None:
        self._known = {head.seq: head.chain, 0: first_chain(head.log_id, layer_digest)}

    def note(self, entries: list[ChainedEntry]) -> list[ChainedEntry]:
        """Keep the chains of entries that were read for another reason; returns the entries.

        A header's vector since the asker's state reads all entries that its changed cells name later.
        """
        self._known.update((entry.seq, entry.chain) for entry in entries)
        return entries

    def get(self, seq: int, read: Callable[[], bytes | None]) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log), by `read` the first time; None: there is no such entry."""
        chain = self._known.get(seq)
        if chain is None and (chain := read()) is not None:
            self._known[seq] = chain
        return chain


class KnownVectors:
    """Vectors of recent states of maps, from which those of later ones are made; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._maps: OrderedDict[int, OrderedDict[tuple[int, bytes], VersionVector]] = OrderedDict()
        """By number of the map; then by entry and its chain."""

    def at(self, map_number: int, seq: int, log: MarkedLog) -> VersionVector:
        """Ids of the commits folded at or before an entry of a map's log."""
        chain = log.chain_at(seq)
        if seq == 0 or chain is None:
            return vector_in(log, seq)
        with self._lock:
            states = self._maps.get(map_number, OrderedDict())
            if (seq, chain) in states:
                states.move_to_end((seq, chain))
                return states[seq, chain]
            earlier = sorted((state for state in states if state[0] < seq), reverse=True)
            vectors = {state: states[state] for state in earlier}
        # An entry with another chain is of a history that this log does not have (any more).
        proven = (state for state in earlier if log.chain_at(state[0]) == state[1])
        start = next(proven, None)
        vector = vector_in(log, seq, (start[0], vectors[start]) if start else (0, EMPTY))
        with self._lock:
            states = self._maps.setdefault(map_number, OrderedDict())
            self._maps.move_to_end(map_number)
            states[seq, chain] = vector
            while len(states) > STATES_MAX:
                states.popitem(last=False)
            while len(self._maps) > MAPS_MAX:
                self._maps.popitem(last=False)
        return vector
