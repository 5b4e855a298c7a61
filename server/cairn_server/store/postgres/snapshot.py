"""Reading one state of a map from PostgreSQL, inside one transaction."""

import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import compress, islice
from typing import Any

import numpy as np

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector, vector_text, version_vector_from_json
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.messages import LogEntry
from cairn_server.store.history import KnownVectors, ReadChains
from cairn_server.store.objects.cold_bytes import ColdReads, split_cell_object
from cairn_server.store.postgres.connections import Connection, first, rows
from cairn_server.store.postgres.failures import lost_map
from cairn_server.store.postgres.schema import IS_MEASURED
from cairn_server.store.postgres.tile_rows import (
    CELL_COLUMNS,
    IN_TILES,
    OF_MAP,
    fingerprint_in_box,
    tiles_changed,
    totals_of,
)
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

OF_COMMIT = "map = %s AND robot = %s AND incarnation = %s AND n = %s"
LOG_COLUMNS = (
    "seq, kind, robot, incarnation, n, sha, size_bytes, cells, captured_first_s, captured_last_s, retracts, meta, via,"
    " received_s"
)
HELD_CELLS, HELD_BYTES_MAX = 16, 1 << 20
"""Most cells that are read at once, and the size from which on a cell is not among them."""
LOG_PAGE = 64
"""Log entries that are read at once, as each comes with its commit's meta."""


