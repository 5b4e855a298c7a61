"""`cairn telepresence` on a recording: one picture, a folder of pictures, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from cairn_client.telepresence_command import main
from cairn_fusion.images import read_colour
from cairn_map.errors import BadInputError, NotFoundError
from cairn_sim.record import Plan, record
from cairn_sim.robots import ROBOTS
from cairn_sim.scene_file import load_scene, shipped_text


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("telepresence") / "lab"
    plan = Plan(
        scene=load_scene("small-room"),
        robot=ROBOTS["orpheus"],
        path="west",
        scale=0.125,
        truth="none",
        speed_m_s=0.5,
        rate_hz=1.0,
        last_stop=3,
    )
    assert len(list(record(plan, folder, scene_text=shipped_text("small-room")))) == 3
    return folder


def test_one_scan_becomes_a_png(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(recording), "--output", str(tmp_path / "view.png"), "--scan", "1", "--mode", "side-by-side"]) == 0
    assert "side-by-side, scan 1 of 3" in capsys.readouterr().out
    assert read_colour(tmp_path / "view.png").shape == (120, 320, 3)


def test_all_scans_become_a_folder_with_one_scale(recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    assert main([str(recording), "--output", str(folder), "--band", "-5:40", "--scale", "-10:50"]) == 0
    pictures = [read_colour(path) for path in sorted(folder.iterdir())]
    assert len(pictures) == 3 and pictures[0].shape == (120, 160, 3)
    assert not np.array_equal(pictures[0], pictures[2])


def test_what_cannot_be_is_refused_in_words(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="scans 0 to 2"):
        main([str(recording), "--output", str(tmp_path / "view.png"), "--scan", "7"])
    with pytest.raises(BadInputError, match="no camera 'nose'"):
        main([str(recording), "--output", str(tmp_path / "view.png"), "--camera", "nose"])
    with pytest.raises(BadInputError, match="lower to a higher"):
        main([str(recording), "--output", str(tmp_path / "view.png"), "--scale", "40:20"])
    with pytest.raises(BadInputError, match="cannot write"):
        main([str(recording), "--output", str(tmp_path / "none" / "view.png")])
    for wrong in (["--serve", "loud"], ["--rate", "0", "--serve", "0"], ["--scale", "warm", "--serve", "0"], []):
        with pytest.raises(SystemExit):
            main([str(recording), *wrong])
