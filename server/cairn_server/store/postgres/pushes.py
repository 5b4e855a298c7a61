"""Commits that are kept: in one statement if they are what a robot pushes day by day, else in a transaction.

    fast    the author's next number, a key that is known, room in the account: one statement, one round trip
    slow    everything else, under the lock of the map's head: new authors, gaps, repeated commits, retracts, refusals

The fast statement writes rows of its robot only, so that no robot waits for another one; nor does it wait for a fold.
"""

import secrets
from typing import Any

from psycopg import errors

from cairn_map.commits.cursor import first_chain
from cairn_map.commits.ids import Author
from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.errors import ConflictError, UnreachableError
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.map_refusals import check_layer_count, check_same_layer
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.retention import check_kept, count_kept, is_retracted, remember_evidence
from cairn_server.store.postgres.robot_keys import admit_commit
from cairn_server.store.postgres.schema import (
    ATTACHMENTS_OLDEST,
    EPOCHS_OLDEST,
    LAYERS_OLDEST,
    MARKS_OLDEST,
    NOW_S,
    bar_older_programs,
)
from cairn_server.store.postgres.shares import CHARGE, COUNT_MARKS, charge_of, check_charge, lock_head, note_number
from cairn_server.store.shares import check_marks, own_targets
from cairn_server.store.store_rows import MapRow, NewCommit
from cairn_server.store.stored_columns import CORNERS, attached_columns, epoch_to_column

NUMBER_BITS = 52
"""Bits of a map's number: exact in any program that reads numbers as floats."""
KEEP = f"""
    INSERT INTO commits (
        map, robot, incarnation, n, sha, size_bytes, cells, bricks, meta, captured_first_s, captured_last_s, retracts,
        rig, signatures, via, regions, tops, received_s, received_age_s, epoch
    )
    SELECT %(map)s, %(robot)s, %(incarnation)s, %(n)s, %(sha)s, %(size_bytes)s, %(cells)s, %(bricks)s, %(meta)s,
        %(first_s)s::float8, %(last_s)s::float8, %(retracts)s, %(rig)s::bytea, %(signatures)s, %(via)s,
        %(regions)s::bigint[], %(tops)s::bigint[], {NOW_S}, %(age_s)s::float8, %(epoch)s::bigint
    {{source}}
    RETURNING number"""
"""SQL that keeps a commit without its diff."""
FAST = f"""
WITH next AS (
    UPDATE author SET top = %(n)s, kept_bytes = kept_bytes + %(size_bytes)s
    WHERE map = %(map)s AND robot = %(robot)s AND incarnation = %(incarnation)s AND top = %(n)s - 1 AND NOT closed
        AND EXISTS (
            SELECT FROM robot_key AS k
            WHERE k.map = %(names)s AND k.robot = %(robot)s AND k.incarnation = %(incarnation)s
                AND (k.is_proven OR NOT %(signs)s)
        )
    RETURNING 1
), charged AS ({CHARGE.format(source="next,")}
), kept AS ({KEEP.format(source="FROM next")}
), bodies AS (
    INSERT INTO diff (map, commit_number, cell, body)
    SELECT %(map)s, kept.number, d.cell, d.body
    FROM kept, unnest(%(keys)s::bigint[], %(bodies)s::bytea[]) AS d (cell, body)
)
SELECT number FROM kept"""
SLOW_CHARGE = CHARGE.format(source="")
SLOW_KEEP = KEEP.format(source="")
HELD_OF = """
SELECT count(*) FROM unnest(%(incarnations)s::text[], %(numbers)s::bigint[]) AS target (incarnation, n)
    JOIN commits AS c ON c.map = %(map)s AND c.robot = %(robot)s
        AND c.incarnation = target.incarnation AND c.n = target.n
    JOIN mark ON mark.map = c.map AND commit_number = c.number
WHERE record IS NOT NULL"""
"""SQL that counts the marks of a robot's commits that are not taken out."""
INSERT_MARKS = (
    f"INSERT INTO mark (map, commit_number, n, {', '.join(CORNERS)}, record, attached_sha, attached_bytes)"
    " SELECT %(map)s, %(number)s, u.* FROM unnest(%(n)s::bigint[], "
    + ", ".join(f"%({corner})s::bigint[]" for corner in CORNERS)
    + ", %(record)s::text[], %(attached_sha)s::bytea[], %(attached_bytes)s::bigint[]) AS u"
)


