"""A store in memory: dictionaries, for tests and for maps that need not survive the process (`store.Store`)."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace

from tests.memory_store.admission import Keys, admit_registration
from tests.memory_store.attachments import MemoryAttachments
from tests.memory_store.clock import MemoryClock
from tests.memory_store.figures import MemoryHealth, MemoryNotes, MemoryShares, MemoryUses
from tests.memory_store.leases import MemoryLeases
from tests.memory_store.map import MemoryMap, new_memory_map
from tests.memory_store.maps import MemoryMaps
from tests.memory_store.robot_keys import MemoryAdmittedKeys
from tests.memory_store.snapshot import MemorySnapshot
from tests.memory_store.tokens import MemoryAuditLog, MemoryTokens

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import CairnError, NotFoundError, UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.map_refusals import GoneMap, check_layer_count, check_same_layer, check_same_map
from cairn_server.store.admission import OWN_WORD, Grounds
from cairn_server.store.replica_notes import FoldHint, ReplicaNotes
from cairn_server.store.store import Store
from cairn_server.store.store_age import CLOCKS, AgeMark, Clocks, StoreAge
from cairn_server.store.store_rows import Branch, Fold, MapRow, NewCommit, StoredCommit

log = logging.getLogger(__name__)


class MemoryStore:
    """`store.Store` without a disk: what it acknowledges lasts as long as the process."""

    def __init__(
        self,
        clocks: Clocks = CLOCKS,
        *,
        leases: MemoryLeases | None = None,
        make_notes: Callable[[MemoryMaps], ReplicaNotes] | None = None,
    ) -> None:
        """Make an empty store; `make_notes` (`replicas.MemoryReplicaNotes`) where several servers work on it."""
        self._maps = MemoryMaps()
        self.leases = leases
        self.replicas = make_notes(self._maps) if make_notes else None
        self.age = StoreAge(AgeMark(), clocks)
        self.clock = MemoryClock(clocks, is_shared=make_notes is not None)
        self.tokens = MemoryTokens(self._maps, self.age)
        self.keys = MemoryAdmittedKeys(self._maps)
        self.audit_log = MemoryAuditLog(self._maps)
        self.health = MemoryHealth(self._maps, self.age)
        self.uses = MemoryUses(self._maps)
        self.shares = MemoryShares(self._maps)
        self.attachments = MemoryAttachments(self._maps)
        self.notes = MemoryNotes(self._maps)

    def create_map(
        self, name: str, geometry: Geometry, sensor_model: SensorModel, epoch_s: int | None = None
    ) -> tuple[MapRow, bool]:
        """The map and whether it is new; an equal one may exist already."""
        layer = MapLayer(geometry=geometry, epoch_s=epoch_s)
        with self._maps.locked() as maps:
            known = maps.get(name)
            if known is None:
                self._maps.made += 1
                maps[name] = new_memory_map(self._maps.made, name, layer, sensor_model)
            else:
                check_same_map(name, (known.row.layer, known.row.sensor_model), (layer, sensor_model))
            return maps[name].row, known is None

    def map(self, name: str) -> MapRow:
        """The map of a name."""
        return self._maps.row(name)

    def delete_map(self, row: MapRow, *, by: str) -> GoneMap:
        """Take a map out of the store for good, and end its tokens."""
        with self._maps.locked() as maps, self._maps.changing(row):
            for layer in self.layers(row):
                self.delete_map(layer, by=by)
            gone = GoneMap(number=row.number, name=row.name, deleted_s=time.time(), by=by)
            self._maps.gone.append(gone)
            del maps[row.name]
            self.tokens.end_with(gone)
            return gone

    def clear_deleted(self, *, size_bytes_max: int) -> bool:
        """Nothing: nothing is left of a deleted map."""
        return False

    def maps(self) -> list[MapRow]:
        """All maps, by name."""
        with self._maps.locked() as maps:
            return [maps[name].row for name in sorted(maps)]

    def layers(self, row: MapRow) -> list[MapRow]:
        """Further layers of a map, by name."""
        return [each for each in self.maps() if each.name.startswith(f"{row.name}.")]

    def heads(self, numbers: Collection[int] | None = None) -> list[tuple[MapRow, Cursor]]:
        """All maps, or those of these numbers that there are, with their present states."""
        with self._maps.locked() as kept:
            found = [(kept[name].row, kept[name].head) for name in sorted(kept)]
        return [(row, head) for row, head in found if numbers is None or row.number in numbers]

    def waiting_maps(self) -> list[MapRow]:
        """Maps with commits to be folded, or with a retract under way, by name."""
        with self._maps.locked() as maps:
            return [maps[name].row for name in sorted(maps) if any(kept.is_due for kept in maps[name].commits.values())]

    def next_waiting(self, *, after: int, limit: int) -> list[MapRow]:
        """Maps with commits to be folded whose numbers are above `after`, by number: the first `limit`."""
        rows = sorted(self.waiting_maps(), key=lambda row: row.number)
        return [row for row in rows if row.number > after][:limit]

    def maps_with_evidence(self, *, before_s: float) -> list[MapRow]:
        """Maps with evidence of commits folded before an age of the store, by name."""
        with self._maps.locked() as maps:
            return [maps[name].row for name in sorted(maps) if maps[name].has_evidence(before_s)]

    def newest_epoch(self, row: MapRow) -> Epoch:
        """Newest epoch of the commits of a map; `BASE` if none has one."""
        with self._maps.reading(row) as state:
            return max((kept.new.epoch for kept in state.commits.values()), default=BASE)

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """Keep a commit; True if it is new, False if the same one is known already."""
        with self._maps.changing_keys(row) as keys, self._maps.changing(row) as changed:
            return self._append(changed, commit, keys)

    def _append(self, changed: MemoryMap, commit: NewCommit, keys: Keys) -> bool:
        """Keep a commit, and begin the layer that it defines."""
        row, layer = changed.row, commit.layer
        others = {each.name: each.layer for each in self.layers(row)}
        name = f"{row.name}.{layer.name}" if layer is not None else ""
        if layer is not None and commit.id not in changed.commits:
            if name in others:
                check_same_layer(name, others[name], layer)
            else:
                check_layer_count(row.name, len(others))
        is_new = changed.append(commit, age_s=self.age.now_s(), keys=keys)
        if is_new and layer is not None and name not in others:
            with self._maps.locked() as maps:
                self._maps.made += 1
                grid = MapLayer(geometry=layer.geometry, epoch_s=layer.epoch_s)
                maps[name] = new_memory_map(self._maps.made, name, grid, row.sensor_model, row)
        return is_new

    def submit(self, row: MapRow, commit: NewCommit) -> Future[bool]:
        """Keep a commit, at once."""
        done: Future[bool] = Future()
        try:
            done.set_result(self.append(row, commit))
        except CairnError as exc:
            done.set_exception(exc)
        return done

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""
        with self._maps.changing_keys(row) as keys, self._maps.changing(row) as changed:
            commit = build(changed.next_number(author))
            self._append(changed, commit, keys)
            return commit

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """Commits to be folded, in turn of their robots, with their diffs: at most `limit`; one or within the size."""
        found: list[StoredCommit] = []
        total_bytes = 0
        with self._maps.reading(row) as state:
            waiting = [kept for kept in state.due() if kept.number not in skip]
            turns: Counter[str] = Counter()
            turn_of: dict[int, int] = {}
            for kept in waiting:
                robot = kept.new.id.author.robot
                turns[robot] += 1
                turn_of[kept.number] = turns[robot]
            for kept in sorted(waiting, key=lambda kept: (turn_of[kept.number], kept.number)):
                total_bytes += kept.new.size_bytes
                if len(found) >= limit or (found and total_bytes > size_bytes_max):
                    break
                found.append(kept.stored())
        return found

    def commit(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A commit with its diff, folded or not; None if there is none."""
        with self._maps.reading(row) as state:
            kept = state.commits.get(commit)
            return kept.stored() if kept else None

    def kept_sha(self, row: MapRow, commit: CommitId) -> bytes | None:
        """SHA-256 of a commit whose bytes are not wanted; None of any other."""
        with self._maps.reading(row) as state:
            kept = state.commits.get(commit)
            if kept is None or kept.is_damaged or (kept.is_gone and commit not in state.retracted):
                return None
            return kept.new.sha

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        with self._maps.reading(row) as state:
            kept = state.commits.get(commit)
            return kept.stored() if kept and kept.folded_seq is not None else None

    def forget_evidence(self, row: MapRow, *, before_s: float, limit: int) -> int:
        """Drop the evidence and the meta of up to `limit` commits folded, and last pushed, before an age; how many."""
        with self._maps.changing(row) as changed:
            return changed.forget_evidence(before_s=before_s, limit=limit, age_s=self.age.now_s())

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """Whether a retract of this id has taken effect, or waits for it to come."""
        with self._maps.reading(row) as state:
            return commit in state.retracted

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if the head is still its base; False (and nothing written) otherwise."""
        with self._maps.changing(row) as changed:
            is_written = changed.fold(fold, age_s=self.age.now_s())
        if is_written:
            self._maps.tell_fold(FoldHint(row.number, fold.head.seq))
        return is_written

    @contextmanager
    def snapshot(self, row: MapRow) -> Iterator[MemorySnapshot]:
        """One state of the map."""
        yield MemorySnapshot(self._maps.shared(row))

    def register(self, row: MapRow, branch: Branch, token_hash: bytes, grounds: Grounds = OWN_WORD) -> None:
        """Make a branch and its token, or give an existing one another secret."""
        with self._maps.changing_keys(row) as keys, self._maps.changing(row) as changed:
            author = Author(RobotName(branch.name), Incarnation(branch.incarnation))
            admit_registration(keys, author, grounds)
            known = changed.branches.get(branch.name)
            # A new incarnation may have lost its disk: where it stands is not known before it fetches.
            cursor = known.cursor if known and known.incarnation == branch.incarnation else None
            changed.branches[branch.name] = replace(branch, cursor=cursor)
            self.tokens.put_registration(row, branch.name, token_hash)

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands."""
        with suppress(UnreachableError, NotFoundError), self._maps.changing(row) as changed:  # it is only a note
            known = changed.branches.get(name)
            if known is not None:
                changed.branches[name] = replace(known, cursor=cursor or known.cursor, last_seen_s=time.time())

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and all tokens of its robot."""
        with self._maps.changing(row) as changed:
            if changed.branches.pop(name, None) is None:
                raise NotFoundError("no_branch", f"map {row.name} has no branch {name!r}")
            for notes in (changed.statuses, changed.heard_s, changed.views):
                notes.pop(name, None)  # type: ignore[attr-defined]
            self.tokens.remove_of(row, name)

    def branches(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        with self._maps.reading(row) as state:
            return [state.branches[name] for name in sorted(state.branches)]

    def branch(self, row: MapRow, name: str) -> Branch | None:
        """One branch as it is stored."""
        with self._maps.reading(row) as state:
            return state.branches.get(name)

    def keep_age(self) -> None:
        """Keep nothing: the store ends with the process."""

    def audit(self, what: str, detail: str, *, client: str = "") -> None:
        """Note something that an administrator may have to look into."""
        log.warning("%s: %r", what, detail)
        with suppress(UnreachableError):
            self.audit_log.add("server", what, detail, client=client)

    def close(self) -> None:
        """Answer nothing any more."""
        self._maps.close()


_IS_A_STORE: type[Store] = MemoryStore
"""Refused by the type checker if it is none."""
