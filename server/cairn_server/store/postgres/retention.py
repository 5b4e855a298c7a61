"""Retention: what a store keeps no longer (see `store.sqlite.retention`), evidence of old commits and deleted maps.

A retract that is pushed and evidence that is dropped must not miss each other: both lock the map's head.

Deletion of maps in PostgreSQL: one transaction ends a map for all servers, many bounded ones remove its rows.

    delete_map     map, head, authors and branches go at once; gone_map and gone_token keep what is said of them
    clear_part     log and evidence, cells, accounts; objects of them are dead from then on (`settling`)

Without its head nothing is folded or kept slowly, and without their authors nothing is kept fast (`pushes`): so no row
comes after those that are removed. Servers that have the map in memory are refused by what is missing.
"""

from cairn_map.commits.ids import Author, CommitId
from cairn_server.map_refusals import GoneMap
from cairn_server.store.numbering import AGAIN_KEPT_S, EvidenceGoneError
from cairn_server.store.postgres.connections import Connection, first, rows
from cairn_server.store.postgres.failures import lost_map
from cairn_server.store.postgres.schema import IS_WAITING, NOW_S
from cairn_server.store.postgres.shares import lock_head
from cairn_server.store.store_rows import MapRow, NewCommit

DROP_DIFFS = """
WITH went AS (
    DELETE FROM diff WHERE map = %(map)s AND commit_number = ANY(%(numbers)s) RETURNING segment
), fewer AS (
    SELECT segment AS name, count(*) AS pieces FROM went WHERE segment IS NOT NULL GROUP BY segment
), empty AS (
    DELETE FROM segment USING fewer
    WHERE map = %(map)s AND segment.name = fewer.name AND live = pieces RETURNING segment.name
), left_over AS (
    UPDATE segment SET live = live - pieces FROM fewer
    WHERE map = %(map)s AND segment.name = fewer.name AND live > pieces
)
INSERT INTO dead_object (map, name, since_age_s) SELECT %(map)s, name, %(age_s)s FROM empty"""
"""SQL that drops the evidence of commits, and gives up the segments of which nothing is left."""

COUNT_GONE = """
UPDATE author SET kept_bytes = greatest(0, kept_bytes - went.size_bytes) FROM (
    SELECT robot, incarnation, sum(size_bytes)::bigint AS size_bytes FROM commits
    WHERE map = %(map)s AND number = ANY(%(numbers)s) GROUP BY 1, 2
) AS went
WHERE author.map = %(map)s AND author.robot = went.robot AND author.incarnation = went.incarnation"""
"""SQL that counts off what was dropped. A server of an earlier version counted nothing: so never below 0."""


def forget_evidence(connection: Connection, row: MapRow, before_s: float, limit: int, *, age_s: float) -> int:
    """Drop the evidence of commits folded, and last pushed, before an age of the store (now `age_s`); their count.

    What was pushed again and is not taken out stays for `AGAIN_KEPT_S` at least: a retract may need it.
    """
    lock_head(connection, row)
    pinned = _pinned(connection, row)
    found = rows(
        connection,
        "SELECT number, greatest(folded_seq, unfolded_seq), robot || '.' || incarnation || '.' || n FROM commits"
        " WHERE map = %s AND NOT gone AND cells > 0 AND folded_seq IS NOT NULL AND folded_age_s < %s"
        " AND received_age_s < CASE WHEN received_age_s > folded_age_s AND coalesce(unfolded_seq, 0) = 0"
        " THEN %s::float8 ELSE %s::float8 END ORDER BY folded_age_s, number LIMIT %s",
        (row.number, before_s, min(before_s, age_s - AGAIN_KEPT_S), before_s, limit + len(pinned)),
    )
    gone = [(number, newest) for number, newest, commit in found if commit not in pinned][:limit]
    if not gone:
        return 0
    values = {"map": row.number, "numbers": [n for n, _ in gone], "newest": [newest for _, newest in gone]}
    # One row for each cell, however many of the commits touch it; the cells of a map are only written under its head.
    connection.execute(
        "UPDATE cell SET gone_seq = greatest(cell.gone_seq, went.newest) FROM ("
        "  SELECT layer, diff.cell, max(newest) AS newest FROM unnest(%(numbers)s::bigint[], %(newest)s::bigint[])"
        "  AS commit (number, newest) JOIN diff ON map = %(map)s AND commit_number = commit.number GROUP BY 1, 2"
        ") AS went WHERE cell.map = %(map)s AND cell.layer = went.layer AND cell.cell = went.cell",
        values,
    )
    connection.execute(
        "DELETE FROM touched USING commits, diff WHERE commits.map = %(map)s AND commits.number = ANY(%(numbers)s)"
        " AND diff.map = commits.map AND diff.commit_number = commits.number"
        " AND touched.map = diff.map AND touched.layer = diff.layer AND touched.cell = diff.cell"
        " AND touched.seq IN (commits.folded_seq, commits.unfolded_seq)",
        values,
    )
    connection.execute(DROP_DIFFS, {**values, "age_s": age_s})
    query = "UPDATE commits SET gone = true, meta = '' WHERE map = %(map)s AND number = ANY(%(numbers)s)"
    connection.execute(query, values)
    # Last, as it keeps these robots' pushes waiting until the end of the transaction; they wait for nothing else of it.
    connection.execute(COUNT_GONE, values)
    return len(gone)


