"""Folds: a compare-and-swap of the map's head, with all that follows from it, in one transaction.

lock the head if it is the fold's base      another folder was faster, or was paused for an hour: nothing is written
log, touched, commits, accounts             what is folded, and what is taken out
cells                                       in batches: a fold may be larger than memory
tiles, head with its totals, NOTIFY, mark   one hint for those that wait for news; they ask the head in any case

A fold of one commit is the most frequent one, and a statement costs much here and in the database whatever it does. So
each line is one statement, but for what is rare.
"""

from collections.abc import Iterator, Sequence

from cairn_map.commits.cursor import ENTRY_FOLD, next_chain
from cairn_map.commits.ids import Author, CommitId
from cairn_server.store.history import KnownVectors, crosses_mark
from cairn_server.store.objects.cold_bytes import NoObjects
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.shares import COUNT_MARKS, give_back_sums, lock_head
from cairn_server.store.postgres.snapshot import PgSnapshot
from cairn_server.store.postgres.tile_rows import (
    COUNTED,
    TOTALS,
    Counted,
    PgTileWriter,
    recount_tile,
    totals_from,
    totals_values,
)
from cairn_server.store.store import LEASE_S
from cairn_server.store.store_rows import CellRow, Fold, MapRow
from cairn_server.store.tiles import Corners, TileSums, tile_of

CHANNEL = "cairn_fold"
"""Channel on which a fold notifies: number of the map, and its new seq."""
BATCH_BYTES = 8 << 20
"""Bytes of cells that are written by one statement."""
BASE = """
    SELECT cells, cells_bytes, fingerprint, corners, history_bytes FROM head WHERE map = %s AND seq = %s AND chain = %s
    FOR NO KEY UPDATE"""
"""SQL that locks a map's head if it is a fold's base, and gives its totals."""
LEAVE_OBJECTS = """
    INSERT INTO dead_object (map, name, since_age_s)
    SELECT map, object, %(age_s)s FROM cell
    WHERE map = %(map)s AND layer = 0 AND cell = ANY(%(keys)s::bigint[]) AND object IS NOT NULL"""
"""SQL that notes the objects of cells that are about to be written here, so that they are deleted in time."""
PUT_CELLS = f"""
WITH left_objects AS ({LEAVE_OBJECTS}
), put AS (
    INSERT INTO cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, hottest_k, history_bytes, body, stamps)
    SELECT %(map)s, u.* FROM unnest(
        %(keys)s::bigint[], %(lms)s::bigint[], %(digests)s::bytea[], %(fingerprints)s::bytea[], %(voxels)s::bigint[],
        %(sizes_bytes)s::bigint[], %(hottest_k)s::float8[], %(history_bytes)s::bigint[], %(bodies)s::bytea[],
        %(stamps)s::bytea[]
    ) AS u
    ON CONFLICT (map, layer, cell) DO UPDATE SET lm = excluded.lm, digest = excluded.digest,
        fingerprint = excluded.fingerprint, voxels = excluded.voxels, size_bytes = excluded.size_bytes,
        hottest_k = excluded.hottest_k, history_bytes = excluded.history_bytes, body = excluded.body,
        stamps = excluded.stamps, object = NULL
)
{COUNTED}"""
"""SQL that writes cells; its rows are the sums (`Counted`) that they and their tiles had until then."""
ENTER = """
WITH e AS (SELECT * FROM unnest(%(seqs)s::bigint[], %(kinds)s::bytea[], %(numbers)s::bigint[], %(chains)s::bytea[])
        AS e (seq, kind, number, chain)
), logged AS (
    INSERT INTO log (map, seq, kind, commit_number, chain) SELECT %(map)s, seq, kind, number, chain FROM e
), folded AS (
    UPDATE commits SET folded_seq = e.seq, folded_age_s = %(age_s)s::float8
    FROM e WHERE map = %(map)s AND commits.number = e.number AND e.kind = %(fold)s AND folded_seq IS NULL
), marked AS (
    UPDATE mark SET changed_seq = e.seq
    FROM e WHERE mark.map = %(map)s AND commit_number = e.number AND e.kind = %(fold)s AND changed_seq IS NULL
)
INSERT INTO touched (map, layer, cell, seq, kind, robot, incarnation, n, size_bytes, epoch)
SELECT d.map, d.layer, d.cell, e.seq, e.kind, c.robot, c.incarnation, c.n, coalesce(octet_length(d.body), d.size_bytes),
    c.epoch
FROM e JOIN commits AS c ON c.map = %(map)s AND c.number = e.number
    JOIN diff AS d ON d.map = c.map AND d.commit_number = c.number"""
"""SQL that writes a fold's log entries, what they touch, and which commits and marks come with them."""
TAKE_MARKS_OUT = """
    UPDATE mark SET changed_seq = e.seq, record = NULL, attached_sha = NULL
    FROM unnest(%(seqs)s::bigint[], %(kinds)s::bytea[], %(numbers)s::bigint[]) AS e (seq, kind, number)
    WHERE mark.map = %(map)s AND mark.commit_number = e.number AND e.kind <> %(fold)s AND record IS NOT NULL
    RETURNING mark.commit_number"""
