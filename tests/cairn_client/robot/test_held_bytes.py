"""A robot's memory: what others push costs it a bounded multiple of what it downloads, and never above its limit."""

import logging
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import cells_of
from tests.fixtures.client.robots import evidence_of, robot_in
from tests.fixtures.map.costly import air, costly_evidence, dust

from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client.folders.folder_status import folder_status
from cairn_client.http.api import MapApi
from cairn_client.replica.limits import NO_LIMITS, Limits
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.machine_memory import memory_bytes, standard_limit_bytes
from cairn_map.wire.messages import CreateMap

DEEP = Geometry(voxel_edge_um=40_000, depth=7, channels=())
FLAT = Geometry(voxel_edge_um=40_000, depth=5, channels=())
SWEEPING = SpinningLidar(width=96, height=64, elevations_deg=tuple(np.linspace(15, -25, 64).tolist()))
MAST = Rig(name="mast", cameras={"lidar": mount_camera(Spectrum.RANGE, SWEEPING, np.eye(4))})
PER_BYTE = 200
"""Bytes held for each byte downloaded, at most."""


def make_map(server: LiveServer, name: str, geometry: Geometry) -> str:
    with MapApi(server.url) as api:
        api.create_map(name, CreateMap(geometry=geometry))
    return f"{server.url}/maps/{name}"


def push(url: str, folder: Path, diff: dict[CellKey, Evidence], *, name: str = "mole") -> None:
    with Robot(None, url, directory=folder / name, name=name) as robot:
        robot.replica.commit(diff)
        robot.sync()


def wait_for_fold(server: LiveServer, name: str) -> None:
    row = server.service.store.map(name)
    while True:
        with server.service.store.snapshot(row) as snapshot:
            if not len(snapshot.pending()):
                return


def test_a_commit_of_a_few_bytes_costs_a_robot_a_few_bytes(server: LiveServer, tmp_path: Path) -> None:
    url = make_map(server, "deep", DEEP)
    push(url, tmp_path, {cell_key((i, 0, 0)): dust(DEEP, first=i) for i in range(4)})
    push(url, tmp_path, {cell_key((0, 1, 0)): air(DEEP)})
    wait_for_fold(server, "deep")
    with Robot(None, url, directory=tmp_path / "warm", name="warm") as robot:
        robot.sync()
    with Robot(None, url, directory=tmp_path / "wren", name="wren", limits=NO_LIMITS) as robot:
        tracemalloc.start()
        robot.sync()
        held_bytes, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(robot.map) == 5
        assert robot.map.size_bytes <= robot.traffic.down_bytes
        assert held_bytes <= PER_BYTE * robot.traffic.down_bytes


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiveServer, list[int]]]:
    """A server, and the numbers of the maps made on it."""
    live = LiveServer(tmp_path_factory.mktemp("flat"))
    yield live, []
    live.stop()


@settings(max_examples=6, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(st.lists(st.lists(costly_evidence(FLAT, misses_max=1), min_size=1, max_size=3), min_size=1, max_size=3))
def test_any_accepted_commits_cost_a_robot_what_it_downloads(
    flat: tuple[LiveServer, list[int]], tmp_path_factory: pytest.TempPathFactory, commits: list[list[Evidence]]
) -> None:
    server, made = flat
    made.append(len(made))
    folder, name = tmp_path_factory.mktemp("robots"), f"m{made[-1]}"
    url = make_map(server, name, FLAT)
    with (
        Robot(None, url, directory=folder / "mole", name="mole") as mole,
        Robot(None, url, directory=folder / "wren", name="wren", limits=NO_LIMITS) as wren,
    ):
        wren.sync()
        for diff in commits:
            mole.replica.commit({cell_key((i, 0, 0)): evidence for i, evidence in enumerate(diff)})
            mole.sync()
            wait_for_fold(server, name)
            wren.sync()
            assert wren.map.size_bytes <= PER_BYTE * wren.traffic.down_bytes
        mole.sync()
        assert cells_of(mole.map) == cells_of(wren.map)


def test_a_quarter_of_the_memory_is_the_limit_of_a_robot_that_is_given_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "cairn_client"), robot_in(tmp_path) as robot:
        assert robot._rounds._budget._memory_max == standard_limit_bytes() == memory_bytes() // 4
    assert f"at most {standard_limit_bytes() / 1e6:.0f} MB of memory" in caplog.text
    assert folder_status(tmp_path / "mole").memory_bytes_max == standard_limit_bytes()
    with robot_in(tmp_path, limits=Limits(memory_bytes_max=1 << 20)):
        assert folder_status(tmp_path / "mole").memory_bytes_max == 1 << 20
    with robot_in(tmp_path, limits=NO_LIMITS):
        assert folder_status(tmp_path / "mole").memory_bytes_max is None


