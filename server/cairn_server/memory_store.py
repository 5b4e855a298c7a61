"""A store in memory: dictionaries, for tests and for maps that need not survive the process (`store.Store`).

    writer     changes the dictionaries of one map under the lock
    snapshot   gets these very dictionaries; whoever writes next copies them first

So reading never waits for writing, and a map that nobody reads is not copied for each commit.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from cairn_map.cursor import Cursor
from cairn_map.errors import ConflictError, NotFoundError, UnreachableError
from cairn_map.grid import Geometry
from cairn_map.ids import Author, CommitId
from cairn_map.sensor_model import SensorModel
from cairn_server.memory_map import MemoryMap, MemorySnapshot, new_memory_map
from cairn_server.store_rows import Branch, Fold, MapRow, NewCommit, StoredCommit

log = logging.getLogger(__name__)


class MemoryStore:
    """`store.Store` without a disk: what it acknowledges lasts as long as the process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._maps: dict[str, MemoryMap] = {}
        self._closed = False

    def create_map(self, name: str, geometry: Geometry, sensor_model: SensorModel) -> tuple[MapRow, bool]:
        """The map and whether it is new; an equal one may exist already."""
        with self._locked():
            known = self._maps.get(name)
            if known is None:
                self._maps[name] = new_memory_map(len(self._maps) + 1, name, geometry, sensor_model)
            elif (known.row.geometry, known.row.sensor_model) != (geometry, sensor_model):
                raise ConflictError("map_exists", f"map {name} exists with another geometry or sensor model")
            return self._maps[name].row, known is None

    def map(self, name: str) -> MapRow:
        """The map of a name."""
        with self._locked():
            if name in self._maps:
                return self._maps[name].row
        raise NotFoundError("no_map", f"there is no map {name!r}; `cairn map ls` lists them")

    def maps(self) -> list[MapRow]:
        """All maps, by name."""
        with self._locked():
            return [self._maps[name].row for name in sorted(self._maps)]

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """Keep a commit; True if it is new, False if the same one is kept already."""
        with self._changing(row) as changed:
            return changed.append(commit)

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""
        with self._changing(row) as changed:
            commit = build(changed.next_number(author))
            changed.append(commit)
            return commit

    def pending(self, row: MapRow, *, limit: int, size_bytes_max: int) -> list[StoredCommit]:
        """Commits to be folded, in order of arrival, with their diffs: at most `limit`, and one or within the size."""
        found: list[StoredCommit] = []
        total_bytes = 0
        with self._reading(row) as state:
            for commit in state.waiting():
                total_bytes += commit.size_bytes
                if len(found) >= limit or (found and total_bytes > size_bytes_max):
                    break
                found.append(state.stored(commit.id))
        return found

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        with self._reading(row) as state:
            return state.stored(commit) if commit in state.folded else None

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """Whether a retract of this id has taken effect, or waits for it to come."""
        with self._reading(row) as state:
            return commit in state.retracted

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if the head is still its base; False (and nothing written) otherwise."""
        with self._changing(row) as changed:
            return changed.fold(fold)

    @contextmanager
    def snapshot(self, row: MapRow) -> Iterator[MemorySnapshot]:
        """One state of the map."""
        with self._locked():
            state = self._maps[row.name]
            state.is_shared = True
        yield MemorySnapshot(state)

    def register(self, row: MapRow, branch: Branch, token_hash: bytes) -> None:
        """Make a branch, or give an existing one a new token."""
        with self._changing(row) as changed:
            known = changed.branches.get(branch.name)
            changed.branches[branch.name] = replace(branch, cursor=known.cursor if known else None)
            changed.tokens[branch.name] = token_hash

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands."""
        with self._lock:
            if self._closed or name not in self._maps[row.name].branches:
                return
            changed = self._to_change(row)
            known = changed.branches[name]
            changed.branches[name] = replace(known, cursor=cursor or known.cursor, last_seen_s=time.time())

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and its token."""
        with self._changing(row) as changed:
            if changed.branches.pop(name, None) is None:
                raise NotFoundError("no_branch", f"map {row.name} has no branch {name!r}")
            del changed.tokens[name]

    def branches(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        with self._reading(row) as state:
            return [state.branches[name] for name in sorted(state.branches)]

    def branch_of_token(self, row: MapRow, token_hash: bytes) -> str | None:
        """The branch that a token was given to."""
        with self._reading(row) as state:
            return next((name for name, known in state.tokens.items() if known == token_hash), None)

    def audit(self, what: str, detail: str) -> None:
        """Note something that an administrator may have to look into."""
        log.warning("%s: %r", what, detail)

    def close(self) -> None:
        """Answer nothing any more."""
        self._closed = True

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with self._lock:
            if self._closed:
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            yield

    @contextmanager
    def _reading(self, row: MapRow) -> Iterator[MemoryMap]:
        with self._locked():
            yield self._maps[row.name]

    @contextmanager
    def _changing(self, row: MapRow) -> Iterator[MemoryMap]:
        with self._locked():
            yield self._to_change(row)

    def _to_change(self, row: MapRow) -> MemoryMap:
        """The map's dictionaries, which no snapshot has."""
        state = self._maps[row.name]
        if state.is_shared:
            state = self._maps[row.name] = state.copied()
        return state
