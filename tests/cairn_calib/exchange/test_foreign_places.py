"""Kalibr's chains that place cameras by the IMU, and camera_info as ROS prints it."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.fixtures.calib.foreign_rigs import ROS1_ECHO, ROS2_ECHO

from cairn_calib.cli.main import main
from cairn_calib.exchange.kalibr_camchain import read_kalibr
from cairn_calib.exchange.rig_exchange import MESSAGE, format_of_text, read_cameras
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.rig import load_rig
from cairn_map.errors import BadInputError

PINHOLE = {
    "camera_model": "pinhole",
    "distortion_coeffs": [-0.28, 0.07, 0.0002, 0.00002],
    "distortion_model": "radtan",
    "intrinsics": [458.6, 457.3, 367.2, 248.4],
    "resolution": [752, 480],
}
T_imu_cams = [
    transform_from_vector([1.2, -1.1, 1.3, -0.02, -0.06, 0.01]),
    transform_from_vector([1.21, -1.12, 1.29, -0.02, 0.05, 0.01]),
    transform_from_vector([0.3, 2.0, 0.1, 0.1, 0.2, -0.3]),
]
FORMS = ("T_cn_cnm1", "T_cam_imu", "T_imu_cam")


def chain(*forms: str) -> dict[str, dict[str, object]]:
    """Three cameras, the place of each in these forms."""
    document: dict[str, dict[str, object]] = {}
    for n, form in enumerate(forms):
        document[f"cam{n}"] = dict(PINHOLE)
        T_cn_imu = np.linalg.inv(T_imu_cams[n])
        of = {"T_cam_imu": T_cn_imu, "T_imu_cam": T_imu_cams[n]}
        if n:
            of["T_cn_cnm1"] = T_cn_imu @ T_imu_cams[n - 1]
        for each in filter(None, form.split("+")):
            document[f"cam{n}"][each] = of[each].tolist()
    return document


@pytest.mark.parametrize(
    "forms",
    [
        ("T_cam_imu", "T_cam_imu", "T_cam_imu"),
        ("T_imu_cam", "T_imu_cam", "T_imu_cam"),
        ("T_imu_cam", "T_cam_imu", "T_imu_cam"),
        ("T_cam_imu", "T_cam_imu+T_cn_cnm1", "T_cam_imu+T_cn_cnm1"),
        ("", "T_cn_cnm1+T_cam_imu", "T_cam_imu"),
        ("", "T_cn_cnm1", "T_cn_cnm1"),
    ],
)
def test_every_statement_of_a_place_gives_the_same_rig(forms: tuple[str, ...]) -> None:
    found = read_kalibr(yaml.safe_dump(chain(*forms)), name="chain.yaml")
    for camera, T_imu_cam in zip(found.cameras, T_imu_cams, strict=True):
        assert camera.T_rig_camera is not None
        np.testing.assert_allclose(camera.T_rig_camera, np.linalg.inv(T_imu_cams[0]) @ T_imu_cam, atol=1e-12)
    said = [form for form in forms if "imu" in form]
    assert len(found.left_out) == bool(said), "the IMU's place is named once, where it was stated"


def test_a_place_that_is_missing_or_stated_in_two_ways_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"cam2.T_cn_cnm1 is missing.*T_cam_imu"):
        read_kalibr(yaml.safe_dump(chain("T_cam_imu", "T_cam_imu", "")), name="chain.yaml")
    with pytest.raises(BadInputError, match=r"cam1.T_cn_cnm1 is missing"):
        read_kalibr(yaml.safe_dump(chain("", "T_cam_imu", "T_cam_imu")), name="chain.yaml")
    document = chain("T_cam_imu", "T_cam_imu+T_cn_cnm1", "T_cam_imu")
    document["cam1"]["T_cam_imu"] = T_imu_cams[1].tolist()  # the inverse under the wrong name
    with pytest.raises(BadInputError, match=r"cam1: its place by T_cn_cnm1 and its place by T_cam_imu differ by"):
        read_kalibr(yaml.safe_dump(document), name="chain.yaml")


def test_messages_of_both_versions_of_ros_are_read_as_they_are_printed() -> None:
    assert format_of_text(Path("x.yaml"), ROS2_ECHO) == format_of_text(Path("x.txt"), ROS1_ECHO) == MESSAGE
    lost = "A message was lost!!!\n\ttotal count change:3\n\ttotal count: 3---\n"
    cut_off = ROS2_ECHO[: len(ROS2_ECHO) // 2]
    found = read_cameras(Path("x.yaml"), ROS2_ECHO + lost + ROS2_ECHO + ROS1_ECHO + cut_off)
    left, right = found.cameras
    assert (left.name, right.name) == ("left_camera_optical_frame", "head_right")
    assert (left.camera.width, left.camera.height) == (640, 480)
    assert (left.camera.focal_px, left.camera.centre_px) == ((605.25, 606.5), (321.5, 239.25))
    assert left.camera.distortion == (0.41, 0.2, 0.001, -0.0005, 0.05, 0.7, 0.15, 0.01)
    assert right.camera.distortion == (-0.25, 0.07, 0.0001, -0.0002, 0.0)
    assert left.T_rig_camera is None and found.left_out == ("r, p (of the rectified image)",)
    unended = ROS1_ECHO.removesuffix("---\n")
    assert read_cameras(Path("x.yaml"), unended).cameras[0].camera == right.camera


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (ROS1_ECHO.replace("500.5", "0").replace("320.25", "0"), None),
        (
            ROS1_ECHO.replace("[500.5, 0.0, 320.25, 0.0, 501.0, 240.75, 0.0, 0.0, 1.0]", str([0.0] * 9)),
            "no calibration",
        ),
        (ROS1_ECHO.replace("binning_x: 1", "binning_x: 2"), "binned or cut out"),
        (ROS1_ECHO.replace("  width: 640", "  width: 320"), "binned or cut out"),
        (ROS1_ECHO.replace("plumb_bob", "double_sphere"), "the lens is double sphere"),
        (ROS1_ECHO + ROS1_ECHO.replace("500.5", "500.6"), "message 2 states another lens of head_right"),
        (ROS1_ECHO.replace("K: [500.5, ", "K: ["), "at least 9 items"),
    ],
)
def test_messages_of_no_calibrated_whole_image_are_refused(text: str, named: str | None) -> None:
    with pytest.raises(BadInputError, match=named or "focal"):
        read_cameras(Path("x.yaml"), text)


def test_a_printed_message_becomes_a_rig(tmp_path: Path) -> None:
    (tmp_path / "info.yaml").write_text(ROS2_ECHO)
    main(["convert", str(tmp_path / "info.yaml"), str(tmp_path / "rig.json"), "--spectrum", "colour"])
    assert load_rig(tmp_path / "rig.json")["left_camera_optical_frame"].camera.focal_px == (605.25, 606.5)
