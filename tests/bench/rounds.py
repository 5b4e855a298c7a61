"""Rounds of a robot that follows a map: without news, with one commit of another robot, and the first fetch of all.

The server is a process of its own; the robot runs in this one. Times are of the processor, unless they say otherwise.
"""

import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

from tests.bench.pushing import Diff, Server, facts_of, served
from tests.crowd.building import survey
from tests.fixtures.client.made import cursor, header
from tests.fixtures.map.made import random_evidence
from tests.fixtures.server.deadline import until

from cairn_client.http.api import MapApi
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.replica.server_cells import ServerCells
from cairn_client.robot.robot import Robot
from cairn_client.sync.exchange import Exchange
from cairn_map.codec.cell_code import encode_cell
from cairn_map.codec.layer_code import decode_layer_cell
from cairn_map.commits.ids import RobotName
from cairn_map.epochs.cell_history import merged
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import ZERO, fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_map.wire.messages import Done, MapInfo, MissingRequest

Row = tuple[str, str, str]
SMALL, LARGE = Geometry(depth=5), Geometry()
LARGE_VOXELS = 90_000
"""Known voxels by which a cell takes some 440 kB, as those of a building do."""
SIDE, COMMIT_CELLS, SCANS = 80, 100, 9
QUIET_ROUNDS = 40


def round_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    quiet_ms = []
    for cells in (42, 420) if smoke else (420, 4200):
        robot_ms, server_ms = _quiet_ms(cells)
        quiet_ms.append(robot_ms + server_ms)
        unit = f"ms of CPU, at most 10: robot {robot_ms:.1f}, server {server_ms:.1f}"
        yield f"a round without news, {cells} cells held", f"{quiet_ms[-1]:.1f}", unit
    yield "  ten times the cells", f"{quiet_ms[1] / quiet_ms[0]:.2f}", "times the time; at most 1.1"
    yield from _received_rows(stops=3 if smoke else 9)
    yield from _first_rows(20 if smoke else 420)


class _WholeCells(Exchange):
    """The way before: a delta is added to the sums of the whole cell, which is coded again."""

    def _apply_delta(self, base: ServerCells, frame: CellFrame) -> None:
        payload = decode_layer_cell(frame.payload, frame.cell, self._replica.layer).history
        self._hold_if_sound(base, frame, merged([base.history(frame.cell), payload], self._replica.geometry))


def _received_rows(stops: int) -> Iterator[Row]:
    """One commit of another robot, in turns as a delta next to the cells and as the whole cells anew."""
    seen = survey(robot="orpheus", voxel_m=0.04, stops=stops)
    with tempfile.TemporaryDirectory() as folder:
        ways = (("delta", Exchange), ("whole", _WholeCells))
        robots = [(_replica(Path(folder) / name, seen.geometry), way, list[float]()) for name, way in ways]
        whole, size_bytes = EvidenceMap(seen.geometry), list[int]()
        # Most cells are held by then, as in a team that works: the first two thirds come whole.
        first = 2 * len(seen.stops) // 3
        for diff in seen.stops[:first]:
            whole.merge(diff)
        for replica, way, _ in robots:
            _taken_s(replica, way, _frames_of(FrameKind.FULL, whole.packed(), whole, 0), 0)
        for n, diff in enumerate(seen.stops[first:], 1):
            whole.merge(diff)
            frames = _frames_of(FrameKind.DELTA, diff, whole, n)
            size_bytes.append(sum(len(frame.payload) for frame in frames))
            for replica, way, taken_s in robots:
                taken_s.append(_taken_s(replica, way, frames, n))
        views = {replica.view.digest() for replica, _, _ in robots}
        for replica, _, _ in robots:
            replica.close()
    if len(views) != 1:
        raise RuntimeError("the two ways give different maps")
    delta_s, whole_s = (statistics.mean(taken_s) for _, _, taken_s in robots)
    mean_bytes = statistics.mean(size_bytes)
    unit = f"ms of the robot's CPU, {delta_s / mean_bytes * 1e9:.0f} for each MB; at most 120"
    yield f"a commit of {mean_bytes / 1e6:.2f} MB received", f"{1e3 * delta_s:.1f}", unit
    yield "  as whole cells, as before", f"{1e3 * whole_s:.1f}", f"ms = {whole_s / delta_s:.1f} times as long"


def _replica(folder: Path, geometry: Geometry) -> Replica:
    return Replica(ReplicaStore(folder), robot=RobotName("bee"), map_name="bench", geometry=geometry)


