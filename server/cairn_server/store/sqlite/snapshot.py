"""Reading one state of a map from SQLite, inside one read transaction."""

import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import compress, islice
from typing import Any

import apsw
import numpy as np

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector, version_vector_from_json
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.messages import LogEntry
from cairn_server.store.history import KnownVectors, ReadChains
from cairn_server.store.sqlite.failures import damaged_pages
from cairn_server.store.sqlite.retention import check_lives
from cairn_server.store.sqlite.schema import IS_MEASURED
from cairn_server.store.sqlite.tile_rows import CELL_COLUMNS, IN_TILES, fingerprint_in_box, tiles_changed, totals_of
from cairn_server.store.sqlite.writer import first, rows
from cairn_server.store.store_rows import (
    CellRow,
    ChainedEntry,
    Contribution,
    MarkBox,
    MarkChange,
    NamedCommit,
    Selection,
    Totals,
)
from cairn_server.store.stored_columns import (
    cell_row,
    corner_conditions,
    corner_values,
    epoch_from_column,
    log_entry,
    mark_changes,
)
from cairn_server.store.tiles import Box, is_in_box

PARENT, SEEN, PLACE, NOTE = (
    f"CASE WHEN json_valid(CAST(meta AS TEXT)) THEN json_extract(CAST(meta AS TEXT), '$.{path}') END"
    for path in ("parent", "seen", "scans[#-1].t_map_rig", "note")
)
"""SQL of four fields of a commit's meta; NULL, too, if the meta is damaged."""
LOG_COLUMNS = (
    "seq, kind, robot, incarnation, n, sha, size_bytes, cells, captured_first_s, captured_last_s, retracts,"
    f" {PARENT}, {SEEN}, {PLACE}, {NOTE}, via, received_s"
)


