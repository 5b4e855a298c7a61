"""Rows of a store from the columns that databases keep of them."""

import json
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName, commit_id_from_text
from cairn_map.commits.mark import Mark, MarkKey
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.evidence.fingerprint import fingerprint_from_bytes
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.messages import LogEntry
from cairn_server.store.store_rows import CellRow, MarkBox, MarkChange

CORNERS = ("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
"""Columns of the corners of a mark's own box."""


class TableRows(NamedTuple):
    """Rows of one table of a map, on their way from one database to another."""

    name: str
    columns: tuple[str, ...]
    rows: Iterable[Sequence[Any]]


def cell_row(columns: tuple[Any, ...]) -> CellRow:
    """A cell from its columns, body and stamps last or left out."""
    key, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k, history_bytes, *rest = columns
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
        history_bytes=history_bytes,
    )


def epoch_to_column(epoch: Epoch) -> int | None:
    """An epoch as it is stored; None: the base, as of all commits of before there were epochs."""
    return None if epoch == BASE else int(epoch)


def epoch_from_column(column: int | None) -> Epoch:
    """The epoch that a column states."""
    return BASE if column is None else Epoch(column)


def ids_from_text(text: str) -> tuple[CommitId, ...]:
    """Ids separated by spaces."""
    return tuple(commit_id_from_text(part) for part in text.split())


def log_entry(
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
    note: str | None,
    via: str | None,
    received_s: float,
) -> LogEntry:
    """A log entry from its columns; the place is JSON."""
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
            "note": note or "",
            "pushed_s": received_s,
        }
    )


def attached_columns(mark: Mark) -> tuple[bytes | None, int | None]:
    """SHA-256 and size of a mark's attachment, as they are stored; None, None: it has none."""
    return (None, None) if mark.attachment is None else (mark.attachment.sha, mark.attachment.size_bytes)


def corner_conditions(mark: str) -> str:
    """SQL that is true of rows whose boxes overlap one, whose corners are its six values (of marks `?` or `%s`)."""
    ends = [f"{low} <= {mark}" for low in CORNERS[:3]] + [f"{high} >= {mark}" for high in CORNERS[3:]]
    return " AND ".join(ends)


def corner_values(box: MarkBox) -> tuple[int, ...]:
    """Values of `corner_conditions`."""
    low, high = box
    return (*high, *low)


def mark_changes(found: Iterable[Sequence[Any]]) -> list[MarkChange]:
    """Changes of marks from their columns and those of their commits, whose `retracts` come last."""
    # Marks of one commit stand together, and what it takes out is parsed once for all of them.
    last: tuple[str, tuple[CommitId, ...]] = ("", ())
    changes: list[MarkChange] = []
    for seq, robot, incarnation, n, number, record, retracts in found:
        if retracts != last[0]:
            last = retracts, ids_from_text(retracts)
        author = Author(RobotName(robot), Incarnation(incarnation))
        changes.append(MarkChange(seq, MarkKey(CommitId(author, n), number), record, last[1]))
    return changes
