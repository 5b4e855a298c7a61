"""`cairn map publish`: a map as messages in a file, and live to a viewer, by the lines that a user types."""

import io
import queue
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from tests.fixtures.client.floors import SIDE, push_storey
from tests.fixtures.client.foxglove_viewer import WAIT_S, FoxgloveViewer
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, A
from tests.fixtures.fusion.cdr_reader import read_message

from cairn_client.cli.maps.command import main
from cairn_client.http.api import MapApi
from cairn_client.publish.followed_map import FollowedMap
from cairn_client.robot.robot import Robot
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.wire.live_events import CellsEvent
from cairn_map.wire.messages import RobotStatus

BAND = "--band=0.05,0.25"


def messages_of(path: Path) -> dict[str, dict[str, Any]]:
    """The last message of each topic."""
    with path.open("rb") as stream:
        return {
            channel.topic: read_message(schema.data.decode(), schema.name, record.data)
            for schema, channel, record in make_reader(stream).iter_messages()
            if schema is not None
        }


def floor(wall_x: int | None) -> np.ndarray[Any, np.dtype[np.int8]]:
    expected = np.zeros((SIDE, SIDE), np.int8)
    if wall_x is not None:
        expected[:, wall_x] = 100
    return expected.ravel()


def test_a_file_holds_floor_voxels_hot_spots_octree_and_robots(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_storey(server, tmp_path / "wren", wall_x=2)
    path = tmp_path / "lab.mcap"
    pose = ScanPose(time_s=1.7e9, t_map_rig=(0.1, 0.2, 0.3), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    with Robot(None, server.map_url, directory=tmp_path / "mole", name="mole") as robot, MapApi(server.url) as api:
        robot.sync()
        api.put_status(MAP, "mole", RobotStatus(time_s=1.7e9, pose=pose))
        assert main(["publish", server.map_url, "--mcap", str(path), BAND, "--octomap", "--frame", "lab"]) == 0
    assert f"{path}: 7 messages, " in capsys.readouterr().out
    found = messages_of(path)
    assert found["/map"]["header"]["frame_id"] == "lab"
    np.testing.assert_array_equal(found["/map"]["data"], floor(2))
    occupied = SIDE * SIDE + SIDE * (SIDE - 1)
    assert found["/cairn/points"]["width"] == found["/cairn/changed_points"]["width"] == occupied
    assert [marker["text"] for marker in found["/cairn/hot_spots"]["markers"]][2] == "26.9 °C"
    assert found["/cairn/octomap"]["id"] == "OcTree"
    (edge,) = found["/tf"]["transforms"]
    assert (edge["header"]["frame_id"], edge["child_frame_id"]) == ("lab", "mole")
    assert found["/cairn/robots/mole/path"]["poses"][0]["pose"]["position"] == {"x": 0.1, "y": 0.2, "z": 0.3}


def test_a_change_reaches_a_viewer_and_who_joins_late_gets_the_latest_floor(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_storey(server, tmp_path / "mole")
    lines, ended = Lines(), list[int]()
    monkeypatch.setattr("sys.stdout", lines)
    words = ["publish", server.map_url, "--foxglove=0", f"--mcap={tmp_path / 'a.mcap'}", "--changes=3", BAND]
    publishing = threading.Thread(target=lambda: ended.append(main(words)), daemon=True)
    publishing.start()
    url = lines.next_with("ws://").split()[2].rstrip(":")
    with FoxgloveViewer(url) as viewer:
        viewer.subscribe("/map")
        np.testing.assert_array_equal(viewer.next_message()["data"], floor(None))
        push_storey(server, tmp_path / "mole", wall_x=2)
        np.testing.assert_array_equal(viewer.next_message()["data"], floor(2))
        with FoxgloveViewer(url) as late:
            late.subscribe("/map")
            np.testing.assert_array_equal(late.next_message()["data"], floor(2))
        push_storey(server, tmp_path / "mole", wall_x=5)
        assert (viewer.next_message()["data"] == 100).sum() == 2 * SIDE
    publishing.join(WAIT_S)
    assert ended == [0]
    # A file that is followed has the floor after each change; the cloud of all at first, since the rest came soon.
    assert (messages_of(tmp_path / "a.mcap")["/map"]["data"] == 100).sum() == 2 * SIDE


class Lines(io.TextIOBase):
    """Standard output of a command in another thread, line by line."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def write(self, text: str) -> int:
        self._lines.put(text)
        return len(text)

    def next_with(self, part: str) -> str:
        """The next line that holds a text."""
        while part not in (line := self._lines.get(timeout=WAIT_S)):
            pass
        return line


def test_sigterm_ends_a_file_as_ctrl_c_does(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_storey(server, tmp_path / "mole")
    lines, path = Lines(), tmp_path / "a.mcap"
    monkeypatch.setattr("sys.stdout", lines)
    main_thread = threading.main_thread().ident
    assert main_thread is not None

    def end() -> None:
        lines.next_with("1 cells: ")
        signal.pthread_kill(main_thread, signal.SIGTERM)

    def fail(number: int, frame: FrameType | None) -> None:
        raise AssertionError("the command does not mind the signal")

    before = signal.signal(signal.SIGTERM, fail)
    try:
        ending = threading.Thread(target=end, daemon=True)
        ending.start()
        with pytest.raises(KeyboardInterrupt):
            main(["publish", server.map_url, f"--mcap={path}", "--follow", BAND])
        ending.join(WAIT_S)
        assert signal.getsignal(signal.SIGTERM) is fail
    finally:
        signal.signal(signal.SIGTERM, before)
    np.testing.assert_array_equal(messages_of(path)["/map"]["data"], floor(None))


def test_a_followed_map_fetches_what_changed_alone_and_equals_the_servers(server: LiveServer, tmp_path: Path) -> None:
    push_storey(server, tmp_path / "mole")
    with MapApi(server.url) as api:
        followed = FollowedMap(api, MAP)
        assert followed.fetch() == [A]
        followed.note_any()
        assert followed.fetch() == []
        push_storey(server, tmp_path / "mole", wall_x=2)
        followed.note(CellsEvent(id="", cells=[(0, 0, 0, 2)]))
        assert followed.has_news
        assert followed.fetch() == [A]
        whole = FollowedMap(api, MAP)
        whole.fetch()
    np.testing.assert_array_equal(followed.snapshot.voxels_in().counts, whole.snapshot.voxels_in().counts)
    assert not followed.has_news


def test_what_was_taken_out_is_gone_from_a_followed_map(server: LiveServer, tmp_path: Path) -> None:
    push_storey(server, tmp_path / "mole")
    with MapApi(server.url) as api:
        followed = FollowedMap(api, MAP)
        followed.fetch()
        assert main(["retract", server.map_url, "--robot", "mole"]) == 0
        server.wait_for_fold()
        followed.note(CellsEvent(id="", cells="many"))
        assert followed.fetch() == [A]
    assert len(followed.snapshot.voxels_in()) == 0


def test_a_map_without_ground_is_published_without_a_floor(server: LiveServer, tmp_path: Path) -> None:
    path = tmp_path / "lab.mcap"
    assert main(["publish", server.map_url, "--mcap", str(path)]) == 0
    found = messages_of(path)
    assert "/map" not in found
    assert found["/cairn/points"]["width"] == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "say where to publish"),
        (["--mcap=a.mcap", "--band=0.01,1"], "at least a voxel"),
        (["--mcap=nowhere/a.mcap"], "cannot write"),
        (["--foxglove=203.0.113.7:1"], "another port"),
        (["--ros2"], "this Python has no ROS 2 .* source the ROS of this machine first"),
        (["--mcap=a.mcap", "--changes=2"], "give --follow"),
        (["--mcap=a.mcap", "--follow", "--changes=0"], "1 or more"),
        (["--mcap=a.mcap", "--origin=http://viewer:8080"], "give --foxglove"),
    ],
)
def test_what_cannot_be_published_is_said(
    server: LiveServer, tmp_path: Path, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match=said):
        main(["publish", server.map_url, *words])
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_map_that_is_not_there_is_said(server: LiveServer, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        main(["publish", f"{server.url}/maps/nothing", f"--mcap={tmp_path / 'a.mcap'}"])
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.parametrize(
    "words", [["--foxglove=http://a"], ["--foxglove=70000"], ["--frame=a b", "--mcap=a"], ["--origin=viewer"]]
)
def test_addresses_and_frames_are_checked(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["publish", "http://127.0.0.1:9/maps/lab", *words])
    assert ended.value.code == 2
    assert "got" in capsys.readouterr().err
