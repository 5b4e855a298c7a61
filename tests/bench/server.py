"""A real server under the pushes of eight robots, on loopback: what it acknowledges, how late it answers, how it folds.

Every push is a real diff of one scan of the simulated building, each under an id of its own.
"""

import json
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from tests.bench.fetching import fetching_rows
from tests.bench.folding import fold_cost_rows, fold_lag_rows
from tests.bench.pushing import BOMB_BYTES, Bodies, Diff, Robot, bomb, meta_of, served

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.commits.commit import make_commit
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.frames import CellFrame, frames_of
from cairn_map.wire.messages import ReplyHeader
from cairn_server.store.sqlite.store import SqliteStore
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
ROBOTS_PUSHING = 8


@dataclass(slots=True)
class Pushes:
    """What robots saw of a server."""

    seconds: list[float] = field(default_factory=list)
    refused: int = 0
    size_bytes: int = 0


def server_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    layouts = (("tof", 0.08, 1.0), ("tof", 0.04, 1.0), ("orpheus", 0.04, 0.25))
    for robot, edge_m, scale in layouts[:1] if smoke else layouts:
        geometry = geometry_for(voxel_edge_m=edge_m)
        diffs = scan_diffs(robot, geometry, scale=scale, scans=4 if smoke else 36)
        name = f"{robot}, {edge_m * 100:g} cm"
        yield from _push_rows(name, diffs, geometry, seconds=1.0 if smoke else 30.0)
        if robot == "tof":
            yield from _store_rows(name, diffs, geometry, commits=200 if smoke else 10_000)
        yield from fold_cost_rows(diffs, geometry, smoke=smoke)
    yield from _visible_rows(diffs, geometry, pushes=10 if smoke else 200)
    yield from _bomb_rows(diffs[0], geometry)
    fine = geometry_for(voxel_edge_m=0.02)
    yield from fold_lag_rows(scan_diffs("tof", fine, scale=1.0, scans=2 if smoke else 36), fine, smoke=smoke)
    yield from fetching_rows(diffs, geometry, smoke)


def scan_diffs(robot: str, geometry: Geometry, *, scale: float, scans: int) -> list[Diff]:
    """What single scans of two stops say."""
    plan = Plan(
        scene=load_scene("building"),
        robot=replace(ROBOTS[robot], scans=(6, 3)),
        path="labs",
        scale=scale,
        truth="none",
        first_stop=8,
        last_stop=10,
    )
    rig = plan.robot.rig_of(scale)
    found = [scan for _, scan, _ in scans_of(plan, shots_of(plan)[:scans], rig)]
    return [integrate_scans([scan], rig, geometry, integrator=Integrator(), threads=1) for scan in found]


