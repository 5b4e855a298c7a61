"""A thin link with losses: what is near comes first, nothing breaks, and nothing is paid twice. Real transfers."""

import json
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, cells_of, opened
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.client.robots import robot_in
from tests.links.proxy import Cut, Fault, FaultProxy

from cairn_client.cli.robots import command as robot_command
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.replica.outbox import CommitFacts
from cairn_client.robot import status_report
from cairn_client.robot.robot import Robot
from cairn_client.sync.link_profile import LINKS
from cairn_client.sync.near_cells import cell_at
from cairn_client.sync.scope import Scope
from cairn_client.sync.sync import push_commits
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import UnreachableError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Cell, cell_key, cell_of_key
from cairn_map.wire.messages import Register

SIZE = 6
"""Cells along one side of the made map."""
BYTES_PER_S = 8000.0
"""64 kbit/s."""


FIRE = Cell(5, 5, 0)


def rings_between(cell: Cell, near: Cell) -> int:
    """Distance of a cell from another, in cells along the farthest axis."""
    return max(abs(a - b) for a, b in zip(cell, near, strict=True))


@pytest.fixture
def city(server: LiveServer, tmp_path: Path) -> LiveServer:
    """A map of many cells, each of them a few hundred bytes that do not compress."""
    return built(server, tmp_path / "owl", kelvin=lambda _: 0)


@pytest.fixture
def burning(server: LiveServer, tmp_path: Path) -> LiveServer:
    """The same with temperatures, and a fire in one corner."""
    return built(server, tmp_path / "owl", kelvin=lambda cell: 900 if cell == FIRE else 290 + cell.i)


def built(server: LiveServer, folder: Path, *, kelvin: Callable[[Cell], int]) -> LiveServer:
    """A city; a temperature of 0 is none."""
    owl = opened(folder, "owl")
    rng = np.random.default_rng(1)
    cells = {}
    for i in range(SIZE):
        for j in range(SIZE):
            voxels = np.sort(rng.choice(512, 200, replace=False)).astype(np.uint32)
            counts = rng.integers(1, 30, (200, 2))
            steps = 20 * kelvin(Cell(i, j, 0))
            samples = np.tile([steps, steps**2, int(steps > 0)], (200, 1))
            cells[cell_key((i, j, 0))] = packed_evidence(voxels, counts, samples, GEOMETRY)
    pose = ScanPose(time_s=1.5e9, t_map_rig=(0.0, 0.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    with MapApi(server.url) as api:
        api.register(MAP, Register(robot="owl", incarnation=owl.author.incarnation))
        owl.commit(cells, CommitFacts(scans=(pose,) * 64))
        assert Link(api, MAP, branch="owl").hold(push_commits(owl)).pushed == 1
    server.wait_for_fold()
    owl.close()
    return server


def robot_at(folder: Path, link: FaultProxy, place: Cell, *, name: str = "fox", scope: Scope | None = None) -> Robot:
    """A robot that stands in a cell, behind a small link."""
    url = f"http://127.0.0.1:{link.port}/maps/{MAP}"
    robot = Robot(RIG, url, directory=folder / name, name=name, geometry=GEOMETRY, link="small", scope=scope or Scope())
    edge_m = GEOMETRY.cell_edge_m
    middle = ((place.i + 0.5) * edge_m, (place.j + 0.5) * edge_m, (place.k + 0.5) * edge_m)
    robot.status.pose = ScanPose(time_s=1.5e9, t_map_rig=middle, q_map_rig=(0.0, 0.0, 0.0, 1.0))
    return robot


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "times"), [("high-end", 1), ("low-end", 10)])
def test_at_64_kbit_and_5_percent_loss_the_cells_around_the_robot_come_first(
    city: LiveServer, tmp_path: Path, mode: str, times: int
) -> None:
    place = Cell(4, 2, 0)
    scope = Scope(reply_bytes_max=2000, round_bytes_max=4000)
    order: list[Cell] = []
    with (
        FaultProxy(
            city.port, fault=lambda: Fault(loss=0.05), bytes_per_s=times * BYTES_PER_S, random=Random(1)
        ) as link,
        robot_at(tmp_path, link, place, scope=scope) as robot,
    ):
        robot.mode = mode  # type: ignore[assignment]
        rounds = 0
        while len(order) < SIZE * SIZE:
            before = set(robot.replica.cells)
            report = robot.sync()
            order += [cell_of_key(key) for key in robot.replica.cells if key not in before]
            rounds += 1
            if rounds == 2:
                assert all(rings_between(cell, place) <= 2 for cell in order)
            assert report.has_more == (len(order) < SIZE * SIZE)
        assert rounds > 3
    rings = [rings_between(cell, place) for cell in order]
    assert rings == sorted(rings)


@pytest.mark.parametrize("mode", ["high-end", "low-end"])
def test_a_far_fire_comes_right_after_the_robots_surroundings(burning: LiveServer, tmp_path: Path, mode: str) -> None:
    place = Cell(1, 1, 0)
    with (
        FaultProxy(burning.port) as link,
        robot_at(tmp_path, link, place, scope=Scope(reply_bytes_max=1, round_bytes_max=1)) as robot,
    ):
        robot.mode = mode  # type: ignore[assignment]
        order: list[Cell] = []
        while len(order) < 12:
            before = set(robot.replica.cells)
            assert robot.sync().has_more
            order += [cell_of_key(key) for key in robot.replica.cells if key not in before]
    assert {rings_between(cell, place) for cell in order[:9]} == {0, 1}
    assert order[9] == FIRE
    assert {rings_between(cell, place) for cell in order[10:]} == {2}


