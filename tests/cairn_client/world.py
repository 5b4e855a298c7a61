"""Robots and a server in one process, whose links and disks fail on request.

The server is the real `Service` on a real store; only the folding thread is replaced by folding on request, and what
is stable by what the last backup holds. `DirectApi` has the methods of `MapApi` and calls the service; `FaultyApi`
loses, repeats and cuts its answers.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest
from tests.cairn_client.made import GEOMETRY, MAP, cells_of, random_diff
from tests.sync_sim.server import FoldOnRequest, StableBackup

from cairn_client.http.http_link import Link
from cairn_client.replica import replica_store
from cairn_client.replica.outbox import UNNUMBERED
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.sync.applying import is_within
from cairn_client.sync.responses import FetchedCell
from cairn_client.sync.sync import fetch_cells, fetch_missing, push_commits
from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import Commit, CommitMeta, split_commit
from cairn_map.commits.ids import OPERATOR, Author, CommitId, RobotName, commit_id_from_text
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import ConflictError, UnreachableError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import ZERO, fingerprint
from cairn_map.evidence.grid import Cell, CellKey, cell_key
from cairn_map.wire.frames import Frame
from cairn_map.wire.index_messages import CellIndex
from cairn_map.wire.messages import CreateMap, MissingRequest, Pushed, Retract
from cairn_map.wire.resumed_replies import Replies
from cairn_server import service as service_module
from cairn_server.access.auth import Caller, Role
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite import store as sqlite_store
from cairn_server.store.sqlite import writer as sqlite_writer
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.sync.handing_over import found_commit

MODES = ("high-end", "high-end", "low-end", "viewer")
PUSHES = (0, 1, 2)
FINAL_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens to the n-th call of a round: lost before or after the server did it, done twice, or cut."""

    call: int
    kind: str
    frames: int = 0


