"""Retention: what a store keeps no longer, which is the evidence of old commits, and deleted maps.

Only the last version of the map is stored: the evidence of old commits goes, their row in the log stays.

What goes is each commit's diff, its meta, and which cells it touched: some 500 bytes of it are left, whatever it held.
A cell notes the newest entry that went, so that no sum of commits is ever made without it (SYNC.md rule 4).

Deletion of maps in SQLite: one short transaction ends a map, many bounded ones remove its rows.

    delete_map     gone_map has the map, gone_token the secrets of its tokens; its name is free
    clear_part     log and evidence, cells, accounts, then the row of the map

A row of `map` that `gone_map` names is no map any more, and stays for as long as other rows refer to it. So nothing is
read or written of a deleted map, and a kill leaves no row that the next start does not remove.
"""

import time

import apsw

from cairn_map.commits.ids import CommitId
from cairn_map.errors import NotFoundError
from cairn_server.map_refusals import GoneMap, map_gone, no_map
from cairn_server.store.numbering import AGAIN_KEPT_S, EvidenceGoneError
from cairn_server.store.sqlite.ended_tokens import EndedTokens
from cairn_server.store.sqlite.writer import Values, first, rows
from cairn_server.store.store_rows import MapRow, NewCommit


def forget_evidence(connection: apsw.Connection, row: MapRow, before_s: float, limit: int, *, age_s: float) -> int:
    """Drop the evidence of commits folded, and last pushed, before an age of the store (now `age_s`); how many.

    What was pushed again and is not taken out stays for `AGAIN_KEPT_S` at least: a retract may need it.
    """
    pinned = _pinned(connection, row)
    found = rows(
        connection,
        "SELECT number, folded_seq, unfolded_seq, robot || '.' || incarnation || '.' || n, robot, incarnation,"
        " size_bytes FROM commits"
        " WHERE map = ? AND gone = 0 AND cells > 0 AND folded_seq IS NOT NULL AND folded_age_s < ?"
        " AND received_age_s < CASE WHEN received_age_s > folded_age_s AND coalesce(unfolded_seq, 0) = 0"
        " THEN ? ELSE ? END ORDER BY folded_age_s LIMIT ?",
        (row.number, before_s, min(before_s, age_s - AGAIN_KEPT_S), before_s, limit + len(pinned)),
    )
    gone = [row_found for row_found in found if row_found[3] not in pinned][:limit]
    for number, folded_seq, unfolded_seq, _, robot, incarnation, size_bytes in gone:
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
        count_kept(connection, row, (robot, incarnation), -size_bytes)
    return len(gone)


def count_kept(connection: apsw.Connection, row: MapRow, author: tuple[str, str], more_bytes: int) -> None:
    """Count the bytes of an author's commits whose evidence is kept."""
    query = "UPDATE author SET kept_bytes = kept_bytes + ? WHERE map = ? AND robot = ? AND incarnation = ?"
    connection.execute(query, (more_bytes, row.number, *author))


def remember_evidence(
    connection: apsw.Connection, row: MapRow, number: int, commit: NewCommit, *, age_s: float
) -> None:
    """Keep the evidence of a commit that was pushed again; it can be retracted for as long as after the first push."""
    count_kept(connection, row, commit.id.author, commit.size_bytes)
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


GONE = "SELECT number, name, deleted_s, by FROM gone_map"
DYING = "SELECT number FROM map JOIN gone_map USING (number) ORDER BY number LIMIT 1"
ROWS_MAX = 2000
"""Most rows that are looked at by one query."""
ROW_BYTES = 1000
"""Bytes that a row counts for, besides those of its blobs: with its indexes, and the pages that it dirties."""
SMALL = {
    "touched": "cell, seq",
    "log": "seq",
    "tile": "tile",
    "mark": "commit_number, n",
    "attachment": "sha, uploader",
    "held": "account, region",
    "author": "robot, incarnation",
    "retracted": "id",
    "vector_mark": "seq",
    "robot_key": "robot, incarnation",
    "branch": "name",
    "assignment": "robot",
}
"""Tables without blobs, with the rest of their keys, which begin with the map."""


def check_lives(connection: apsw.Connection, number: int) -> None:
    """Refuse to go on with a map that was deleted.

    Raises:
        NotFoundError: kind `gone`.
    """
    gone = _gone(connection, "WHERE number = ?", (number,))
    if gone is not None:
        raise map_gone(gone)


def missing_map(connection: apsw.Connection, name: str) -> NotFoundError:
    """Error for a name that no map has: `gone`, if one had it."""
    gone = _gone(connection, "WHERE name = ? ORDER BY deleted_s DESC LIMIT 1", (name,))
    return no_map(name) if gone is None else map_gone(gone)


def gone_of_token(connection: apsw.Connection, secret_hash: bytes) -> GoneMap | None:
    """The deleted map with which the token of a secret ended."""
    return _gone(connection, "WHERE number = (SELECT map FROM gone_token WHERE hash = ?)", (secret_hash,))


