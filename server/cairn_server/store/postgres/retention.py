"""Retention: the evidence of old commits goes, their row in the log stays (see `store.sqlite.retention`).

A retract that is pushed and evidence that is dropped must not miss each other: both lock the map's head.
"""

from cairn_map.commits.ids import CommitId
from cairn_server.store.numbering import AGAIN_KEPT_S, EvidenceGoneError
from cairn_server.store.postgres.connections import Connection, first, rows
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
    return len(gone)


def remember_evidence(connection: Connection, row: MapRow, number: int, commit: NewCommit, *, age_s: float) -> None:
    """Keep the meta of a commit that was pushed again; it can be retracted for as long as after the first push."""
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
