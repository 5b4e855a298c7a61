"""Status of live mapping: each thing that is missing has a sentence of its own."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_run import GRID, MAKE, MAPPING, NOWHERE, Clock
from tests.fixtures.fusion.bags import Timed
from tests.fixtures.fusion.drive_mapping import TOPICS
from tests.fixtures.fusion.live_drive import START_S, bag_message, depth, drive

from cairn_calib.rig.rig import Rig
from cairn_client.live.foxglove_source import FoxgloveSource
from cairn_client.live.inbox import Inbox
from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.live_status import LiveStatus, StatusWatch
from cairn_client.live.path_corrections import PathCorrections
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.ros.bag import Topic
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.messages import RosPath
from cairn_fusion.ros.scan_decoder import ScanDecoder


class Source(FoxgloveSource):
    """A door without a link, whose topics a test gives."""

    def __init__(self, clock: Clock) -> None:
        self.inbox = Inbox()
        super().__init__("ws://robot:8765", inbox=self.inbox, steady_s=clock)
        self.offered = dict(TOPICS)

    @property
    def topics(self) -> dict[str, Topic]:
        return self.offered


class Watched:
    """A live robot under watch, without a door."""

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.clock = Clock()
        self.source = Source(self.clock)
        self.scans = LiveScans("drive", MAPPING, TOPICS)
        self.robot = Robot(rig, NOWHERE, directory=folder, name="mole", geometry=GRID, stay=True)
        self.corrections = PathCorrections(self.robot, topic="/path", frame="odom", T_path_rig=np.eye(4))
        decoder = ScanDecoder("drive", MAPPING, rig, TOPICS)
        self.live = LiveMapping(self.robot, self.scans, decoder, ScanGate(None), steady_s=self.clock)
        self.watch = StatusWatch("mole", self.source, self.scans, self.live, TOPICS, 0.0)

    def take(self, *timed: Timed, lead_s: float = 0.0) -> None:
        """Take messages at their times, this machine's clock so far ahead."""
        for entry in timed:
            self.clock.now_s = max(self.clock.now_s, entry[0] - START_S)
            message = bag_message(entry)
            self.source.inbox.receive(message.topic, message.data)
            self.live.step(self.source.take(within_s=0.0))
            self.watch.note_lead(entry[0] + lead_s)

    def status(self, *, lead_s: float = 0.0) -> LiveStatus:
        wall_s = START_S + self.clock.now_s + lead_s
        return self.watch.status(self.clock.now_s, wall_s, commits_waiting=self.robot.waiting)


@pytest.fixture
def watched(rig: Rig, tmp_path: Path) -> Iterator[Watched]:
    found = Watched(rig, tmp_path / "mole")
    yield found
    found.robot.close()


def test_a_whole_drive_lacks_nothing(watched: Watched) -> None:
    watched.take(*drive(MAKE, scans=20))
    status = watched.status()
    assert status.missing == [] and status.arrived == 20
    assert watched.watch.line(status).startswith("mole: ")


def test_clocks_that_differ_are_named_with_their_difference(watched: Watched) -> None:
    watched.take(*drive(MAKE, scans=20), lead_s=31.0)
    (said,) = watched.status(lead_s=31.0).missing
    assert said == "clock apart 31 s: this machine's and the robot's differ"
    assert watched.status(lead_s=31.0).arrived == 20


def test_stamps_of_a_simulation_are_named(watched: Watched) -> None:
    watched.take(depth(MAKE, 12.5, 1), lead_s=1e9)
    assert "stamps are of a simulation's clock (use_sim_time)" in watched.status().missing


def test_topics_without_a_publisher_and_silent_ones_are_told_apart(watched: Watched) -> None:
    watched.take(*drive(MAKE, scans=20))
    del watched.source.offered["/colour/image"]
    watched.clock.now_s += 1.0
    watched.status()  # it notes when each topic was heard last
    watched.clock.now_s += 7.0
    said = watched.status().missing
    assert "/colour/image: no publisher" in said
    assert "/depth/image: publisher there, nothing came for 7 s" in said
    assert not any("info" in text or "static" in text for text in said)  # they come once


def test_no_link_is_all_that_is_said(watched: Watched) -> None:
    watched.source.lost_since_s = 0.0
    watched.clock.now_s = 9.0
    assert watched.status().missing == ["no link to ws://robot:8765 for 9 s"]


def test_jumps_without_a_path_are_named_with_what_to_do(watched: Watched) -> None:
    T_map_odom = np.eye(4)
    watched.live.jumps.note(START_S, np.eye(4), np.eye(4))
    T_map_odom[0, 3] = 0.42
    watched.live.jumps.note(START_S + 1, T_map_odom, T_map_odom)
    (said,) = watched.status().missing
    assert said.startswith("odometry jumped in the map once, by up to 0.42 m, and what was mapped before stays")
    assert watched.status().jumps == 1
    # With a topic of corrections a path must follow.
    watched.live.corrections = watched.corrections
    (said,) = watched.status().missing
    assert said == "odometry jumped in the map once, by up to 0.42 m, and no path came since"
    watched.corrections.note_path(RosPath("odom", []))
    assert len(watched.status().missing) == 1
    watched.corrections.newest_s = START_S + 1
    assert watched.status().missing == []
    assert watched.source.dropped == Counter()
