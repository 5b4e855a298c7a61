"""`cairn calib verify` on a simulated drive past targets: files, table, and a camera that has moved."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.sim.drive import record_drive

from cairn_calib.rig.rig import Rig
from cairn_client.cli.robots.verify import main
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_map.errors import BadInputError, NotFoundError
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.robots.targets import laboratory
from cairn_sim.scene.scene import scene_of
from cairn_sim.scene.solids import placed
from cairn_sim.study.run import T_MAP_HEAD

RIG = full_head(scale=0.5)
SCANS = 4


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("drive") / "drive", RIG, scans=SCANS)


def verified(rig: Rig, drive: Path, folder: Path, *options: str) -> dict[str, dict[str, float]]:
    """Rows of the JSON by camera."""
    (folder / "rig.json").write_bytes(rig.to_json())
    assert main([str(folder / "rig.json"), str(drive), "--output", str(folder / "out"), *options]) == 0
    document = json.loads((folder / "out" / "verification.json").read_text())
    return {row["camera"]: row for row in document["cameras"]}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["grey", "paper"])
def test_a_true_rig_is_off_by_less_than_a_range_pixel_and_everything_is_written(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    rows = verified(RIG, drive, tmp_path, "--method", method)
    assert set(rows) == {"colour_left", "colour_right", "thermal_left", "thermal_right"}
    for name, row in rows.items():
        assert row["sigma_px"] < 0.5 * row["source_pixel_px"]
        assert row["count"] >= (3 if name.startswith("colour") else 3 * SCANS - 1)
    out = capsys.readouterr().out
    assert "thermal_right" in out and "targets in 4 images" in out
    assert "Fig. 16: thermal_right, y" in (tmp_path / "out" / "verification.html").read_text()
    sheet = np.asarray(cv2.imread(str(tmp_path / "out" / "targets-thermal_left.png")))
    assert sheet.shape[1] == 8 * 160 and sheet.max() == 255


@pytest.mark.slow
def test_a_camera_that_has_turned_shows_as_a_bias(drive: Path, tmp_path: Path) -> None:
    turned, angle_rad = RIG["thermal_left"], 0.01
    T = turned.transform @ placed((0, 0, 0), (0, angle_rad, 0))
    changed = turned.model_copy(update={"T_rig_camera": tuple(tuple(map(float, row)) for row in T)})
    rig = RIG.model_copy(update={"cameras": {**RIG.cameras, "thermal_left": changed}})
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    before, after = (verified(each, drive, tmp_path / name) for each, name in ((RIG, "a"), (rig, "b")))
    moved_px = after["thermal_left"]["bias_x_px"] - before["thermal_left"]["bias_x_px"]
    focal_px = full_head(scale=0.5)["thermal_left"].camera.model_dump()["focal_px"][0]
    assert -moved_px == pytest.approx(angle_rad * focal_px, rel=0.3)
    assert after["thermal_right"] == before["thermal_right"]


def test_a_recording_without_targets_or_of_another_head_is_refused(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_bytes(full_head(scale=0.25).to_json())
    with pytest.raises(BadInputError, match="must be 320 x 240 pixels, got 640 x 480"):
        main([str(tmp_path / "rig.json"), str(drive)])
    rig = Rig(name="pair", cameras={name: full_head(scale=0.2)[name] for name in (RANGE_CAMERA, "thermal_left")})
    with RecordingWriter(tmp_path / "empty", rig, name="empty", note="") as writer:
        bare = scene_of(laboratory(), name="bare")
        scan = render_scan(bare, rig, T_map_rig=T_MAP_HEAD, range_camera=RANGE_CAMERA, time_s=1.0, noise=Noise(1))
        writer.add(replace(scan, time_s=1e9))
        writer.end_measurement()
    (tmp_path / "rig.json").write_bytes(rig.to_json())
    with pytest.raises(NotFoundError, match="no camera found two"):
        main([str(tmp_path / "rig.json"), str(tmp_path / "empty"), "--output", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
