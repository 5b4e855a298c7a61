"""Commits that the server holds, as relays compare them, and those that it wants pushed again.

Vectors compare the ids of what two servers hold; sums of SHA-256 compare the contents.
"""

import threading
from collections import defaultdict
from collections.abc import Iterable

from cairn_map.commits.cursor import ENTRY_FOLD, Cursor
from cairn_map.commits.ids import Author, CommitId, RobotName
from cairn_map.wire.messages import WANTED_MAX
from cairn_map.wire.relay_peer import SUM_BYTES, Held, sum_of_shas
from cairn_server.access.shared_places import SharedPlaces
from cairn_server.store.history import head_of, is_proven
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import MapRow

PAGE = 1000
ZERO = bytes(SUM_BYTES)


class HeldCommits:
    """Holdings of all maps; sums are kept, and only what was folded since is added to them. Thread-safe."""

    def __init__(self, store: Store, wanted: "WantedCommits") -> None:
        self._store = store
        self._wanted = wanted
        self._locks: dict[int, threading.Lock] = {}
        self._sums: dict[int, tuple[Cursor, dict[Author, bytes]]] = {}

    def of(self, row: MapRow) -> Held:
        """Holdings of a map now."""
        with self._store.snapshot(row) as snapshot:
            pending = snapshot.pending()
            with self._locks.setdefault(row.number, threading.Lock()):  # one log may take long to read
                sums = self._sums_in(row, snapshot)
            return Held(
                vector=head_of(snapshot).vector.with_commits(pending),
                wanted=self._wanted.of(row.name),
                sums={author: total for author, total in sums.items() if author not in pending.intervals},
            )

    def _sums_in(self, row: MapRow, snapshot: Snapshot) -> dict[Author, bytes]:
        head = snapshot.head
        known, sums = self._sums.get(row.number, (None, {}))
        # A store that was restored has another history behind the same number.
        if known is None or not is_proven(known, snapshot):
            known, sums = None, {}
        after_seq = known.seq if known else 0
        sums = dict(sums)
        while entries := snapshot.chained(after_seq=after_seq, limit=PAGE):
            shas = defaultdict(list)
            for entry in entries:
                if entry.kind == ENTRY_FOLD:
                    shas[entry.commit.author].append(entry.sha)
            sums |= {author: sum_of_shas(sums.get(author, ZERO), found) for author, found in shas.items()}
            after_seq = entries[-1].seq
        self._sums[row.number] = head, sums
        return sums


class WantedCommits:
    """Commits whose evidence was dropped and which a retract needs again, so that robots are asked for them.

    `WANTED_MAX` of each map are kept, and robots share these places (`access.shared_places`): no robot's retracts make
    the server forget what another's, or an operator's, need. In memory only: after a start a retract is refused once
    more, and its targets are wanted again. Thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wanted: defaultdict[str, SharedPlaces[CommitId, None]] = defaultdict(lambda: SharedPlaces(WANTED_MAX))

    def note(self, map_name: str, commits: Iterable[CommitId], *, asker: RobotName) -> None:
        """Want these: a retract of them was refused, by this author's robot or `operator`."""
        with self._lock:
            for commit in commits:
                self._wanted[map_name].put(asker, commit, None)

    def forget(self, map_name: str, commit: CommitId) -> None:
        """Stop wanting a commit: it came."""
        with self._lock:
            if map_name in self._wanted:
                self._wanted[map_name].remove(commit)

    def of(self, map_name: str) -> tuple[CommitId, ...]:
        """Wanted commits of a map."""
        with self._lock:
            return tuple(self._wanted[map_name].keys()) if map_name in self._wanted else ()