def append_commit(connections: Connections, row: MapRow, commit: NewCommit, *, age_s: float) -> bool:
    """Keep a commit at an age of the store; False if the same one is kept already. Durable on return."""
    values = _values(row, commit, age_s)
    # A server's own commits share an account, retracts must not miss what is dropped, and marks and layers are counted:
    # under the lock.
    is_plain = not commit.retracts and not commit.marks and commit.layer is None
    if is_plain and _append_fast(connections, values):
        return True
    return connections.run(lambda connection: append_slowly(connection, row, commit, age_s=age_s))


def append_slowly(connection: Connection, row: MapRow, commit: NewCommit, *, age_s: float) -> bool:
    """Keep a commit of any kind inside a transaction, or refuse it."""
    lock_head(connection, row)
    known = first(
        connection,
        "SELECT number, sha, damaged, gone FROM commits WHERE map = %s AND robot = %s AND incarnation = %s AND n = %s",
        (row.number, *commit.id.author, commit.id.n),
    )
    if known is not None:
        number, sha, damaged, gone = known
        if sha != commit.sha:
            raise ConflictError("id_taken", f"commit {commit.id} is already here with other bytes")
        if damaged is not None:
            _repair(connection, row, number, commit)
        elif gone and not is_retracted(connection, row, commit.id):
            remember_evidence(connection, row, number, commit, age_s=age_s)
            _insert_diff(connection, row, number, commit)
        return damaged is not None
    check_kept(connection, row, commit.retracts)
    admit_commit(connection, row, commit.id.author, commit.grounds)
    note_number(connection, row, commit.id, is_carried=commit.is_carried)
    count_kept(connection, row, commit.id.author, commit.size_bytes)
    values = _values(row, commit, age_s)
    if commit.tops:
        check_charge(connection, row, commit.id, commit.tops)
        connection.execute(SLOW_CHARGE, values)
    number = first(connection, SLOW_KEEP, values)
    _insert_diff(connection, row, number, commit)
    if commit.marks:
        bar_older_programs(connection, MARKS_OLDEST, what="marks", instead="push no marks")
        if any(mark.attachment for mark in commit.marks):
            bar_older_programs(
                connection, ATTACHMENTS_OLDEST, what="attachments of marks", instead="push marks without them"
            )
        _insert_marks(connection, row, number, commit)
    if commit.layer is not None:
        bar_older_programs(connection, LAYERS_OLDEST, what="layers", instead="add no layer")
        _begin_layer(connection, row, commit.layer)
    return True


def insert_map(connection: Connection, name: str, layer: MapLayer, model: SensorModel, seal_key: bytes) -> bool:
    """Write the rows of a new map, or of a new layer of one; False (and nothing written) if the name is taken."""
    log_id = secrets.token_bytes(16)
    # Random, not the next one: servers remember maps that a database put back to an older state has lost, and none
    # made since may have the number of one of these.
    number = 1 + secrets.randbits(NUMBER_BITS)
    texts = layer.geometry.model_dump_json(), model.model_dump_json()
    made = connection.execute(
        "INSERT INTO map (map, name, geometry, sensor_model, seal_key, epoch_s) OVERRIDING SYSTEM VALUE"
        " VALUES (%s, %s, %s, %s, %s, %s) ON CONFLICT (name) DO NOTHING",
        (number, name, *texts, seal_key, layer.epoch_s),
    )
    if not made.rowcount:
        return False
    if layer.has_epochs:
        bar_older_programs(connection, EPOCHS_OLDEST, what="maps with epochs", instead="make a map without epochs")
    connection.execute(
        "INSERT INTO head (map, log_id, seq, chain, fingerprint) VALUES (%s, %s, 0, %s, %s)",
        (number, log_id, first_chain(log_id, layer.digest()), ZERO.to_bytes()),
    )
    return True


def _begin_layer(connection: Connection, row: MapRow, definition: LayerDefinition) -> None:
    """Make a layer that a new commit defines, unless an equal one is there; the map's head is locked.

    Raises:
        ConflictError: kind `other_layer` or `too_many_layers`.
    """
    name = f"{row.name}.{definition.name}"
    found = rows(connection, "SELECT geometry, epoch_s FROM map WHERE name = %s", (name,))
    if found:
        known = MapLayer(geometry=Geometry.model_validate_json(found[0][0]), epoch_s=found[0][1])
        check_same_layer(name, known, definition)
        return
    further = first(connection, "SELECT count(*) FROM map WHERE starts_with(name, %s)", (f"{row.name}.",))
    check_layer_count(row.name, further)
    layer = MapLayer(geometry=definition.geometry, epoch_s=definition.epoch_s)
    # Its servers sign, and know their own retracts again, by the key of the map.
    insert_map(connection, name, layer, row.sensor_model, row.seal_key)


