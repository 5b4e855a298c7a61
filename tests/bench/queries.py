"""How fast a map answers, beside OctoMap on the very same voxels.

    $ python -m tests.bench queries

All laboratories of the building at 4 cm. OctoMap's tree is given each known voxel with our log-odds and is pruned; so
both answer alike, and the rows say by how much they do not. Points are random in the box of the known voxels, rays go
from the camera's places in random directions. One thread; the fewest CPU seconds of some runs, the two in turns.
"""

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tests.bench import octomap

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.native.point_handle import PointHandle
from cairn_map.queries.occupancy_states import State
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
Floats = npt.NDArray[np.float64]
POINTS, RAYS, FEW = 1_000_000, 100_000, 10_000
RANGE_MAX_M = 10.0


def query_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    whole, places_m = _laboratories(1 if smoke else None)
    snapshot = snapshot_of(whole)
    known = snapshot.voxels_in()
    rng = np.random.default_rng(1)
    points = rng.uniform(known.centres_m.min(axis=0), known.centres_m.max(axis=0), (POINTS, 3))
    points = points.astype(np.float32).astype(np.float64)  # OctoMap reads no others
    origins = rng.choice(places_m, RAYS).astype(np.float32).astype(np.float64)
    directions = rng.normal(size=(RAYS, 3)).astype(np.float32).astype(np.float64)
    yield "a map to ask, 4 cm", f"{len(known)}", f"known voxels, {whole.size_bytes / 1e6:.0f} MB"
    yield from _snapshot_rows(whole, snapshot)
    works: dict[str, Callable[[], object]] = {
        "state": lambda: snapshot.state_at(points),
        "hits and misses": lambda: snapshot.counts_at(points),
        "log-odds": lambda: snapshot.log_odds_at(points),
        "probability": lambda: snapshot.probability_at(points),
    }
    rays: dict[str, Callable[[], object]] = {
        "rays": lambda: snapshot.cast_rays(origins, directions, max_range_m=RANGE_MAX_M),
        "rays that end in unknown": lambda: snapshot.cast_rays(
            origins, directions, max_range_m=RANGE_MAX_M, ends_in_unknown=True
        ),
    }
    ours = dict.fromkeys([*works, *rays], np.inf)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        why = octomap.missing()
        if not why:
            driver = octomap.compiled_driver(folder, octomap.QUERIES)
            odds = snapshot.log_odds_at(known.centres_m)
            octomap.write_queries(folder, known.centres_m, odds, points, np.hstack([origins, directions]))
        theirs = []
        for _ in range(1 if smoke else 5):
            for what, work in (works | rays).items():
                ours[what] = min(ours[what], _cpu_s(work, 1 if smoke else 4))
            if not why:
                answers = octomap.ask(driver, folder, voxel_edge_m=0.04, range_max_m=RANGE_MAX_M, repeats=2)
                theirs.append(answers)
    if why:
        yield "  OctoMap", "skipped", why
    points_s = min((answers.points_s for answers in theirs), default=np.nan)
    rays_s = min((answers.rays_s for answers in theirs), default=np.nan)
    for group, count, peer_s in ((works, POINTS, points_s), (rays, RAYS, rays_s)):
        for what in group:
            ratio = f" = {count / ours[what] / 1e6:.3g} M/s: {peer_s / ours[what]:.1f} x as fast as OctoMap"
            yield f"  {what}, {count}", f"{1e3 * ours[what]:.1f}", "ms CPU" + (ratio if theirs else "")
    if theirs:
        states, hits = snapshot.state_at(points), snapshot.cast_rays(origins, directions, max_range_m=RANGE_MAX_M).hit
        for what, seconds, mine, other in (
            ("search", points_s, int((states != State.UNKNOWN).sum()), theirs[0].known),
            ("search", points_s, int((states == State.OCCUPIED).sum()), theirs[0].occupied),
            ("castRay", rays_s, int(hits.sum()), theirs[0].hits),
        ):
            yield f"  OctoMap, {what}", f"{1e3 * seconds:.0f}", f"ms CPU; found {other}, ours {mine}"
    yield from _single_rows(snapshot, points, points_s, 2 if smoke else 20)
    yield from _other_rows(snapshot, points[:FEW])


def _snapshot_rows(whole: EvidenceMap, snapshot: MapSnapshot) -> Iterator[Row]:
    yield "  first snapshot", f"{1e3 * _cpu_s(lambda: snapshot_of(whole), 5):.1f}", "ms CPU"
    yield "  the next, nothing changed", f"{1e3 * _cpu_s(lambda: snapshot.refreshed(whole), 5):.1f}", "ms CPU"


