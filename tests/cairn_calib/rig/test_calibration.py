"""The record of a calibration in rig.json: what it says comes back, and what cannot be is refused by name."""

import json
from typing import Any

import numpy as np
import pytest

from cairn_calib.rig.calibration import Calibration, covariance_from_matrix
from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.rig import RIG_BYTES_MAX, Rig, Spectrum, mount_camera, rig_from_json
from cairn_map.errors import BadInputError

FISHEYE = FisheyeCamera(
    width=640, height=480, focal_px=(200.0, 201.0), centre_px=(320.0, 240.0), distortion=(0.1, 0.0, 1e-3, -1e-4)
)
NAMES = [("tof", "fx"), ("left", "k4"), ("left", "rx"), ("left", "tz")]
MATRIX = np.array([[4e-2, 1e-5, 0, 0], [1e-5, 1e-6, 0, 0], [0, 0, 1e-6, -2e-7], [0, 0, -2e-7, 1e-7]])
CALIBRATION = Calibration.model_validate(
    {
        "software": "cairn 0.1.0",
        "made_s": 1763740800.0,
        "gauge": "tof",
        "covariance": covariance_from_matrix(NAMES, MATRIX),
        "statistics": {
            "chi2": 812.5,
            "degrees_of_freedom": 800,
            "cameras": {"tof": {"images": 12, "points": 420, "outliers": 3, "rms_px": 0.09, "sigma_px": 0.1}},
        },
        "inputs": [{"name": "corners.json", "size_bytes": 81234, "sha256": "0" * 63 + "f"}],
    }
)
RIG = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, camera_from_field_of_view(176, 144, horizontal_deg=69), np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, FISHEYE, transform_from_vector([0.1, 0.2, 0.3, 1, 2, 3])),
    },
    calibration=CALIBRATION,
)


def changed(*path: str | int, to: object) -> bytes:
    """The rig's JSON with one field set."""
    document = json.loads(RIG.to_json())
    at: Any = document
    for name in path[:-1]:
        at = at[name]
    at[path[-1]] = to
    return json.dumps(document).encode()


def test_a_calibrated_rig_comes_back_from_its_json() -> None:
    again = rig_from_json(RIG.to_json())
    assert (again, again.digest(), again.to_json()) == (RIG, RIG.digest(), RIG.to_json())
    assert again["left"].camera == FISHEYE
    assert again.calibration is not None
    assert again.calibration.covariance is not None
    np.testing.assert_array_equal(again.calibration.covariance.matrix, MATRIX)
    np.testing.assert_allclose(again.calibration.covariance.sigmas, [0.2, 1e-3, 1e-3, np.sqrt(1e-7)])


def test_the_document_names_its_units() -> None:
    document = json.loads(RIG.to_json())["calibration"]
    assert document["units"] == {"length": "m", "angle": "rad", "image": "px", "distortion": "1"}
    assert [each["unit"] for each in document["covariance"]["parameters"]] == ["px", "1", "rad", "m"]
    assert document["covariance"]["lower"][1] == [1e-5, 1e-6]


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("version",), 2, "version: .*this cairn reads version 1, the file is of 2"),
        (("calibration", "gauge"), "right", "speaks of right; the rig has tof, left"),
        (("calibration", "gauge"), "left", "left has no rx"),
        (("calibration", "covariance", "parameters", 1, "name"), "p1", "left has no p1; it has rx, .*k4"),
        (("calibration", "covariance", "parameters", 2, "camera"), "tof", "tof has no rx"),
        (("calibration", "covariance", "parameters", 0, "unit"), "m", "unit of fx must be px, got m"),
        (("calibration", "covariance", "lower"), [[1.0]], "rows of 1 to 4 numbers"),
        (("calibration", "covariance", "lower", 1), [1.0, 1e-6], "negative eigenvalue"),
        (("calibration", "covariance", "lower", 0), [-1.0], "negative eigenvalue"),
        (("calibration", "units", "length"), "mm", "units.length"),
        (("calibration", "inputs", 0, "sha256"), "f" * 63, "sha256"),
    ],
)
def test_a_record_that_cannot_be_is_refused_by_name(path: tuple[str | int, ...], value: object, named: str) -> None:
    with pytest.raises(BadInputError, match=named):
        rig_from_json(changed(*path, to=value))


def test_the_gauge_must_be_where_the_rig_is() -> None:
    with pytest.raises(BadInputError, match="gauge is tof: its T_rig_camera must be the identity"):
        rig_from_json(changed("cameras", "tof", "T_rig_camera", to=RIG["left"].T_rig_camera))


def test_the_largest_covariance_fits_the_document() -> None:
    cameras = {f"c{n}": mount_camera(Spectrum.COLOUR, FISHEYE, np.eye(4)) for n in range(18)}
    names = [(name, parameter) for name in list(cameras)[1:] for parameter in FISHEYE.intrinsic_names]
    names += [(name, part) for name in list(cameras)[1:] for part in ("rx", "ry", "rz", "tx", "ty", "tz")]
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(238, 300)) * 10.0 ** rng.uniform(-9, -6, (238, 1))
    record = {
        "software": "x",
        "made_s": 0,
        "gauge": "c0",
        "covariance": covariance_from_matrix(names, factor @ factor.T),
    }
    rig = Rig(name="many", cameras=cameras, calibration=Calibration.model_validate(record))
    assert len(names) == 238
    # The rest of the document's 4 MiB is for a map of the range camera's pixels.
    assert 0.8 * (1 << 20) < len(rig.to_json()) <= 1 << 20 < RIG_BYTES_MAX
    assert rig_from_json(rig.to_json()) == rig
