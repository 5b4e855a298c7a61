"""One round with the server: push what it may lack, fetch what is missing. Repeating a round changes nothing.

high-end   push commits; frames that bring every held cell to the server's head
low-end    push commits; the index of cells; whole cells that changed, all or those near a place
viewer     fetch as high-end does, push nothing
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_client.api import MapApi
from cairn_client.applying import Exchange
from cairn_client.replica import Replica, base_cell
from cairn_client.replica_store import BaseCell
from cairn_map.cell_code import decode_cell
from cairn_map.commit import Commit, split_commit
from cairn_map.errors import ConflictError, DamagedDataError, UnreachableError
from cairn_map.fingerprint import fingerprint
from cairn_map.grid import Cell, CellKey, cell_key
from cairn_map.ids import CommitId

log = logging.getLogger(__name__)

ROUNDS_MAX = 64
"""Requests in one fetch: a reply may ask to come back for the rest, or to compare; it may not go on for ever."""


@dataclass(slots=True)
class RoundReport:
    """What one round did."""

    pushed: int = 0
    frames: int = 0
    cells_fetched: int = 0


Wanted = Callable[[Cell], bool]


def push_commits(
    replica: Replica, api: MapApi, map_name: str, *, on_push: Callable[[CommitId], None] | None = None
) -> int:
    """Push every commit that the server may lack, oldest first; returns how many.

    Raises:
        UnreachableError: the link broke; what was acknowledged before stays so.
    """
    pushed = 0
    for commit_id in replica.push_set():
        renamed_once = False
        while True:
            data = replica.commit_data(commit_id)
            if data is None:
                break
            try:
                api.push(map_name, _as_commit(replica, commit_id, data))
            except ConflictError as exc:
                if exc.kind != "id_taken" or renamed_once:
                    raise
                commit_id = replica.rename(commit_id)
                renamed_once = True
                continue
            replica.acknowledge(commit_id)
            pushed += 1
            if on_push:
                on_push(commit_id)
            break
    return pushed


def fetch_missing(replica: Replica, api: MapApi, map_name: str, branch: str) -> RoundReport:
    """Bring every held cell to the server's head; what arrives before a cut is kept.

    Raises:
        UnreachableError: the link broke, or the server keeps asking to come back.
        DamagedDataError: the server's answer is not sound.
    """
    report = RoundReport()
    compare = False
    for _ in range(ROUNDS_MAX):
        exchange = Exchange(replica, compare=compare)
        try:
            for frame in api.missing(map_name, branch, exchange.request()):
                exchange.take(frame)
                report.frames += 1
        except ConflictError as exc:
            if exc.kind != "other_log":
                raise
            log.warning("another server answers for map %s; starting without its old state", map_name)
            replica.forget_server()
            continue
        compare = exchange.must_compare
        if exchange.is_done and not _has_unproven(replica):
            return report
    raise UnreachableError("no_end", f"no end of the answer after {ROUNDS_MAX} requests", retry_after_s=30.0)


def fetch_cells(replica: Replica, api: MapApi, map_name: str, *, wanted: Wanted | None = None) -> RoundReport:
    """Low-end: whole cells that changed since they were fetched last, all or the wanted ones.

    Raises:
        UnreachableError: the link broke; the cells before it are kept.
    """
    report = RoundReport()
    index = api.cell_index(map_name, replica.author)
    replica.take_header(index.header)
    for entry in index.cells:
        cell = Cell(*entry.cell)
        if wanted is None or wanted(cell):
            report.cells_fetched += fetch_cell(replica, api, map_name, cell)
    replica.forget_stable_commits()
    return report


def fetch_cell(replica: Replica, api: MapApi, map_name: str, cell: Cell) -> bool:
    """Low-end: one cell, if it changed; True if bytes came.

    Raises:
        DamagedDataError: the cell does not have the fingerprint that the server states.
    """
    key = cell_key(cell)
    held = replica.cells.get(key)
    fetched = api.cell(map_name, cell, etag=held.etag if held else None)
    with replica.lock:
        if fetched.body is None:
            replica.move([key], to=fetched.cursor, coverage=fetched.coverage)
            replica.refresh_view(key)
            return False
        decoded = decode_cell(fetched.body)
        if decoded.key != key or fingerprint(decoded.evidence, key) != fetched.fingerprint:
            raise DamagedDataError("fingerprint_mismatch", f"cell {cell} is not what the server says it is")
        based = base_cell(key, decoded.evidence, cursor=fetched.cursor, coverage=fetched.coverage)
        tagged = BaseCell(based.cursor, based.coverage, based.fingerprint, fetched.etag)
        replica.hold(key, tagged, decoded.evidence, body=fetched.body)
        return True


def within(position_m: npt.ArrayLike, *, radius_m: float, cell_edge_m: float) -> Wanted:
    """Cells of which some point lies within a radius of a position."""
    centre = np.asarray(position_m, dtype=np.float64)

    def is_near(cell: Cell) -> bool:
        low = np.array(cell) * cell_edge_m
        nearest = np.clip(centre, low, low + cell_edge_m)
        return bool(np.linalg.norm(nearest - centre) <= radius_m)

    return is_near


def _as_commit(replica: Replica, commit_id: CommitId, data: bytes) -> Commit:
    meta, cells = split_commit(data)
    return Commit(meta, cells, replica.commits[commit_id].sha, data)


def _has_unproven(replica: Replica) -> bool:
    """Whether a cell still waits to be fetched whole."""
    with replica.lock:
        unproven: list[CellKey] = [key for key, cell in replica.cells.items() if cell.cursor is None]
    return bool(unproven)
