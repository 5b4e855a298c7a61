"""`cairn doctor` of a live robot: the words of the status line, each with its check, and nothing is mapped."""

import json
import socket
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_run import MAKE
from tests.fixtures.fusion.bags import Timed
from tests.fixtures.fusion.drive_mapping import TOPICS, mapping_text
from tests.fixtures.fusion.live_drive import START_S, bag_message, drive, latched, moving

from cairn_client import main as cairn
from cairn_client.cli.doctor.checks import Check, CheckResult
from cairn_client.cli.doctor.live_checks import live_checks
from cairn_fusion.ros.bag import BagMessage, Topic, Wire
from cairn_map.machine_clocks import MachineClocks

TICK_S = 0.1


class ScriptedDoor:
    """A door that brings the messages of a drive by a clock of its own, which each call lets tick."""

    url, links, damaged, lost_since_s = "ws://robot:8765", 1, 0, None

    def __init__(
        self,
        timed: Sequence[Timed],
        *,
        lead_s: float = 0.0,
        look_s: float = 0.0,
        topics: Mapping[str, Topic] = TOPICS,
    ) -> None:
        self.now_s = 0.0
        self.topics = dict(topics)
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.is_closed = False
        self._left = list(timed)
        self._lead_s, self._look_s = lead_s, look_s

    @property
    def clocks(self) -> MachineClocks:
        return MachineClocks(wall_s=lambda: START_S + self.now_s + self._lead_s, steady_s=self._look)

    def _look(self) -> float:
        self.now_s += self._look_s
        return self.now_s

    def open(self, wanted: Callable[[Topic], bool]) -> None:
        assert all(wanted(topic) for topic in self.topics.values())

    def take(self, *, within_s: float) -> list[BagMessage]:
        self.now_s += TICK_S
        due = [bag_message(entry) for entry in self._left if entry[0] - START_S <= self.now_s]
        self._left = self._left[len(due) :]
        self.counts += Counter(message.topic for message in due)
        return due

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def checks_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> "Checks":
    def checks_of(door: ScriptedDoor, text: str = mapping_text()) -> dict[str, Check]:
        (tmp_path / "live.yaml").write_text(text)
        monkeypatch.setattr("cairn_client.cli.doctor.live_checks.open_door", lambda url, ca_file: door)
        found = {check.what: check for check in live_checks(door.url, tmp_path / "live.yaml", clocks=door.clocks)}
        assert door.is_closed
        assert all(check.advice for check in found.values() if check.verdict is not CheckResult.OK)
        return found

    return checks_of


Checks = Callable[..., dict[str, Check]]


def test_a_sound_robot_passes_every_check(checks_of: Checks) -> None:
    found = checks_of(ScriptedDoor(drive(MAKE, scans=60)))
    assert {check.verdict for check in found.values()} == {CheckResult.OK}, found
    assert found.keys() == {"door", "head", "topics", "scans", "robot clock"}
    assert "/depth/image " in found["topics"].found and " scans/s of " in found["scans"].found


def test_poses_that_end_are_named_by_their_cause(checks_of: Checks) -> None:
    timed = [entry for entry in drive(MAKE, scans=60) if entry[1] != "/tf" or entry[0] < START_S + 1]
    found = checks_of(ScriptedDoor(timed))
    assert found["scans"].verdict is not CheckResult.OK and "tf late" in found["scans"].found
    assert found["topics"].found == "/tf: publisher there, nothing came for 2 s"
    assert found["topics"].verdict is CheckResult.FAIL


def test_clocks_that_differ_fail_with_their_difference(checks_of: Checks) -> None:
    clock = checks_of(ScriptedDoor(drive(MAKE, scans=60), lead_s=31.0))["robot clock"]
    assert clock.verdict is CheckResult.FAIL
    assert clock.found == "clock apart 31 s: this machine's and the robot's differ"


def test_a_topic_without_a_publisher_and_a_silent_one_are_told_apart(checks_of: Checks) -> None:
    timed = [entry for entry in drive(MAKE, scans=60) if entry[1] != "/warm/image" or entry[0] < START_S + 0.3]
    door = ScriptedDoor(timed)
    assert checks_of(door)["topics"].found == "/warm/image: publisher there, nothing came for 3 s"
    lacking = ScriptedDoor(timed, look_s=1.0)
    del lacking.topics["/warm/image"]
    (check,) = checks_of(lacking).values()
    assert "offers no topic /warm/image (images of camera warm)" in check.found
    assert check.verdict is CheckResult.FAIL


def test_a_robot_that_sends_nothing_is_known_within_ten_seconds(checks_of: Checks) -> None:
    door = ScriptedDoor([])
    (check,) = checks_of(door).values()
    assert "a publisher is there, nothing came in 5 s: " in check.found and door.now_s < 10.0


def test_clouds_of_livox_become_scans(checks_of: Checks) -> None:
    points = np.random.default_rng(1).uniform(1, 4, (30, 3)).astype(np.float32)
    after_ns = np.arange(30, dtype=np.uint32) * 1_000_000
    timed = [latched(MAKE), *(moving(MAKE, START_S + n / 20) for n in range(-2, 122))]
    timed += [(t, "/livox", MAKE.livox(t, "depth_frame", points, after_ns)) for t in START_S + np.arange(60) / 10]
    topics = {name: TOPICS[name] for name in ("/tf", "/tf_static")}
    topics["/livox"] = Topic("/livox", "livox_ros_driver2/CustomMsg", Wire.CDR, 0)
    text = "\n".join(
        [
            "name: drive\nframes: {map: odom, base: base_link}\nposes: {topic: /tf, max_gap_s: 0.2}",
            "cameras: {lidar: {spectrum: range, topic: /livox, lidar: {kind: cloud}}}",
        ]
    )
    timed.sort(key=lambda entry: entry[0])
    found = checks_of(ScriptedDoor(timed, topics=topics), text)
    assert {check.verdict for check in found.values()} == {CheckResult.OK}, found


def test_no_bridge_is_one_line_and_the_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "live.yaml").write_text(mapping_text())
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{free.getsockname()[1]}"
        code = cairn.main(["doctor", url, "--topics", str(tmp_path / "live.yaml"), "--json"])
    checks = {check["what"]: check for check in json.loads(capsys.readouterr().out)}
    assert code == 1 and "[no_bridge]" in checks["live"]["found"]


def test_options_of_live_robots_are_refused_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    assert cairn.main(["doctor", "--topics", "live.yaml"]) == 1
    assert "[bad_option]" in capsys.readouterr().err
