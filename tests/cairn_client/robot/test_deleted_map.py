"""A robot whose map was deleted keeps all that it has, says so, and goes on elsewhere by a person's word alone."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP
from tests.fixtures.client.robots import ADMIN, TOKEN, map_commit, robot_in

from cairn_client.http.api import MapApi
from cairn_client.robot import rounds
from cairn_client.robot.robot import Robot
from cairn_client.robot.robot_events import SyncFailed
from cairn_map.commits.ids import CommitId
from cairn_map.errors import NotFoundError
from cairn_map.wire.messages import CreateMap, Mode
from cairn_server.operations.serve import main as serve


@pytest.fixture(params=["guarded", "open"])
def place(server: LiveServer, request: pytest.FixtureRequest) -> Iterator[LiveServer]:
    """A server that wants tokens, and one that wants none."""
    if request.param == "guarded":
        server.stop()
        server.settings = server.settings.model_copy(update={"admin_token": ADMIN, "enrolment_token": TOKEN})
        server.start()
    yield server


@pytest.fixture
def admin(place: LiveServer) -> Iterator[MapApi]:
    with MapApi(place.url, token=place.settings.admin_token) as api:
        yield api


def robot_at(place: LiveServer, folder: Path, mode: Mode = "high-end") -> Robot:
    return robot_in(folder, place.map_url, token=place.settings.enrolment_token, mode=mode, stay=True)


def kept_in(robot: Robot) -> dict[CommitId, bytes]:
    """Commits whose bytes are in a robot's folder."""
    replica = robot.replica
    found = {entry.id: replica.kept_commit(entry.id) for entry in replica.outbox}
    return {commit: kept.data for commit, kept in found.items() if kept is not None}


def refusal(robot: Robot) -> NotFoundError:
    with pytest.raises(NotFoundError) as refused:
        robot.sync()
    assert refused.value.kind == "gone"
    return refused.value


@pytest.mark.parametrize("mode", ["high-end", "low-end"])
def test_a_robot_loses_nothing_with_its_map_and_makes_none(
    place: LiveServer, admin: MapApi, tmp_path: Path, mode: Mode
) -> None:
    with robot_at(place, tmp_path, mode) as robot:
        map_commit(robot, 1)
        robot.sync()
        place.wait_for_fold()
        robot.sync()
        map_commit(robot, 2)
        held, cells, token = kept_in(robot), robot.map.digest(), robot.replica.state.token
        admin.delete_map(MAP)
        for _ in range(2):
            said = refusal(robot).message
            assert f"map {MAP} was deleted on 20" in said and "cairn map robots admit" in said
        assert (kept_in(robot), robot.map.digest(), robot.waiting) == (held, cells, 1)
        assert robot.replica.state.token == token
        assert admin.maps() == []
        map_commit(robot, 3)  # it maps on
    with robot_at(place, tmp_path, mode) as robot:  # and after a restart, too
        assert robot.waiting == 2
        refusal(robot)
        assert kept_in(robot).items() >= held.items() and len(kept_in(robot)) == len(held) + 1


def test_a_robot_joins_a_new_map_of_the_name_once_an_operator_lets_it_in(
    place: LiveServer, admin: MapApi, tmp_path: Path
) -> None:
    with robot_at(place, tmp_path) as robot:
        map_commit(robot, 1)
        robot.sync()
        place.wait_for_fold()
        robot.sync()
        map_commit(robot, 2)
        cells = robot.map.digest()
        admin.delete_map(MAP)
        admin.create_map(MAP, CreateMap(geometry=GEOMETRY))
        refusal(robot)
        assert admin.map_info(MAP).commits == 0
        admin.admit(MAP, robot.replica.author)
        robot.sync(until_folded=True)
        assert robot.map.digest() == cells
        assert admin.map_info(MAP).commits == 2
        row = place.service.store.map(MAP)
        place.wait_for_fold()
        assert [branch.branch for branch in admin.branches(MAP)] == ["mole"]
        with place.service.store.snapshot(row) as snapshot:
            assert robot.replica.header is not None
            assert robot.replica.header.to_cursor.log_id == snapshot.head.log_id


def test_a_robot_goes_on_where_it_was_once_its_map_is_brought_back(
    place: LiveServer, admin: MapApi, tmp_path: Path
) -> None:
    data, file = str(place.settings.folder), str(tmp_path / "lab.cairn")
    with robot_at(place, tmp_path) as robot:
        map_commit(robot, 1)
        robot.sync()
        place.wait_for_fold()
        robot.sync()
        map_commit(robot, 2)
        serve(["archive", MAP, file, "--data", data])
        admin.delete_map(MAP)
        refusal(robot)
        place.stop()
        serve(["unarchive", file, "--data", data])
        place.start()
        header = robot.replica.header
        assert header is not None
        report = robot.sync(until_folded=True)
        assert (report.refused, robot.waiting) == ({}, 0)
        row = place.service.store.map(MAP)
        with place.service.store.snapshot(row) as snapshot:
            assert snapshot.head.log_id == header.to_cursor.log_id  # the same log: its cursor is proven
            assert snapshot.head.seq == header.to_cursor.seq + 1
        assert admin.map_info(MAP).commits == 2


def test_a_robot_asks_once_an_hour_and_its_events_say_why(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    wait = rounds.SyncThread._wait

    def note(thread: rounds.SyncThread, exc: NotFoundError, wait_s: float) -> None:
        waits.append(wait_s)
        wait(thread, exc, wait_s)

    monkeypatch.setattr(rounds.SyncThread, "_wait", note)
    with robot_in(tmp_path, server.map_url, stay=True) as robot, robot.events() as events:
        robot.sync()
        with MapApi(server.url) as api:
            api.delete_map(MAP)
        robot.start_sync(every_s=0.01)
        failed = next(event for event in iter(events) if isinstance(event, SyncFailed))
        assert (failed.kind, failed.again_s, waits) == ("gone", rounds.GONE_S, [rounds.GONE_S])
        map_commit(robot, 1)  # wakes nothing
        assert waits == [rounds.GONE_S]
    assert waits == [rounds.GONE_S]