def test_a_folder_with_more_than_its_limit_is_opened_within_it(server: LiveServer, tmp_path: Path) -> None:
    diff = {key: evidence for n in range(6) for key, evidence in shifted(evidence_of(n).packed(), n).items()}
    with robot_in(tmp_path, server.map_url, limits=replace(NO_LIMITS, keep_acked_s=0)) as robot:
        robot.replica.commit(diff)
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        robot.replica.forget_stable_commits()
        whole_bytes = robot.map.size_bytes
        assert robot.replica.commits == []
    limits = Limits(memory_bytes_max=1 << 16)
    assert whole_bytes > 3 << 15
    with robot_in(tmp_path, server.map_url, limits=limits) as robot:
        cell_bytes = max(robot.map.cell_bytes(key) for key in robot.map)
        assert robot.map.size_bytes <= (1 << 16) + cell_bytes
        robot.snapshot()
        robot.sync()
        assert robot.replica.memory_bytes() <= (1 << 16) + cell_bytes


def shifted(diff: dict[CellKey, Evidence], by: int) -> dict[CellKey, Evidence]:
    return {cell_key((10 * by + n, 0, 0)): evidence for n, evidence in enumerate(diff.values())}


def test_the_memory_of_a_container_counts_and_not_its_machine_s(tmp_path: Path) -> None:
    machine_bytes = memory_bytes(tmp_path)  # no such folders: no container
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text("0::/robots/mole\n")
    groups = tmp_path / "sys/fs/cgroup"
    (groups / "robots/mole").mkdir(parents=True)
    (groups / "robots/mole/memory.max").write_text("max\n")
    assert memory_bytes(tmp_path) == machine_bytes
    (groups / "robots/memory.max").write_text("512000000\n")  # a limit of the group above
    assert memory_bytes(tmp_path) == 512_000_000
    (groups / "memory.max").write_text("256000000\n")  # inside a container, where its own path is not seen
    assert memory_bytes(tmp_path) == 256_000_000
    (tmp_path / "proc/self/cgroup").write_text("4:memory:/docker/1\n3:cpu:/\n")
    (groups / "memory/docker/1").mkdir(parents=True)
    (groups / "memory/docker/1/memory.limit_in_bytes").write_text("128000000\n")
    assert memory_bytes(tmp_path) == 128_000_000


def sweep_of_80_m() -> Scan:
    """A sweep of 64 beams over flat ground, walls all round at 80 m."""
    slopes = np.radians(SWEEPING.elevations_deg)
    ranges = np.minimum(79.0 / np.cos(slopes), np.where(slopes < 0, 1.5 / np.maximum(np.sin(-slopes), 1e-9), np.inf))
    image = np.repeat(ranges[:, None], SWEEPING.width, axis=1).astype(np.float32)
    return Scan(time_s=0.0, T_map_rig=look_at((0, 0, 1.5), (1, 0, 1.5)), range_camera="lidar", range_m=image)


def test_an_honest_sweep_of_80_m_and_open_air_at_2_cm_are_accepted_and_held(server: LiveServer, tmp_path: Path) -> None:
    wide, fine = (
        Geometry(voxel_edge_um=400_000, depth=6, channels=()),
        DEEP.model_copy(update={"voxel_edge_um": 20_000}),
    )
    sweep = integrate_scans([sweep_of_80_m()], MAST, wide, integrator=Integrator(max_range_m=81))
    clear = {cell_key((i, 0, 0)): air(fine) for i in range(1)}
    for name, geometry, diff in (("sweep", wide, sweep), ("clear", fine, clear)):
        url = make_map(server, name, geometry)
        push(url, tmp_path, diff, name=f"mole-{name}")
        wait_for_fold(server, name)
        with Robot(None, url, directory=tmp_path / f"wren-{name}", name="wren") as robot:
            robot.sync()
            assert robot.map.packed() == dict(sorted(diff.items()))
            assert robot.map.size_bytes <= PER_BYTE * robot.traffic.down_bytes