def count_kept(connection: Connection, row: MapRow, author: Author, more_bytes: int) -> None:
    """Count the bytes of an author's commits whose evidence is kept."""
    query = "UPDATE author SET kept_bytes = kept_bytes + %s WHERE map = %s AND robot = %s AND incarnation = %s"
    connection.execute(query, (more_bytes, row.number, *author))


def remember_evidence(connection: Connection, row: MapRow, number: int, commit: NewCommit, *, age_s: float) -> None:
    """Keep the meta of a commit that was pushed again; it can be retracted for as long as after the first push."""
    count_kept(connection, row, commit.id.author, commit.size_bytes)
    connection.execute(
        f"UPDATE commits SET gone = false, meta = %s, received_s = {NOW_S}, received_age_s = %s"
        " WHERE map = %s AND number = %s",
        (commit.text, age_s, row.number, number),
    )


def check_kept(connection: Connection, row: MapRow, targets: tuple[CommitId, ...]) -> None:
    """Refuse to retract what cannot be subtracted any more.

    Raises:
        ConflictError: kind `evidence_gone`.
    """
    query = "SELECT gone FROM commits WHERE map = %s AND robot = %s AND incarnation = %s AND n = %s"
    gone = [
        target
        for target in targets
        if first(connection, query, (row.number, *target.author, target.n))
        and not is_retracted(connection, row, target)
    ]
    if gone:
        raise EvidenceGoneError(gone)


def is_retracted(connection: Connection, row: MapRow, commit: CommitId) -> bool:
    """True if a retract of this id has taken effect, or waits for the commit to come."""
    query = "SELECT 1 FROM retracted WHERE map = %s AND id = %s"
    return first(connection, query, (row.number, str(commit))) is not None


def _pinned(connection: Connection, row: MapRow) -> set[str]:
    """Ids that commits name which are not folded yet, or whose retract is under way."""
    query = (
        "SELECT retracts FROM commits WHERE map = %(map)s AND folded_seq IS NULL AND retracts <> ''"
        f" UNION ALL SELECT retracts FROM commits WHERE map = %(map)s AND {IS_WAITING} AND due_from IS NOT NULL"
    )
    return {name for (text,) in rows(connection, query, {"map": row.number}) for name in text.split()}