def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No flush to disk (nobody cuts the power of these tests), and no folding thread."""
    pragmas = tuple(p for p in replica_store.PRAGMAS if "synchronous" not in p)
    monkeypatch.setattr(replica_store, "PRAGMAS", (*pragmas, "synchronous = OFF"))
    connect = sqlite_writer.connect

    def connect_quickly(path: Path) -> Any:
        connection = connect(path)
        connection.execute("PRAGMA synchronous = OFF")
        return connection

    monkeypatch.setattr(sqlite_writer, "connect", connect_quickly)
    monkeypatch.setattr(sqlite_store, "connect", connect_quickly)
    monkeypatch.setattr(service_module, "Folder", FoldOnRequest)


class DirectApi:
    """`MapApi` without HTTP."""

    def __init__(self, world: "World", robot: str) -> None:
        self._world = world
        self._caller = Caller(Role.ROBOT, robot)

    def commit(self, name: str, commit: CommitId) -> tuple[bytes, str | None]:
        service = self._world.service
        found = found_commit(service.store, service.store.map(name), str(commit))
        return found.data, found.seal

    def push(self, name: str, commit: Commit, *, seal: str | None = None, signatures: str | None = None) -> Pushed:
        service = self._world.service
        beside = {"seal": seal, "signatures": signatures}
        is_new = service.push(service.store.map(name), self._caller, str(commit.id), commit.data, **beside)
        return Pushed(id=str(commit.id), state="new" if is_new else "known")

    def missing(
        self, name: str, branch: str, request: MissingRequest, *, replies: Replies | None = None
    ) -> Iterator[Frame]:
        service = self._world.service
        reply = (replies or Replies()).reply_to(request)
        sent = MissingRequest.model_validate_json(reply.request.model_dump_json())
        data = service.missing(service.store.map(name), branch, sent)
        yield from reply.frames([data]) if data else reply.again()

    def cell_index(
        self, name: str, author: Author | None = None, *, box: object = None, after: object = None
    ) -> CellIndex:
        service = self._world.service
        index = service.cell_index(service.store.map(name), author)
        return CellIndex.model_validate_json(index.model_dump_json())

    def cell(self, name: str, cell: Cell, *, etag: str | None = None) -> FetchedCell:
        service = self._world.service
        stored, head = service.cells.sound(service.store.map(name), cell_key(cell))
        assert stored is not None
        found = f'"{stored.digest.hex()}"'
        body = None if etag == found else stored.body
        return FetchedCell(body, found, head.cursor, head.vector, stored.fingerprint)


class FaultyApi:
    """An API one of whose calls goes wrong."""

    def __init__(self, api: DirectApi, fault: Fault | None) -> None:
        self._api = api
        self._fault = fault
        self._calls = 0

    def commit(self, name: str, commit: CommitId) -> tuple[bytes, str | None]:
        found: tuple[bytes, str | None] = self._call(self._api.commit, name, commit)
        return found

    def push(self, name: str, commit: Commit, *, seal: str | None = None, signatures: str | None = None) -> Pushed:
        pushed: Pushed = self._call(self._api.push, name, commit, seal=seal, signatures=signatures)
        return pushed

    def missing(
        self, name: str, branch: str, request: MissingRequest, *, replies: Replies | None = None
    ) -> Iterator[Frame]:
        fault = self._next()
        self._lose(fault, "before")
        for n, frame in enumerate(list(self._api.missing(name, branch, request, replies=replies))):
            if fault and fault.kind in ("cut", "after") and n == fault.frames:
                raise UnreachableError("cut_off", "cut")
            yield frame

    def cell_index(
        self, name: str, author: Author | None = None, *, box: object = None, after: object = None
    ) -> CellIndex:
        index: CellIndex = self._call(self._api.cell_index, name, author)
        return index

    def cell(self, name: str, cell: Cell, *, etag: str | None = None) -> FetchedCell:
        fetched: FetchedCell = self._call(self._api.cell, name, cell, etag=etag)
        return fetched

    def _next(self) -> Fault | None:
        self._calls += 1
        return self._fault if self._fault and self._fault.call == self._calls - 1 else None

    def _lose(self, fault: Fault | None, kind: str) -> None:
        if fault and fault.kind == kind:
            raise UnreachableError("no_link", f"lost {kind}")

    def _call(self, function: Any, *args: Any, **options: Any) -> Any:
        fault = self._next()
        self._lose(fault, "before")
        answer = function(*args, **options)
        if fault and fault.kind == "twice":
            answer = function(*args, **options)
        self._lose(fault, "after")
        return answer


StoredNote = tuple[str, dict[CellKey, bytes]]


def stored_commits(folder: Path) -> dict[CommitId, StoredNote | None]:
    """Note and cells of every commit that the server of a folder has; None where they are not kept any more."""
    connection = sqlite_writer.connect(folder / sqlite_store.FILE_NAME)
    try:
        found: dict[CommitId, StoredNote | None] = {}
        query = "SELECT number, robot || '.' || incarnation || '.' || n, meta, gone FROM commits"
        for number, text, meta, gone in connection.execute(query).fetchall():
            if gone:
                found[commit_id_from_text(text)] = None
                continue
            cells = connection.execute("SELECT cell, body FROM diff WHERE commit_number = ?", (number,)).fetchall()
            found[commit_id_from_text(text)] = (CommitMeta.model_validate_json(meta).note, dict(cells))
        return found
    finally:
        connection.close()


class World:
    """A server and some robots, each in a folder."""

    def __init__(self, folder: Path, modes: tuple[str, ...] = MODES) -> None:
        self._folder = folder
        self._modes = modes
        self._stable = EMPTY
        self._serial = 0
        self._seen: dict[CommitId, StoredNote] = {}
        """Commits as they were before the server forgot their evidence."""
        self._start_server()
        self.service.create_map(MAP, CreateMap(geometry=GEOMETRY))
        self.robots: list[Replica] = [self._open(r) for r in range(len(modes))]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for robot in self.robots:
            robot.close()
        self.service.close()

    # What can happen

    def commit(self, robot: int, seed: int) -> None:
        """A robot maps something."""
        self._commit(robot, seed, ())

    def amend(self, robot: int, which: int) -> None:
        """A robot takes one of the commits that it still has back, and puts other evidence in its place."""
        own = [commit for commit in self.robots[robot].commits if commit.author.robot != OPERATOR]
        if own:
            self._commit(robot, which, (str(own[which % len(own)]),))

    def retract(self, which: int) -> None:
        """An operator takes out a commit that may or may not have come yet."""
        known = {commit for robot in self.robots for commit in robot.commits} | self._stored().keys()
        targets = sorted(str(commit) for commit in known if commit.author.robot != OPERATOR)
        if targets:
            try:
                self.service.retract(self._row, Retract(commits=[targets[which % len(targets)]]), by=Caller(Role.ADMIN))
            except ConflictError as exc:
                assert exc.kind == "evidence_gone"

    def forget_evidence(self) -> None:
        """The server drops the evidence of all that it has folded."""
        self._stored()
        self.service.store.forget_evidence(self._row, before_s=float("inf"), limit=1000)

    def sync(self, robot: int, fault: Fault | None = None) -> None:
        """A robot's round, which the fault may end early."""
        api: Any = FaultyApi(DirectApi(self, f"r{robot}"), fault)
        try:
            self._round(robot, api)
        except UnreachableError:
            assert fault is not None
        else:
            self._check_level(robot)

    def sync_box(self, robot: int, side: int) -> None:
        """A robot fetches only what lies on one side."""
        if self._modes[robot] != "low-end":
            box = (Cell(-9, -9, -9), Cell(-1, 9, 9)) if side else (Cell(0, -9, -9), Cell(9, 9, 9))
            api: Any = DirectApi(self, f"r{robot}")
            Link(api, MAP, branch=f"r{robot}").hold(fetch_missing(self.robots[robot], box=box))
            inside = [key for key in self.robots[robot].cells if is_within(key, box)]
            with self.service.store.snapshot(self._row) as snapshot:
                rows = {row.key: row for row in snapshot.cells() if is_within(row.key, box)}
            for key in rows.keys() | set(inside):
                held = self.robots[robot].cells[key].fingerprint
                assert held == (rows[key].fingerprint if key in rows else ZERO)

    def fold(self, limit: int) -> None:
        """The server folds some of what waits."""
        fold_pending(self.service.store, self._row, self._cache, limit=limit)

    def restart_server(self) -> None:
        """The server stops and starts again on the same store."""
        self.service.close()
        self._start_server()

    def back_up(self) -> None:
        """A backup is made, and older ones are thrown away; what it holds is stable."""
        self.service.close()
        self._copy("server", "backup")
        self._start_server()
        with self.service.store.snapshot(self._row) as snapshot:
            self._stable = snapshot.head.vector
        self._start_stable()

    def restore(self) -> None:
        """The server's folder is replaced by the backup."""
        if (self._folder / "backup").exists():
            self.service.close()
            self._copy("backup", "server")
            self._start_server()

    def restart_robot(self, robot: int) -> None:
        """A robot's program stops without a word and starts again."""
        self.robots[robot].close()
        self.robots[robot] = self._open(robot)

    def save_disk(self, robot: int) -> None:
        """Somebody copies a robot's folder."""
        self.robots[robot].close()
        self._copy(f"r{robot}", f"saved{robot}")
        self.robots[robot] = self._open(robot)

    def roll_back_disk(self, robot: int) -> None:
        """Somebody puts that copy back."""
        if (self._folder / f"saved{robot}").exists():
            self.robots[robot].close()
            self._copy(f"saved{robot}", f"r{robot}")
            self.robots[robot] = self._open(robot)

    def lose_disk(self, robot: int) -> None:
        """A robot's folder is gone."""
        self.robots[robot].close()
        shutil.rmtree(self._folder / f"r{robot}")
        self.robots[robot] = self._open(robot)

    # What must hold

    def settle(self) -> None:
        """A few rounds without faults, everything folded."""
        for _ in range(FINAL_ROUNDS):
            for robot in range(len(self.robots)):
                self.sync(robot)
            self.fold(1000)

    def check(self) -> None:
        """After `settle` all maps are equal, equal to the sum of all commits, and no commit was lost."""
        held = self._notes_held()
        sealed = self._sealed_targets()
        self.settle()
        assert all(self.service.store.is_retracted(self._row, target) for target in sealed)
        expected = cells_of(self._sum_of_commits())
        with self.service.store.snapshot(self._row) as snapshot:
            rows = {row.key: (row.digest, row.fingerprint.hex()) for row in snapshot.cells() if row.voxels}
        assert rows == expected
        for robot in self.robots:
            assert cells_of(robot.view) == expected
            assert not robot.push_set()
            for key, cell in robot.cells.items():
                assert base_fingerprint(robot, key) == cell.fingerprint.hex()
        assert self._notes_stored() == held

    def _commit(self, robot: int, seed: int, retracts: tuple[str, ...]) -> None:
        self._serial += 1
        author = self.robots[robot].author
        unnumbered = str(CommitId(author, UNNUMBERED))
        meta = CommitMeta(id=unnumbered, geometry=GEOMETRY.digest().hex(), retracts=retracts, note=f"{self._serial}")
        self.robots[robot].commit(random_diff(seed), meta)

    def _check_level(self, robot: int) -> None:
        """After a whole round a robot shows the server's map, and what its own commits change of it."""
        replica = self.robots[robot]
        expected = EvidenceMap(GEOMETRY)
        with self.service.store.snapshot(self._row) as snapshot:
            for listed in snapshot.cells():
                row = snapshot.cell(listed.key)
                assert row is not None
                expected.merge({row.key: decode_cell(row.body).evidence})
            folded = snapshot.head.vector
        kept = {commit: split_commit(replica.commit_data(commit) or b"") for commit in replica.commits}
        named = {target: commit for commit, (meta, _) in reversed(kept.items()) for target in meta.retracted_ids}
        for commit, (_, cells) in kept.items():
            diff = {key: decode_cell(body).evidence for key, body in cells.items()}
            if commit not in folded and commit not in named:
                expected.merge(diff)
            elif commit in folded and commit in named and named[commit] not in folded:
                expected.unmerge(diff)
        assert cells_of(replica.view) == cells_of(expected)

    def _round(self, robot: int, api: Any) -> None:
        replica, link = self.robots[robot], Link(api, MAP, branch=f"r{robot}")
        if robot in PUSHES:
            assert not link.hold(push_commits(replica)).refused
        if self._modes[robot] == "low-end":
            link.hold(fetch_cells(replica))
        else:
            link.hold(fetch_missing(replica))

    def _open(self, robot: int) -> Replica:
        store = ReplicaStore(self._folder / f"r{robot}")
        return Replica(store, robot=RobotName(f"r{robot}"), map_name=MAP, geometry=GEOMETRY)

    def _start_server(self) -> None:
        folder = self._folder / "server"
        self.service = Service(SqliteStore(folder), Settings(folder=folder))
        self._cache = CellCache(GEOMETRY)
        self._start_stable()

    def _start_stable(self) -> None:
        self.service._stable = StableBackup(self._stable)  # type: ignore[assignment]

    @property
    def _row(self) -> Any:
        return self.service.store.map(MAP)

    def _copy(self, source: str, target: str) -> None:
        shutil.rmtree(self._folder / target, ignore_errors=True)
        shutil.copytree(self._folder / source, self._folder / target)

    def _stored(self) -> dict[CommitId, StoredNote]:
        stored = stored_commits(self._folder / "server")
        self._seen |= {commit: note for commit, note in stored.items() if note is not None}
        return {commit: note or self._seen[commit] for commit, note in stored.items()}

    def _sealed_targets(self) -> set[CommitId]:
        """What operators' retracts name that some robot keeps: no restore may bring it back (rule 11)."""
        kept = [(robot, commit) for robot in self.robots for commit in robot.commits if commit.author.robot == OPERATOR]
        data = [robot.commit_data(commit) for robot, commit in kept]
        return {target for text in data if text for target in split_commit(text)[0].retracted_ids}

    def _sum_of_commits(self) -> EvidenceMap:
        stored = self._stored()
        total = EvidenceMap(GEOMETRY)
        for commit, (_, cells) in stored.items():
            if not self.service.store.is_retracted(self._row, commit):
                total.merge({key: decode_cell(body).evidence for key, body in cells.items()})
        return total

    def _notes_stored(self) -> set[str]:
        return {note for note, _ in self._stored().values()} - {""}

    def _notes_held(self) -> set[str]:
        notes = self._notes_stored()
        for r in PUSHES[: len(self.robots)]:
            for commit in self.robots[r].commits:
                data = self.robots[r].commit_data(commit)
                assert data is not None
                notes.add(split_commit(data)[0].note)
        return notes - {""}


def base_fingerprint(robot: Replica, key: CellKey) -> str:
    """Fingerprint of a base as it is on the robot's disk."""
    return fingerprint(robot.base_evidence(key), key).hex()
