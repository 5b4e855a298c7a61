"""Glance into a robot's folder: read in one transaction, while the robot goes on.

Nothing is locked or written, so that a glance neither waits for a robot nor holds one up; of the file's values only
their kinds are checked.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import apsw

from cairn_client.replica.replica_schema import check_form
from cairn_client.replica.replica_store import BUSY_MS, FILE_NAME, failure_of
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.errors import NotFoundError


@dataclass(frozen=True, slots=True)
class KeptBytes:
    """A commit whose bytes are in the folder."""

    id: CommitId
    is_acked: bool
    cells: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Glance:
    """Contents of a robot's folder at one instant."""

    file: Path
    meta: Mapping[str, str]
    """Texts that the folder remembers, by key (`replica_state`)."""
    commits: tuple[KeptBytes, ...]
    """Commits whose bytes are kept, in the order in which they came."""
    cells: int
    """Number of cells that are held whole, as the server had them."""
    cells_bytes: int
    disk_bytes: int
    """Bytes of the file, and of its log."""


def glance(folder: Path) -> Glance:
    """Look into a robot's folder.

    Raises:
        NotFoundError: kind `no_robot`: it is none.
        DamagedDataError: its file is no SQLite file, or a broken one.
        ConflictError: kind `folder_in_use`: a robot of an older version has it open for itself alone.
    """
    with _Reader(folder) as reader:
        (cells, cells_bytes) = reader.rows("SELECT count(cursor), coalesce(sum(length(body)), 0) FROM cell")[0]
        if reader.rows("SELECT 1 FROM sqlite_master WHERE name = 'delta'"):  # not in a folder of an older version
            cells_bytes += reader.rows("SELECT coalesce(sum(length(body)), 0) FROM delta")[0][0]
        commits = reader.rows(
            "SELECT robot, incarnation, n, acked, json_array_length(iif(json_valid(cells), cells, '[]')), length(data)"
            " FROM commits"
            " WHERE data IS NOT NULL ORDER BY number"
        )
        return Glance(
            file=folder / FILE_NAME,
            meta=dict(reader.rows("SELECT key, value FROM meta")),
            commits=tuple(
                KeptBytes(CommitId(Author(RobotName(r), Incarnation(i)), n), bool(acked), count, size)
                for r, i, n, acked, count, size in commits
            ),
            cells=cells,
            cells_bytes=cells_bytes,
            disk_bytes=sum(path.stat().st_size for path in folder.glob(f"{FILE_NAME}*")),
        )


def commit_bytes(folder: Path, commit: CommitId) -> bytes | None:
    """A commit's bytes; None if they were forgotten meanwhile. Raises as `glance`."""
    author = commit.author
    with _Reader(folder) as reader:
        query = "SELECT data FROM commits WHERE robot = ? AND incarnation = ? AND n = ?"
        rows = reader.rows(query, (author.robot, author.incarnation, commit.n))
    data: bytes | None = rows[0][0] if rows else None
    return data


class _Reader:
    """One read transaction."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE_NAME
        if not self._path.is_file():
            raise NotFoundError("no_robot", f"{folder} is no robot's folder: there is no {FILE_NAME} in it")

    def __enter__(self) -> "_Reader":
        try:
            try:
                self._connection = self._opened("mode=ro")
            except apsw.CantOpenError:  # nothing may be written next to it, so no robot that could change it is at work
                self._connection = self._opened("immutable=1")
        except (apsw.Error, UnicodeDecodeError) as exc:
            raise failure_of(exc, self._path) from exc
        return self

    def __exit__(self, *error: object) -> None:
        self._connection.close()

    def rows(self, query: str, values: tuple[str | int, ...] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query."""
        try:
            return self._connection.execute(query, values).fetchall()
        except (apsw.Error, UnicodeDecodeError) as exc:
            raise failure_of(exc, self._path) from exc

    def _opened(self, how: str) -> apsw.Connection:
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        connection = apsw.Connection(f"{self._path.absolute().as_uri()}?{how}", flags=flags)
        try:
            connection.set_busy_timeout(BUSY_MS)
            connection.execute("BEGIN")
            check_form(connection, self._path)
        except BaseException:
            connection.close()
            raise
        return connection
