"""A robot's clock as its server counts: right to the bound of what was learnt, whatever the robot's own time of day."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY
from tests.fixtures.clocks import DAY_S, NOW_S, HandClocks

from cairn_client.http.answer_reading import time_sample
from cairn_client.http.api import MapApi
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.robot import Robot
from cairn_client.robot.server_clock import ERROR_MAX_S, ServerClock, Times
from cairn_client.sync.responses import TimeSample
from cairn_map.epochs.epoch import epoch_of
from cairn_map.wire.messages import CreateMap

EPOCH_S = 120


@contextmanager
def opened(folder: Path, clocks: HandClocks, times: Times = "own") -> Iterator[ServerClock]:
    store = ReplicaStore(folder)
    try:
        yield ServerClock(ReplicaState(store), clocks.of_machine(), times=times)
    finally:
        store.close()


def sample(clocks: HandClocks, server_s: float, error_s: float = 0.0) -> TimeSample:
    return TimeSample(server_s, clocks.since_boot_s(), error_s)


@pytest.fixture
def clocks() -> HandClocks:
    return HandClocks(wall_s=1000.0)


@pytest.fixture
def clock(tmp_path: Path, clocks: HandClocks) -> Iterator[ServerClock]:
    with opened(tmp_path, clocks) as found:
        yield found


def test_without_an_answer_of_the_server_there_is_no_epoch(clock: ServerClock, clocks: HandClocks) -> None:
    assert clock.now_s() is None
    assert clock.epoch_of((clocks.wall_s, clocks.wall_s), EPOCH_S) is None
    assert clock.recorded_time(2.0) is None


def test_a_scan_has_the_servers_time_whatever_the_robots_own(clock: ServerClock, clocks: HandClocks) -> None:
    clock.learn(sample(clocks, NOW_S))
    stamped_s = clocks.wall_s
    clocks.pass_s(500.0)
    assert clock.server_time(stamped_s) == NOW_S and clock.now_s() == NOW_S + 500.0
    assert clock.epoch_of((0.0, clocks.wall_s), EPOCH_S) == epoch_of(NOW_S + 500.0, EPOCH_S)
    assert clock.epoch_of((0.0, clocks.wall_s), None) is None and clock.epoch_of(None, EPOCH_S) is None


@pytest.mark.parametrize("jump_s", [40 * DAY_S, -40 * DAY_S, NOW_S])
def test_scans_before_and_after_a_jump_have_their_times(jump_s: float, clock: ServerClock, clocks: HandClocks) -> None:
    clock.learn(sample(clocks, NOW_S))
    clocks.pass_s(60.0)
    before_s = clocks.wall_s
    clock.look()
    clocks.pass_s(60.0)
    clocks.wall_s += jump_s
    amid_s = clocks.wall_s
    clock.look()
    clocks.pass_s(60.0)
    clocks.wall_s -= jump_s
    after_s = clocks.wall_s
    clock.look()
    clocks.pass_s(60.0)
    found = [clock.server_time(time_s) for time_s in (before_s, amid_s, after_s)]
    assert found == pytest.approx([NOW_S + 60.0, NOW_S + 120.0, NOW_S + 180.0], abs=1e-3)


def test_a_time_that_was_stamped_in_a_jump_that_nobody_saw_is_unknown(clock: ServerClock, clocks: HandClocks) -> None:
    clocks.wall_s = NOW_S
    clock.look()
    clock.learn(sample(clocks, NOW_S))
    assert clock.server_time(NOW_S + 40 * DAY_S) is None
    assert clock.server_time(NOW_S - 40 * DAY_S) == NOW_S - 40 * DAY_S, "old news, as a recording's"


def test_a_recording_keeps_its_own_times_but_none_of_the_future(tmp_path: Path, clocks: HandClocks) -> None:
    with opened(tmp_path, clocks, "recorded") as clock:
        clock.learn(sample(clocks, NOW_S))
        for time_s in (0.0, 5.0, clocks.wall_s, NOW_S):
            assert clock.epoch_of((0.0, time_s), EPOCH_S) == epoch_of(time_s, EPOCH_S)
        assert clock.epoch_of((0.0, NOW_S + 1.0), EPOCH_S) is None


def test_an_offset_counts_until_the_machine_is_booted_and_no_longer(tmp_path: Path, clocks: HandClocks) -> None:
    with opened(tmp_path, clocks) as clock:
        clock.learn(sample(clocks, NOW_S))
    clocks.pass_s(100.0)
    with opened(tmp_path, clocks) as clock:
        assert clock.now_s() == NOW_S + 100.0
    clocks.reboot(wall_s=12.0)
    with opened(tmp_path, clocks) as clock:
        assert clock.now_s() is None and clock.server_time(clocks.wall_s) is None
        clock.learn(sample(clocks, NOW_S + 200.0))
        assert clock.server_time(clocks.wall_s) == NOW_S + 200.0
    nameless = HandClocks(boot="")
    for _ in range(2):
        with opened(tmp_path / "nameless", nameless) as clock:
            assert clock.now_s() is None
            clock.learn(sample(nameless, NOW_S))


def test_a_slow_answer_corrects_nothing_unless_it_contradicts(clock: ServerClock, clocks: HandClocks) -> None:
    clock.learn(sample(clocks, NOW_S, 0.1))
    clock.learn(sample(clocks, NOW_S + 4.0, 5.0))
    assert clock.now_s() == NOW_S
    clock.learn(sample(clocks, NOW_S + 40.0, 5.0))
    assert clock.now_s() == NOW_S + 40.0
    clock.learn(sample(clocks, NOW_S + 9000.0, ERROR_MAX_S + 1))
    clock.learn(None)
    assert clock.now_s() == NOW_S + 40.0


WALL_STEPS = st.lists(st.tuples(st.sampled_from(["pass", "jump", "scan", "learn"]), st.floats(-1, 1)), max_size=40)


@given(steps=WALL_STEPS)
def test_no_scan_is_dated_later_than_it_was_taken(
    steps: list[tuple[str, float]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    clocks = HandClocks(wall_s=NOW_S)
    right_s, error_s = NOW_S, 0.0
    with opened(tmp_path_factory.mktemp("robot"), clocks) as clock:
        scans: list[tuple[float, float]] = []
        for what, amount in steps:
            if what == "pass":
                clocks.pass_s(abs(amount) * 1000)
                right_s += abs(amount) * 1000
            elif what == "jump":
                clocks.wall_s += amount * 100 * DAY_S
            elif what == "scan":
                clock.look()
                scans.append((clocks.wall_s, right_s))
            else:
                error_s = max(error_s, abs(amount))
                clock.learn(sample(clocks, right_s + amount, abs(amount)))
            for stamped_s, taken_s in scans:
                found_s = clock.server_time(stamped_s)
                # Of two times at which the clock said the same the earlier one is taken.
                assert found_s is None or found_s <= taken_s + error_s + 3.0


def test_a_robot_learns_the_servers_time_by_registering_and_by_each_sync(server: LiveServer, tmp_path: Path) -> None:
    with MapApi(server.url) as api:
        api.create_map("epochs", CreateMap(geometry=GEOMETRY, epoch_s=600))
    clocks = HandClocks(wall_s=12.0)
    options = {"directory": tmp_path / "eye", "name": "eye", "clocks": clocks.of_machine()}
    with Robot(None, f"{server.url}/maps/epochs", **options) as eye:
        before_s = time.time()
        assert eye._clock.now_s() is None
        eye.sync()
        assert before_s - 0.001 <= (eye._clock.server_time(12.0) or 0.0) <= time.time() + 0.001
        clocks.pass_s(1e6)
        eye.sync()
        assert before_s - 0.001 <= (eye._clock.now_s() or 0.0) <= time.time() + 0.001, "the server did not age with it"


@pytest.mark.parametrize(
    ("headers", "is_taken"),
    [
        ({"Cairn-Time": "1800000000.5"}, True),
        ({"Cairn-Time": "1800000000"}, True),
        ({}, False),
        ({"Cairn-Time": "1800000000.5", "Age": "3600"}, False),
        ({"Cairn-Time": "1e9"}, False),
        ({"Cairn-Time": "nan"}, False),
        ({"Cairn-Time": "-5"}, False),
        ({"Cairn-Time": "9" * 400}, False),
    ],
)
def test_the_time_of_an_answer_is_that_of_its_middle_and_of_a_cached_one_none(
    headers: dict[str, str], is_taken: bool
) -> None:
    found = time_sample(headers, asked_s=10.0, answered_s=12.0)
    assert (found is not None) == is_taken
    if found is not None:
        assert (found.server_s, found.steady_s, found.error_s) == (float(headers["Cairn-Time"]), 11.0, 1.0)