class SqliteSnapshot:
    """`store.Snapshot` over one connection that is inside a read transaction."""

    def __init__(
        self, connection: apsw.Connection, map_number: int, layer_digest: bytes, vectors: KnownVectors
    ) -> None:
        self._connection = connection
        self._map = map_number
        self._vectors = vectors
        check_lives(connection, map_number)
        self._head = Cursor(*first(connection, "SELECT log_id, seq, chain FROM map WHERE number = ?", (map_number,)))
        self._chains = ReadChains(self._head, layer_digest)

    @property
    def head(self) -> Cursor:
        """The state."""
        return self._head

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        query = "SELECT chain FROM log WHERE map = ? AND seq = ?"
        return self._chains.get(seq, lambda: first(self._connection, query, (self._map, seq)))

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body."""
        with damaged_pages():
            row = first(
                self._connection,
                f"SELECT {CELL_COLUMNS}, body, stamps FROM cell WHERE map = ? AND cell = ?",  # noqa: S608 - constant columns
                (self._map, key),
            )
        return cell_row(row) if row else None

    def hold_cells(self, keys: Collection[CellKey]) -> None:
        """Nothing: a cell is read in 30 us, one by one as well."""

    def cells(
        self, *, after_seq: int = -1, after_key: int = -1, limit: int | None = None, box: Box | None = None
    ) -> Iterator[CellRow]:
        """Cells changed after a log entry, in a box, of numbers above `after_key`, at most `limit`; no bodies."""
        at_most = -1 if limit is None else limit
        if after_seq < 0 and box is None:
            query = f"SELECT {CELL_COLUMNS} FROM cell WHERE map = ? AND cell > ? ORDER BY cell LIMIT ?"  # noqa: S608
            found = rows(self._connection, query, (self._map, after_key, at_most))
            yield from map(cell_row, found)
            return
        tiles = tiles_changed(self._connection, self._map, after_seq=after_seq, box=box)
        query = f"SELECT {CELL_COLUMNS} FROM {IN_TILES} WHERE lm > ? AND cell.cell > ? ORDER BY cell.cell"  # noqa: S608
        found = rows(self._connection, query, (json.dumps(tiles), self._map, after_seq, after_key))
        if box is not None:
            is_asked = is_in_box(np.fromiter((row[0] for row in found), np.uint64, len(found)), box)
            found = list(compress(found, is_asked.tolist()))
        yield from map(cell_row, islice(found, limit))

    def cells_of(self, keys: Collection[CellKey]) -> list[CellRow]:
        """Those of these cells that are stored, without their bodies, by rising number."""
        query = f"SELECT {CELL_COLUMNS} FROM cell WHERE map = ? AND cell IN (SELECT value FROM json_each(?))"  # noqa: S608
        found = rows(self._connection, f"{query} ORDER BY cell", (self._map, json.dumps(sorted(keys))))
        return [cell_row(row) for row in found]

    def fingerprint_sum(self, box: Box | None = None) -> Fingerprint:
        """Sum of the fingerprints of all cells, or of those in a box."""
        if box is not None:
            return fingerprint_in_box(self._connection, self._map, box)
        return totals_of(self._connection, self._map)[0].fingerprint

    def contributions(self, key: CellKey, *, after_seq: int, newest: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most so many of the newest."""
        found = rows(
            self._connection,
            "SELECT touched.seq, log.kind, robot, incarnation, n, length(diff.body), epoch FROM touched"
            " JOIN log ON log.map = touched.map AND log.seq = touched.seq"
            " JOIN commits ON commits.number = log.commit_number"
            " JOIN diff ON diff.commit_number = commits.number AND diff.cell = touched.cell"
            " WHERE touched.map = ? AND touched.cell = ? AND touched.seq > ? ORDER BY touched.seq DESC LIMIT ?",
            (self._map, key, after_seq, -1 if newest is None else newest),
        )
        return [
            Contribution(seq, kind, CommitId(Author(robot, incarnation), n), size_bytes, epoch_from_column(epoch))
            for seq, kind, robot, incarnation, n, size_bytes, epoch in reversed(found)
        ]

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

    def vector_at(self, seq: int) -> VersionVector:
        """Ids of the commits folded at or before a log entry."""
        return self._vectors.at(self._map, seq, self)

    def newest_mark(self, seq: int) -> int:
        """Entry of the newest mark at or before one; 0: there is none."""
        query = "SELECT seq FROM vector_mark WHERE map = ? AND seq <= ? ORDER BY seq DESC LIMIT 1"
        return int(first(self._connection, query, (self._map, seq)) or 0)

    def mark(self, seq: int) -> VersionVector:
        """Vector of the mark at an entry."""
        query = "SELECT vector FROM vector_mark WHERE map = ? AND seq = ?"
        return version_vector_from_json(json.loads(first(self._connection, query, (self._map, seq))))

    def seq_before(self, age_s: float) -> int:
        """Newest log entry with a commit that was folded before an age of the store; 0: there is none."""
        query = (
            "SELECT folded_seq FROM commits WHERE map = ? AND folded_age_s < ? AND folded_seq IS NOT NULL"
            " ORDER BY folded_age_s DESC, folded_seq DESC LIMIT 1"
        )
        return int(first(self._connection, query, (self._map, age_s)) or 0)

    def log(self, *, after_seq: int, limit: int, names_max: int | None = None) -> list[LogEntry]:
        """Log entries, oldest first: the first one, and as many more as name so many commits together at most."""
        found: list[LogEntry] = []
        names = 0
        for row in self._connection.execute(
            f"SELECT {LOG_COLUMNS} FROM log JOIN commits ON commits.number = log.commit_number"  # noqa: S608 - constants
            " WHERE log.map = ? AND seq > ? ORDER BY seq LIMIT ?",
            (self._map, after_seq, limit),
        ):
            entry = log_entry(*row)
            names += entry.names
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
        entries = [
            ChainedEntry(seq, kind, CommitId(Author(robot, incarnation), n), sha, chain)
            for seq, kind, robot, incarnation, n, sha, chain in found
        ]
        return self._chains.note(entries)

    def marks(self, *, after_seq: int | None, limit: int, box: MarkBox | None = None) -> list[MarkChange]:
        """Marks that changed after a log entry, or those of the map, in a box, oldest first: as `Snapshot.marks`."""
        return _changed_marks(self._connection, self._map, after_seq=after_seq, limit=limit, box=box)

    def totals(self) -> Totals:
        """Sizes."""
        sums, corners = totals_of(self._connection, self._map)
        query = (
            "SELECT folded + (SELECT count(*) FROM commits WHERE map = ?1 AND folded_seq IS NULL AND damaged IS NULL),"
            " (SELECT count(*) FROM branch WHERE map = ?1),"
            " (SELECT coalesce(sum(kept_bytes), 0) FROM author WHERE map = ?1) FROM map WHERE number = ?1"
        )
        commits, branches, evidence_bytes = first(self._connection, query, (self._map,))
        return Totals(
            cells=sums.cells,
            size_bytes=sums.size_bytes,
            commits=commits,
            branches=branches,
            corner_cells=corners,
            history_bytes=sums.history_bytes,
            evidence_bytes=evidence_bytes,
        )


def _vector(found: list[tuple[Any, ...]]) -> VersionVector:
    return EMPTY.with_commits(CommitId(Author(robot, incarnation), n) for robot, incarnation, n in found)


def _changed_marks(
    connection: apsw.Connection, map_number: int, *, after_seq: int | None, limit: int, box: MarkBox | None
) -> list[MarkChange]:
    """Marks changed after a log entry, in a box, by entry and number; as `Snapshot.marks`."""
    where: str = "map = ? AND changed_seq > ?" + (" AND record IS NOT NULL" if after_seq is None else "")
    values: tuple[int, ...] = (map_number, after_seq or 0)
    if box is not None:
        where, values = f"{where} AND {corner_conditions('?')}", (*values, *corner_values(box))
    # A page ends with an entry, that of its last row, which is found along the index alone: it has the corners, too.
    query = f"SELECT changed_seq FROM mark WHERE {where} ORDER BY changed_seq LIMIT 1 OFFSET ?"  # noqa: S608 - our own clause
    last = first(connection, query, (*values, limit - 1))
    if last is not None:
        where, values = f"{where} AND changed_seq <= ?", (*values, last)
    found = rows(
        connection,
        "SELECT changed_seq, robot, incarnation, commits.n, mark.n, record, retracts FROM"  # noqa: S608 - our own clause
        f" (SELECT * FROM mark WHERE {where}) AS mark JOIN commits ON commits.number = commit_number"
        " ORDER BY changed_seq, mark.n",
        values,
    )
    return mark_changes(found)
