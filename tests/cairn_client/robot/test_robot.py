"""A robot as its user sees it: with and without a server, killed, and in the wrong folder."""

import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, cells_of, opened
from tests.fixtures.client.robot_program import RIG, scan_of
from tests.fixtures.client.robots import ADMIN, NOWHERE, TOKEN, evidence_of, map_commit, robot_in
from tests.fixtures.client.world import stored_commits

from cairn_client.http.api import MapApi
from cairn_client.http.backoff import RETRY_AFTER_MAX_S, Backoff
from cairn_client.http.map_url import split_map_url
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import Profile
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, DeniedError, UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.occupancy_states import State
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import CreateMap

Until = Callable[[Callable[[], bool]], None]


def test_without_a_server_a_robot_maps_on_and_forgets_nothing(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        map_commit(robot, 1, 2)
        map_commit(robot, 3)
        with pytest.raises(UnreachableError):
            robot.sync()
        assert cells_of(robot.map) == cells_of(evidence_of(1, 2, 3))
    with robot_in(tmp_path) as robot:
        assert cells_of(robot.map) == cells_of(evidence_of(1, 2, 3))
        assert robot.waiting == 2


def test_a_robot_asks_its_map_without_a_server_and_its_snapshot_stays(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        assert len(robot.snapshot().voxels_in()) == 0
        map_commit(robot, 1)
        first = robot.snapshot()
        occupied = first.occupied_in()
        assert len(occupied) > 0
        assert (first.state_at(occupied.centres_m) == State.OCCUPIED).all()
        assert first.nearest_occupied(occupied.centres_m, radius_m=1).distance_m.tolist() == [0] * len(occupied)
        counts = first.counts_at(occupied.centres_m).tolist()
        map_commit(robot, 1)
        assert first.counts_at(occupied.centres_m).tolist() == counts
        assert robot.snapshot().counts_at(occupied.centres_m).tolist() == (2 * np.array(counts)).tolist()
        wary = SensorModel(p_occupied=0.9)
        assert robot.snapshot(wary).model == wary
        assert len(robot.snapshot(wary).occupied_in()) < len(robot.snapshot().occupied_in())


@pytest.mark.slow
def test_a_snapshot_is_taken_and_asked_while_another_thread_syncs(server: LiveServer, tmp_path: Path) -> None:
    with (
        robot_in(tmp_path, server.map_url) as mole,
        robot_in(tmp_path, server.map_url, name="bat") as bat,
        ThreadPoolExecutor(1) as asking,
    ):
        mole.start_sync(every_s=0.01)
        done = threading.Event()

        def ask() -> int:
            asked = 0
            while not done.is_set():
                snapshot = mole.snapshot()
                voxels = snapshot.voxels_in()
                assert snapshot.counts_at(voxels.centres_m).tolist() == voxels.counts.tolist()
                asked += 1
            return asked

        asked = asking.submit(ask)
        try:
            for seed in range(1, 7):
                map_commit(bat, seed)
                bat.sync()
                map_commit(mole, seed)
        finally:
            done.set()
        assert asked.result() > 0


@pytest.mark.slow
def test_two_robots_share_a_map(server: LiveServer, tmp_path: Path) -> None:
    with (
        robot_in(tmp_path, server.map_url) as mole,
        robot_in(tmp_path, server.map_url, name="bat", mode="low-end") as bat,
    ):
        map_commit(mole, 1)
        map_commit(bat, 2)
        for robot in (mole, bat):
            assert robot.sync().pushed == 1
        server.wait_for_fold()
        for robot in (mole, bat):
            robot.sync()
            assert cells_of(robot.map) == cells_of(evidence_of(1, 2))


@pytest.mark.slow
def test_a_small_commit_says_the_same_in_fewer_bytes(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as mole, robot_in(tmp_path, name="bat") as bat:
        commits = []
        for robot, profile in ((mole, Profile.SMALL), (bat, Profile.FAST)):
            for seed in range(1, 6):
                robot.observe(scan_of(seed))
            commits.append(robot.commit(profile=profile))
        small, fast = commits
        assert small is not None
        assert fast is not None
        assert len(small.data) < 0.9 * len(fast.data)
        assert mole.sync().pushed == 1
    server.wait_for_fold()
    with robot_in(tmp_path, server.map_url, name="owl") as owl:
        owl.sync()
        assert cells_of(owl.map) == cells_of(evidence_of(*range(1, 6)))


def test_a_viewer_sees_and_does_not_push(server: LiveServer, tmp_path: Path) -> None:
    with (
        robot_in(tmp_path, server.map_url) as mole,
        robot_in(tmp_path, server.map_url, name="eye", mode="viewer") as eye,
    ):
        map_commit(mole, 1)
        map_commit(eye, 2)
        mole.sync()
        server.wait_for_fold()
        assert eye.sync().pushed == 0
        assert cells_of(eye.map) == cells_of(evidence_of(1, 2))
        mole.sync()
        assert cells_of(mole.map) == cells_of(evidence_of(1))


def test_the_geometry_comes_from_the_server_once(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url, geometry=None) as robot:
        assert robot.replica.geometry == GEOMETRY
    with robot_in(tmp_path, geometry=None) as robot:
        assert robot.replica.geometry == GEOMETRY
    with pytest.raises(UnreachableError):
        robot_in(tmp_path, name="new", geometry=None)


def test_closing_pushes_what_waits_even_if_the_robot_never_synced(server: LiveServer, tmp_path: Path) -> None:
    robot = robot_in(tmp_path, server.map_url)
    robot.observe(scan_of(1))
    robot.close()
    robot.close()
    server.wait_for_fold()
    assert len(stored_commits(tmp_path / "server")) == 1


def test_the_background_thread_syncs_after_a_commit_and_stops(server: LiveServer, tmp_path: Path, until: Until) -> None:
    robot = robot_in(tmp_path, server.map_url)
    robot.start_sync(every_s=1000)
    robot.start_sync(every_s=1000)
    for seed in (1, 2, 3):
        map_commit(robot, seed)
        until(lambda: not robot.waiting)
    robot.close()
    assert len(stored_commits(tmp_path / "server")) == 3


def test_the_background_thread_fetches_without_a_commit(server: LiveServer, tmp_path: Path, until: Until) -> None:
    with robot_in(tmp_path, server.map_url, name="fox") as fox, robot_in(tmp_path, server.map_url) as mole:
        fox.start_sync(every_s=0.02)
        map_commit(mole, 4)
        mole.sync()
        until(lambda: cells_of(fox.map) == cells_of(evidence_of(4)))


def test_the_background_thread_survives_a_server_that_goes_and_comes_back(
    server: LiveServer, tmp_path: Path, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Backoff, "next_s", lambda self, wish: 0.01)
    with robot_in(tmp_path, server.map_url) as robot:
        robot.start_sync(every_s=0.01)
        map_commit(robot, 1)
        until(lambda: not robot.waiting)
        server.stop()
        map_commit(robot, 2)
        assert robot.waiting == 1
        server.start()
        until(lambda: not robot.waiting)


def test_a_robot_can_take_its_first_commit_back(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        map_commit(robot, 1)
        (first,) = robot.replica.commits
        robot.observe(scan_of(2))
        robot.commit(retracts=(first,))
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        assert cells_of(robot.map) == cells_of(evidence_of(2))


def test_a_robot_without_a_rig_can_take_a_commit_back(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        map_commit(robot, 1)
        (first,) = robot.replica.commits
    with Robot(None, server.map_url, directory=tmp_path / "mole", name="mole") as robot:
        with pytest.raises(BadInputError):
            robot.observe(scan_of(1))
        assert robot.commit() is None
        assert robot.commit(retracts=(first,)) is not None
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        assert cells_of(robot.map) == {}


def test_a_scan_that_shows_nothing_is_no_commit(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        blind = scan_of(1)
        blind.range_m[:] = np.nan
        robot.observe(blind)
        assert robot.commit() is None
        assert robot.commit() is None
        assert robot.waiting == 0


def test_a_note_that_is_too_long_is_refused_and_the_measurement_stays_open(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        robot.observe(scan_of(1))
        with pytest.raises(BadInputError):
            robot.commit(note="x" * 2000)
        assert robot.commit() is not None


def test_a_commit_that_the_server_refuses_does_not_hold_up_the_others(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        refused = map_commit(robot, 1)
        map_commit(robot, 2)
        push = robot._api.push

        def picky(name: str, commit: object, **options: object) -> object:
            if str(commit.id) == refused:  # type: ignore[attr-defined]
                raise BadInputError("too_much_evidence", "no")
            return push(name, commit)  # type: ignore[arg-type]

        robot._api.push = picky  # type: ignore[assignment, method-assign]
        report = robot.sync()
        assert (report.pushed, [str(commit) for commit in report.refused]) == (1, [refused])
        assert robot.waiting == 1


# Tokens


@pytest.fixture
def guarded(server: LiveServer) -> Iterator[LiveServer]:
    server.stop()
    server.settings = server.settings.model_copy(update={"admin_token": ADMIN, "enrolment_token": TOKEN})
    server.start()
    yield server


def test_a_robot_registers_with_an_enrolment_token(guarded: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, guarded.map_url, token="not-the-enrolment-token") as robot, pytest.raises(DeniedError):
        robot.sync()
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        map_commit(robot, 1)
        assert robot.sync().pushed == 1
    with robot_in(tmp_path, guarded.map_url) as robot:  # its own token is in the folder
        robot.sync()


def test_a_robot_works_with_a_token_of_its_own_that_an_admin_gave_it(guarded: LiveServer, tmp_path: Path) -> None:
    with MapApi(guarded.url, token=ADMIN) as admin:
        own, other = (
            admin.create_token(name, CreateToken(role="robot", map=MAP, robot=name)).token for name in ("mole", "bat")
        )
    with robot_in(tmp_path, guarded.map_url, token=other) as robot, pytest.raises(DeniedError, match="admin rights"):
        robot.sync()
    with robot_in(tmp_path, guarded.map_url, token=own) as robot:
        map_commit(robot, 1)
        assert robot.sync().pushed == 1
        guarded.wait_for_fold()
        robot.sync()
        assert cells_of(robot.map) == cells_of(evidence_of(1))
    with robot_in(tmp_path, guarded.map_url, token=TOKEN) as robot:  # and may be enrolled all the same
        robot.sync()
        assert robot.replica.state.token not in (None, own)


def test_a_robot_that_left_the_map_comes_back_when_it_syncs(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot, MapApi(server.url) as api:
        robot.sync()
        assert [branch.branch for branch in api.branches(MAP)] == ["mole"]
        robot.deregister()
        assert api.branches(MAP) == []
        robot.sync()
        assert [branch.branch for branch in api.branches(MAP)] == ["mole"]


# Folders and names


def test_a_folder_of_another_robot_is_refused(tmp_path: Path) -> None:
    robot_in(tmp_path).close()
    with pytest.raises(BadInputError, match="another robot"):
        Robot(RIG, NOWHERE, directory=tmp_path / "mole", name="fox", geometry=GEOMETRY)


def test_a_folder_of_another_map_is_refused(tmp_path: Path) -> None:
    robot_in(tmp_path).close()
    with pytest.raises(BadInputError, match="another map"):
        robot_in(tmp_path, "http://127.0.0.1:9/maps/cellar")


def test_a_folder_of_another_grid_is_refused(tmp_path: Path) -> None:
    robot_in(tmp_path).close()
    with pytest.raises(BadInputError, match="another geometry"):
        robot_in(tmp_path, geometry=GEOMETRY.model_copy(update={"depth": 4}))
    robot_in(tmp_path).close()  # the failure left nothing open


def test_a_map_of_another_grid_is_refused(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url, geometry=GEOMETRY.model_copy(update={"depth": 4})) as robot:
        with pytest.raises(BadInputError) as caught:
            robot.sync()
        assert caught.value.kind == "other_geometry"


def test_a_folder_that_is_open_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cairn_client.replica.replica_store.BUSY_MS", 1)
    with robot_in(tmp_path):
        with pytest.raises(ConflictError) as caught:
            robot_in(tmp_path)
        assert caught.value.kind == "folder_in_use"


def test_a_file_that_is_no_store_is_said_to_be_damaged(tmp_path: Path) -> None:
    (tmp_path / "mole").mkdir()
    (tmp_path / "mole/robot.sqlite").write_bytes(b"no such thing" * 1000)
    with pytest.raises(DamagedDataError):
        robot_in(tmp_path)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mole").write_text("a file")
    with pytest.raises(BadInputError):
        robot_in(tmp_path)


def test_a_store_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    replica = opened(tmp_path / "mole")
    replica.store._connection.execute("PRAGMA user_version = 99")
    replica.close()
    with pytest.raises(BadInputError) as caught:
        robot_in(tmp_path)
    assert caught.value.kind == "store_version"


@pytest.mark.parametrize(
    "url",
    ["", "base:8750/maps/lab", "ftp://base/maps/lab", "http://base", "http://base/maps/", "http://base/maps/a/b",
     "http:///maps/lab", "http://base/maps/LAB", "http://base/lab"],
)  # fmt: skip
def test_a_bad_url_is_refused_with_the_right_form(tmp_path: Path, url: str) -> None:
    with pytest.raises(BadInputError, match=r"http://HOST:PORT/maps/NAME|a map's name is"):
        robot_in(tmp_path, url)


@pytest.mark.parametrize("url", ["http://base:99999/maps/lab", "http://[::1/maps/lab", "http://base:x/maps/lab"])
def test_a_url_that_cannot_be_parsed_is_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(BadInputError):
        robot_in(tmp_path, url)


def test_a_url_may_have_a_path_before_the_maps() -> None:
    assert split_map_url("https://base.example/robots/maps/lab/") == ("https://base.example/robots", "lab")


# Waiting


def test_waits_grow_and_start_anew_after_a_success() -> None:
    backoff = Backoff(first_s=1.0, last_s=8.0)
    waits = [backoff.next_s(None) for _ in range(10)]
    assert all(0.1 * top <= wait <= top for wait, top in zip(waits, [1, 2, 4, 8, 8, 8, 8, 8, 8, 8], strict=True))
    backoff.reset()
    assert backoff.next_s(None) <= 1.0


def test_the_server_is_not_asked_before_it_wishes_but_within_an_hour() -> None:
    assert Backoff().next_s(100.0) == 100.0
    assert Backoff().next_s(float("inf")) == RETRY_AFTER_MAX_S


# Power cuts


@pytest.mark.processes
def test_a_killed_robot_loses_nothing_that_it_committed_and_counts_nothing_twice(
    server: LiveServer, tmp_path: Path
) -> None:
    moments = random.Random(7)
    told: set[str] = set()
    for run in range(3):
        command = [
            sys.executable,
            "-m",
            "tests.fixtures.client.robot_program",
            server.map_url,
            str(tmp_path / "mole"),
            str(run),
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for _ in range(moments.randrange(1, 12)):
                word, *rest = process.stdout.readline().split()
                told |= set(rest) if word == "committed" else set()
            os.kill(process.pid, signal.SIGKILL)
            told |= {
                line.split()[1] for line in process.stdout if line.startswith("committed ") and line.endswith("\n")
            }
    with robot_in(tmp_path, server.map_url) as robot:
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        stored = stored_commits(tmp_path / "server")
        assert told
        assert told <= {str(commit) for commit in stored}
        seeds = [int(seed) for note, _ in stored.values() for seed in note.split()]
        assert len(set(seeds)) == len(seeds)
        assert cells_of(robot.map) == cells_of(evidence_of(*seeds))


# The map's own sensor model


def test_a_snapshot_is_read_under_the_model_that_the_map_was_made_with(server: LiveServer, tmp_path: Path) -> None:
    wary = SensorModel(p_occupied=0.9, p_max=0.99)
    with MapApi(server.url) as api:
        api.create_map("wary", CreateMap(geometry=GEOMETRY, sensor_model=wary))
    url = f"{server.url}/maps/wary"
    with robot_in(tmp_path, url) as robot:  # the grid is given: it hears of the model when it registers
        assert robot.snapshot().model == SensorModel()
        robot.sync()
        assert robot.snapshot().model == wary
    with robot_in(tmp_path, url, name="fox", geometry=None) as robot:  # it asks for the grid
        assert robot.snapshot().model == wary
        map_commit(robot, 1)
        assert robot.snapshot(SensorModel()).model == SensorModel()
    server.stop()
    with robot_in(tmp_path, url) as robot:
        assert robot.snapshot().model == wary
