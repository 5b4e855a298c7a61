"""A server whose disk is full refuses pushes: the robot's side says so, and not that there is no link."""

import logging
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import A, seen
from tests.fixtures.commands import cairn
from tests.fixtures.fusion.bags import small_recording

from cairn_client.cli.event_lines import event_line
from cairn_client.robot.robot import Robot
from cairn_client.robot.robot_events import LinkLost

Until = Callable[[Callable[[], bool]], None]


@pytest.fixture
def full(server: LiveServer) -> LiveServer:
    """A server without enough room for any push."""
    server.stop()
    server.settings = server.settings.model_copy(update={"disk_free_min_bytes": 1 << 62})
    server.start()
    return server


def test_the_command_and_the_folder_say_that_the_server_s_disk_is_full(full: LiveServer, tmp_path: Path) -> None:
    state = tmp_path / "mole"
    with Robot(None, full.map_url, directory=state, name="mole") as robot:
        robot.replica.commit({A: seen(1)})
    said = cairn("robot", "sync", state, "--map", full.map_url, folder=tmp_path, code=5)
    assert "bytes are free on the server's disk" in said
    assert "[disk_full]" in said
    status = cairn("robot", "status", state, folder=tmp_path)
    assert "[disk_full]" in status
    assert "no link" not in said + status


def test_the_robot_s_log_and_events_name_the_cause(
    full: LiveServer, tmp_path: Path, until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with (
        Robot(None, full.map_url, directory=tmp_path / "mole", name="mole") as robot,
        robot.events() as events,
    ):
        robot.replica.commit({A: seen(1)})
        robot.start_sync()
        until(lambda: "the server takes nothing now: disk_full" in caplog.text)
        lost = [event for event in events.take(timeout_s=20) if isinstance(event, LinkLost)]
    assert "no link (" not in caplog.text
    assert lost[0].kind == "disk_full"
    assert "[disk_full]" in event_line(lost[0])


@pytest.mark.slow
def test_a_replay_says_why_not_all_is_on_the_server(full: LiveServer, tmp_path: Path) -> None:
    small_recording(tmp_path / "room")
    url = f"{full.url}/maps/room"
    cairn("map", "create", url, "--voxel", "0.05", "--channels", "colour,temperature", folder=tmp_path)
    said = cairn("robot", "replay", tmp_path / "room", "--map", url, "--state", tmp_path / "mole", folder=tmp_path)
    assert "not all is on " in said
    assert "[disk_full]; `cairn robot sync" in said
    assert "no link" not in said
