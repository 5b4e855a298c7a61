"""Statements of a rig about a range camera's noise, fullness and silence."""

import json

import numpy as np
import pytest

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.rig import RangeSensing, Rig, Spectrum, mount_camera, rig_from_json
from cairn_map.errors import BadInputError

CAMERA = camera_from_field_of_view(4, 3, horizontal_deg=60)
STATED = mount_camera(Spectrum.RANGE, CAMERA, np.eye(4)).model_copy(
    update={"sensing": RangeSensing(sigma_m=((1.0, 0.01), (3.0, 0.05)), saturated_amplitude=9000, no_return_clears_m=7)}
)
RIG = Rig(name="head", cameras={"tof": STATED, "eye": mount_camera(Spectrum.COLOUR, CAMERA, np.eye(4))})


def test_sigma_is_linear_between_what_is_stated_and_constant_beyond() -> None:
    sigma_m = STATED.range_sigma_m(np.array([0.2, 1.0, 2.0, 3.0, 50.0, np.nan]))
    np.testing.assert_allclose(sigma_m, [0.01, 0.01, 0.03, 0.05, 0.05, np.nan])


def test_without_a_statement_a_camera_is_a_time_of_flight_camera_and_a_lidar_a_lidar() -> None:
    range_m = np.array([0.0, 3.0, 60.0])
    np.testing.assert_allclose(RIG["eye"].range_sigma_m(range_m), [0.005, 0.01, 0.03])
    lidar = SpinningLidar(width=8, height=1, elevations_deg=(0.0,))
    np.testing.assert_allclose(mount_camera(Spectrum.RANGE, lidar, np.eye(4)).range_sigma_m(range_m), 0.02)


def test_what_is_stated_comes_back_and_what_is_not_is_not_in_the_document() -> None:
    assert rig_from_json(RIG.to_json()) == RIG
    cameras = json.loads(RIG.to_json())["cameras"]
    assert "sensing" in cameras["tof"] and not {"sensing", "calibration_sigma_px"} & set(cameras["eye"])


@pytest.mark.parametrize(
    ("camera", "sensing"),
    [
        ("eye", {}),
        ("tof", {"sigma_m": []}),
        ("tof", {"sigma_m": [[0, 0.0]]}),
        ("tof", {"sigma_m": [[2, 0.1], [2, 0.2]]}),
        ("tof", {"sigma_m": [[0, 1e999]]}),
        ("tof", {"saturated_amplitude": 0}),
        ("tof", {"no_return_clears_m": -1}),
        ("tof", {"loud": True}),
    ],
)
def test_what_makes_no_sense_is_refused(camera: str, sensing: object) -> None:
    document = json.loads(RIG.to_json())
    document["cameras"][camera]["sensing"] = sensing
    with pytest.raises(BadInputError, match="sensing"):
        rig_from_json(json.dumps(document).encode())
