"""Proof of the demo's claims: all maps are the same, and a retract leaves no trace."""

import time
from collections.abc import Callable, Sequence

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import index_of
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import decode_cell
from cairn_map.codec.layer_code import encode_layer_cell
from cairn_map.commits.commit import split_commit
from cairn_map.commits.ids import CommitId
from cairn_map.epochs.cell_history import CellHistory, history_fingerprint
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import DamagedDataError, UnreachableError
from cairn_map.evidence.grid import CellKey, cell_key

LEVEL_WITHIN_S = 120.0
Identity = tuple[str, str]
"""SHA-256 of a cell's canonical bytes, and its fingerprint, in hex."""


def bring_level(robots: Sequence[Robot], api: MapApi, map_name: str) -> None:
    """Sync until the server folded every commit and every robot has all of it; a busy server is asked again.

    Raises:
        UnreachableError: it took longer than `LEVEL_WITHIN_S`.
    """
    deadline_s = time.monotonic() + LEVEL_WITHIN_S
    while True:
        try:
            for robot in robots:
                robot.sync()
            if not (api.cell_index(map_name).header.pending or any(robot.waiting for robot in robots)):
                break
        except UnreachableError:
            if time.monotonic() > deadline_s:
                raise
        if time.monotonic() > deadline_s:
            raise UnreachableError("not_level", f"the server did not fold all commits within {LEVEL_WITHIN_S:.0f} s")
        time.sleep(0.05)
    for robot in robots:
        robot.sync()


def server_identity(api: MapApi, map_name: str) -> dict[CellKey, Identity]:
    """Each of the server's cells that holds evidence."""
    cells = index_of(api, map_name).cells
    return {cell_key(entry.cell): (entry.digest, entry.fingerprint) for entry in cells if entry.voxels}


def map_identity(view: HistoryMap) -> dict[CellKey, Identity]:
    """Each cell of a map in memory that holds evidence."""
    return {key: _identity(key, history, view.layer) for key in view if len(history := view.history(key))}


def require_equal(identities: dict[str, dict[CellKey, Identity]]) -> int:
    """Refuse maps that differ; returns the number of cells.

    Raises:
        DamagedDataError: naming the two maps.
    """
    (first_name, first), *others = identities.items()
    for name, identity in others:
        if identity != first:
            different = sorted(key for key in identity.keys() | first.keys() if identity.get(key) != first.get(key))
            raise DamagedDataError("maps_differ", f"{name} and {first_name} differ in {len(different)} cells")
    return len(first)


def map_without(robots: Sequence[Robot], left_out: CommitId) -> HistoryMap:
    """The sum of all commits that the robots keep but one: a map that never had it."""
    view = HistoryMap(robots[0].replica.layer)
    for robot in robots:
        for commit in robot.replica.commits:
            data = robot.replica.commit_data(commit)
            if commit != left_out and data is not None:
                meta, bodies = split_commit(data)
                view.merge({key: decode_cell(body).evidence for key, body in bodies.items()}, epoch=meta.row)
    return view


def wait_for_fold(api: MapApi, map_name: str, is_folded: Callable[[set[str]], bool]) -> None:
    """Wait until the ids in the server's log satisfy a condition.

    Raises:
        UnreachableError: it took longer than `LEVEL_WITHIN_S`.
    """
    deadline_s = time.monotonic() + LEVEL_WITHIN_S
    while not is_folded({entry.id for entry in api.log(map_name, limit=1000)}):
        if time.monotonic() > deadline_s:
            raise UnreachableError("not_level", f"the server did not fold within {LEVEL_WITHIN_S:.0f} s")
        time.sleep(0.05)


def _identity(key: CellKey, history: CellHistory, layer: MapLayer) -> Identity:
    found = history_fingerprint(history, key, layer_word=layer.word)
    return encode_layer_cell(key, history, layer).digest.hex(), found.hex()
