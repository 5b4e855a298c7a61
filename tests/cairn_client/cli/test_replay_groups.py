"""Replay of scans that the recording does not group: few commits, and the map of one commit for each scan."""

from dataclasses import replace
from pathlib import Path

import pytest
from tests.fixtures.client.robot_program import RIG, scan_of
from tests.fixtures.fusion.bags import ALL_CHANNELS, small_recording

from cairn_client.cli.robots.command import main
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_map.errors import BadInputError

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


def test_a_recording_of_a_robot_at_rest_is_gated_only_when_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, first = tmp_path / "rest", scan_of(1)
    with RecordingWriter(folder, RIG, name="rest") as writer:
        for n in range(40):
            writer.add(replace(first, time_s=first.time_s + n / 10))
    every = replayed(folder, tmp_path / "every")
    assert "not mapped" not in capsys.readouterr().out
    assert replayed(folder, tmp_path / "gated", "--scan-every-s", "2") != every
    assert "38 of these scans were taken by a robot that had not moved" in capsys.readouterr().out
    assert replayed(folder, tmp_path / "same", "--every-scan") == every
    with pytest.raises(BadInputError, match="exclude each other"):
        replayed(folder, tmp_path / "both", "--every-scan", "--scan-every-m", "0.1")
