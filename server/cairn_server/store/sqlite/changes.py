"""Writes of commits and folds, each function inside one transaction of the writer."""

import json
import secrets
import time

import apsw

from cairn_map.commits.cursor import ENTRY_FOLD, first_chain
from cairn_map.commits.ids import CommitId, new_incarnation
from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.errors import ConflictError
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.map_refusals import check_layer_count, check_same_layer
from cairn_server.store.history import KnownVectors, crosses_mark
from cairn_server.store.shares import check_marks, own_targets
from cairn_server.store.sqlite.retention import (
    check_kept,
    check_lives,
    count_kept,
    is_retracted,
    next_map_number,
    remember_evidence,
)
from cairn_server.store.sqlite.robot_keys import admit_commit
from cairn_server.store.sqlite.schema import MAPS
from cairn_server.store.sqlite.shares import give_back_sums, note_number, take_sums
from cairn_server.store.sqlite.snapshot import SqliteSnapshot
from cairn_server.store.sqlite.tile_rows import TileWriter, mark_at, recount_tile
from cairn_server.store.sqlite.writer import first
from cairn_server.store.store_rows import CellRow, Fold, MapRow, NewCommit
from cairn_server.store.stored_columns import CORNERS, attached_columns, epoch_to_column
from cairn_server.store.tiles import tile_of

INSERT_MAP = (
    "INSERT INTO map (number, name, geometry, sensor_model, operator, log_id, seq, chain, tops, epoch_s, seal_key)"
    " VALUES (?, ?, ?, ?, ?, ?, 0, ?, ?, ?, ?)"
)
MARK_COLUMNS = ("map", "commit_number", "n", *CORNERS, "record", "attached_sha", "attached_bytes")
INSERT_MARK = f"INSERT INTO mark ({', '.join(MARK_COLUMNS)}) VALUES ({', '.join('?' * len(MARK_COLUMNS))})"  # noqa: S608 - our own columns


def append_commit(connection: apsw.Connection, row: MapRow, commit: NewCommit, *, age_s: float) -> bool:
    """Keep a commit at an age of the store; False if the same one is kept already."""
    check_lives(connection, row.number)
    key = (row.number, *commit.id.author, commit.id.n)
    query = "SELECT number, sha, damaged, gone FROM commits WHERE map = ? AND robot = ? AND incarnation = ? AND n = ?"
    known = first(connection, query, key)
    if known is not None:
        number, sha, damaged, gone = known
        if sha != commit.sha:
            raise ConflictError("id_taken", f"commit {commit.id} is already here with other bytes")
        if damaged is not None:
            _repair(connection, number, commit)
        elif gone and not is_retracted(connection, row, commit.id):
            remember_evidence(connection, row, number, commit, age_s=age_s)
            _insert_diff(connection, number, commit)
        return damaged is not None
    check_kept(connection, row, commit.retracts)
    admit_commit(connection, row, commit.id.author, commit.grounds)
    note_number(connection, row, commit.id, is_carried=commit.is_carried)
    charged = take_sums(connection, row, commit)
    count_kept(connection, row, commit.id.author, commit.size_bytes)
    connection.execute(
        "INSERT INTO commits (map, robot, incarnation, n, sha, size_bytes, cells, meta, captured_first_s,"
        " captured_last_s, retracts, received_s, received_age_s, rig, signatures, via, charged, bricks, epoch)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            *key,
            commit.sha,
            commit.size_bytes,
            len(commit.diff),
            commit.text,
            *(commit.captured_s or (None, None)),
            " ".join(map(str, commit.retracts)),
            time.time(),
            age_s,
            commit.rig,
            commit.signatures,
            commit.via,
            charged,
            commit.bricks,
            epoch_to_column(commit.epoch),
        ),
    )
    number = connection.last_insert_rowid()
    _insert_diff(connection, number, commit)
    _insert_marks(connection, row, number, commit)
    if commit.layer is not None:
        _begin_layer(connection, row, commit.layer)
    return True


def insert_map(connection: apsw.Connection, name: str, layer: MapLayer, model: SensorModel, seal_key: bytes) -> None:
    """Write the row of a new map, or of a new layer of one."""
    number, log_id = next_map_number(connection), secrets.token_bytes(16)
    texts = layer.geometry.model_dump_json(), model.model_dump_json()
    chain, tops = first_chain(log_id, layer.digest()), json.dumps([0] * (2 + layer.geometry.plane_count))
    values = (number, name, *texts, new_incarnation(), log_id, chain, tops, layer.epoch_s, seal_key)
    connection.execute(INSERT_MAP, values)


