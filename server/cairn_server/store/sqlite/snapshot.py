"""Reading one state of a map from SQLite, inside one read transaction."""

import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import apsw

from cairn_map.commits.cursor import Cursor, first_chain
from cairn_map.commits.ids import Author, CommitId, commit_id_from_text
from cairn_map.commits.version_vector import EMPTY, VersionVector, version_vector_from_json
from cairn_map.evidence.fingerprint import fingerprint_from_bytes
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.messages import LogEntry
from cairn_server.store.sqlite.failures import damaged_pages
from cairn_server.store.sqlite.schema import IS_MEASURED
from cairn_server.store.sqlite.writer import first, rows
from cairn_server.store.store_rows import (
    CellRow,
    CellState,
    ChainedEntry,
    Contribution,
    Head,
    NamedCommit,
    Selection,
    Totals,
)

CELL_COLUMNS = "cell, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k"
PARENT, SEEN, PLACE = (
    f"CASE WHEN json_valid(CAST(meta AS TEXT)) THEN json_extract(CAST(meta AS TEXT), '$.{path}') END"
    for path in ("parent", "seen", "scans[#-1].t_map_rig")
)
"""SQL of three fields of a commit's meta; NULL, too, if the meta is damaged."""
LOG_COLUMNS = (
    "seq, kind, robot, incarnation, n, sha, size_bytes, cells, captured_first_s, captured_last_s, retracts,"
    f" {PARENT}, {SEEN}, {PLACE}, via"
)


