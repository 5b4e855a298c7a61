"""What a robot must not forget, in one SQLite file: its name and number, its commits, the server's cells it holds.

Every change is one transaction with `synchronous=FULL`, so that power may be cut between any two steps. All
methods are called under the replica's lock.
"""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import apsw

from cairn_map.commit import Commit
from cairn_map.cursor import Cursor, cursor_from_text
from cairn_map.errors import BadInputError
from cairn_map.fingerprint import Fingerprint, fingerprint_from_bytes
from cairn_map.grid import CellKey
from cairn_map.ids import Author, CommitId
from cairn_map.version_vector import VersionVector, version_vector_from_json

FILE_NAME = "robot.sqlite"
VERSION = 1
DDL = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE commits (
    number INTEGER PRIMARY KEY,
    robot TEXT NOT NULL, incarnation TEXT NOT NULL, n INTEGER NOT NULL,
    sha BLOB NOT NULL,
    acked INTEGER NOT NULL DEFAULT 0,   -- the server said once that it has exactly these bytes
    cells TEXT NOT NULL,                -- numbers of the cells it touches, as JSON
    data BLOB,                          -- NULL once the commit may be forgotten
    UNIQUE (robot, incarnation, n)
);
CREATE TABLE coverage (name INTEGER PRIMARY KEY, vector TEXT NOT NULL UNIQUE);
CREATE TABLE cell (
    cell INTEGER PRIMARY KEY,
    cursor TEXT,                        -- NULL: not proven any more, to be fetched whole
    coverage INTEGER NOT NULL REFERENCES coverage,
    fingerprint BLOB NOT NULL,
    etag TEXT,
    body BLOB NOT NULL
);
"""


@dataclass(frozen=True, slots=True)
class BaseCell:
    """The server's cell as this robot last had it, without its bytes."""

    cursor: Cursor | None
    coverage: VersionVector
    fingerprint: Fingerprint
    etag: str | None = None


@dataclass(frozen=True, slots=True)
class KeptCommit:
    """A commit in the store, without its bytes."""

    id: CommitId
    sha: bytes
    acked: bool
    cells: tuple[CellKey, ...]
    has_data: bool
    """False where only the SHA is remembered."""


