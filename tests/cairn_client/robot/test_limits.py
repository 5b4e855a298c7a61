"""Robots with little room: what goes, in which order, what never goes, and that the map stays exact all the same."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, cells_of
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import evidence_of, map_commit, robot_in

from cairn_client.replica import replica_store
from cairn_client.replica.limits import NO_LIMITS, Limits
from cairn_client.replica.replica_state import CellCube
from cairn_client.robot.robot import Robot
from cairn_client.robot.robot_events import CellsDropped, OutboxNearlyFull
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key

EDGE_M = GEOMETRY.cell_edge_m
SIDE = 16
"""The tests' map is a row of twice as many cells, and one."""


@pytest.fixture(autouse=True)
def small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that small cells fill a small disk."""
    pragmas = tuple(p for p in replica_store.PRAGMAS if "page_size" not in p and "synchronous" not in p)
    monkeypatch.setattr(replica_store, "PRAGMAS", ("page_size = 512", "synchronous = OFF", *pragmas))
    monkeypatch.setattr("cairn_client.robot.cell_budget.ROW_BYTES", 300)
    monkeypatch.setattr("cairn_client.robot.cell_budget.SLACK_BYTES", 4096)


def full_cell(seed: int) -> Evidence:
    """A cell of which every voxel was seen, with numbers that do not compress: some 2 kB."""
    rng = np.random.default_rng(seed + 1000)
    voxels = np.arange(512, dtype=np.uint32)
    samples = rng.integers(1, 1 << 14, (512, 1))
    sums = np.hstack([samples, samples**2, samples * 0 + 1])
    return packed_evidence(voxels, np.eye(2, dtype=np.int64)[rng.integers(0, 2, 512)], sums, GEOMETRY)


ROW = {cell_key((i, 0, 0)): full_cell(i) for i in range(-SIDE, SIDE + 1)}


@pytest.fixture
def row_server(server: LiveServer, tmp_path: Path) -> Iterator[LiveServer]:
    """A server with a row of cells along x."""
    with robot_in(tmp_path, server.map_url, name="maker") as maker:
        maker.replica.commit(ROW)
        maker.sync()
    server.wait_for_fold()
    yield server


def at(robot: Robot, i: int) -> None:
    """Let the robot be in the i-th cell of the row."""
    place = ((i + 0.5) * EDGE_M, 0.1, 0.1)
    robot.status.pose = ScanPose(time_s=1.0, t_map_rig=place, q_map_rig=(0, 0, 0, 1))


def held(robot: Robot) -> list[int]:
    """The cells of the row that the robot holds whole."""
    return sorted(cell_of_key(key)[0] for key, cell in robot.replica.cells.items() if cell.cursor is not None)


def shown(robot: Robot) -> dict[CellKey, Evidence]:
    return robot.map.packed()


def used(robot: Robot) -> int:
    return robot.replica.store.used_bytes()


def row_bytes() -> int:
    whole = EvidenceMap(GEOMETRY)
    whole.merge(ROW)
    return whole.size_bytes


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["high-end", "low-end", "viewer"])
def test_a_full_disk_holds_the_cells_around_the_robot_and_they_go_with_it(
    row_server: LiveServer, tmp_path: Path, mode: str
) -> None:
    limits = Limits(disk_bytes_max=66_000)
    with robot_in(tmp_path, row_server.map_url, limits=limits, mode=mode, stay=True) as robot:
        for place in (0, 2, SIDE):
            at(robot, place)
            robot.sync()
            assert used(robot) <= 66_000
            kept = held(robot)
            assert place in kept and 8 <= len(kept) < 29
            near = [i for i in range(-SIDE, SIDE + 1) if abs(i - place) <= 4]
            assert set(near) <= set(kept)
            assert all(np.array_equal(shown(robot)[cell_key((i, 0, 0))].counts, full_cell(i).counts) for i in kept)
    with robot_in(tmp_path, row_server.map_url, limits=limits, mode=mode, stay=True) as robot:
        assert held(robot) == kept  # it is remembered, and so is where it was
        robot.sync()
        assert set(held(robot)) >= set(range(SIDE - 4, SIDE + 1))
    with robot_in(tmp_path, row_server.map_url, mode=mode, stay=True) as robot:  # and so are the limits
        at(robot, SIDE)
        robot.sync()
        assert used(robot) <= 66_000
    with robot_in(tmp_path, row_server.map_url, limits=NO_LIMITS, mode=mode) as robot:  # without them the rest comes
        robot.sync()
        assert held(robot) == list(range(-SIDE, SIDE + 1))
        whole = EvidenceMap(GEOMETRY)
        whole.merge(ROW)
        assert cells_of(robot.map) == cells_of(whole)


def test_memory_is_bounded_as_the_disk_is(row_server: LiveServer, tmp_path: Path) -> None:
    limits = Limits(memory_bytes_max=row_bytes() // 2)
    with robot_in(tmp_path, row_server.map_url, limits=limits) as robot, robot.events() as events:
        at(robot, 3)
        robot.sync()
        assert robot.map.size_bytes <= row_bytes() // 2
        assert set(range(1, 6)) <= set(held(robot))
        dropped = [event for event in events.take() if isinstance(event, CellsDropped)]
        assert dropped and all(abs(cell[0] - 3) > 2 for event in dropped for cell in event.cells)


def test_a_box_that_is_chosen_is_asked_for_alone(row_server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, row_server.map_url, limits=Limits(disk_bytes_max=66_000)) as robot:
        at(robot, 0)
        robot.sync()
        before = robot.traffic.down_bytes
        robot.sync()
        robot.sync()
        assert robot.traffic.down_bytes - before < 2000  # a cell has some 2 kB


def test_own_evidence_is_shown_where_the_servers_cells_had_to_go(row_server: LiveServer, tmp_path: Path) -> None:
    far = cell_key((-SIDE, 0, 0))
    with robot_in(tmp_path, row_server.map_url, limits=Limits(disk_bytes_max=66_000)) as robot:
        robot.replica.commit({far: full_cell(99)})
        at(robot, SIDE)
        robot.replica.header = None
        _fetch_only(robot)
        assert -SIDE not in held(robot)
        assert np.array_equal(robot.map.evidence(far).counts, full_cell(99).counts)
        robot.sync()
        row_server.wait_for_fold()
        at(robot, -SIDE)
        robot.sync()
        whole = EvidenceMap(GEOMETRY)
        whole.merge({far: full_cell(99)})
        whole.merge({far: full_cell(-SIDE)})
        assert np.array_equal(robot.map.evidence(far).counts, whole.evidence(far).counts)


def _fetch_only(robot: Robot) -> None:
    """A round without a push."""
    robot._rounds._fetch()


@pytest.mark.slow
def test_a_commit_drops_the_farthest_cells_and_then_refuses(row_server: LiveServer, tmp_path: Path) -> None:
    limits = Limits(disk_bytes_max=150_000)
    with robot_in(tmp_path, row_server.map_url, limits=limits) as robot, robot.events() as events:
        at(robot, 0)
        robot.sync()
        assert held(robot) == list(range(-SIDE, SIDE + 1))
        row_server.stop()
        kept = held(robot)
        commits = 0
        with pytest.raises(UnreachableError) as caught:
            while True:
                robot.replica.commit({cell_key((100 + i, 0, 0)): full_cell(1000 + commits) for i in range(4)})
                commits += 1
                assert used(robot) <= 150_000
                now = held(robot)
                lost = set(kept) - set(now)
                assert not lost or min(map(abs, lost)) >= max(map(abs, now), default=0), (lost, now)
                kept = now
        assert caught.value.kind == "outbox_full"
        assert "disk_bytes_max" in caught.value.message and f"{commits} of them unpushed" in caught.value.message
        assert held(robot) == [] and robot.waiting == commits > 10
        kinds = [type(event) for event in events.take()]
        assert CellsDropped in kinds and kinds.count(OutboxNearlyFull) == 1
        row_server.start()
        robot.sync()
        row_server.wait_for_fold()
        robot.sync()  # what is stable goes
        robot.replica.commit({cell_key((100, 0, 0)): full_cell(5000)})
        assert robot.sync().pushed == 1


def test_a_full_outbox_refuses_and_the_measurement_stays_open(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_client.replica.limits.LEAST_BYTES", 1)
    with robot_in(tmp_path, server.map_url) as robot:
        size_bytes = 0
        map_commit(robot, 1)
        size_bytes = robot.replica.store.data_bytes(robot.replica.commits)
    limit = Limits(outbox_bytes_max=1 << 13)
    with robot_in(tmp_path, server.map_url, name="bat", limits=limit) as bat:
        seeds = []
        with pytest.raises(UnreachableError) as caught:
            for seed in range(10_000):
                bat.observe(scan_of(seed))
                seeds.append(seed)
                bat.commit()
        assert caught.value.kind == "outbox_full" and "outbox_bytes_max" in caught.value.message
        assert bat.waiting == len(seeds) - 1 > (1 << 13) // size_bytes // 2
        bat.sync()
        server.wait_for_fold()
        bat.sync()
        assert bat.commit() is not None  # with the scan that found no room
        assert cells_of(bat.map) == cells_of(_sum(evidence_of(1), evidence_of(*seeds)))


def _sum(*maps: EvidenceMap) -> EvidenceMap:
    total = EvidenceMap(GEOMETRY)
    for each in maps:
        total.merge(each.packed())
    return total


def test_commits_that_are_stable_go_first(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url, limits=Limits(outbox_bytes_max=1 << 16)) as robot:
        far = {cell_key((50, i, 0)): full_cell(i) for i in range(25)}
        robot.replica.commit(far)
        robot.sync()
        server.wait_for_fold()
        # The robot hears that it is stable, and goes on without its cells, before it fetches again.
        header = robot._api.cell_index(MAP, robot.replica.author).header
        robot.replica.take_header(header, asked_by=robot.replica.author)
        robot._rounds._budget.kept = CellCube(centre=(0, 0, 0), radius=1)
        robot.replica.commit(far)
        assert len(robot.replica.commits) == 1
        with pytest.raises(UnreachableError, match="1 of them unpushed"):
            robot.replica.commit(far)


@pytest.mark.parametrize(
    ("limits", "left"), [(Limits(memory_bytes_max=1 << 16), 1), (Limits(disk_bytes_max=76_000), 0)]
)
def test_a_map_too_large_for_the_memory_drops_no_acknowledged_bytes(
    row_server: LiveServer, tmp_path: Path, limits: Limits, left: int
) -> None:
    with robot_in(tmp_path, row_server.map_url, limits=limits) as robot:
        at(robot, 3)
        map_commit(robot, 1)
        robot.sync()
        row_server.wait_for_fold()
        robot.sync()
        robot.sync()
        assert robot._rounds._budget.kept is not None, "a box was chosen"
        assert len(robot.replica.commits) == left


@pytest.mark.slow
def test_acknowledged_commits_that_a_restore_could_lose_stay(server: LiveServer, tmp_path: Path) -> None:
    server.stop()
    server.settings = server.settings.model_copy(update={"stable_after_s": 1e6})
    server.start()
    with robot_in(tmp_path, server.map_url, limits=Limits(outbox_bytes_max=1 << 16)) as robot:
        with pytest.raises(UnreachableError, match="outbox_bytes_max"):
            for n in range(100):
                robot.replica.commit({cell_key((n, i, 0)): full_cell(n) for i in range(8)})
                robot.sync()
                server.wait_for_fold()
                robot.sync()
        assert len(robot.replica.commits) == n


def test_where_not_even_one_cell_fits_the_cause_is_told(row_server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, row_server.map_url, limits=Limits(memory_bytes_max=1 << 16)) as robot:
        at(robot, 0)
        robot.sync()
        robot._rounds._budget._memory_max = 4096
        robot._rounds._budget.kept = CellCube(centre=(5, 0, 0), radius=0)
        at(robot, 5)
        with pytest.raises(BadInputError) as caught:
            robot.sync()
        assert caught.value.kind == "no_room"


def test_limits_that_leave_no_room_are_refused() -> None:
    with pytest.raises(BadInputError):
        Limits(disk_bytes_max=100)
