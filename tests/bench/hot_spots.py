"""Hot spots of a campus, twelve buildings side by side: the first list, and the list after a push, over HTTP.

    $ python -m tests.bench hot_spots

A real server on loopback that was just started, so that nothing is kept but what it reads ahead meanwhile; one request
before it, of another map, loads its libraries. The whole list is there when an answer is complete. With --smoke the
building is a few scans of the small room. Processor time is the server's own.
"""

import os
import signal
import tempfile
import time
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path

import httpx
import numpy as np
from tests.bench.building import building_map, wait_until_folded
from tests.bench.pushing import meta_of
from tests.fixtures.map.changing import GEOMETRY as WARM_GEOMETRY
from tests.fixtures.map.changing import scans
from tests.fixtures.server.live import Process

from cairn_client.http.api import MapApi
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.arrays import Ints
from cairn_map.commits.commit import Commit, make_commit
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_key, cell_of_key, geometry_for
from cairn_map.files.cell_folder import read_cells, read_head
from cairn_map.wire.messages import CreateMap, Register
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import path_names
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
Building = Mapping[CellKey, Evidence]
MAP, OTHER = "campus", "other"
COUNT = 30
"""Spots that the page asks for."""
GRID = (4, 3)
"""Buildings along x and y."""


def hot_spot_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    with tempfile.TemporaryDirectory() as name:
        geometry, building = _building(Path(name), smoke)
        folder = Path(name) / "server"
        server = Process(folder)
        assert server.url
        cells = _fill(server.url, geometry, building)
        _end(server)
        server = Process(folder)
        assert server.url
        try:
            yield from _asked_rows(server, geometry, building, cells)
        finally:
            _end(server)


def _building(inside: Path, smoke: bool) -> tuple[Geometry, Building]:
    if smoke:
        geometry, scene = geometry_for(voxel_edge_m=0.08), load_scene("small-room")
        (path, *_) = path_names("small-room")
        plan = Plan(scene=scene, robot=ROBOTS["orpheus"], path=path, scale=0.1, truth="none", last_stop=1)
        rig = plan.robot.rig_of(plan.scale)
        found = [scan for _, scan, _ in scans_of(plan, shots_of(plan)[:6], rig)]
        return geometry, integrate_scans(found, rig, geometry, integrator=Integrator(), threads=1)
    folder = building_map(inside, 4, stops=None)
    layer = read_head(folder).layer
    return layer.geometry, {cell.key: cell.history.total(layer.geometry) for cell in read_cells(folder, layer)}


def _fill(url: str, geometry: Geometry, building: Building) -> int:
    """Push the building twelve times, each one next to the others; the number of cells."""
    low, high = (end([cell_of_key(key) for key in building], axis=0) for end in (np.min, np.max))
    campus, other = _robot(url, MAP, geometry), _robot(url, OTHER, WARM_GEOMETRY)
    found = scans(np.zeros((1, 3), np.int64), 0, hits=1, kelvin=320.0)
    other.push(OTHER, _commit(0, {key: history.rows[Epoch(0)] for key, history in found.items()}, WARM_GEOMETRY))
    for n, (i, j) in enumerate(product(*map(range, GRID))):
        step = np.array([i, j, 0]) * (high - low + 1)
        moved = {_moved(key, step): evidence for key, evidence in building.items()}
        campus.push(MAP, _commit(n, moved, geometry))
    for name, robot in ((MAP, campus), (OTHER, other)):
        wait_until_folded(robot, name)
    return 12 * len(building)


def _moved(key: CellKey, step: Ints) -> CellKey:
    i, j, k = (step + cell_of_key(key)).tolist()
    return cell_key((i, j, k))


def _robot(url: str, name: str, geometry: Geometry) -> MapApi:
    """A robot of a new map."""
    robot = MapApi(url)
    robot.create_map(name, CreateMap(geometry=geometry))
    robot.register(name, Register(robot="scout", incarnation="0" * 16))
    return robot


def _commit(n: int, cells: Building, geometry: Geometry) -> Commit:
    most = max(int(evidence.counts.max(initial=1)) for evidence in cells.values())
    return make_commit(meta_of("scout", n, geometry, most), cells, geometry)


def _asked_rows(server: Process, geometry: Geometry, building: Building, cells: int) -> Iterator[Row]:
    assert server.url
    with httpx.Client(base_url=server.url, timeout=120) as http:

        def asked(name: str = MAP) -> tuple[float, float, httpx.Response]:
            wall_s, cpu_s = time.perf_counter(), _cpu_s(server)
            answer = http.get(f"/maps/{name}/main/hotspots", params={"count": COUNT})
            answer.raise_for_status()
            return 1000 * (time.perf_counter() - wall_s), 1000 * (_cpu_s(server) - cpu_s), answer

        def rows(what: str, found: tuple[float, float, httpx.Response], goal: str = "") -> Iterator[Row]:
            wall_ms, cpu_ms, answer = found
            told = answer.json()
            read = f"{told['read']} of {cells} cells read, {told['total']} spots, complete {told['complete']}"
            yield f"hot spots, {what}", f"{wall_ms:.0f}", f"ms, {cpu_ms:.0f} of a processor: {read}{goal}"

        asked(OTHER)
        start_s = time.perf_counter()
        yield from rows("first list", asked(), "; below 2000 is asked for")
        while not asked()[2].json()["complete"]:
            pass
        yield "  until it is whole", f"{time.perf_counter() - start_s:.1f}", "s"
        found = asked()
        yield from rows("the same again", found)
        yield f"  its answer of {COUNT} spots", f"{len(found[2].content) / 1e3:.1f}", "kB; at most 10 are asked for"
        answer = found[2]
        i, j, k = (each >> geometry.depth for each in answer.json()["spots"][0]["voxel"])
        api = MapApi(server.url)
        api.push(MAP, _commit(12, {cell_key((i, j, k)): next(iter(building.values()))}, geometry))
        wait_until_folded(api, MAP)
        yield from rows("after a push to one cell", asked())


def _cpu_s(server: Process) -> float:
    """Processor time of a server so far."""
    fields = Path(f"/proc/{server.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _end(server: Process) -> None:
    server.send(signal.SIGTERM)
    server.end()