def next_map_number(connection: apsw.Connection) -> int:
    """Number that no map has or had: caches go by it."""
    query = (
        "SELECT max(coalesce((SELECT max(number) FROM map), 0), coalesce((SELECT max(number) FROM gone_map), 0)) + 1"
    )
    return int(first(connection, query))


def delete_map(connection: apsw.Connection, row: MapRow, ended: EndedTokens, *, by: str) -> GoneMap:
    """End a map, its layers and their tokens inside a transaction; their rows stay (`clear_part`)."""
    check_lives(connection, row.number)
    for number, name in rows(connection, "SELECT number, name FROM map WHERE name GLOB ?", (f"{row.name}.*",)):
        _end(connection, GoneMap(number=number, name=name, deleted_s=time.time(), by=by), ended)
    return _end(connection, GoneMap(number=row.number, name=row.name, deleted_s=time.time(), by=by), ended)


def _end(connection: apsw.Connection, gone: GoneMap, ended: EndedTokens) -> GoneMap:
    values = (gone.number, gone.name, gone.deleted_s, gone.by)
    connection.execute("INSERT INTO gone_map (number, name, deleted_s, by) VALUES (?, ?, ?, ?)", values)
    connection.execute("INSERT INTO gone_token (hash, map) SELECT hash, map FROM token WHERE map = ?", (gone.number,))
    ended.note_map(connection, gone.number)
    connection.execute("DELETE FROM token WHERE map = ?", (gone.number,))
    # No name of a map has a slash.
    connection.execute("UPDATE map SET name = '/' || number WHERE number = ?", (gone.number,))
    return gone


def clear_part(connection: apsw.Connection, *, size_bytes_max: int) -> bool:
    """Remove about so many bytes of a deleted map's rows inside a transaction; False once there is nothing left."""
    number = first(connection, DYING)
    if number is None:
        return False
    left_bytes = size_bytes_max
    for clear in (_clear_commits, _clear_cells, _clear_attachments):
        left_bytes -= clear(connection, number, left_bytes)
        if left_bytes <= 0:
            return True
    for table, key in SMALL.items():
        left_bytes -= _clear_small(connection, table, key, number, left_bytes)
        if left_bytes <= 0:
            return True
    connection.execute("DELETE FROM map WHERE number = ?", (number,))
    return first(connection, DYING) is not None


def _gone(connection: apsw.Connection, clause: str, values: Values) -> GoneMap | None:
    found = rows(connection, f"{GONE} {clause}", values)
    return None if not found else GoneMap(**dict(zip(("number", "name", "deleted_s", "by"), found[0], strict=True)))


def _clear_commits(connection: apsw.Connection, number: int, left_bytes: int) -> int:
    """Remove commits in the order of their ids, each with its evidence; bytes that went."""
    went = 0
    query = "SELECT number FROM commits WHERE map = ? LIMIT ?"
    while went < left_bytes and (found := rows(connection, query, (number, ROWS_MAX))):
        for (commit,) in found:
            # The length of a blob stands in its row: the blob is not read.
            pieces = rows(connection, "SELECT number, length(body) FROM diff WHERE commit_number = ?", (commit,))
            for piece, size_bytes in pieces:
                connection.execute("DELETE FROM diff WHERE number = ?", (piece,))
                went += ROW_BYTES + (size_bytes or 0)
                if went >= left_bytes:
                    return went
            connection.execute("DELETE FROM commits WHERE number = ?", (commit,))
            went += ROW_BYTES
            if went >= left_bytes:
                return went
    return went


def _clear_cells(connection: apsw.Connection, number: int, left_bytes: int) -> int:
    went: int = 0
    query = "SELECT number, size_bytes FROM cell INDEXED BY cell_listed WHERE map = ? LIMIT ?"
    while went < left_bytes and (found := rows(connection, query, (number, ROWS_MAX))):
        for cell, size_bytes in found:
            connection.execute("DELETE FROM cell WHERE number = ?", (cell,))
            went += ROW_BYTES + int(size_bytes)
            if went >= left_bytes:
                return went
    return went


def _clear_attachments(connection: apsw.Connection, number: int, left_bytes: int) -> int:
    """Remove parts of attachments; bytes that went."""
    went = 0
    query = "SELECT rowid, length(body) FROM attachment_part WHERE map = ? LIMIT ?"
    for part, size_bytes in rows(connection, query, (number, ROWS_MAX)):
        if went >= left_bytes:
            break
        connection.execute("DELETE FROM attachment_part WHERE rowid = ?", (part,))
        went += ROW_BYTES + int(size_bytes)
    return went


def _clear_small(connection: apsw.Connection, table: str, key: str, number: int, left_bytes: int) -> int:
    query = f"DELETE FROM {table} WHERE map = ?1 AND ({key}) IN (SELECT {key} FROM {table} WHERE map = ?1 LIMIT ?2)"  # noqa: S608 - our own names
    went = 0
    while went < left_bytes:
        count = min(ROWS_MAX, max(1, (left_bytes - went) // ROW_BYTES))
        connection.execute(query, (number, count))
        if not connection.changes():
            break
        went += ROW_BYTES * connection.changes()
    return went
