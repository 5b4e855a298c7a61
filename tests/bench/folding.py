"""Fold lag: the time from an honest commit's receipt until it is in the map, alone and next to costly commits.

Thirty commits of another robot, of a few hundred bytes each, stand for one voxel in each of 2^17 bricks (dust), or for
two cells full of equal air. Each ratio is against the same robot's commits on the same server before they came.
"""

import json
import statistics
import time
from collections.abc import Iterator

from tests.bench.pushing import Bodies, Diff, Robot, Server, served
from tests.fixtures.map.costly import air, dust

from cairn_map.commits.ids import commit_id_from_text
from cairn_map.commits.version_vector import version_vector_from_json
from cairn_map.evidence.grid import Geometry, cell_key

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