def _single_rows(snapshot: MapSnapshot, points: Floats, peer_s: float, repeats: int) -> Iterator[Row]:
    """One point a call: from C and from Python through a handle, and from Python through the snapshot."""
    few = points[:FEW].tolist()
    with PointHandle(snapshot) as handle, tempfile.TemporaryDirectory() as name:
        if shutil.which("cc") is None:
            yield "  one point a call, from C", "skipped", "no cc (apt-get install gcc)"
        else:
            library, source = Path(name) / "loop.so", Path(__file__).with_name("point_loop.c")
            options = ["-O3", "-shared", "-fPIC", f"-I{handle.HEADER.parent}", "-o", str(library)]
            subprocess.run(["cc", *options, str(source)], check=True)
            loop, states = ctypes.CDLL(str(library)).ask, np.empty(len(points), np.int8)
            loop.restype = ctypes.c_double
            state, number = ctypes.c_void_p(handle.state_address), ctypes.c_uint64(handle.map)
            asked, answers = (ctypes.c_void_p(array.ctypes.data) for array in (points, states))
            own_s = loop(state, number, asked, ctypes.c_int64(len(points)), answers, repeats)
            alike = "alike" if (states == snapshot.state_at(points)).all() else "NOT ALIKE"
            peer = f"; OctoMap {1e6 * peer_s / len(points):.3f}: {peer_s / own_s:.1f} x as fast"
            ratio = f"{peer if peer_s < np.inf else ''}; answers {alike}"
            what = f"  one point a call, from C, {len(points)}"
            yield what, f"{1e6 * own_s / len(points):.3f}", f"us CPU each{ratio}"
        from_python: dict[str, Callable[[], object]] = {
            "from Python, handle": lambda: [handle.state(handle.map, *point) for point in few],
            "from Python, snapshot": lambda: [snapshot.state_at([point]) for point in few],
        }
        for what, work in from_python.items():
            yield f"  one point a call, {what}", f"{1e6 * _cpu_s(work, min(repeats, 3)) / FEW:.2f}", "us CPU each"


def _other_rows(snapshot: MapSnapshot, points: Floats) -> Iterator[Row]:
    """Queries that OctoMap has not."""
    angles = np.random.default_rng(2).uniform(0, 2 * np.pi, len(points))
    T = np.tile(np.eye(4), (len(points), 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angles)
    T[:, 1, 0] = np.sin(angles)
    T[:, 0, 1] = -T[:, 1, 0]
    T[:, :3, 3] = points
    robot_m = [[-0.4, -0.3, -0.2], [0.4, 0.3, 0.4]]
    for what, work in (
        ("box of 80 x 60 x 60 cm, turned", lambda: snapshot.check_box(T, robot_m)),
        ("sphere of 30 cm", lambda: snapshot.check_sphere(points, radius_m=0.3)),
        ("nearest occupied within 1 m", lambda: snapshot.nearest_occupied(points, radius_m=1)),
        ("nearest unknown within 1 m", lambda: snapshot.nearest_unknown(points, radius_m=1)),
    ):
        yield f"  {what}", f"{1e6 * _cpu_s(work, 3) / len(points):.1f}", "us CPU each"  # type: ignore[arg-type]
    for what, work in (
        ("frontier of the whole map", snapshot.frontier),
        ("height map", snapshot.height_map),
        ("layer of probabilities", lambda: snapshot.layer_at(0.5)),
    ):
        yield f"  {what}", f"{1e3 * _cpu_s(work, 3):.1f}", "ms CPU"  # type: ignore[arg-type]


def _laboratories(stops: int | None) -> tuple[EvidenceMap, Floats]:
    """Their map, and (N, 3) where the camera was."""
    robot = ROBOTS["tof"]
    plan = Plan(scene=load_scene("building"), robot=robot, path="labs", truth="none", last_stop=stops)
    rig, geometry = robot.rig_of(1.0), Geometry()
    whole, stop, places = EvidenceMap(geometry), [], []
    for shot, scan, _ in scans_of(plan, shots_of(plan), rig):
        stop.append(scan)
        places.append((scan.T_map_rig @ rig[scan.range_camera].transform)[:3, 3])
        if shot.ends_stop:
            whole.merge(integrate_scans(stop, rig, geometry, integrator=Integrator(), threads=1))
            stop = []
    return whole, np.array(places)


def _cpu_s(work: Callable[[], object], repeats: int) -> float:
    """The fewest CPU seconds."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best
