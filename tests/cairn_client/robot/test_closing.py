"""Closing of a robot: what waits is pushed, it leaves the map if it may come back, and nothing holds it up for long."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, cells_of
from tests.fixtures.client.robot_program import RIG, scan_of
from tests.fixtures.client.robots import ADMIN, NOWHERE, TOKEN, evidence_of, map_commit, robot_in
from tests.fixtures.client.world import stored_commits

from cairn_client.http.api import MapApi
from cairn_client.http.backoff import Backoff
from cairn_client.robot.robot import Robot
from cairn_map.errors import BadInputError, DeniedError, UnreachableError
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.access_messages import CreateToken

Until = Callable[[Callable[[], bool]], None]
SOON_S = 8.0
"""Two seconds for the round, some for a busy machine; far less than the half minute of a silent server."""


def robots_on(server: LiveServer, token: str | None = None) -> list[str]:
    with MapApi(server.url, token=token) as api:
        return [branch.branch for branch in api.branches(MAP)]


@pytest.fixture
def guarded(server: LiveServer) -> Iterator[LiveServer]:
    server.stop()
    server.settings = server.settings.model_copy(update={"admin_token": ADMIN, "enrolment_token": TOKEN})
    server.start()
    yield server


# Leaving the map


def test_a_robot_that_is_closed_pushes_and_leaves_the_map(server: LiveServer, tmp_path: Path) -> None:
    for seed in (1, 2):  # and comes back
        with robot_in(tmp_path, server.map_url) as robot:
            robot.sync()
            assert robots_on(server) == ["mole"]
            map_commit(robot, seed)
        assert robots_on(server) == []
        assert len(stored_commits(tmp_path / "server")) == seed


def test_a_robot_that_pauses_stays_on_the_map(server: LiveServer, tmp_path: Path) -> None:
    robot = robot_in(tmp_path, server.map_url)
    robot.sync()
    robot.close(stay=True)
    assert robots_on(server) == ["mole"]
    with robot_in(tmp_path, server.map_url, stay=True) as robot:
        map_commit(robot, 1)
    assert robots_on(server) == ["mole"]
    assert len(stored_commits(tmp_path / "server")) == 1


def test_a_robot_whose_commits_still_wait_stays_on_the_map(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        robot.sync()
        map_commit(robot, 1)
        server.stop()
    server.start()
    assert robots_on(server) == ["mole"]
    with robot_in(tmp_path, server.map_url) as robot:
        assert robot.waiting == 1
    assert robots_on(server) == []


def test_a_robot_that_never_met_its_server_closes_without_a_word(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        sent = robot._api
        map_commit(robot, 1)
    assert sent.traffic.up_bytes == 0


def test_a_robot_with_an_admins_token_stays_and_its_token_still_counts(guarded: LiveServer, tmp_path: Path) -> None:
    with MapApi(guarded.url, token=ADMIN) as admin:
        own = admin.create_token("mole", CreateToken(role="robot", map=MAP, robot="mole")).token
    for seed in (1, 2):
        with robot_in(tmp_path, guarded.map_url, token=own) as robot:
            map_commit(robot, seed)
            assert robot.sync().pushed == 1


def test_a_robot_leaves_only_if_it_could_register_again(guarded: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        robot.sync()
    with robot_in(tmp_path, guarded.map_url) as robot:  # it has nothing but the token in its folder
        robot.sync()
    assert robots_on(guarded, ADMIN) == ["mole"]
    with robot_in(tmp_path, guarded.map_url, token=TOKEN) as robot:
        robot.sync()
    assert robots_on(guarded, ADMIN) == []
    with robot_in(tmp_path, guarded.map_url) as robot, pytest.raises(DeniedError):
        robot.sync()


def test_where_the_last_commit_is_refused_those_before_it_are_pushed(server: LiveServer, tmp_path: Path) -> None:
    robot = robot_in(tmp_path, server.map_url)
    map_commit(robot, 1)
    robot.observe(scan_of(2))

    class Full:
        def admit_cell(self, key: CellKey, size_bytes: int) -> None:
            """There is room for cells."""

        def make_room(self, size_bytes: int) -> None:
            raise UnreachableError("outbox_full", "no room")

    robot.replica.obey(Full())
    with pytest.raises(UnreachableError, match="no room"):
        robot.close()
    assert len(stored_commits(tmp_path / "server")) == 1
    assert robots_on(server) == ["mole"]
    robot.close()


def test_a_robot_that_cannot_be_opened_leaves_its_folder_to_the_next(tmp_path: Path) -> None:
    (tmp_path / "mole").mkdir()
    (tmp_path / "mole" / "carried").write_text("a file")
    with pytest.raises(BadInputError, match="carried"):
        robot_in(tmp_path, carry_bytes_max=1000)
    with robot_in(tmp_path) as robot:
        assert robot.waiting == 0


# In time


def closed_in_s(robot: object, **options: float) -> float:
    start_s = time.monotonic()
    robot.close(**options)  # type: ignore[attr-defined]
    return time.monotonic() - start_s


def test_a_wait_for_the_next_try_does_not_hold_up_the_end(
    tmp_path: Path, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    monkeypatch.setattr(Backoff, "next_s", lambda self, wish: waits.append(1000.0) or waits[-1])
    robot = robot_in(tmp_path, NOWHERE)
    robot.start_sync()
    map_commit(robot, 1)
    until(lambda: bool(waits))
    assert closed_in_s(robot) < SOON_S
    with robot_in(tmp_path) as robot:
        assert robot.waiting == 1


class Silent:
    """A server that takes connections, and whatever comes, and never says a word."""

    def __init__(self, *, reads: bool) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/maps/{MAP}"
        self.taken: list[socket.socket] = []
        self.heard = threading.Event()
        """A request came, so that its sender waits for the answer."""
        self._reads = reads
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                self.taken.append(self._listener.accept()[0])
            except OSError:
                return
            if self._reads:
                self.taken[-1].recv(1 << 16)
                self.heard.set()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        for each in (self._listener, *self.taken):
            each.close()
        self._thread.join()


@pytest.mark.slow
@pytest.mark.parametrize("reads", [True, False])
def test_a_transfer_that_hangs_is_cut(tmp_path: Path, until: Until, reads: bool) -> None:
    silent = Silent(reads=reads)
    try:
        robot = robot_in(tmp_path, silent.url)
        robot.start_sync()
        map_commit(robot, 1)
        until(lambda: bool(silent.taken))
        assert closed_in_s(robot, flush_s=0.5) < SOON_S
    finally:
        silent.close()
    with robot_in(tmp_path) as robot:
        assert robot.waiting == 1


def test_what_hangs_is_cut_by_another_thread_and_can_be_asked_again(server: LiveServer) -> None:
    silent = Silent(reads=True)
    errors: list[UnreachableError] = []
    with MapApi(silent.url.partition("/maps/")[0]) as api:

        def ask() -> None:
            try:
                api.maps()
            except UnreachableError as exc:
                errors.append(exc)

        asking = threading.Thread(target=ask)
        asking.start()
        assert silent.heard.wait(SOON_S)
        api.sockets.cut()
        asking.join(SOON_S)
        assert [error.kind for error in errors] == ["no_link"]
        ask()
        assert errors[1].kind == "interrupted"
    silent.close()
    with MapApi(server.url) as api:
        assert len(api.maps()) == 1
        api.sockets.cut()
        api.sockets.mend()
        assert len(api.maps()) == 1


# Errors of the robot's own program


def test_an_error_in_the_block_discards_the_open_measurement_and_keeps_the_commits(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), robot_in(tmp_path) as robot:
        map_commit(robot, 1)
        robot.observe(scan_of(2))
        raise ZeroDivisionError
    with robot_in(tmp_path) as robot:
        assert robot.waiting == 1
        assert cells_of(robot.map) == cells_of(evidence_of(1))


def test_a_signal_in_the_block_commits_the_open_measurement(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), robot_in(tmp_path) as robot:
        robot.observe(scan_of(2))
        raise KeyboardInterrupt
    with robot_in(tmp_path) as robot:
        assert cells_of(robot.map) == cells_of(evidence_of(2))


@pytest.mark.parametrize(
    "use",
    [
        lambda robot: robot.observe(scan_of(1)),
        lambda robot: robot.commit(),
        lambda robot: robot.sync(),
        lambda robot: robot.start_sync(),
        lambda robot: robot.deregister(),
        lambda robot: robot.mount(RIG),
        lambda robot: robot.amend_all({}),
        lambda robot: robot.align([scan_of(1)], T_map_robot=np.eye(4)),
    ],
)
def test_a_closed_robot_says_that_it_is_closed(tmp_path: Path, use: Callable[[Robot], object]) -> None:
    robot = robot_in(tmp_path)
    robot.close()
    with pytest.raises(BadInputError, match="robot mole is closed") as caught:
        use(robot)
    assert caught.value.kind == "robot_closed"


def test_a_mode_that_is_none_and_a_path_as_rig_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"high-end, low-end, viewer; got 'lowend'"):
        robot_in(tmp_path, mode="lowend")
    path: Any = tmp_path / "rig.json"
    with pytest.raises(BadInputError, match=r"got \w*Path: cairn\.load_rig"):
        Robot(path, NOWHERE, directory=tmp_path / "mole", name="mole")
    assert not (tmp_path / "mole").exists()
