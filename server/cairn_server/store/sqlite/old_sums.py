"""Sums of commits that came before each robot had an account of its own.

Their largest numbers were added up over the whole map and never given back, so that a map may seem full which is not.
Evidence is never negative: the largest number of a plane in any cell of the map bounds what they hold today.
"""

import json
import logging
from operator import gt

import apsw
import numpy as np
import numpy.typing as npt

from cairn_map.codec.cell_code import decode_cell
from cairn_map.errors import CairnError
from cairn_map.evidence.evidence import largest
from cairn_server.store.shares import RESERVE, Tops, limits_of
from cairn_server.store.sqlite.schema import MAPS
from cairn_server.store.sqlite.writer import first

log = logging.getLogger(__name__)


def old_sums(connection: apsw.Connection, map_number: int) -> Tops:
    """Bound of what these commits hold in any voxel of a map, by plane."""
    return tuple(json.loads(first(connection, "SELECT tops FROM map WHERE number = ?", (map_number,))))


def measure_old_sums(connection: apsw.Connection) -> None:
    """Measure them again, from what the cells hold, in each map where they leave no room for robots' shares.

    That reads every cell of such a map, some milliseconds each. A map with a damaged cell stays as it is.
    """
    for number, name in list(connection.execute(f"SELECT number, name FROM {MAPS}")):  # noqa: S608 - our own clause
        old = old_sums(connection, number)
        if not any(map(gt, old, limits_of(RESERVE, len(old)))):
            continue
        log.warning("map %s seems full of evidence: measuring what its cells hold", name)
        try:
            held = _held(connection, number, len(old))
        except CairnError as exc:
            log.error("map %s takes no evidence: %s", name, exc.message)
            continue
        connection.execute("UPDATE map SET tops = ? WHERE number = ?", (json.dumps(held.tolist()), number))


def _held(connection: apsw.Connection, map_number: int, planes: int) -> npt.NDArray[np.int64]:
    """(planes,) largest numbers of any cell, and of the commits without account that wait to be folded."""
    most = np.zeros(planes, np.int64)
    for (body,) in connection.execute("SELECT body FROM cell WHERE map = ?", (map_number,)):
        np.maximum(most, _tops(body), out=most)
    waiting = (
        "SELECT body FROM diff JOIN commits ON commits.number = commit_number"
        " WHERE map = ? AND charged IS NULL AND folded_seq IS NULL AND body IS NOT NULL"
    )
    for (body,) in connection.execute(waiting, (map_number,)):
        most += _tops(body)
    return most


def _tops(body: bytes) -> npt.NDArray[np.int64]:
    evidence = decode_cell(body).evidence
    return largest(evidence.counts, evidence.samples)