class PgSnapshot:
    """`store.Snapshot` over one connection that is inside a transaction."""

    def __init__(
        self,
        connection: Connection,
        map_number: int,
        layer_digest: bytes,
        vectors: KnownVectors,
        objects: ColdReads,
    ) -> None:
        self._connection = connection
        self._objects = objects
        self._map = map_number
        self._vectors = vectors
        head = first(connection, "SELECT log_id, seq, chain FROM head WHERE map = %s", (map_number,))
        if head is None:
            raise lost_map(connection, map_number)
        self._head = Cursor(*head)
        self._chains = ReadChains(self._head, layer_digest)
        self._held: dict[CellKey, CellRow | None] = {}

    @property
    def head(self) -> Cursor:
        """The state."""
        return self._head

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        query = "SELECT chain FROM log WHERE map = %s AND seq = %s"
        return self._chains.get(seq, lambda: first(self._connection, query, (self._map, seq)))

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body.

        Raises:
            AwayError: it is in the object store, which does not answer.
        """
        if key in self._held:
            return self._held[key]
        query = f"SELECT {CELL_COLUMNS}, body, stamps, object FROM cell WHERE {OF_MAP} AND cell = %(key)s"
        row = first(self._connection, query, {"map": self._map, "key": key})
        if row is None:
            return None
        *columns, body, stamps, name = row
        # A fold by an older program leaves the name of the object that it replaced.
        if body is None:
            body, stamps = split_cell_object(self._objects.get(name))
        return cell_row((*columns, body, stamps))

    def hold_cells(self, keys: Collection[CellKey]) -> None:
        """Read up to `HELD_CELLS` of these cells at once, none of them large or cold, for `cell`."""
        some = list(islice(keys, HELD_CELLS))
        if not some:
            return
        query = (
            f"SELECT key, {CELL_COLUMNS}, body, stamps FROM unnest(%(keys)s::bigint[]) AS u (key)"
            f" LEFT JOIN cell ON {OF_MAP} AND cell = key"
            f" WHERE cell IS NULL OR (body IS NOT NULL AND size_bytes < {HELD_BYTES_MAX})"
        )
        for key, *columns in rows(self._connection, query, {"map": self._map, "keys": some}):
            self._held[CellKey(key)] = cell_row(tuple(columns)) if columns[0] is not None else None

    def cells(
        self, *, after_seq: int = -1, after_key: int = -1, limit: int | None = None, box: Box | None = None
    ) -> Iterator[CellRow]:
        """Cells changed after a log entry, in a box, of numbers above `after_key`, at most `limit`; no bodies."""
        values: dict[str, Any] = {"map": self._map, "after_key": after_key, "limit": limit}
        if after_seq < 0 and box is None:
            clause = f"FROM cell WHERE {OF_MAP} AND cell > %(after_key)s ORDER BY cell LIMIT %(limit)s"
            yield from map(cell_row, rows(self._connection, f"SELECT {CELL_COLUMNS} {clause}", values))
            return
        tiles = tiles_changed(self._connection, self._map, after_seq=after_seq, box=box)
        values |= {"tiles": tiles, "after_seq": after_seq}
        clause = f"FROM {IN_TILES} WHERE cell.lm > %(after_seq)s AND cell.cell > %(after_key)s ORDER BY cell.cell"
        found = rows(self._connection, f"SELECT {CELL_COLUMNS} {clause}", values)
        if box is not None:
            is_asked = is_in_box(np.fromiter((row[0] for row in found), np.uint64, len(found)), box)
            found = list(compress(found, is_asked.tolist()))
        yield from map(cell_row, islice(found, limit))

    def cells_of(self, keys: Collection[CellKey]) -> list[CellRow]:
        """Those of these cells that are stored, without their bodies, by rising number."""
        if not keys:
            return []
        query = f"SELECT {CELL_COLUMNS} FROM cell WHERE {OF_MAP} AND cell = ANY(%(keys)s) ORDER BY cell"
        found = rows(self._connection, query, {"map": self._map, "keys": [int(key) for key in keys]})
        return [cell_row(row) for row in found]

    def fingerprint_sum(self, box: Box | None = None) -> Fingerprint:
        """Sum of the fingerprints of all cells, or of those in a box."""
        if box is not None:
            return fingerprint_in_box(self._connection, self._map, box)
        return totals_of(self._connection, self._map)[0].fingerprint

    def contributions(self, key: CellKey, *, after_seq: int, newest: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most so many of the newest."""
        query = (
            "SELECT seq, kind, robot, incarnation, n, size_bytes, epoch FROM touched"
            f" WHERE {OF_MAP} AND cell = %(key)s AND seq > %(after)s ORDER BY seq DESC LIMIT %(newest)s"
        )
        values = {"map": self._map, "key": key, "after": after_seq, "newest": newest}
        return [
            Contribution(seq, kind, CommitId(Author(robot, incarnation), n), size_bytes, epoch_from_column(epoch))
            for seq, kind, robot, incarnation, n, size_bytes, epoch in reversed(rows(self._connection, query, values))
        ]

    def named(self, commits: Sequence[CommitId]) -> list[NamedCommit]:
        """State of each of these commits, folded or not, in the same order; no evidence is read."""
        query = (
            "SELECT folded_seq IS NOT NULL, folded_seq IS NOT NULL AND gone, id IS NOT NULL,"
            " CASE WHEN folded_seq IS NULL THEN 0 ELSE cells END, "
            " CASE WHEN folded_seq IS NULL THEN 0 ELSE coalesce(nullif(bricks, 0), size_bytes) END"
            " FROM unnest(%(robots)s::text[], %(incarnations)s::text[], %(numbers)s::bigint[])"
            "   WITH ORDINALITY AS a (robot, incarnation, n, place)"
            " LEFT JOIN commits AS c ON c.map = %(map)s AND c.robot = a.robot AND c.incarnation = a.incarnation"
            "   AND c.n = a.n"
            " LEFT JOIN retracted AS r ON r.map = %(map)s AND id = a.robot || '.' || a.incarnation || '.' || a.n"
            " ORDER BY place"
        )
        values = {
            "map": self._map,
            "robots": [commit.author.robot for commit in commits],
            "incarnations": [commit.author.incarnation for commit in commits],
            "numbers": [commit.n for commit in commits],
        }
        found = rows(self._connection, query, values)
        return [NamedCommit(commit, *state) for commit, state in zip(commits, found, strict=True)]

    def touched_cells(self, commits: Iterable[CommitId]) -> frozenset[CellKey]:
        """Cells in which these commits have evidence that is kept; none of it is read."""
        query = (
            "SELECT DISTINCT d.cell FROM unnest(%(robots)s::text[], %(incarnations)s::text[], %(numbers)s::bigint[])"
            " AS a (robot, incarnation, n) JOIN commits AS c ON c.map = %(map)s AND c.robot = a.robot"
            " AND c.incarnation = a.incarnation AND c.n = a.n"
            " JOIN diff AS d ON d.map = %(map)s AND d.commit_number = c.number"
        )
        named = list(commits)
        values = {
            "map": self._map,
            "robots": [commit.author.robot for commit in named],
            "incarnations": [commit.author.incarnation for commit in named],
            "numbers": [commit.n for commit in named],
        }
        return frozenset(CellKey(cell) for (cell,) in rows(self._connection, query, values))

    def diff(self, commit: CommitId, key: CellKey) -> bytes | None:
        """The bytes of a commit's evidence in a cell; None if they are not kept any more.

        Raises:
            AwayError: they are in the object store, which does not answer.
        """
        query = (
            "SELECT body, segment, start_bytes, size_bytes FROM diff"
            f" WHERE {OF_MAP} AND cell = %(key)s AND commit_number = (SELECT number FROM commits"
            " WHERE map = %(map)s AND robot = %(robot)s AND incarnation = %(incarnation)s AND n = %(n)s)"
        )
        robot, incarnation = commit.author
        values = {"map": self._map, "key": key, "robot": robot, "incarnation": incarnation, "n": commit.n}
        found = first(self._connection, query, values)
        if found is None:
            return None
        body, name, start, size_bytes = found
        return body if body is not None else self._objects.part(name, start=start, size_bytes=size_bytes) or b""

    def tip(self, author: Author) -> tuple[int, bytes] | None:
        """Highest folded number of an author and its SHA-256."""
        row: tuple[int, bytes] | None = first(
            self._connection,
            "SELECT n, sha FROM commits WHERE map = %s AND robot = %s AND incarnation = %s AND folded_seq IS NOT NULL"
            " ORDER BY n DESC LIMIT 1",
            (self._map, *author),
        )
        return row

    def newest_captured_s(self) -> float | None:
        """Latest time at which a commit in the map says credibly that it was captured."""
        query = (
            f"SELECT captured_last_s FROM commits WHERE map = %s AND {IS_MEASURED}"
            " ORDER BY captured_last_s DESC LIMIT 1"
        )
        found: float | None = first(self._connection, query, (self._map,))
        return found

    def commits_where(self, selection: Selection) -> list[CommitId]:
        """Every commit with evidence that fits and is not retracted, folded or not, in order of arrival."""
        query = (
            "SELECT robot, incarnation, n FROM commits WHERE map = %(map)s AND cells > 0"
            " AND (%(robot)s::text IS NULL OR robot = %(robot)s) AND (%(rig)s::bytea IS NULL OR rig = %(rig)s)"
            " AND received_s BETWEEN %(pushed_first_s)s::float8 AND %(pushed_last_s)s::float8"
            " AND coalesce(captured_last_s, '-infinity') >= %(first_s)s::float8"
            " AND coalesce(captured_first_s, 'infinity') <= %(last_s)s::float8"
            " AND NOT EXISTS (SELECT FROM retracted WHERE retracted.map = commits.map"
            " AND id = robot || '.' || incarnation || '.' || n) ORDER BY number"
        )
        values = {
            "map": self._map,
            "robot": selection.robot,
            "rig": selection.rig,
            "pushed_first_s": float(selection.pushed_s[0]),
            "pushed_last_s": float(selection.pushed_s[1]),
            "first_s": float(selection.captured_s[0]),
            "last_s": float(selection.captured_s[1]),
        }
        return [CommitId(Author(r, i), n) for r, i, n in rows(self._connection, query, values)]

    def pending(self) -> VersionVector:
        """Commits that are durable but not folded, without those that are set aside as damaged."""
        found = rows(
            self._connection,
            "SELECT robot, incarnation, n FROM commits WHERE map = %s AND folded_seq IS NULL AND damaged IS NULL",
            (self._map,),
        )
        return EMPTY.with_commits(CommitId(Author(robot, incarnation), n) for robot, incarnation, n in found)

    def vector_at(self, seq: int) -> VersionVector:
        """Ids of the commits folded at or before a log entry."""
        return self._vectors.at(self._map, seq, self)

    def newest_mark(self, seq: int) -> int:
        """Entry of the newest mark at or before one; 0: there is none."""
        query = "SELECT seq FROM vector_mark WHERE map = %s AND seq <= %s ORDER BY seq DESC LIMIT 1"
        return int(first(self._connection, query, (self._map, seq)) or 0)

    def mark(self, seq: int) -> VersionVector:
        """Vector of the mark at an entry."""
        query = "SELECT vector FROM vector_mark WHERE map = %s AND seq = %s"
        return version_vector_from_json(json.loads(first(self._connection, query, (self._map, seq))))

    def keep_mark(self, seq: int) -> None:
        """Store the vector at an entry; by the fold that leads there."""
        query = "INSERT INTO vector_mark (map, seq, vector) VALUES (%s, %s, %s)"
        self._connection.execute(query, (self._map, seq, vector_text(self.vector_at(seq))))

    def seq_before(self, age_s: float) -> int:
        """Newest log entry with a commit that was folded before an age of the store; 0: there is none."""
        query = (
            "SELECT folded_seq FROM commits WHERE map = %s AND folded_age_s < %s::float8 AND folded_seq IS NOT NULL"
            " ORDER BY folded_age_s DESC, folded_seq DESC LIMIT 1"
        )
        return int(first(self._connection, query, (self._map, age_s)) or 0)

    def log(self, *, after_seq: int, limit: int, names_max: int | None = None) -> list[LogEntry]:
        """Log entries, oldest first: the first one, and as many more as name so many commits together at most."""
        found: list[LogEntry] = []
        names, end_seq = 0, after_seq + limit
        while after_seq < end_seq:
            page = self._log_page(after_seq, min(LOG_PAGE, end_seq - after_seq))
            for entry in page:
                names += entry.names
                if found and names_max is not None and names > names_max:
                    return found
                found.append(entry)
            if len(page) < LOG_PAGE:
                break
            after_seq += len(page)
        return found

    def _log_page(self, after_seq: int, limit: int) -> list[LogEntry]:
        query = (
            f"SELECT {LOG_COLUMNS} FROM log JOIN commits ON commits.map = log.map AND commits.number = commit_number"
            " WHERE log.map = %s AND seq > %s ORDER BY seq LIMIT %s"
        )
        found = rows(self._connection, query, (self._map, after_seq, limit))
        columns = ([*facts, *_said(meta), via, received_s] for *facts, meta, via, received_s in found)
        return [log_entry(*each) for each in columns]

    def chained(self, *, after_seq: int, limit: int) -> list[ChainedEntry]:
        """Log entries, oldest first, without what they say."""
        found = rows(
            self._connection,
            "SELECT seq, kind, robot, incarnation, n, sha, chain FROM log"
            " JOIN commits ON commits.map = log.map AND commits.number = log.commit_number"
            " WHERE log.map = %s AND seq > %s ORDER BY seq LIMIT %s",
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
            "SELECT folded + (SELECT count(*) FROM commits WHERE map = %(map)s AND folded_seq IS NULL"
            " AND damaged IS NULL), (SELECT count(*) FROM branch WHERE map = %(map)s),"
            " (SELECT coalesce(sum(kept_bytes), 0)::bigint FROM author WHERE map = %(map)s)"
            " FROM head WHERE map = %(map)s"
        )
        commits, branches, evidence_bytes = first(self._connection, query, {"map": self._map})
        return Totals(
            cells=sums.cells,
            size_bytes=sums.size_bytes,
            commits=commits,
            branches=branches,
            corner_cells=corners,
            history_bytes=sums.history_bytes,
            evidence_bytes=evidence_bytes,
        )