class SqliteSnapshot:
    """`store.Snapshot` over one connection that is inside a read transaction."""

    def __init__(self, connection: apsw.Connection, map_number: int, geometry_digest: bytes) -> None:
        self._connection = connection
        self._map = map_number
        self._geometry_digest = geometry_digest
        log_id, seq, chain, vector = first(
            connection, "SELECT log_id, seq, chain, vector FROM map WHERE number = ?", (map_number,)
        )
        self._head = Head(cursor=Cursor(log_id, seq, chain), vector=_vector_of_text(vector))

    @property
    def head(self) -> Head:
        """The state."""
        return self._head

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        if seq == 0:
            return first_chain(self._head.cursor.log_id, self._geometry_digest)
        chain: bytes | None = first(
            self._connection, "SELECT chain FROM log WHERE map = ? AND seq = ?", (self._map, seq)
        )
        return chain

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body."""
        with damaged_pages():
            row = first(
                self._connection,
                f"SELECT {CELL_COLUMNS}, body, stamps FROM cell WHERE map = ? AND cell = ?",  # noqa: S608 - constant columns
                (self._map, key),
            )
        return cell_row(row) if row else None

    def cells(self, *, after_seq: int = -1, after_key: int = -1, limit: int | None = None) -> Iterator[CellRow]:
        """Cells changed after a log entry, of numbers above `after_key`, at most `limit`; without bodies, rising."""
        found = rows(
            self._connection,
            f"SELECT {CELL_COLUMNS} FROM cell WHERE map = ? AND lm > ? AND cell > ? ORDER BY cell LIMIT ?",  # noqa: S608 - constant columns
            (self._map, after_seq, after_key, -1 if limit is None else limit),
        )
        for row in found:
            yield cell_row(row)

    def contributions(self, key: CellKey, *, after_seq: int, newest: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most so many of the newest."""
        found = rows(
            self._connection,
            "SELECT touched.seq, log.kind, robot, incarnation, n, length(diff.body) FROM touched"
            " JOIN log ON log.map = touched.map AND log.seq = touched.seq"
            " JOIN commits ON commits.number = log.commit_number"
            " JOIN diff ON diff.commit_number = commits.number AND diff.cell = touched.cell"
            " WHERE touched.map = ? AND touched.cell = ? AND touched.seq > ? ORDER BY touched.seq DESC LIMIT ?",
            (self._map, key, after_seq, -1 if newest is None else newest),
        )
        return [
            Contribution(seq, kind, CommitId(Author(robot, incarnation), n), size_bytes)
            for seq, kind, robot, incarnation, n, size_bytes in reversed(found)
        ]

    def cell_states(self, keys: Collection[CellKey]) -> list[CellState]:
        """Those of these cells that are stored, without their bodies, by rising number."""
        query = "SELECT cell, lm, digest FROM cell WHERE map = ? AND cell IN (SELECT value FROM json_each(?))"
        found = rows(self._connection, f"{query} ORDER BY cell", (self._map, json.dumps(sorted(keys))))
        return [CellState(CellKey(cell), lm, digest) for cell, lm, digest in found]

    def named(self, commits: Sequence[CommitId]) -> list[NamedCommit]:
        """State of each of these commits, folded or not, in the same order; no evidence is read."""
        query = (
            "SELECT 1, gone, cells, coalesce(nullif(bricks, 0), size_bytes) FROM commits"
            " WHERE map = ? AND robot = ? AND incarnation = ? AND n = ? AND folded_seq IS NOT NULL"
        )
        is_out = "SELECT 1 FROM retracted WHERE map = ? AND id = ?"
        found: list[NamedCommit] = []
        for commit in commits:
            known = first(self._connection, query, (self._map, *commit.author, commit.n))
            is_folded, is_gone, cells, bricks = known or (0, 0, 0, 0)
            is_retracted = first(self._connection, is_out, (self._map, str(commit))) is not None
            found.append(NamedCommit(commit, bool(is_folded), bool(is_gone), is_retracted, cells, bricks))
        return found

    def touched_cells(self, commits: Iterable[CommitId]) -> frozenset[CellKey]:
        """Cells in which these commits have evidence that is kept; none of it is read."""
        # The index over commit and cell answers: rows, which have the bodies, are never looked at.
        query = (
            "SELECT cell FROM diff WHERE commit_number ="
            " (SELECT number FROM commits WHERE map = ? AND robot = ? AND incarnation = ? AND n = ?)"
        )
        return frozenset(
            CellKey(cell)
            for commit in commits
            for (cell,) in rows(self._connection, query, (self._map, *commit.author, commit.n))
        )

    def diff(self, commit: CommitId, key: CellKey) -> bytes | None:
        """The bytes of a commit's evidence in a cell; None if they are not kept any more."""
        with damaged_pages():
            body: bytes | None = first(
                self._connection,
                "SELECT body FROM commits JOIN diff ON diff.commit_number = commits.number"
                " WHERE map = ? AND robot = ? AND incarnation = ? AND n = ? AND cell = ?",
                (self._map, *commit.author, commit.n, key),
            )
        return body

    def tip(self, author: Author) -> tuple[int, bytes] | None:
        """Highest folded number of an author and its SHA-256."""
        row: tuple[int, bytes] | None = first(
            self._connection,
            "SELECT n, sha FROM commits WHERE map = ? AND robot = ? AND incarnation = ? AND folded_seq IS NOT NULL"
            " ORDER BY n DESC LIMIT 1",
            (self._map, *author),
        )
        return row

    def newest_captured_s(self) -> float | None:
        """Latest time at which a commit in the map says credibly that it was captured."""
        query = (
            f"SELECT captured_last_s FROM commits WHERE map = ? AND {IS_MEASURED} ORDER BY captured_last_s DESC LIMIT 1"  # noqa: S608 - our own clause
        )
        found: float | None = first(self._connection, query, (self._map,))
        return found

    def commits_where(self, selection: Selection) -> list[CommitId]:
        """Every commit with evidence that fits and is not retracted, folded or not, in order of arrival."""
        robot, rig, pushed_s, captured_s = selection.robot, selection.rig, selection.pushed_s, selection.captured_s
        found = rows(
            self._connection,
            "SELECT robot, incarnation, n FROM commits WHERE map = ? AND cells > 0"
            " AND (? IS NULL OR robot = ?) AND (? IS NULL OR rig = ?) AND received_s BETWEEN ? AND ?"
            " AND coalesce(captured_last_s, -9e999) >= ? AND coalesce(captured_first_s, 9e999) <= ?"
            " AND NOT EXISTS (SELECT 1 FROM retracted WHERE retracted.map = commits.map"
            " AND id = robot || '.' || incarnation || '.' || n) ORDER BY number",
            (self._map, robot, robot, rig, rig, *pushed_s, *captured_s),
        )
        return [CommitId(Author(r, i), n) for r, i, n in found]

    def pending(self) -> VersionVector:
        """Commits that are durable but not folded, without those that are set aside as damaged."""
        found = rows(
            self._connection,
            "SELECT robot, incarnation, n FROM commits WHERE map = ? AND folded_seq IS NULL AND damaged IS NULL",
            (self._map,),
        )
        return _vector(found)

    def folded_before(self, age_s: float) -> VersionVector:
        """Commits folded before an age of the store."""
        found = rows(
            self._connection,
            "SELECT robot, incarnation, n FROM commits WHERE map = ? AND folded_age_s < ? AND folded_seq IS NOT NULL",
            (self._map, age_s),
        )
        return _vector(found)

    def log(self, *, after_seq: int, limit: int, names_max: int | None = None) -> list[LogEntry]:
        """Log entries, oldest first: the first one, and as many more as name so many commits together at most."""
        found: list[LogEntry] = []
        names = 0
        for row in self._connection.execute(
            f"SELECT {LOG_COLUMNS} FROM log JOIN commits ON commits.number = log.commit_number"  # noqa: S608 - constants
            " WHERE log.map = ? AND seq > ? ORDER BY seq LIMIT ?",
            (self._map, after_seq, limit),
        ):
            entry = _log_entry(*row)
            names += len(entry.retracts)
            if found and names_max is not None and names > names_max:
                break
            found.append(entry)
        return found

    def chained(self, *, after_seq: int, limit: int) -> list[ChainedEntry]:
        """Log entries, oldest first, without what they say."""
        found = rows(
            self._connection,
            "SELECT seq, kind, robot, incarnation, n, sha, chain FROM log"
            " JOIN commits ON commits.number = log.commit_number WHERE log.map = ? AND seq > ? ORDER BY seq LIMIT ?",
            (self._map, after_seq, limit),
        )
        return [
            ChainedEntry(seq, kind, CommitId(Author(robot, incarnation), n), sha, chain)
            for seq, kind, robot, incarnation, n, sha, chain in found
        ]

    def totals(self) -> Totals:
        """Sizes."""
        cells, size = first(
            self._connection,
            "SELECT count(*), coalesce(sum(size_bytes), 0) FROM cell WHERE map = ? AND voxels > 0",
            (self._map,),
        )
        keys = rows(self._connection, "SELECT cell FROM cell WHERE map = ? AND voxels > 0", (self._map,))
        cells_found = [cell_of_key(key) for (key,) in keys]
        corners = None
        if cells_found:
            corners = (
                (min(c.i for c in cells_found), min(c.j for c in cells_found), min(c.k for c in cells_found)),
                (max(c.i for c in cells_found), max(c.j for c in cells_found), max(c.k for c in cells_found)),
            )
        commits = first(self._connection, "SELECT count(*) FROM commits WHERE map = ?", (self._map,))
        branches = first(self._connection, "SELECT count(*) FROM branch WHERE map = ?", (self._map,))
        return Totals(cells=cells, size_bytes=size, commits=commits, branches=branches, corner_cells=corners)


