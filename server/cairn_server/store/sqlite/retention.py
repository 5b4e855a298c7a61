"""Only the last version of the map is stored: the evidence of old commits goes, their row in the log stays.

What goes is each commit's diff, its meta, and which cells it touched: some 200 bytes of it are left, whatever it held.
A cell notes the newest entry that went, so that no sum of commits is ever made without it (SYNC.md rule 4).
"""

import time

import apsw

from cairn_map.commits.ids import CommitId
from cairn_server.store.numbering import AGAIN_KEPT_S, EvidenceGoneError
from cairn_server.store.sqlite.writer import first, rows
from cairn_server.store.store_rows import MapRow, NewCommit


def forget_evidence(connection: apsw.Connection, row: MapRow, before_s: float, limit: int, *, age_s: float) -> int:
    """Drop the evidence of commits folded, and last pushed, before an age of the store (now `age_s`); how many.

    What was pushed again and is not taken out stays for `AGAIN_KEPT_S` at least: a retract may need it.
    """
    pinned = _pinned(connection, row)
    found = rows(
        connection,
        "SELECT number, folded_seq, unfolded_seq, robot || '.' || incarnation || '.' || n FROM commits"
        " WHERE map = ? AND gone = 0 AND cells > 0 AND folded_seq IS NOT NULL AND folded_age_s < ?"
        " AND received_age_s < CASE WHEN received_age_s > folded_age_s AND coalesce(unfolded_seq, 0) = 0"
        " THEN ? ELSE ? END ORDER BY folded_age_s LIMIT ?",
        (row.number, before_s, min(before_s, age_s - AGAIN_KEPT_S), before_s, limit + len(pinned)),
    )
    gone = [(number, *seqs) for number, *seqs, commit in found if commit not in pinned][:limit]
    for number, folded_seq, unfolded_seq in gone:
        newest = max(folded_seq, unfolded_seq or 0)
        cells = "cell IN (SELECT cell FROM diff WHERE commit_number = ?)"
        connection.execute(
            f"UPDATE cell SET gone_seq = max(gone_seq, ?) WHERE map = ? AND {cells}",  # noqa: S608 - our own clause
            (newest, row.number, number),
        )
        connection.execute(
            f"DELETE FROM touched WHERE map = ? AND {cells} AND seq IN (?, ?)",  # noqa: S608 - our own clause
            (row.number, number, folded_seq, unfolded_seq),
        )
        connection.execute("DELETE FROM diff WHERE commit_number = ?", (number,))
        connection.execute("UPDATE commits SET gone = 1, meta = x'' WHERE number = ?", (number,))
    return len(gone)


def remember_evidence(connection: apsw.Connection, number: int, commit: NewCommit, *, age_s: float) -> None:
    """Keep the evidence of a commit that was pushed again; it can be retracted for as long as after the first push."""
    connection.execute(
        "UPDATE commits SET gone = 0, meta = ?, received_s = ?, received_age_s = ? WHERE number = ?",
        (commit.text, time.time(), age_s, number),
    )


def check_kept(connection: apsw.Connection, row: MapRow, targets: tuple[CommitId, ...]) -> None:
    """Refuse to retract what cannot be subtracted any more.

    Raises:
        ConflictError: kind `evidence_gone`.
    """
    query = "SELECT gone FROM commits WHERE map = ? AND robot = ? AND incarnation = ? AND n = ?"
    gone = [
        target
        for target in targets
        if first(connection, query, (row.number, *target.author, target.n))
        and not is_retracted(connection, row, target)
    ]
    if gone:
        raise EvidenceGoneError(gone)


def is_retracted(connection: apsw.Connection, row: MapRow, commit: CommitId) -> bool:
    """True if a retract of this id has taken effect, or waits for the commit to come."""
    query = "SELECT 1 FROM retracted WHERE map = ? AND id = ?"
    return first(connection, query, (row.number, str(commit))) is not None


def _pinned(connection: apsw.Connection, row: MapRow) -> set[str]:
    """Ids that commits name which are not folded yet, or whose retract is under way."""
    query = (
        "SELECT retracts FROM commits WHERE map = ?1 AND folded_seq IS NULL AND retracts <> ''"
        " UNION ALL SELECT retracts FROM commits WHERE map = ?1 AND due_from IS NOT NULL"
    )
    return {name for (text,) in rows(connection, query, (row.number,)) for name in text.split()}