def next_number(connection: Connection, row: MapRow, author: Author) -> int:
    """The number after an author's highest; no other commit takes it while the head is locked."""
    lock_head(connection, row)
    query = "SELECT top + 1 FROM author WHERE map = %s AND robot = %s AND incarnation = %s FOR NO KEY UPDATE"
    return int(first(connection, query, (row.number, *author)) or 0)


def _append_fast(connections: Connections, values: dict[str, Any]) -> bool:
    try:
        with connections.lent() as connection:
            is_new = first(connection, FAST, values) is not None
    except UnreachableError as exc:
        # No room on the account, or a commit that overtook this one: the slow way says which.
        if isinstance(exc.__cause__, errors.CheckViolation | errors.UniqueViolation | errors.DeadlockDetected):
            return False
        connections.note_failure(exc)
        raise
    if is_new:
        connections.note_written()
    return is_new


def _values(row: MapRow, commit: NewCommit, age_s: float) -> dict[str, Any]:
    """Values of `FAST`."""
    robot, incarnation = commit.id.author
    first_s, last_s = commit.captured_s or (None, None)
    return {
        "map": row.number,
        "names": row.names_number,
        "robot": robot,
        "incarnation": incarnation,
        "n": commit.id.n,
        "signs": incarnation in commit.grounds.signers,
        "sha": commit.sha,
        "size_bytes": commit.size_bytes,
        "cells": len(commit.diff),
        "bricks": commit.bricks,
        "meta": bytes(commit.text),
        "first_s": first_s,
        "last_s": last_s,
        "retracts": " ".join(map(str, commit.retracts)),
        "rig": commit.rig,
        "signatures": commit.signatures,
        "via": commit.via,
        "age_s": age_s,
        "epoch": epoch_to_column(commit.epoch),
        **_bodies(commit),
        **charge_of(commit.id, commit.tops, 2 + row.geometry.plane_count),
    }


def _bodies(commit: NewCommit) -> dict[str, Any]:
    return {"keys": [int(key) for key in commit.diff], "bodies": [bytes(body) for body in commit.diff.values()]}


def _repair(connection: Connection, row: MapRow, number: int, commit: NewCommit) -> None:
    """Fresh bytes for a commit that was set aside."""
    connection.execute("DELETE FROM diff WHERE map = %s AND commit_number = %s", (row.number, number))
    query = "UPDATE commits SET damaged = NULL, meta = %s WHERE map = %s AND number = %s"
    connection.execute(query, (commit.text, row.number, number))
    _insert_diff(connection, row, number, commit)


def _insert_diff(connection: Connection, row: MapRow, number: int, commit: NewCommit) -> None:
    connection.execute(
        "INSERT INTO diff (map, commit_number, cell, body) SELECT %(map)s, %(number)s, d.cell, d.body"
        " FROM unnest(%(keys)s::bigint[], %(bodies)s::bytea[]) AS d (cell, body)",
        {"map": row.number, "number": number, **_bodies(commit)},
    )


def _insert_marks(connection: Connection, row: MapRow, number: int, commit: NewCommit) -> None:
    """Keep the marks of a commit that is new and has some.

    Raises:
        BadInputError: kind `too_many_marks`.
    """
    query = "SELECT coalesce(sum(marks), 0)::bigint FROM author WHERE map = %s AND robot = %s"
    held: int = first(connection, query, (row.number, commit.id.author.robot))
    targets = own_targets(commit)
    values: dict[str, object] = {
        "map": row.number,
        "robot": commit.id.author.robot,
        "incarnations": [target.author.incarnation for target in targets],
        "numbers": [target.n for target in targets],
    }
    check_marks(commit, held - (first(connection, HELD_OF, values) if targets else 0))
    shas, sizes = zip(*map(attached_columns, commit.marks), strict=True)
    corners = zip(*((*mark.low_mm, *mark.high_mm) for mark in commit.marks), strict=True)
    values = {
        "map": row.number,
        "number": number,
        "n": list(range(len(commit.marks))),
        "record": [mark.to_json() for mark in commit.marks],
        "attached_sha": list(shas),
        "attached_bytes": list(sizes),
        **{name: list(column) for name, column in zip(CORNERS, corners, strict=True)},
    }
    connection.execute(INSERT_MARKS.encode(), values)
    connection.execute(COUNT_MARKS, {"map": row.number, "number": number, "more": len(commit.marks)})
