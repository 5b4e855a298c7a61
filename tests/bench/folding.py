"""Fold lag: the time from an honest commit's receipt until it is in the map, alone and next to costly commits; and the
processor time of folding, of each commit alone and of many together.

Thirty commits of another robot, of a few hundred bytes each, stand for one voxel in each of 2^17 bricks (dust), or for
two cells full of equal air. Each ratio is against the same robot's commits on the same server before they came.
"""

import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.bench.pushing import Bodies, Diff, Robot, Server, served
from tests.fixtures.map.costly import air, dust

from cairn_map.commits.ids import commit_id_from_text
from cairn_map.commits.version_vector import version_vector_from_json
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.group_folding import LocalFolding
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow

Row = tuple[str, str, str]


def fold_lag_rows(diffs: list[Diff], geometry: Geometry, *, smoke: bool) -> Iterator[Row]:
    """Lag alone, and next to each kind of costly commits; `geometry` has cells of depth 8."""
    honest = Bodies(diffs, geometry)
    count, costly = (5, 4) if smoke else (20, 30)
    for name, evidence, cells in (("dust", dust(geometry), 4), ("air", air(geometry), 2)):
        bodies = Bodies([{cell_key((500 + n, 0, 0)): evidence for n in range(cells)}], geometry, scans=9)
        with served(geometry) as server:
            lags_s = [_lag_s(server, "wren", honest, n) for n in range(count + 3)]
            quiet_s = statistics.median(lags_s[3:])  # the first ones load kernels
            mole = Robot(server, "mole")
            for n in range(costly):
                mole.push(f"mole.{'0' * 16}.{n}", bodies.body("mole", n))
            mole.close()
            beside_s = [_lag_s(server, "wren", honest, count + 3 + n) for n in range(count)]
        yield f"fold lag of an honest commit, quiet (before {name})", f"{1e3 * quiet_s:.0f}", "ms, median"
        ratio = statistics.median(beside_s) / quiet_s
        yield (
            f"  next to {costly} commits of {name}",
            f"{ratio:.1f}",
            f"times as long; the first {beside_s[0] / quiet_s:.1f}, the longest {max(beside_s) / quiet_s:.1f}",
        )


def fold_cost_rows(diffs: list[Diff], geometry: Geometry, *, smoke: bool) -> Iterator[Row]:
    """Processor time of the fold, with the store's, once the map has all of these diffs."""
    bodies = Bodies(diffs, geometry)
    size = sum(len(body) for n in range(len(diffs)) for body in bodies.commit("wren", n).diff.values()) // len(diffs)
    for group in (1, 4) if smoke else (1, 24):
        count = -(-len(diffs) // group) * group
        with tempfile.TemporaryDirectory() as folder:
            store = SqliteStore(Path(folder))
            row, _ = store.create_map("bench", geometry, SensorModel())
            folding = LocalFolding(store, DamagedCells())
            _fold_groups(store, row, folding, bodies, range(count), group)  # which loads kernels
            start_s = time.process_time()
            _fold_groups(store, row, folding, bodies, range(count, 2 * count), group)
            took_s = time.process_time() - start_s
            folding.close()
            store.close()
        yield f"{size} B pushed and folded in groups of {group}", f"{1e3 * took_s / count:.1f}", "ms CPU a commit"


def _fold_groups(
    store: SqliteStore, row: MapRow, folding: LocalFolding, bodies: Bodies, numbers: range, group: int
) -> None:
    for first in numbers[::group]:
        for n in range(first, first + group):
            store.append(row, bodies.commit("wren", n))
        while folding.fold(row).commits:
            pass


def _lag_s(server: Server, name: str, bodies: Bodies, n: int) -> float:
    """Time from the answer to a push until the version vector of the map has the commit."""
    robot, commit = Robot(server, name), f"{name}.{'0' * 16}.{n}"
    status = robot.push(commit, bodies.body(name, n))
    start_s = time.perf_counter()
    robot.close()
    if status != 201:
        raise RuntimeError(f"the push of {commit} was answered {status}")
    while True:
        cursor = json.loads(server.ask("GET", "/maps/bench"))["cursor"]
        vector = json.loads(server.ask("GET", f"/maps/bench/main/vector?at={cursor}"))
        if commit_id_from_text(commit) in version_vector_from_json(vector):
            return time.perf_counter() - start_s
        time.sleep(0.005)