def test_a_robot_that_moves_gets_what_is_around_its_new_place(city: LiveServer, tmp_path: Path) -> None:
    scope = Scope(reply_bytes_max=2000, round_bytes_max=2000)
    with FaultProxy(city.port) as link, robot_at(tmp_path, link, Cell(0, 0, 0), scope=scope) as robot:
        robot.sync()
        first = set(robot.replica.cells)
        with robot_at(tmp_path, link, Cell(5, 5, 0), name="owl2") as other:
            robot.status.pose = other.status.pose
        robot.sync()
        second = robot.replica.cells.keys() - first
        assert max(rings_between(cell_of_key(key), Cell(0, 0, 0)) for key in first) <= 2
        assert max(rings_between(cell_of_key(key), Cell(5, 5, 0)) for key in second) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("cut", ["close", "half", "reset"])
def test_at_30_percent_loss_and_with_cuts_nothing_breaks_and_nothing_is_paid_twice(
    city: LiveServer, tmp_path: Path, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.links.proxy.FIRST_AGAIN_S", 0.005)
    with FaultProxy(city.port) as link, robot_at(tmp_path, link, Cell(3, 3, 0)) as robot:
        while robot.sync().has_more:
            pass
        whole, whole_bytes = cells_of(robot.map), link.size_bytes
    random = Random(3)

    def fault() -> Fault:
        return Fault(loss=0.3, down_bytes=random.randint(1500, 5000), cut=cut)

    with (
        FaultProxy(city.port, fault=fault, bytes_per_s=20 * BYTES_PER_S, random=random) as link,
        robot_at(tmp_path, link, Cell(3, 3, 0), name="hare") as robot,
    ):
        frames = 0
        while True:
            try:
                report = robot.sync()
            except UnreachableError:
                continue
            frames += report.frames
            if not report.has_more:
                break
        assert cells_of(robot.map) == whole
        assert link.cuts >= 3
        # A cut costs a question, the head of its answer, and what a reset throws away of a packet or two.
        assert link.size_bytes <= whole_bytes + link.cuts * 5000


@pytest.mark.slow
def test_on_a_small_link_commits_take_few_bytes_and_statuses_are_seldom(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    profiles = []
    now_s = [1.7e9]
    monkeypatch.setattr(status_report.time, "time", lambda: now_s[0])
    with (
        FaultProxy(server.port) as link,
        Robot(
            RIG,
            f"http://127.0.0.1:{link.port}/maps/{MAP}",
            directory=tmp_path / "mole",
            name="mole",
            geometry=GEOMETRY,
            integrator=INTEGRATOR,
            link="small",
        ) as robot,
    ):
        commit = robot.replica.commit
        monkeypatch.setattr(
            robot.replica,
            "commit",
            lambda *a, profile, notes: (profiles.append(profile), commit(*a, profile=profile))[1],
        )
        for seed in range(6):
            robot.observe(scan_of(seed))
            robot.commit()
            robot.sync()
            now_s[0] += 15.0
        statuses = [line for line in link.requests if b"/status" in line]
    assert profiles == [Profile.SMALL] * 6
    assert len(statuses) == 2


def test_a_sync_that_finds_nothing_new_is_one_small_request(city: LiveServer, tmp_path: Path) -> None:
    with FaultProxy(city.port) as link, robot_at(tmp_path, link, Cell(3, 3, 0)) as robot:
        while robot.sync().has_more:
            pass
        robot.sync()
        before, asked = link.size_bytes, len(link.requests)
        robot.sync()
        assert len(link.requests) == asked + 1
        assert link.size_bytes - before < 600


def test_who_joins_late_pays_for_the_map_and_hardly_more(city: LiveServer, tmp_path: Path) -> None:
    with MapApi(city.url) as api:
        at_rest_bytes = api.map_info(MAP).size_bytes
    with FaultProxy(city.port) as link, robot_in(tmp_path, f"http://127.0.0.1:{link.port}/maps/{MAP}") as robot:
        frames = robot.sync().frames
        assert link.size_bytes < at_rest_bytes + 160 * frames + 4000  # frames of real cells have some 150 kB


def test_a_copy_comes_whole_over_a_small_link(
    city: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with MapApi(city.url) as api:
        cells = api.map_info(MAP).cells
    state = str(tmp_path / "copy")
    assert robot_command.main(["sync", state, "--map", city.map_url, "--link", "small", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["cells"], report["pushed"], report["refused"], report["waiting"]) == (cells, 0, {}, 0)
    assert report["voxels"] > 0 and report["down_bytes"] > 0
    copy = opened(tmp_path / "copy", "viewer")
    assert len(copy.view.packed()) == cells == SIZE * SIZE
    copy.close()


def test_a_place_is_in_its_cell() -> None:
    assert cell_at((0.0, -0.1, 5.2), (0.4, 0.4, 0.4)) == Cell(0, -1, 13)
    assert cell_at((1e30, 0.0, -1e30), (0.4, 0.4, 0.4)) == Cell((1 << 20) - 1, 0, -(1 << 20))


def test_the_small_profile_is_small() -> None:
    small, good = LINKS["small"], LINKS["good"]
    assert small.commits is Profile.SMALL
    assert small.parts.part_bytes < good.parts.part_bytes
    assert good.scope_of(Scope()) == Scope()
    assert small.scope_of(Scope(reply_bytes_max=77)).reply_bytes_max == 77
