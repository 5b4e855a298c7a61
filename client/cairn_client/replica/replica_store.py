"""SQLite file of a robot's durable state: its name and number, its commits, the server's cells that it holds.

Every change is one transaction with `synchronous=FULL`, so that power may be cut between any two steps. One robot
at a time has the file open; others may look at it (`sqlite_glance`). Any thread may call any method: the store locks
itself, for as long as a transaction lasts. It calls nothing else, so a thread that holds another lock may wait for it.
"""

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import apsw

from cairn_client.replica.folder_lock import lock_folder, make_folder
from cairn_client.replica.replica_schema import DDL, STEPS, VERSION, check_form, translate_damage
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector, version_vector_from_json
from cairn_map.epochs.epoch import BASE, Epoch, check_epoch
from cairn_map.errors import CairnError, ConflictError, DamagedDataError, UnreachableError
from cairn_map.evidence.fingerprint import Fingerprint, fingerprint_from_bytes
from cairn_map.evidence.grid import CellKey

FILE_NAME = "robot.sqlite"
BUSY_MS = 1000
"""Milliseconds for which a folder may still be held by a robot that is just closing."""
PRAGMAS = (
    "page_size = 16384",
    "journal_mode = WAL",
    "synchronous = FULL",
    "mmap_size = 0",
    "journal_size_limit = 67108864",
)
ONE_COMMIT = "robot = ? AND incarnation = ? AND n = ?"
TOGETHER = "together"
"""Text in the place of a cell's cursor: the cell stands at the map's own cursor and coverage (`ReplicaState`)."""
AGE = "age_s"
"""Key of the text that holds the store's age."""
Values = tuple[str | int | float | bytes | None, ...]


@dataclass(frozen=True, slots=True)
class BaseCell:
    """The server's cell as this robot last had it, without its bytes."""

    cursor: Cursor | None
    """None: not proven, to be fetched whole."""
    coverage: VersionVector
    fingerprint: Fingerprint
    etag: str | None = None


@dataclass(frozen=True, slots=True)
class GroupedCell:
    """A held cell that stands at the map's own state, without its bytes."""

    fingerprint: Fingerprint
    etag: str | None = None


@dataclass(frozen=True, slots=True)
class StoredBases:
    """All cells held, without their bytes."""

    apart: dict[CellKey, BaseCell]
    """Those with a state of their own."""
    together: dict[CellKey, GroupedCell]
    """Those that stand at the map's own state."""


@dataclass(frozen=True, slots=True)
class DeltaSizes:
    """Sizes of what was added to a cell since its bytes were written."""

    count: int
    size_bytes: int
    body_bytes: int
    """Size of the cell's own bytes."""


@dataclass(frozen=True, slots=True)
class KeptCommit:
    """A commit in the store, without its bytes."""

    id: CommitId
    sha: bytes
    cells: tuple[CellKey, ...]
    acked: bool = False
    has_data: bool = True
    """False if only the SHA is remembered."""
    seal: str | None = None
    """Seal of a server's own retract, which is kept to be pushed back if the server loses it."""
    acked_age_s: float = 0.0
    """Age of the store when the server acknowledged it last, seconds."""
    epoch: Epoch = BASE
    """Row of the cells to which its evidence is added."""