def _begin_layer(connection: apsw.Connection, row: MapRow, definition: LayerDefinition) -> None:
    """Make a layer that a new commit defines, unless an equal one is there.

    Raises:
        ConflictError: kind `other_layer` or `too_many_layers`.
    """
    name = f"{row.name}.{definition.name}"
    found = first(connection, "SELECT geometry, epoch_s FROM map WHERE name = ?", (name,))
    if found:
        known = MapLayer(geometry=Geometry.model_validate_json(found[0]), epoch_s=found[1])
        check_same_layer(name, known, definition)
        return
    check_layer_count(row.name, first(connection, "SELECT count(*) FROM map WHERE name GLOB ?", (f"{row.name}.*",)))
    layer = MapLayer(geometry=definition.geometry, epoch_s=definition.epoch_s)
    # Its servers sign, and know their own retracts again, by the key of the map.
    insert_map(connection, name, layer, row.sensor_model, row.seal_key)


def next_number(connection: apsw.Connection, row: MapRow, author: tuple[str, str]) -> int:
    """The number after an author's highest."""
    query = "SELECT top + 1 FROM author WHERE map = ? AND robot = ? AND incarnation = ?"
    return int(first(connection, query, (row.number, *author)) or 0)


def write_fold(connection: apsw.Connection, row: MapRow, fold: Fold, *, age_s: float) -> bool:
    """Cells, entries and head at an age of the store, if head and retracts are still where the fold begins."""
    head = first(connection, f"SELECT seq, chain FROM {MAPS} WHERE number = ?", (row.number,))  # noqa: S608
    if head != (fold.base.seq, fold.base.chain):
        return False
    # A part in which no commit was there to be taken out leaves the head where it is.
    query = "SELECT due_from FROM commits WHERE number = ?"
    if any(first(connection, query, (step.commit,)) != step.before for step in fold.steps):
        return False
    connection.execute(
        "UPDATE map SET seq = ?, chain = ? WHERE number = ?", (fold.head.seq, fold.head.chain, row.number)
    )
    for seq, entry in enumerate(fold.entries, start=fold.base.seq + 1):
        connection.execute(
            "INSERT INTO log (map, seq, kind, commit_number, chain) VALUES (?, ?, ?, ?, ?)",
            (row.number, seq, entry.kind, entry.commit, entry.chain),
        )
        connection.execute(
            "INSERT INTO touched (map, cell, seq) SELECT ?, cell, ? FROM diff WHERE commit_number = ?",
            (row.number, seq, entry.commit),
        )
        connection.execute(
            "UPDATE commits SET folded_seq = ?, folded_age_s = ? WHERE number = ? AND folded_seq IS NULL"
            if entry.kind == ENTRY_FOLD
            else "UPDATE commits SET unfolded_seq = ? WHERE number = ?",
            (seq, age_s, entry.commit) if entry.kind == ENTRY_FOLD else (seq, entry.commit),
        )
        if entry.kind == ENTRY_FOLD:
            _bring_marks(connection, row, entry.commit, seq)
        else:
            give_back_sums(connection, row, entry.commit)
            _take_marks_out(connection, row, entry.commit, seq)
    connection.executemany(
        "INSERT INTO retracted (map, id) VALUES (?, ?)", [(row.number, str(target)) for target in fold.retracted]
    )
    connection.executemany(
        "UPDATE commits SET damaged = ? WHERE number = ?", [(why, number) for number, why in fold.damaged]
    )
    connection.executemany(
        "UPDATE commits SET due_from = ? WHERE number = ?", [(step.after, step.commit) for step in fold.steps]
    )
    _write_cells(connection, row, fold)
    if crosses_mark(fold.base, fold.head):
        snapshot = SqliteSnapshot(connection, row.number, row.layer.digest(), KnownVectors())
        mark_at(connection, row.number, fold.head.seq, snapshot.vector_at(fold.head.seq))
    return True


def _write_cells(connection: apsw.Connection, row: MapRow, fold: Fold) -> None:
    query = (
        "INSERT INTO cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, hottest_k, history_bytes, body,"
        " stamps) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (map, cell) DO UPDATE SET lm = excluded.lm, digest = excluded.digest,"
        " fingerprint = excluded.fingerprint, voxels = excluded.voxels, size_bytes = excluded.size_bytes,"
        " hottest_k = excluded.hottest_k, history_bytes = excluded.history_bytes, body = excluded.body,"
        " stamps = excluded.stamps"
    )
    tiles = TileWriter(connection, row.number)
    for c in fold.cells:
        tiles.note(c)
        facts = (c.key, c.lm, c.digest, c.fingerprint.to_bytes(), c.voxels, c.size_bytes, c.hottest_k, c.history_bytes)
        connection.execute(query, (row.number, *facts, c.body, c.stamps))
    tiles.write(folded=sum(entry.kind == ENTRY_FOLD for entry in fold.entries))


