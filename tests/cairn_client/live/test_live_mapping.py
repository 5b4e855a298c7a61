"""Live mapping without a door: newest wins on a slow machine, every image is accounted for, and rest is committed."""

import time
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import pytest
from tests.fixtures.client.live_run import GRID, MAKE, MAPPING, NOWHERE, Clock
from tests.fixtures.fusion.drive_mapping import TOPICS
from tests.fixtures.fusion.live_drive import bag_message, drive

from cairn_calib.rig.rig import Rig
from cairn_client.live.live_mapping import REST_S, LiveMapping
from cairn_client.replica.limits import Limits
from cairn_client.robot.robot import Robot
from cairn_client.sync.responses import TimeSample
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.ros.bag import BagMessage
from cairn_fusion.ros.live_scans import Cause, LiveScans, ReadyScan
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import Geometry

DRIVE = drive(MAKE, scans=100)


class Driven:
    """A live robot whose messages and time a test gives."""

    def __init__(
        self, rig: Rig, folder: Path, gate: ScanGate, *, layer: MapLayer | Geometry = GRID, limits: Limits | None = None
    ) -> None:
        self.clock = Clock()
        self.scans = LiveScans("drive", MAPPING, TOPICS)
        self.robot = Robot(rig, NOWHERE, directory=folder, name="mole", geometry=layer, limits=limits, stay=True)
        decoder = ScanDecoder("drive", MAPPING, rig, TOPICS)
        self.live = LiveMapping(self.robot, self.scans, decoder, gate, steady_s=self.clock)

    def step(self, messages: list[BagMessage]) -> None:
        self.live.step(messages)
        self.check_account()

    def check_account(self) -> None:
        """Every range image is somewhere."""
        live = self.live
        known = live.taken + live.not_moved + live.dropped + self.scans.left_out.total() + live.waiting
        assert self.scans.arrived.total() == known


@pytest.fixture
def driven(rig: Rig, tmp_path: Path) -> Iterator[Driven]:
    found = Driven(rig, tmp_path / "mole", ScanGate(None))
    yield found
    found.robot.close()


def chunks_of(seconds: float) -> Iterator[list[BagMessage]]:
    """The drive's messages in order of their stamps, so many seconds of it at a time."""

    def chunk_of(message: BagMessage) -> int:
        return int((message.log_ns / 1e9 - DRIVE[0][0]) / seconds)

    for _, messages in groupby(map(bag_message, DRIVE), chunk_of):
        yield list(messages)


def test_a_robot_slower_than_its_cameras_maps_the_newest_and_counts_the_rest(driven: Driven) -> None:
    ages_s = []
    for messages in chunks_of(1 / 3):  # one scan in the time of three or four
        driven.clock.now_s += 1 / 3
        driven.step(messages)
        if driven.live.taken:
            ages_s.append(driven.scans.last_s - driven.live.newest_s)
    # With its own mapping, a third of a second here, each scan is in the map within a second of its image.
    assert max(ages_s) + 1 / 3 < 1.0
    assert driven.live.waiting <= 20
    driven.live.finish()
    driven.check_account()
    assert driven.live.dropped > 50 and driven.live.waiting == 0
    assert driven.scans.arrived.total() == 100


@pytest.mark.slow
def test_what_a_slow_robot_holds_does_not_grow(driven: Driven) -> None:
    held = []
    for n, entry in enumerate(drive(MAKE, scans=600)):  # a minute
        driven.scans.add(bag_message(entry), entry[0])
        if n % 12 == 0:
            driven.clock.now_s = entry[0]
            driven.step([])  # maps a scan of three or four
            held.append(driven.scans.held_bytes + sum(map(_size, driven.live._backlog)))
    assert max(held[len(held) // 2 :]) < 1.2 * max(held[: len(held) // 2])
    assert driven.live.dropped > 200


def _size(ready: ReadyScan) -> int:
    return sum(len(message.data) for message in ready.messages.values())


def test_what_cannot_be_decoded_is_left_out_and_counted(driven: Driven) -> None:
    for entry in DRIVE[:80]:
        message = bag_message(entry)
        if message.topic == "/depth/image":
            message = message._replace(data=bytes(message.data).replace(b"16UC1\0", b"64FC1\0"))
        driven.step([message])
    driven.live.finish()
    driven.check_account()
    assert driven.live.taken == 0 and driven.scans.left_out[Cause.DAMAGED] > 5


def test_a_measurement_is_committed_when_nothing_more_comes(driven: Driven) -> None:
    for entry in DRIVE[:80]:
        driven.step([bag_message(entry)])
    while driven.live.is_behind:
        driven.step([])
    assert driven.live.taken > 5 and driven.live.commits == 0
    driven.clock.now_s += REST_S + 1.0
    for _ in range(20):  # those that wait for images that never come are first
        driven.step([])
    driven.clock.now_s += REST_S + 1.0
    driven.step([])
    assert driven.live.commits == 1


def map_all(driven: Driven) -> None:
    """Step through the drive until no scan waits for its turn."""
    for entry in DRIVE:
        driven.step([bag_message(entry)])
    while driven.live.is_behind:
        driven.step([])


def learn_time(robot: Robot) -> None:
    """Let a robot know a server's time, without which a commit has no epoch."""
    robot._clock.learn(TimeSample(server_s=DRIVE[-1][0] + 1000, steady_s=time.monotonic(), error_s=0.0))


def test_a_full_outbox_at_the_border_of_an_epoch_leaves_the_measurement_open(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_client.replica.limits.LEAST_BYTES", 1)
    layer, limits = MapLayer(geometry=GRID, epoch_s=2), Limits(outbox_bytes_max=1)
    driven = Driven(rig, tmp_path / "mole", ScanGate(None), layer=layer, limits=limits)
    learn_time(driven.robot)
    map_all(driven)
    assert 0 < driven.live.taken < 30 and driven.live.dropped > 50
    assert "outbox_bytes_max" in driven.live.refusal and driven.live.commits == 0
    driven.live.finish()
    driven.check_account()
    with pytest.raises(UnreachableError):
        driven.robot.close()


@pytest.mark.parametrize("epoch_s", [2, 86_400])
def test_a_measurement_too_large_for_a_commit_is_dropped_and_no_scan_counts_as_damaged(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, epoch_s: int
) -> None:
    monkeypatch.setattr("cairn_map.commits.commit.COMMIT_BYTES_MAX", 100)
    driven = Driven(rig, tmp_path / "mole", ScanGate(None), layer=MapLayer(geometry=GRID, epoch_s=epoch_s))
    learn_time(driven.robot)
    map_all(driven)
    assert driven.live.dropped >= 10 and Cause.DAMAGED not in driven.scans.left_out
    driven.live.finish()
    driven.check_account()
    assert driven.live.taken == driven.live.commits == 0
    driven.robot.close()


def test_what_waits_at_the_end_is_mapped_for_a_second_and_the_rest_is_dropped(driven: Driven) -> None:
    for entry in DRIVE:
        driven.scans.add(bag_message(entry), 0.0)
    driven.clock.tick_s = 0.1
    driven.live.finish()
    driven.check_account()
    assert 0 < driven.live.taken < 15 and driven.live.dropped > 50 and driven.live.waiting == 0
