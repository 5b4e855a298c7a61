"""Whole robots among the crowd, `cairn_client` and all, in a process of their own: what the server sends is a map.

They push and sync as often as the others. When nothing is pushed any more they compare what they hold with the
server's cells, byte for byte.
"""

import os
import tempfile
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from tests.bench.pushing import Diff, facts_of

from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import CairnError
from cairn_map.evidence.grid import Cell, Geometry, cell_key

NICENESS = 5
"""What they need to decode and keep a map is not the server's cost, and must not delay it."""


@dataclass(slots=True)
class WholeReport:
    """What they found."""

    rounds: int = 0
    frames: int = 0
    pushed_s: list[float] = field(default_factory=list)
    """When their commits were at the server, `perf_counter`."""
    cells: int = 0
    """Compared at the end."""
    different: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)


def live_whole(
    pipe: Connection,
    url: str,
    token: str,
    names: list[str],
    diffs: list[Diff],
    geometry: Geometry,
    times_s: list[float],
) -> None:
    """Sync until told that all is pushed, then compare; the report goes into the pipe.

    Args:
        pipe: to whoever started this process.
        url: of the map.
        token: that may register robots.
        names: of the robots.
        diffs: what they push, in turn.
        geometry: of the map.
        times_s: between two rounds, and between two pushes of one robot.
    """
    os.nice(NICENESS)
    report = WholeReport()
    sync_s, push_s = times_s
    with tempfile.TemporaryDirectory() as folder:
        robots = [Robot(None, url, directory=Path(folder) / n, name=n, token=token, geometry=geometry) for n in names]
        made = 0
        pushes_s = [time.perf_counter() + push_s * (n + 0.5) / len(robots) for n in range(len(robots))]
        while not pipe.poll(sync_s):
            for n, robot in enumerate(robots):
                if time.perf_counter() >= pushes_s[n]:
                    diff = diffs[(made * 11 + n) % len(diffs)]
                    robot.replica.commit(diff, facts_of(0))
                    pushes_s[n] += push_s
                    made += 1
                _round(robot, report)
        pipe.recv()
        for robot in robots:
            _round(robot, report)
        pipe.send("nothing more is pushed from here")
        pipe.recv()
        for robot in robots:
            _round(robot, report)
            _compare(robot, url, token, report)
            robot.close()
    pipe.send(report)


def _round(robot: Robot, report: WholeReport) -> None:
    try:
        found = robot.sync()
        report.frames += found.frames
        report.pushed_s += [time.perf_counter()] * found.pushed
        report.rounds += 1
    except CairnError as exc:
        report.errors.append(f"{robot.name}: {exc.kind}: {exc.message}")


def _compare(robot: Robot, url: str, token: str, report: WholeReport) -> None:
    server_url, _, name = url.partition("/maps/")
    with MapApi(server_url, token=token) as api:
        index = api.cell_index(name)
        found = {cell_key(entry.cell): api.cell(name, Cell(*entry.cell)).body for entry in index.cells if entry.voxels}
    held = {key: evidence for key, evidence in robot.map.packed().items() if len(evidence)}
    for key in found.keys() | held.keys():
        report.cells += 1
        if key not in held or encode_cell(key, held[key], robot.replica.geometry).data != found.get(key):
            report.different.append(f"{robot.name}: cell {key}")