"""SQL that notes the log entries which took marks out, whose records go (values of `ENTER`)."""

CLAIM = """
WITH wanted AS (SELECT * FROM unnest(%(maps)s::bigint[]) WITH ORDINALITY AS w (map, turn)),
    own AS (SELECT map FROM wanted JOIN lease USING (map) WHERE holder = %(holder)s),
    free AS (
        SELECT map FROM wanted LEFT JOIN lease USING (map)
        WHERE lease.map IS NULL OR (holder <> %(holder)s AND until < clock_timestamp())
        ORDER BY turn LIMIT %(new_max)s
    )
INSERT INTO lease (map, holder, until)
SELECT map, %(holder)s, clock_timestamp() + make_interval(secs => %(for_s)s::float8)
FROM (TABLE own UNION TABLE free) AS claimed ORDER BY map
ON CONFLICT (map) DO UPDATE SET holder = excluded.holder, until = excluded.until
WHERE lease.holder = excluded.holder OR lease.until < clock_timestamp()
RETURNING map
"""
"""Rows are written in the order of the maps, so that two that claim at a time do not wait for each other."""


def write_fold(connection: Connection, row: MapRow, fold: Fold, *, age_s: float) -> bool:
    """Cells, entries and head at an age of the store, if head and retracts are still where the fold begins."""
    base = first(connection, BASE, (row.number, fold.base.seq, fold.base.chain))
    if base is None:
        return False
    # A part in which no commit was there to be taken out leaves the head where it is.
    query = "SELECT due_from FROM commits WHERE map = %s AND number = %s"
    if any(first(connection, query, (row.number, step.commit)) != step.before for step in fold.steps):
        return False
    if not _names_its_commits(connection, row, fold):
        return False
    _write_entries(connection, row, fold, age_s)
    _write_progress(connection, row, fold)
    tiles = PgTileWriter(connection, row.number, totals_from(base))
    for batch in _batches(fold):
        tiles.note(batch, _put_cells(connection, row, batch, age_s=age_s))
    sums, corners = tiles.write()
    _move_head(connection, row, fold, sums, corners)
    if crosses_mark(fold.base, fold.head):
        snapshot = PgSnapshot(connection, row.number, row.layer.digest(), KnownVectors(), NoObjects())
        snapshot.keep_mark(fold.head.seq)
    return True


def heal_cell(connection: Connection, row: MapRow, cell: CellRow, *, age_s: float) -> bool:
    """Put sound bytes in the place of a damaged cell at an age of the store; False if it changed meanwhile."""
    lock_head(connection, row)
    is_same = "SELECT 1 FROM cell WHERE map = %s AND layer = 0 AND cell = %s AND lm = %s"
    if first(connection, is_same, (row.number, cell.key, cell.lm)) is None:
        return False
    connection.execute(LEAVE_OBJECTS, {"age_s": age_s, "map": row.number, "keys": [int(cell.key)]})
    # Stamps that are lost with an object count as if all of the cell had changed with its last entry.
    connection.execute(
        "UPDATE cell SET digest = %s, fingerprint = %s, voxels = %s, size_bytes = %s, body = %s, hottest_k = %s,"
        " history_bytes = %s, stamps = coalesce(stamps, %s), object = NULL WHERE map = %s AND layer = 0 AND cell = %s",
        (
            *(cell.digest, cell.fingerprint.to_bytes(), cell.voxels, cell.size_bytes, cell.body, cell.hottest_k),
            *(cell.history_bytes, cell.stamps, row.number, cell.key),
        ),
    )
    recount_tile(connection, row.number, tile_of(cell.key))
    return True