class ReplicaStore:
    """The file behind a replica."""

    _folder_lock: BinaryIO | None = None

    def __init__(self, folder: Path, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        """Open or make the file.

        Args:
            folder: the robot's.
            steady_s: clock that never jumps, seconds.

        Raises:
            ConflictError: kind `folder_in_use`: another process has it open.
            DamagedDataError: it is no SQLite file, or a broken one.
            BadInputError: it is of another version, or the folder cannot be made.
        """
        self.file = folder / FILE_NAME
        self._lock = threading.RLock()
        make_folder(folder, secret_file=FILE_NAME)
        with self._translated():
            self._connection = apsw.Connection(str(self.file))
        try:
            self._folder_lock = lock_folder(folder, wait_s=BUSY_MS / 1000)
            self._prepare(steady_s)
        except BaseException:
            self.close()
            raise

    def _prepare(self, steady_s: Callable[[], float] = time.monotonic) -> None:
        with self._translated():
            self._connection.set_busy_timeout(BUSY_MS)
            for pragma in PRAGMAS:
                self._connection.execute(f"PRAGMA {pragma}")
            version = check_form(self._connection, self.file)
        if version == 0:
            with self.transaction():
                self._connection.execute(DDL)
                self._connection.execute(f"PRAGMA user_version = {VERSION}")
        elif version in STEPS:
            with self.transaction():
                for step in range(version, VERSION):
                    self._connection.execute(STEPS[step])
                self._connection.execute(f"PRAGMA user_version = {VERSION}")
        self._steady_s = steady_s
        with translate_damage(self.file):
            self._start_s = steady_s() - float(self.get(AGE) or 0)

    def age_s(self) -> float:
        """Seconds that robots were seen to run on this folder, by a steady clock; it never jumps.

        Time without a robot does not count, nor what passed since `keep_age` when one was killed: what ends after an
        age ends later then, never sooner.
        """
        return self._steady_s() - self._start_s

    def keep_age(self) -> None:
        """Keep the age, for the next start; in a transaction of its own, or part of the open one."""
        self.put(AGE, repr(self.age_s()))

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Context in which either all writes of this thread are kept or none; other threads wait.

        Raises:
            UnreachableError: kind `store_failed`: the disk is full or broken; nothing was written.
        """
        with self._translated():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    def get(self, key: str) -> str | None:
        """The text under a key; None if there is none."""
        value: str | None = self._first("SELECT value FROM meta WHERE key = ?", (key,))
        return value

    def keys(self, prefix: str) -> list[str]:
        """Keys of texts that begin so, in order."""
        found = self._run("SELECT key FROM meta WHERE key >= ? AND key < ? ORDER BY key", (prefix, prefix + "\x7f"))
        return [key for (key,) in found]

    def put(self, key: str, value: str | None) -> None:
        """Keep a text under a key; None removes it. A transaction of its own, or part of the open one."""
        if value is None:
            self._run("DELETE FROM meta WHERE key = ?", (key,))
        else:
            self._run(
                "INSERT INTO meta VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value", (key, value)
            )

    def commits(self) -> list[KeptCommit]:
        """All commits, in the order in which they came."""
        rows = self._run(
            "SELECT robot, incarnation, n, sha, cells, acked, data IS NOT NULL, seal, acked_age_s, epoch"
            " FROM commits ORDER BY number"
        )
        with translate_damage(self.file):
            return [
                KeptCommit(
                    id=CommitId(Author(r, i), n),
                    sha=sha,
                    cells=_cells_of(cells),
                    acked=bool(acked),
                    has_data=bool(has_data),
                    seal=seal,
                    acked_age_s=age_s,
                    epoch=BASE if epoch is None else check_epoch(epoch),
                )
                for r, i, n, sha, cells, acked, has_data, seal, age_s, epoch in rows
            ]

    def data_bytes(self, commits: Iterable[CommitId]) -> int:
        """Size of the bytes of these commits that are kept."""
        query = f"SELECT coalesce(sum(length(data)), 0) FROM commits WHERE {ONE_COMMIT}"  # noqa: S608
        return sum(int(self._first(query, _values(commit)) or 0) for commit in commits)

    def commit_data(self, commit: CommitId) -> bytes | None:
        """Bytes of a commit, if they are still kept."""
        data: bytes | None = self._first(f"SELECT data FROM commits WHERE {ONE_COMMIT}", _values(commit))  # noqa: S608
        return data

    def add_commit(self, commit: Commit, *, seal: str | None = None) -> None:
        """Keep a commit; one with a seal is the server's own, which has it already."""
        self._run(
            "INSERT INTO commits (robot, incarnation, n, sha, cells, data, seal, epoch)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (
                *_values(commit.id),
                commit.sha,
                json.dumps(sorted(commit.cells)),
                commit.data,
                seal,
                commit.meta.epoch,
            ),
        )
        if seal is not None:
            self.set_acked(commit.id, age_s=self.age_s())

    def replace_commit(self, commit: Commit) -> None:
        """Keep a commit with other bytes in its old place."""
        self._run(
            "UPDATE commits SET sha = ?, data = ? WHERE robot = ? AND incarnation = ? AND n = ?",
            (commit.sha, commit.data, *commit.id.author, commit.id.n),
        )

    def set_acked(self, commit: CommitId, *, age_s: float) -> None:
        """Note that the server has exactly these bytes, and said so at this age of the store."""
        query = f"UPDATE commits SET acked = 1, acked_age_s = ? WHERE {ONE_COMMIT}"  # noqa: S608
        self._run(query, (age_s, *_values(commit)))
        self.keep_age()

    def clear_acked(self) -> None:
        """Take all acknowledgements back: the server was replaced."""
        self._run("UPDATE commits SET acked = 0")

    def forget_data(self, commits: Iterable[CommitId]) -> None:
        """Drop the bytes of commits that no restore can lose; their SHA stays."""
        for commit in commits:
            self._run(f"UPDATE commits SET data = NULL WHERE {ONE_COMMIT}", _values(commit))  # noqa: S608

    def remove_commit(self, commit: CommitId) -> None:
        """Remove a commit that lives on under another id."""
        self._run(f"DELETE FROM commits WHERE {ONE_COMMIT}", _values(commit))  # noqa: S608

    def cells(self) -> StoredBases:
        """All cells held, without their bytes."""
        coverages = self._run("SELECT name, vector FROM coverage")
        rows = self._run("SELECT cell, cursor, coverage, fingerprint, etag FROM cell ORDER BY cell")
        found = StoredBases({}, {})
        with translate_damage(self.file):
            vectors = {name: version_vector_from_json(json.loads(vector)) for name, vector in coverages}
            for cell, cursor, name, sums, etag in rows:
                key, fingerprint = CellKey(cell), fingerprint_from_bytes(sums)
                if cursor == TOGETHER:
                    found.together[key] = GroupedCell(fingerprint, etag)
                else:
                    place = cursor_from_text(cursor) if cursor else None
                    found.apart[key] = BaseCell(place, vectors[name], fingerprint, etag)
        return found

    def body(self, key: CellKey) -> bytes | None:
        """Bytes of a cell held."""
        body: bytes | None = self._first("SELECT body FROM cell WHERE cell = ?", (key,))
        return body

    def deltas(self, key: CellKey) -> list[bytes]:
        """Evidence that was added to a cell since its bytes were written, oldest first, each as a cell's bytes."""
        return [body for (body,) in self._run("SELECT body FROM delta WHERE cell = ? ORDER BY number", (key,))]

    def delta_sizes(self, key: CellKey) -> DeltaSizes:
        """Sizes of a cell held and of what was added to it."""
        query = "SELECT count(*), coalesce(sum(length(body)), 0), (SELECT length(body) FROM cell WHERE cell = ?1)"
        count, size_bytes, body_bytes = self._run(f"{query} FROM delta WHERE cell = ?1", (key,))[0]
        return DeltaSizes(count, size_bytes, body_bytes or 0)

    def cell_bytes(self) -> dict[CellKey, int]:
        """Sizes of the cells held, as they are at rest."""
        sizes = {CellKey(cell): size for cell, size in self._run("SELECT cell, length(body) FROM cell")}
        for cell, size in self._run("SELECT cell, sum(length(body)) FROM delta GROUP BY cell"):
            sizes[CellKey(cell)] += size
        return sizes

    def used_bytes(self) -> int:
        """Size of the file, without its free pages."""
        pages, free, size = (self._first(f"PRAGMA {n}", ()) for n in ("page_count", "freelist_count", "page_size"))
        return int(pages - free) * int(size)

    def put_cell(self, key: CellKey, cell: BaseCell, *, body: bytes) -> None:
        """Hold a cell; its cursor, coverage and bytes change together."""
        name = self._coverage(cell.coverage)
        self._run(
            "INSERT INTO cell (cell, cursor, coverage, fingerprint, etag, body) VALUES (?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (cell) DO UPDATE SET cursor = excluded.cursor, coverage = excluded.coverage,"
            " fingerprint = excluded.fingerprint, etag = excluded.etag, body = excluded.body",
            (key, str(cell.cursor) if cell.cursor else None, name, cell.fingerprint.to_bytes(), cell.etag, body),
        )
        self._run("DELETE FROM delta WHERE cell = ?", (key,))

    def put_deltas(self, key: CellKey, cell: BaseCell, bodies: Iterable[bytes]) -> None:
        """Add evidence to a cell that is held; its cursor, coverage and fingerprint change with it."""
        for body in bodies:
            self._run("INSERT INTO delta (cell, body) VALUES (?, ?)", (key, body))
        name = self._coverage(cell.coverage)
        self._run(
            "UPDATE cell SET cursor = ?, coverage = ?, fingerprint = ?, etag = ? WHERE cell = ?",
            (str(cell.cursor) if cell.cursor else None, name, cell.fingerprint.to_bytes(), cell.etag, key),
        )

    def put_body(self, key: CellKey, body: bytes) -> None:
        """Write a cell's bytes again, with what was added to it."""
        self._run("UPDATE cell SET body = ? WHERE cell = ?", (body, key))
        self._run("DELETE FROM delta WHERE cell = ?", (key,))

    def move_cells(self, keys: Iterable[CellKey], *, to: Cursor | None, coverage: VersionVector | None) -> None:
        """Give held cells another cursor, and coverage unless None; their bytes stay."""
        name = None if coverage is None else self._coverage(coverage)
        for key in keys:
            self._run(
                "UPDATE cell SET cursor = ?, coverage = coalesce(?, coverage) WHERE cell = ?",
                (str(to) if to else None, name, key),
            )
        self._drop_coverages()

    def join_cells(self, keys: Iterable[CellKey]) -> None:
        """Let held cells stand at the map's own cursor and coverage from here on; their bytes stay."""
        name = self._coverage(EMPTY)  # which says nothing: theirs is the map's
        for key in keys:
            self._run("UPDATE cell SET cursor = ?, coverage = ? WHERE cell = ?", (TOGETHER, name, key))
        self._drop_coverages()

    def drop_cells(self) -> None:
        """Hold nothing of the server any more."""
        self._run("DELETE FROM cell")
        self._run("DELETE FROM delta")
        self._run("DELETE FROM coverage")

    def close(self) -> None:
        """Close the file; may be called twice."""
        with self._lock:
            self._connection.close()
            if self._folder_lock is not None:
                self._folder_lock.close()

    def _drop_coverages(self) -> None:
        """Drop the coverages that no cell has any more; each is one look into the index of the cells."""
        self._run("DELETE FROM coverage WHERE NOT EXISTS (SELECT 1 FROM cell WHERE cell.coverage = coverage.name)")

    def _coverage(self, coverage: VersionVector) -> int:
        """Name under which a coverage is kept: one row for all cells that share it."""
        text = json.dumps(coverage.to_json())
        self._run("INSERT INTO coverage (vector) VALUES (?) ON CONFLICT (vector) DO NOTHING", (text,))
        name: int = self._first("SELECT name FROM coverage WHERE vector = ?", (text,))
        return name

    def _first(self, query: str, values: Values) -> Any:
        with self._translated():
            return self._connection.execute(query, values).get

    def _run(self, query: str, values: Values = ()) -> list[tuple[Any, ...]]:
        with self._translated():
            return self._connection.execute(query, values).fetchall()

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """The lock, and SQLite's errors as a `CairnError`."""
        with self._lock:
            try:
                yield
            except (apsw.Error, UnicodeDecodeError) as exc:
                raise failure_of(exc, self.file) from exc


def failure_of(exc: apsw.Error | UnicodeDecodeError, file: Path) -> CairnError:
    """The `CairnError` of an error of SQLite, or of a text in it, about a robot's file."""
    if isinstance(exc, apsw.BusyError):
        return ConflictError("folder_in_use", f"another robot has {file} open; stop it, or choose another folder")
    if isinstance(exc, apsw.CorruptError | apsw.NotADBError | apsw.SQLError | apsw.TooBigError | UnicodeDecodeError):
        return DamagedDataError("damaged_store", f"{file} is damaged: {exc}; move it away to start again")
    return UnreachableError("store_failed", f"cannot use {file}: {exc}")


def _cells_of(text: str) -> tuple[CellKey, ...]:
    """Numbers of cells in a JSON text; ValueError for another list."""
    found: object = json.loads(text)
    if not isinstance(found, list) or any(type(each) is not int for each in found):
        raise ValueError(f"a list of cells is expected, got {text[:80]!r}")
    return tuple(CellKey(each) for each in found)


def _values(commit: CommitId) -> tuple[str, str, int]:
    return commit.author.robot, commit.author.incarnation, commit.n