def heal_cell(connection: apsw.Connection, row: MapRow, cell: CellRow) -> bool:
    """Put sound bytes in the place of a damaged cell; False if it changed meanwhile."""
    check_lives(connection, row.number)
    query = "SELECT 1 FROM cell INDEXED BY cell_listed WHERE map = ? AND cell = ? AND lm = ?"
    if not first(connection, query, (row.number, cell.key, cell.lm)):
        return False
    connection.execute(
        "UPDATE cell SET digest = ?, fingerprint = ?, voxels = ?, size_bytes = ?, body = ?, hottest_k = ?,"
        " history_bytes = ? WHERE map = ? AND cell = ?",
        (
            *(cell.digest, cell.fingerprint.to_bytes(), cell.voxels, cell.size_bytes, cell.body, cell.hottest_k),
            *(cell.history_bytes, row.number, cell.key),
        ),
    )
    recount_tile(connection, row.number, tile_of(cell.key))
    return True


def _repair(connection: apsw.Connection, number: int, commit: NewCommit) -> None:
    """Fresh bytes for a commit that was set aside."""
    connection.execute("DELETE FROM diff WHERE commit_number = ?", (number,))
    connection.execute("UPDATE commits SET damaged = NULL, meta = ? WHERE number = ?", (commit.text, number))
    _insert_diff(connection, number, commit)


def _insert_diff(connection: apsw.Connection, number: int, commit: NewCommit) -> None:
    connection.executemany(
        "INSERT INTO diff (commit_number, cell, body) VALUES (?, ?, ?)",
        [(number, cell, body) for cell, body in commit.diff.items()],
    )


def _insert_marks(connection: apsw.Connection, row: MapRow, number: int, commit: NewCommit) -> None:
    """Keep the marks of a commit that is new, if it has any.

    Raises:
        BadInputError: kind `too_many_marks`.
    """
    if not commit.marks:
        return
    author = commit.id.author
    query = "SELECT coalesce(sum(marks), 0) FROM author WHERE map = ? AND robot = ?"
    held: int = first(connection, query, (row.number, author.robot))
    check_marks(commit, held - sum(_held_of(connection, row, target) for target in own_targets(commit)))
    connection.executemany(
        INSERT_MARK,
        [
            (row.number, number, n, *mark.low_mm, *mark.high_mm, mark.to_json(), *attached_columns(mark))
            for n, mark in enumerate(commit.marks)
        ],
    )
    _count_marks(connection, row, number, len(commit.marks))


def _held_of(connection: apsw.Connection, row: MapRow, commit: CommitId) -> int:
    """Count of the marks of a commit that are not taken out."""
    query = (
        "SELECT count(*) FROM mark WHERE map = ?1 AND record IS NOT NULL AND commit_number ="
        " (SELECT number FROM commits WHERE map = ?1 AND robot = ?2 AND incarnation = ?3 AND n = ?4)"
    )
    return int(first(connection, query, (row.number, *commit.author, commit.n)) or 0)


def _bring_marks(connection: apsw.Connection, row: MapRow, number: int, seq: int) -> None:
    """Note the log entry that brought the marks of a commit."""
    query = "UPDATE mark SET changed_seq = ? WHERE map = ? AND commit_number = ? AND changed_seq IS NULL"
    connection.execute(query, (seq, row.number, number))


def _take_marks_out(connection: apsw.Connection, row: MapRow, number: int, seq: int) -> None:
    """Note the log entry that took the marks of a commit out, whose records go."""
    query = (
        "UPDATE mark SET changed_seq = ?, record = NULL, attached_sha = NULL"
        " WHERE map = ? AND commit_number = ? AND record IS NOT NULL"
    )
    connection.execute(query, (seq, row.number, number))
    if connection.changes():
        _count_marks(connection, row, number, -connection.changes())


def _count_marks(connection: apsw.Connection, row: MapRow, number: int, more: int) -> None:
    """Count the marks of a commit's author that are not taken out."""
    author = "(SELECT robot, incarnation FROM commits WHERE number = ?)"
    query = f"UPDATE author SET marks = marks + ? WHERE map = ? AND (robot, incarnation) = {author}"  # noqa: S608 - our own clause
    connection.execute(query, (more, row.number, number))
