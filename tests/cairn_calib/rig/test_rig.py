"""rig.json: what is written comes back, what is wrong is named."""

import json
from pathlib import Path

import numpy as np
import pytest

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, load_rig, mount_camera, rig_from_json
from cairn_map.errors import BadInputError

RIG = Rig(
    name="orpheus-head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, camera_from_field_of_view(176, 144, horizontal_deg=69), np.eye(4)),
        "left": mount_camera(
            Spectrum.THERMAL, camera_from_field_of_view(640, 512, horizontal_deg=45), look_at((0.1, 0, 0), (1, 2, 0))
        ),
    },
)
PLAIN = Rig(
    name="head",
    cameras={
        "tof": mount_camera(
            Spectrum.RANGE, Camera(width=176, height=144, focal_px=(130, 131.5), centre_px=(87.5, 71.5)), np.eye(4)
        )
    },
)
PLAIN_JSON = b"""{
 "format": "cairn-rig",
 "version": 1,
 "name": "head",
 "cameras": {
  "tof": {
   "spectrum": "range",
   "camera": {
    "width": 176,
    "height": 144,
    "focal_px": [
     130.0,
     131.5
    ],
    "centre_px": [
     87.5,
     71.5
    ],
    "distortion": [
     0.0,
     0.0,
     0.0,
     0.0,
     0.0
    ]
   },
   "T_rig_camera": [
    [
     1.0,
     0.0,
     0.0,
     0.0
    ],
    [
     0.0,
     1.0,
     0.0,
     0.0
    ],
    [
     0.0,
     0.0,
     1.0,
     0.0
    ],
    [
     0.0,
     0.0,
     0.0,
     1.0
    ]
   ]
  }
 }
}
"""
"""As written before there was a `model`; commits carry its digest, so it stays for ever."""
LIDAR = SpinningLidar(width=1800, height=3, elevations_deg=(15, 0, -20.5))
LIDAR_RIG = Rig(
    name="mast",
    cameras={
        "lidar": mount_camera(Spectrum.RANGE, LIDAR, np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, camera_from_field_of_view(64, 48, horizontal_deg=60), np.eye(4)),
    },
)


def changed(*path: str, to: object) -> bytes:
    """The rig's JSON with one field set."""
    document = json.loads(RIG.to_json())
    at = document
    for name in path[:-1]:
        at = at[name]
    at[path[-1]] = to
    return json.dumps(document).encode()


def test_a_rig_comes_back_from_its_json_with_the_same_digest() -> None:
    again = rig_from_json(RIG.to_json())
    assert again == RIG
    assert again.digest() == RIG.digest()
    assert again.to_json() == RIG.to_json()


def test_another_calibration_has_another_digest() -> None:
    moved = rig_from_json(changed("cameras", "tof", "T_rig_camera", to=look_at((0, 0, 1e-6), (1, 0, 0)).tolist()))
    assert moved.digest() != RIG.digest()


def test_a_transform_comes_back_as_it_was_given() -> None:
    np.testing.assert_allclose(RIG["left"].transform, look_at((0.1, 0, 0), (1, 2, 0)), atol=1e-15)


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("colour",), 1, "colour"),
        (("cameras", "tof", "serial"), "7", "serial"),
        (("cameras", "tof", "camera", "skew"), 0, "skew"),
        (("cameras", "tof", "T_rig_camera"), (2 * np.eye(4)).tolist(), "T_rig_camera"),
        (("cameras", "tof", "spectrum"), "x-ray", "spectrum"),
        (("cameras",), {}, "cameras"),
        (("version",), 2, "version"),
        (("format",), "other", "format"),
        (("name",), "../up", "name"),
    ],
)
def test_what_is_unknown_or_wrong_is_refused_by_name(path: tuple[str, ...], value: object, named: str) -> None:
    with pytest.raises(BadInputError, match=named):
        rig_from_json(changed(*path, to=value))


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b" " * (1 << 21)])
def test_what_is_no_rig_is_refused(data: bytes) -> None:
    with pytest.raises(BadInputError):
        rig_from_json(data)


def test_a_file_that_is_missing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError):
        load_rig(tmp_path / "rig.json")


def test_a_rig_is_loaded_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_bytes(RIG.to_json())
    assert load_rig(tmp_path / "rig.json") == RIG


def test_an_unknown_camera_is_named_with_those_that_are_there() -> None:
    with pytest.raises(BadInputError, match="tof, left"):
        RIG["right"]


def test_cameras_are_found_by_spectrum() -> None:
    assert RIG.of_spectrum(Spectrum.THERMAL) == ["left"]
    assert RIG.of_spectrum(Spectrum.COLOUR) == []


def test_a_rig_without_a_model_keeps_its_bytes_and_digest() -> None:
    assert PLAIN.to_json() == PLAIN_JSON
    assert rig_from_json(PLAIN_JSON) == PLAIN
    assert PLAIN.digest() == "74a7069c2b2f42efd7f3e30a0d8f1ea96c29d05a186daaab6e46bf5a5a8368f5"


def test_a_rig_with_a_lidar_comes_back_from_its_json() -> None:
    again = rig_from_json(LIDAR_RIG.to_json())
    assert again == LIDAR_RIG
    assert again["lidar"].camera == LIDAR
    assert again.to_json() == LIDAR_RIG.to_json()
    document = json.loads(LIDAR_RIG.to_json())["cameras"]
    assert document["lidar"]["camera"] == {
        "width": 1800,
        "height": 3,
        "model": "spinning",
        "elevations_deg": [15.0, 0.0, -20.5],
    }
    assert "model" not in document["left"]["camera"]


@pytest.mark.parametrize("model", ["fisheye", "pinhole", None, 1, ["spinning"]])
def test_an_unknown_model_is_refused_with_those_that_there_are(model: object) -> None:
    with pytest.raises(BadInputError, match=r"cameras\.tof\.camera.*'spinning' .* or absent"):
        rig_from_json(changed("cameras", "tof", "camera", "model", to=model))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("spectrum",), "thermal", "must be range, got thermal"),
        (("camera", "height"), 4, "one per row"),
        (("camera", "elevations_deg"), [0, 1, 2], "fall"),
        (("camera", "focal_px"), [1, 1], "focal_px"),
    ],
)
def test_a_lidar_that_is_wrong_is_refused_by_what_is(path: tuple[str, ...], value: object, named: str) -> None:
    document = json.loads(LIDAR_RIG.to_json())
    (document["cameras"]["lidar"] if len(path) == 1 else document["cameras"]["lidar"]["camera"])[path[-1]] = value
    with pytest.raises(BadInputError, match=rf"cameras\.lidar.*{named}"):
        rig_from_json(json.dumps(document).encode())


@pytest.mark.parametrize("camera", [None, 7, "spinning", []])
def test_what_is_no_camera_is_refused(camera: object) -> None:
    with pytest.raises(BadInputError, match=r"cameras\.tof\.camera"):
        rig_from_json(changed("cameras", "tof", "camera", to=camera))