def _frames_of(kind: FrameKind, diff: Diff, whole: EvidenceMap, n: int) -> list[CellFrame]:
    """Frames that bring cells from the n-th state to the next one."""
    return [
        CellFrame(
            kind=kind,
            cell=key,
            from_cursor=cursor(n) if n else None,
            to_cursor=cursor(n + 1),
            fingerprint=fingerprint(whole.evidence(key), key),
            payload=encode_cell(key, evidence, whole.geometry).data,
        )
        for key, evidence in diff.items()
    ]


def _taken_s(replica: Replica, way: type[Exchange], frames: list[CellFrame], n: int) -> float:
    """CPU of a robot that applies a reply."""
    framed = {frame.cell for frame in frames}
    rest = sum((sums for key, sums in replica.fingerprints().items() if key not in framed), ZERO)
    to = cursor(n + 1)
    start_s = time.process_time()
    exchange = way(replica)
    for frame in (header(to), *frames, Done(to=str(to), rest=rest.hex())):
        exchange.take(frame)
    taken_s = time.process_time() - start_s
    if not exchange.is_done:
        raise RuntimeError("the reply was not taken")
    return taken_s


def _quiet_ms(cells: int) -> tuple[float, float]:
    """CPU of robot and server in a round that brings nothing."""
    with ExitStack() as stack:
        server = stack.enter_context(served(SMALL))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        _fill(server, folder, random_evidence(1, SMALL), SMALL, cells)
        bee = stack.enter_context(_robot(server, folder / "bee", SMALL))
        bee.sync()
        bee.sync()
        robot_s, server_s = [], server.cpu_s()
        for _ in range(QUIET_ROUNDS):
            start_s = time.process_time()
            bee.sync()
            robot_s.append(time.process_time() - start_s)
        if len(bee.replica.cells) != cells:
            raise RuntimeError(f"{len(bee.replica.cells)} cells came of {cells}")
        return 1e3 * statistics.median(robot_s), 1e3 * (server.cpu_s() - server_s) / QUIET_ROUNDS


def _first_rows(cells: int) -> Iterator[Row]:
    """The first fetch of cells of the size that those of a building have."""
    with ExitStack() as stack:
        server = stack.enter_context(served(LARGE))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        _fill(server, folder, random_evidence(1, LARGE, voxels=LARGE_VOXELS), LARGE, cells)
        size_bytes = MapInfo.model_validate_json(server.ask("GET", "/maps/bench")).size_bytes
        token = server.token_of(json.dumps({"robot": "fly", "incarnation": "f" * 16}).encode())
        api = stack.enter_context(MapApi(f"http://127.0.0.1:{server.port}", token=token))
        api.map_info("bench")
        before_bytes = server.resident_bytes()
        start_s = time.perf_counter()
        with closing(api.missing("bench", "fly", MissingRequest())) as frames:
            next(frames)
            next(frames)
            first_s = time.perf_counter() - start_s
            count = 1 + sum(1 for _ in frames)
        name = f"first fetch of {cells} cells, {size_bytes / 1e6:.0f} MB: until its first cell is here"
        yield name, f"{first_s:.3f}", "s of wall time, at most 0.1"
        grown_bytes = server.resident_bytes() - before_bytes
        yield "  memory of the server for a reply", f"{grown_bytes / 1e6:.0f}", f"MB more; {count} frames in it"
        bee = stack.enter_context(_robot(server, folder / "bee", LARGE))
        server_s, start_s = server.cpu_s(), time.process_time()
        bee.sync()
        robot_s, server_s = time.process_time() - start_s, server.cpu_s() - server_s
        yield "  all of it", f"{robot_s:.2f}", f"s of the robot's CPU; the server's {server_s:.2f}"


def _fill(server: Server, folder: Path, evidence: Evidence, geometry: Geometry, cells: int) -> None:
    """Let a robot push the same evidence of so many cells, and wait until it is folded."""
    with _robot(server, folder / "ant", geometry) as ant:
        for start in range(0, cells, COMMIT_CELLS):
            keys = range(start, min(start + COMMIT_CELLS, cells))
            ant.replica.commit({_key(n): evidence for n in keys}, facts_of(0, SCANS))
            ant.sync()
        until(lambda: server.folded() >= -(-cells // COMMIT_CELLS), "all is folded")


def _key(n: int) -> CellKey:
    """The n-th cell of a floor."""
    return cell_key((n % SIDE, n // SIDE, 0))


def _robot(server: Server, folder: Path, geometry: Geometry) -> Robot:
    url = f"http://127.0.0.1:{server.port}/maps/bench"
    return Robot(None, url, directory=folder, name=folder.name, geometry=geometry)