class ReplicaStore:
    """The file behind a replica."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._connection = apsw.Connection(str(folder / FILE_NAME))
        self._connection.set_busy_timeout(10_000)
        for pragma in ("page_size = 16384", "journal_mode = WAL", "synchronous = FULL", "mmap_size = 0"):
            self._connection.execute(f"PRAGMA {pragma}")
        version = self._connection.pragma("user_version")
        if version == 0:
            with self.transaction():
                self._connection.execute(DDL)
                self._connection.execute(f"PRAGMA user_version = {VERSION}")
        elif version != VERSION:
            raise BadInputError("store_version", f"{folder} has version {version}, this cairn needs {VERSION}")

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All or nothing of what is written inside."""
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._connection.execute("ROLLBACK")
            raise
        self._connection.execute("COMMIT")

    def get(self, key: str) -> str | None:
        """A remembered text."""
        value: str | None = self._first("SELECT value FROM meta WHERE key = ?", (key,))
        return value

    def put(self, key: str, value: str | None) -> None:
        """Remember a text, or forget it."""
        if value is None:
            self._run("DELETE FROM meta WHERE key = ?", (key,))
        else:
            self._run(
                "INSERT INTO meta VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value", (key, value)
            )

    def commits(self) -> list[KeptCommit]:
        """All commits, in the order in which they came."""
        rows: Any = self._connection.execute(
            "SELECT robot, incarnation, n, sha, acked, cells, data IS NOT NULL FROM commits ORDER BY number"
        )
        return [
            KeptCommit(CommitId(Author(r, i), n), sha, bool(acked), tuple(json.loads(cells)), bool(has_data))
            for r, i, n, sha, acked, cells, has_data in rows
        ]

    def commit_data(self, commit: CommitId) -> bytes | None:
        """Bytes of a commit, if they are still kept."""
        data: bytes | None = self._first(
            "SELECT data FROM commits WHERE robot = ? AND incarnation = ? AND n = ?", (*commit.author, commit.n)
        )
        return data

    def add_commit(self, commit: Commit) -> None:
        """Keep a commit."""
        self._run(
            "INSERT INTO commits (robot, incarnation, n, sha, cells, data) VALUES (?, ?, ?, ?, ?, ?)",
            (*commit.id.author, commit.id.n, commit.sha, json.dumps(sorted(commit.cells)), commit.data),
        )

    def set_acked(self, commit: CommitId) -> None:
        """Note that the server has exactly these bytes."""
        self._run(
            "UPDATE commits SET acked = 1 WHERE robot = ? AND incarnation = ? AND n = ?", (*commit.author, commit.n)
        )

    def clear_acked(self) -> None:
        """Forget what the server said it has: it is another server now."""
        self._run("UPDATE commits SET acked = 0", ())

    def forget_data(self, commits: Iterable[CommitId]) -> None:
        """Drop the bytes of commits that no restore can lose; their SHA stays."""
        for commit in commits:
            self._run(
                "UPDATE commits SET data = NULL WHERE robot = ? AND incarnation = ? AND n = ?",
                (*commit.author, commit.n),
            )

    def remove_commit(self, commit: CommitId) -> None:
        """Remove a commit that lives on under another id."""
        self._run("DELETE FROM commits WHERE robot = ? AND incarnation = ? AND n = ?", (*commit.author, commit.n))

    def cells(self) -> dict[CellKey, BaseCell]:
        """All cells held, without their bytes."""
        vectors: dict[int, VersionVector] = {}
        names: Any = self._connection.execute("SELECT name, vector FROM coverage")
        for name, vector in names:
            vectors[name] = version_vector_from_json(json.loads(vector))
        found: dict[CellKey, BaseCell] = {}
        rows: Any = self._connection.execute("SELECT cell, cursor, coverage, fingerprint, etag FROM cell")
        for cell, cursor, coverage, fingerprint, etag in rows:
            found[CellKey(cell)] = BaseCell(
                cursor_from_text(cursor) if cursor else None,
                vectors[coverage],
                fingerprint_from_bytes(fingerprint),
                etag,
            )
        return found

    def body(self, key: CellKey) -> bytes | None:
        """Bytes of a cell held."""
        body: bytes | None = self._first("SELECT body FROM cell WHERE cell = ?", (key,))
        return body

    def put_cell(self, key: CellKey, cell: BaseCell, *, body: bytes) -> None:
        """Hold a cell; its cursor, coverage and bytes change together."""
        name = self._coverage(cell)
        self._run(
            "INSERT INTO cell (cell, cursor, coverage, fingerprint, etag, body) VALUES (?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (cell) DO UPDATE SET cursor = excluded.cursor, coverage = excluded.coverage,"
            " fingerprint = excluded.fingerprint, etag = excluded.etag, body = excluded.body",
            (key, str(cell.cursor) if cell.cursor else None, name, cell.fingerprint.to_bytes(), cell.etag, body),
        )

    def move_cell(self, key: CellKey, cell: BaseCell) -> None:
        """Give a held cell another cursor and coverage; its bytes stay."""
        name = self._coverage(cell)
        cursor = str(cell.cursor) if cell.cursor else None
        self._run("UPDATE cell SET cursor = ?, coverage = ? WHERE cell = ?", (cursor, name, key))

    def drop_cells(self) -> None:
        """Hold nothing of the server any more."""
        self._run("DELETE FROM cell", ())
        self._run("DELETE FROM coverage", ())

    def drop_unused_coverage(self) -> None:
        """Forget version vectors that no cell refers to."""
        self._run("DELETE FROM coverage WHERE name NOT IN (SELECT coverage FROM cell)", ())

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _coverage(self, cell: BaseCell) -> int:
        """Name under which the cell's coverage is kept: one row for all cells that share it."""
        text = json.dumps(cell.coverage.to_json())
        self._run("INSERT INTO coverage (vector) VALUES (?) ON CONFLICT (vector) DO NOTHING", (text,))
        name: int = self._first("SELECT name FROM coverage WHERE vector = ?", (text,))
        return name

    def _first(self, query: str, values: tuple[Any, ...]) -> Any:
        return self._connection.execute(query, values).get

    def _run(self, query: str, values: tuple[Any, ...]) -> None:
        self._connection.execute(query, values).fetchall()