class PgLeases:
    """Claims of maps by the processes that fold (`store.FoldLeases`), by the database's clock."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections

    def claim(self, maps: Sequence[MapRow], *, holder: str, new_max: int) -> list[MapRow]:
        """Claim maps: those of this holder, and some that no other one has."""
        if not maps:
            return []
        values = {"maps": [row.number for row in maps], "holder": holder, "new_max": new_max, "for_s": LEASE_S}
        with self._connections.lent() as connection:
            claimed = {number for (number,) in rows(connection, CLAIM, values)}
        return [row for row in maps if row.number in claimed]

    def release(self, *, holder: str) -> None:
        """End all claims of a holder."""
        with self._connections.lent() as connection:
            connection.execute("DELETE FROM lease WHERE holder = %s", (holder,))


def _names_its_commits(connection: Connection, row: MapRow, fold: Fold) -> bool:
    """True if the numbers of a fold's entries are those of the commits that were planned, as their chain proves.

    A database that was put back to an older state while a fold was planned may have the same head; commits that came
    since have the numbers of those that were lost.
    """
    query = "SELECT number, robot, incarnation, n, sha FROM commits WHERE map = %s AND number = ANY(%s)"
    found = rows(connection, query, (row.number, [entry.commit for entry in fold.entries]))
    commits = {number: (CommitId(Author(robot, incarnation), n), sha) for number, robot, incarnation, n, sha in found}
    chain = fold.base.chain
    for entry in fold.entries:
        if entry.commit not in commits:
            return False
        chain = next_chain(chain, entry.kind, *commits[entry.commit])
        if chain != entry.chain:
            return False
    return True


def _write_entries(connection: Connection, row: MapRow, fold: Fold, age_s: float) -> None:
    entries = list(enumerate(fold.entries, start=fold.base.seq + 1))
    if not entries:
        return
    values = {
        "map": row.number,
        "age_s": age_s,
        "seqs": [seq for seq, _ in entries],
        "kinds": [entry.kind for _, entry in entries],
        "numbers": [entry.commit for _, entry in entries],
        "chains": [entry.chain for _, entry in entries],
        "fold": ENTRY_FOLD,
    }
    connection.execute(ENTER, values)
    out = [entry.commit for _, entry in entries if entry.kind != ENTRY_FOLD]
    if out:
        connection.execute(
            "UPDATE commits SET unfolded_seq = e.seq"
            " FROM unnest(%(seqs)s::bigint[], %(kinds)s::bytea[], %(numbers)s::bigint[]) AS e (seq, kind, number)"
            " WHERE map = %(map)s AND commits.number = e.number AND e.kind <> %(fold)s",
            values,
        )
        # Authors before accounts, as every push locks them.
        _take_marks_out(connection, values)
        give_back_sums(connection, row, out)


def _take_marks_out(connection: Connection, values: dict[str, object]) -> None:
    """Note the log entries that took marks out, and count them off; the values are those of `ENTER`."""
    gone = [number for (number,) in rows(connection, TAKE_MARKS_OUT, values)]
    for number in sorted(set(gone)):
        connection.execute(COUNT_MARKS, {"map": values["map"], "number": number, "more": -gone.count(number)})


def _write_progress(connection: Connection, row: MapRow, fold: Fold) -> None:
    """Ids that are retracted, commits to be set aside, and retracts under way."""
    if fold.retracted:
        connection.execute(
            "INSERT INTO retracted (map, id) SELECT %s, unnest(%s::text[])",
            (row.number, [str(target) for target in fold.retracted]),
        )
    for number, why in fold.damaged:
        query = "UPDATE commits SET damaged = %s WHERE map = %s AND number = %s"
        connection.execute(query, (why.replace("\0", "?"), row.number, number))
    for step in fold.steps:
        query = "UPDATE commits SET due_from = %s WHERE map = %s AND number = %s"
        connection.execute(query, (step.after, row.number, step.commit))


def _batches(fold: Fold) -> Iterator[list[CellRow]]:
    """Cells of a fold, some megabytes at a time; each cell is in one batch."""
    batch: list[CellRow] = []
    size_bytes = 0
    for cell in fold.cells:
        batch.append(cell)
        size_bytes += len(cell.body) + len(cell.stamps)
        if size_bytes > BATCH_BYTES:
            yield batch
            batch, size_bytes = [], 0
    if batch:
        yield batch


def _put_cells(connection: Connection, row: MapRow, cells: list[CellRow], *, age_s: float) -> list[Counted]:
    """Write cells; the sums that they and their tiles had until then."""
    values = {
        "map": row.number,
        "age_s": age_s,
        "keys": [int(cell.key) for cell in cells],
        "tiles": list({tile_of(cell.key) for cell in cells}),
        "lms": [cell.lm for cell in cells],
        "digests": [cell.digest for cell in cells],
        "fingerprints": [cell.fingerprint.to_bytes() for cell in cells],
        "voxels": [cell.voxels for cell in cells],
        "sizes_bytes": [cell.size_bytes for cell in cells],
        "hottest_k": [cell.hottest_k for cell in cells],
        "history_bytes": [cell.history_bytes for cell in cells],
        "bodies": [cell.body for cell in cells],
        "stamps": [cell.stamps for cell in cells],
    }
    return [Counted(*found) for found in rows(connection, PUT_CELLS, values)]


def _move_head(connection: Connection, row: MapRow, fold: Fold, sums: TileSums, corners: Corners | None) -> None:
    """Write the head with the map's totals, and tell those that wait for it if it moved."""
    folded = sum(entry.kind == ENTRY_FOLD for entry in fold.entries)
    notify = " RETURNING pg_notify(%s, %s)" if fold.entries else ""
    hint = (CHANNEL, f"{row.number} {fold.head.seq}") if fold.entries else ()
    connection.execute(
        f"UPDATE head SET seq = %s, chain = %s, folded = folded + %s, {TOTALS} WHERE map = %s{notify}".encode(),
        (fold.head.seq, fold.head.chain, folded, *totals_values(sums, corners), row.number, *hint),
    )