def _push_rows(name: str, diffs: list[Diff], geometry: Geometry, *, seconds: float) -> Iterator[Row]:
    bodies = Bodies(diffs, geometry)
    with served(geometry) as server:
        robots = [Robot(server, f"robot{i}") for i in range(ROBOTS_PUSHING)]
        for robot in robots:  # warm
            robot.push(f"{robot.name}.{'0' * 16}.0", bodies.body(robot.name, 0))
        pushes, folded, cpu_s, own_s = Pushes(), server.folded(), server.cpu_s(), time.process_time()
        start_s = time.perf_counter()
        threads = [
            threading.Thread(target=_push_until, args=(robot, bodies, pushes, start_s + seconds)) for robot in robots
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        took_s, cpu_s, own_s = time.perf_counter() - start_s, server.cpu_s() - cpu_s, time.process_time() - own_s
        folded_meanwhile = server.folded() - folded
        count, ordered = len(pushes.seconds), sorted(pushes.seconds)
        while server.folded() < count + ROBOTS_PUSHING:
            time.sleep(0.02)
        lag_s = time.perf_counter() - start_s - took_s
        for robot in robots:
            robot.close()
    yield (
        f"8 robots push scans ({name}, {pushes.size_bytes // count} B) for {seconds:g} s",
        f"{count / took_s:.0f}",
        "/s",
    )
    yield "  p50", f"{1e3 * statistics.median(ordered):.1f}", "ms"
    yield "  p99", f"{1e3 * ordered[int(0.99 * (count - 1))]:.1f}", f"ms, {pushes.refused} refused"
    yield "  processor time", f"{1e3 * cpu_s / count:.2f}", f"ms a push, and {1e3 * own_s / count:.2f} of the robots"
    yield "  folded meanwhile", f"{folded_meanwhile / took_s:.0f}", "/s"
    yield "  all folded after", f"{lag_s:.2f}", f"s more = {(count - folded_meanwhile) / max(lag_s, 1e-3):.0f} /s"


def _push_until(robot: Robot, bodies: Bodies, pushes: Pushes, end_s: float) -> None:
    n = 1
    while time.perf_counter() < end_s:
        data = bodies.body(robot.name, n)
        start_s = time.perf_counter()
        status = robot.push(f"{robot.name}.{'0' * 16}.{n}", data)
        if status == 201:
            pushes.seconds.append(time.perf_counter() - start_s)
            pushes.size_bytes += len(data)
            n += 1
        else:
            pushes.refused += 1


def _store_rows(name: str, diffs: list[Diff], geometry: Geometry, *, commits: int) -> Iterator[Row]:
    """The store alone, from 64 commits on their way at any time, as threads of a web server have them."""
    bodies = Bodies(diffs, geometry)
    made = [bodies.commit("mole", n) for n in range(commits)]
    with tempfile.TemporaryDirectory() as folder:
        store = SqliteStore(Path(folder))
        row, _ = store.create_map("bench", geometry, SensorModel())
        start_s = time.perf_counter()
        threads = [
            threading.Thread(target=lambda i=i: [store.append(row, commit) for commit in made[i::64]])  # type: ignore[misc]
            for i in range(64)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        took_s = time.perf_counter() - start_s
        store.close()
    yield f"  store alone, group commit of {commits}", f"{commits / took_s:.0f}", "/s, durable"


def _visible_rows(diffs: list[Diff], geometry: Geometry, *, pushes: int) -> Iterator[Row]:
    """A robot that asks every 20 ms what it misses, and one that pushes; and what one commit behind is sent."""
    bodies = Bodies(diffs, geometry)
    seconds: list[float] = []
    ratios: list[float] = []
    with served(geometry) as server:
        pusher, asker = Robot(server, "pusher"), Robot(server, "asker")
        cursor = None
        for n in range(pushes):
            data = bodies.body("pusher", n)
            start_s = time.perf_counter()
            pusher.push(f"pusher.{'0' * 16}.{n}", data)
            while True:
                body = json.dumps({"author": f"asker.{'0' * 16}", "cursor": cursor}).encode()
                reply = asker.ask("POST", "/maps/bench/branches/asker/missing", body)[1]
                frames = frames_of(reply)
                header = frames[0]
                if isinstance(header, ReplyHeader) and header.to != cursor:
                    cursor = header.to
                    break
                time.sleep(0.02)
            seconds.append(time.perf_counter() - start_s)
            if any(isinstance(frame, CellFrame) for frame in frames):
                ratios.append(len(reply) / len(data))
        pusher.close()
        asker.close()
    ordered = sorted(seconds[1:])
    yield "pushed at one robot, seen by another that polls, p50", f"{1e3 * statistics.median(ordered):.0f}", "ms"
    yield "  p99", f"{1e3 * ordered[int(0.99 * (len(ordered) - 1))]:.0f}", "ms"
    yield "  one commit behind: reply against the commit's bytes", f"{statistics.median(ratios[1:]):.2f}", ""


def _bomb_rows(diff: Diff, geometry: Geometry) -> Iterator[Row]:
    bodies = Bodies([diff], geometry)
    data = bomb(make_commit(meta_of("robot", 1, geometry), diff, geometry))
    with served(geometry) as server:
        robot = Robot(server, "robot")
        robot.push(f"robot.{'0' * 16}.0", bodies.body("robot", 0))
        before_bytes, seconds = server.resident_bytes(), []
        for _ in range(5):
            start_s = time.perf_counter()
            status = robot.push(f"robot.{'0' * 16}.1", data)
            seconds.append(time.perf_counter() - start_s)
        after_bytes = server.resident_bytes()
        robot.close()
    yield (
        f"zstd bomb, {len(data)} B for {BOMB_BYTES >> 20} MiB",
        f"{1e3 * statistics.median(seconds):.1f}",
        f"ms to {status}",
    )
    yield "  more memory", f"{(after_bytes - before_bytes) / (1 << 20):.1f}", "MiB"