def _said(meta: bytes) -> tuple[str | None, str | None, str | None, str | None]:
    """Parent, seen state, place as JSON and note of a commit's meta; None, too, if it is damaged or gone."""
    try:
        said = json.loads(meta)
        scans = said.get("scans")
        place = json.dumps(scans[-1]["t_map_rig"]) if scans else None
        return said.get("parent"), said.get("seen"), place, said.get("note")
    except (ValueError, TypeError, AttributeError, LookupError):
        return None, None, None, None


def _changed_marks(
    connection: Connection, map_number: int, *, after_seq: int | None, limit: int, box: MarkBox | None
) -> list[MarkChange]:
    """Marks changed after a log entry, in a box, by entry and number; as `Snapshot.marks`."""
    where: str = "map = %s AND changed_seq > %s" + (" AND record IS NOT NULL" if after_seq is None else "")
    values: tuple[int, ...] = (map_number, after_seq or 0)
    if box is not None:
        where, values = f"{where} AND {corner_conditions('%s')}", (*values, *corner_values(box))
    # A page ends with an entry, that of its last row, which is found along the index alone: it has the corners, too.
    query = f"SELECT changed_seq FROM mark WHERE {where} ORDER BY changed_seq LIMIT 1 OFFSET %s"
    last = first(connection, query, (*values, limit - 1))
    if last is not None:
        where, values = f"{where} AND changed_seq <= %s", (*values, last)
    found = rows(
        connection,
        "SELECT changed_seq, robot, incarnation, c.n, m.n, record, retracts FROM"
        f" (SELECT * FROM mark WHERE {where}) AS m JOIN commits AS c ON c.map = m.map AND c.number = commit_number"
        " ORDER BY changed_seq, m.n",
        values,
    )
    return mark_changes(found)