def cell_row(columns: tuple[Any, ...]) -> CellRow:
    """A cell from its columns, body and stamps last or left out."""
    key, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k, *rest = columns
    return CellRow(
        key=CellKey(key),
        lm=lm,
        digest=digest,
        fingerprint=fingerprint_from_bytes(fingerprint),
        voxels=voxels,
        body=rest[0] if rest else b"",
        stamps=rest[1] if rest else b"",
        gone_seq=gone_seq,
        size_bytes=size_bytes,
        hottest_k=hottest_k,
    )


@lru_cache(maxsize=4)
def _vector_of_text(text: str) -> VersionVector:
    """The head's vector: many ask between two folds, and of hundreds of authors it takes longer than the rest."""
    return version_vector_from_json(json.loads(text))


def _vector(found: list[tuple[Any, ...]]) -> VersionVector:
    return EMPTY.with_commits(CommitId(Author(robot, incarnation), n) for robot, incarnation, n in found)


def ids_from_text(text: str) -> tuple[CommitId, ...]:
    """Ids separated by spaces."""
    return tuple(commit_id_from_text(part) for part in text.split())


def _log_entry(
    seq: int,
    kind: bytes,
    robot: str,
    incarnation: str,
    n: int,
    sha: bytes,
    size_bytes: int,
    cells: int,
    first_s: float | None,
    last_s: float | None,
    retracts: str,
    parent: str | None,
    seen: str | None,
    place: str | None,
    via: str | None,
) -> LogEntry:
    return LogEntry.model_validate(
        {
            "seq": seq,
            "kind": kind.decode(),
            "id": f"{robot}.{incarnation}.{n}",
            "sha": sha.hex(),
            "size_bytes": size_bytes,
            "cells": cells,
            "captured_s": None if first_s is None else (first_s, last_s),
            "retracts": retracts.split(),
            "parent": parent,
            "seen": seen,
            "place_m": json.loads(place) if place else None,
            "via": via,
        }
    )
