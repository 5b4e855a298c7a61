"""`cairn calib check`: the example of CONVENTIONS.md is without doubts; each spoilt number is doubted by its camera."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cairn_calib.cli.main import main
from cairn_calib.rig.rig import load_rig
from cairn_map.errors import BadInputError

PAGE = (Path(__file__).parents[3] / "calib" / "CONVENTIONS.md").read_text()
EXAMPLE = next(text for text in re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL) if "cairn-rig" in text)
Spoil = Callable[[dict[str, Any]], None]


def checked(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> str:
    file = tmp_path / "rig.json"
    file.write_text(text)
    assert main(["check", str(file)]) == 0
    return capsys.readouterr().out


def test_the_example_of_the_conventions_is_whole_and_without_doubt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = checked(tmp_path, EXAMPLE, capsys)
    assert f"rig three-eyes, digest {load_rig(tmp_path / 'rig.json').digest()}: 3 cameras" in said
    assert re.search(r"colour +colour +1280 x 960 pixels, 60 x 47 degrees, at \(0.060, 0.000, 0.012\) m", said)
    assert "doubt" not in said


def shift(colour: dict[str, Any]) -> None:
    colour["T_rig_camera"][0][3] = 60


def turn(colour: dict[str, Any]) -> None:
    colour["T_rig_camera"] = [[-1, 0, 0, 0.06], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]


def shorten(colour: dict[str, Any]) -> None:
    colour["camera"]["focal_px"] = [6.2, 6.2]


def halve(colour: dict[str, Any]) -> None:
    colour["camera"]["centre_px"] = [159.5, 119.5]


@pytest.mark.parametrize(
    ("spoil", "doubt"),
    [
        (shift, "colour stands 60.0 m from tof: are its numbers millimetres?"),
        (turn, "colour looks 180 degrees away from tof"),
        (shorten, "focal_px is 6.2 for 1280 pixels; it is in pixels, not in millimetres"),
        (halve, "colour has its principal point at 159.5 of 1280 pixels along x"),
    ],
)
def test_a_number_that_no_head_has_is_doubted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Spoil, doubt: str
) -> None:
    rig = json.loads(EXAMPLE)
    spoil(rig["cameras"]["colour"])
    doubts = [line for line in checked(tmp_path, json.dumps(rig), capsys).splitlines() if line.startswith("doubt: ")]
    assert any(doubt in line for line in doubts), doubts


def test_what_is_no_rig_is_refused_with_the_field(tmp_path: Path) -> None:
    rig = json.loads(EXAMPLE)
    rig["cameras"]["colour"]["camera"]["width"] = "wide"
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    with pytest.raises(BadInputError, match=r"cameras.colour.camera.*width"):
        main(["check", str(tmp_path / "rig.json")])
