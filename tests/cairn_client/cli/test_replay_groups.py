"""Replay of scans that the recording does not group: few commits, and the map of one commit for each scan."""

from pathlib import Path

import pytest
from tests.fixtures.fusion.bags import ALL_CHANNELS, small_recording

from cairn_client.cli.robots.command import main
from cairn_client.robot.robot import Robot

SILENT = "http://127.0.0.1:9/maps/lab"
"""URL at which nothing listens: a robot maps on without a link."""


def replayed(recording: Path, state: Path, *options: str) -> str:
    """Digest of the map that a replay leaves in the robot's folder."""
    voxel = str(ALL_CHANNELS.voxel_edge_m)
    asked = ("--map", SILENT, "--state", str(state), "--voxel", voxel, "--name", "robot", *options)
    assert main(["replay", str(recording), *asked]) == 0
    with Robot(None, SILENT, directory=state, name="robot") as robot:
        return robot.map.digest()


def test_scans_become_few_commits_and_the_same_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "room"
    count = len(small_recording(folder))
    (folder / "measurements.txt").unlink(missing_ok=True)
    alone = replayed(folder, tmp_path / "alone", "--scans-per-measurement", "1")
    assert f"replayed {count} scans as {count} commits" in capsys.readouterr().out
    assert replayed(folder, tmp_path / "grouped") == alone
    said = capsys.readouterr().out
    assert f"replayed {count} scans as " in said and f"as {count} commits" not in said