DYING = "SELECT map FROM gone_map WHERE NOT cleared ORDER BY map LIMIT 1"
CLAIMED = f"{DYING} FOR UPDATE"
ROWS_MAX = 2000
"""Most rows that are removed by one statement."""
ROW_BYTES = 1000
"""Bytes that a row counts for, besides those of its values: with its indexes."""
AT_ONCE = ("head", "author", "branch", "branch_status", "branch_view", "assignment", "lease", "settled")
"""Tables whose rows go when the map does: they are few, and without them nothing new comes."""
LATER = {
    "touched": "layer, cell, seq",
    "log": "seq",
    "commits": "robot, incarnation, n",
    "tile": "layer, tile",
    "mark": "commit_number, n",
    "attachment": "sha, uploader",
    "attachment_part": "sha, uploader, begin_bytes",
    "held": "account, region",
    "retracted": "id",
    "vector_mark": "seq",
    "robot_key": "robot, incarnation",
    "segment": "name",
    "body": "robot, commit",
    "body_part": "robot, commit, offset_bytes",
    "use_day": "robot",
}
"""Tables whose rows go after evidence and cells (`CLEAR_DIFFS`, `CLEAR_CELLS`), with their keys after the map."""
OF_DIFF, OF_CELL = "commit_number, layer, cell", "layer, cell"
SUMMED = "sum(size_bytes + %(row_bytes)s) OVER (ROWS UNBOUNDED PRECEDING) - size_bytes - %(row_bytes)s AS earlier"
"""SQL of the bytes of the rows before one."""
CLEAR_DIFFS = f"""
WITH picked AS (
    SELECT {OF_DIFF}, coalesce(octet_length(body), 0) AS size_bytes FROM diff WHERE map = %(map)s LIMIT %(limit)s
), summed AS (
    SELECT {OF_DIFF}, {SUMMED} FROM picked
), went AS (
    DELETE FROM diff WHERE map = %(map)s AND ({OF_DIFF}) IN (
        SELECT {OF_DIFF} FROM summed WHERE earlier <= %(left_bytes)s
    )
    RETURNING coalesce(octet_length(body), 0) AS size_bytes
)
SELECT coalesce(sum(size_bytes + %(row_bytes)s), 0)::bigint FROM went"""
CLEAR_CELLS = f"""
WITH picked AS (
    SELECT {OF_CELL}, size_bytes FROM cell WHERE map = %(map)s LIMIT %(limit)s
), summed AS (
    SELECT {OF_CELL}, {SUMMED} FROM picked
), went AS (
    DELETE FROM cell WHERE map = %(map)s AND ({OF_CELL}) IN (
        SELECT {OF_CELL} FROM summed WHERE earlier <= %(left_bytes)s
    )
    RETURNING size_bytes, object
), dead AS (
    INSERT INTO dead_object (map, name, since_age_s)
    SELECT %(map)s, object, %(age_s)s::float8 FROM went WHERE object IS NOT NULL ON CONFLICT DO NOTHING
)
SELECT coalesce(sum(size_bytes + %(row_bytes)s), 0)::bigint FROM went"""
LEAVE_SEGMENTS = """
    INSERT INTO dead_object (map, name, since_age_s)
    SELECT map, name, %s FROM segment WHERE map = %s ON CONFLICT DO NOTHING"""


def delete_map(connection: Connection, row: MapRow, *, by: str) -> GoneMap:
    """End a map, its layers and their tokens inside a transaction; most of their rows stay (`clear_part`).

    Raises:
        NotFoundError: kind `gone`.
    """
    # Layers first, in the order in which pushes to them lock heads.
    layers = "SELECT map FROM map WHERE starts_with(name, %s)"
    connection.execute(f"SELECT 1 FROM head WHERE map IN ({layers}) FOR UPDATE".encode(), (f"{row.name}.",))
    if first(connection, "SELECT 1 FROM head WHERE map = %s FOR UPDATE", (row.number,)) is None:
        raise lost_map(connection, row.number)
    for number, name in rows(connection, "SELECT map, name FROM map WHERE starts_with(name, %s)", (f"{row.name}.",)):
        _end(connection, number, name, by=by)
    return _end(connection, row.number, row.name, by=by)


def _end(connection: Connection, number: int, name: str, *, by: str) -> GoneMap:
    deleted_s = first(
        connection,
        f"INSERT INTO gone_map (map, name, deleted_s, by) VALUES (%s, %s, {NOW_S}, %s) RETURNING deleted_s",
        (number, name, by),
    )
    query = "INSERT INTO gone_token (hash, map) SELECT hash, map FROM token WHERE map = %s ON CONFLICT DO NOTHING"
    connection.execute(query, (number,))
    for table in ("token", *AT_ONCE, "map"):
        connection.execute(f"DELETE FROM {table} WHERE map = %s".encode(), (number,))
    return GoneMap(number=number, name=name, deleted_s=deleted_s, by=by)


def clear_part(connection: Connection, *, size_bytes_max: int, age_s: float) -> bool:
    """Remove about so many bytes of a deleted map's rows inside a transaction; False once there is nothing left.

    Another server that is at it has the map locked, and this one waits for the end of its part.
    """
    number = first(connection, CLAIMED)
    if number is None:
        return False
    left_bytes = size_bytes_max
    values = {"map": number, "limit": ROWS_MAX, "row_bytes": ROW_BYTES, "age_s": age_s}
    for query in (CLEAR_DIFFS, CLEAR_CELLS):
        while left_bytes > 0 and (went := first(connection, query, {**values, "left_bytes": left_bytes})):
            left_bytes -= went
    if left_bytes > 0:
        connection.execute(LEAVE_SEGMENTS, (age_s, number))
    for table, key in LATER.items():
        some = f"SELECT {key} FROM {table} WHERE map = %s LIMIT %s"
        query = f"DELETE FROM {table} WHERE map = %s AND ({key}) IN ({some})"
        while left_bytes > 0 and (count := connection.execute(query.encode(), (number, number, ROWS_MAX)).rowcount):
            left_bytes -= ROW_BYTES * count
    if left_bytes > 0:
        connection.execute("UPDATE gone_map SET cleared = true WHERE map = %s", (number,))
    return left_bytes <= 0 or first(connection, DYING) is not None
