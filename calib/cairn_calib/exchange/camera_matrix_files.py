"""Files with a camera matrix and OpenCV's coefficients: OpenCV's YAML and ROS's camera_info, one camera a file.

    [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]     k1, k2, p1, p2[, k3[, k4, k5, k6]], or k1, k2, k3, k4 of a fisheye

OpenCV's YAML (FileStorage) has the names of its calibration samples:

    image_width, image_height, camera_matrix, distortion_coefficients, fisheye_model (1: cv2.fisheye)
    R, T: the camera's place as stereoCalibrate states it, p_camera = R p_rig + T, metres; optional

A file of `stereo_calib` (M1, D1, M2, D2) has no image size, so it is refused by the field that is missing.

ROS's camera_info YAML (camera_calibration_parsers) has no place on the rig:

    image_width, image_height, camera_name, camera_matrix, distortion_model, distortion_coefficients,
    rectification_matrix, projection_matrix

and so does the message itself as `ros2 topic echo` prints it (`camera_info_message.py`).

`plumb_bob` is Brown's model with five coefficients, `rational_polynomial` with eight, `equidistant` is `fisheye.py`.
The last two matrices describe the rectified image, which is no matter of the camera: they are written as those of the
camera alone, and left out on reading.
"""

from collections.abc import Sequence
from pathlib import PurePath
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.exchange.placed_camera import (
    KIND,
    CameraFile,
    PlacedCamera,
    foreign_lens,
    not_held,
    only_camera,
    validate,
)
from cairn_calib.exchange.yaml_text import numbers, read_yaml
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import check_transform, inverse
from cairn_map.errors import BadInputError

BROWN_MODELS = {"plumb_bob": 5, "rational_polynomial": 8}
FISHEYE_MODEL = "equidistant"
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

# Numbers of coefficients: OpenCV's files may have up to 14, of which those from HELD on must be 0.
BROWN_SIZES = (0, 4, 5, 8, 12, 14)
FISHEYE_SIZE = 4
HELD = 8


class MatrixNode(BaseModel):
    """Numbers in rows, as OpenCV and ROS write them."""

    model_config = ConfigDict(extra="ignore")

    rows: Annotated[int, Field(ge=0, le=1000)]
    cols: Annotated[int, Field(ge=0, le=1000)]
    data: Annotated[tuple[float, ...], Field(max_length=10_000)] = ()

    @model_validator(mode="after")
    def _full(self) -> Self:
        if len(self.data) != self.rows * self.cols:
            raise ValueError(f"data must be {self.rows} x {self.cols} numbers, got {len(self.data)}")
        return self


def lens_of(size: tuple[int, int], K: MatrixNode, D: MatrixNode, *, fisheye: bool, name: str) -> Lens:
    """The camera of an image size, a camera matrix and coefficients.

    Raises:
        BadInputError: the matrix is not 3x3 or has skew, or no lens of `rig.json` has these coefficients.
    """
    if len(K.data) != 9:
        raise BadInputError(KIND, f"{name}: camera_matrix must be 3x3, got {len(K.data)} numbers")
    fx, skew, cx, zero, fy, cy, *last = K.data
    if skew or zero or last != [0.0, 0.0, 1.0]:
        raise BadInputError(
            KIND, f"{name}: camera_matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: no skew, got {skew:g}"
        )
    coefficients = D.data
    if fisheye and len(coefficients) != FISHEYE_SIZE:
        raise BadInputError(KIND, f"{name}: a fisheye has 4 distortion_coefficients, got {len(coefficients)}")
    if not fisheye and len(coefficients) not in BROWN_SIZES:
        raise BadInputError(KIND, f"{name}: distortion_coefficients must be 4, 5 or 8, got {len(coefficients)}")
    if any(coefficients[HELD:]):
        raise BadInputError(
            KIND, f"{name}: distortion_coefficients[8] on (thin prism, tilt) must be 0: rig.json has no such lens"
        )
    lens = {
        "width": size[0],
        "height": size[1],
        "focal_px": (fx, fy),
        "centre_px": (cx, cy),
        "distortion": coefficients[:HELD] or (0.0,) * 4,
    }
    return validate(FisheyeCamera if fisheye else Camera, lens, name=name)


def camera_matrix(camera: Lens) -> list[float]:
    """The nine numbers of a lens's camera matrix, row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


class _OpencvCamera(BaseModel):
    """Fields of the file with a counterpart in a rig; all others are listed as left out."""

    model_config = ConfigDict(extra="allow")

    image_width: int
    image_height: int
    camera_matrix: MatrixNode
    distortion_coefficients: MatrixNode
    fisheye_model: Annotated[int, Field(ge=0, le=1)] = 0
    R: MatrixNode | None = None
    T: MatrixNode | None = None


def read_opencv(text: str, *, name: str) -> CameraFile:
    """The camera of a file, named as the file is.

    Raises:
        BadInputError: a field is missing or wrong; the message names it.
    """
    document = read_yaml(text, name=name)
    if "xi" in document:
        raise foreign_lens(name, "omni")  # cv::omnidir
    found = validate(_OpencvCamera, document, name=name)
    size, is_fisheye = (found.image_width, found.image_height), found.fisheye_model == 1
    lens = lens_of(size, found.camera_matrix, found.distortion_coefficients, fisheye=is_fisheye, name=name)
    T_rig_camera = None
    if found.R is not None or found.T is not None:
        if found.R is None or found.T is None or (len(found.R.data), len(found.T.data)) != (9, 3):
            raise BadInputError(KIND, f"{name}: R (3x3) and T (3x1) must both be there, or neither")
        T_camera_rig = np.eye(4)
        T_camera_rig[:3, :3], T_camera_rig[:3, 3] = np.reshape(found.R.data, (3, 3)), found.T.data
        T_rig_camera = inverse(check_transform(T_camera_rig, name=f"{name}: R"))
    return CameraFile((PlacedCamera(PurePath(name).stem, lens, T_rig_camera),), tuple(found.model_extra or ()))


def write_opencv(cameras: Sequence[PlacedCamera]) -> str:
    """A file that `cv2.FileStorage` and YAML readers take; the mirror of `read_opencv`."""
    each = only_camera(cameras, format_name="OpenCV")
    camera = each.camera
    lines = ["%YAML 1.1", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    lines.append(f"fisheye_model: {int(isinstance(camera, FisheyeCamera))}")
    lines += _opencv_matrix("camera_matrix", 3, camera_matrix(camera))
    lines += _opencv_matrix("distortion_coefficients", len(camera.distortion), camera.distortion)
    if each.T_rig_camera is not None:
        T_camera_rig = inverse(each.T_rig_camera)
        lines += _opencv_matrix("R", 3, T_camera_rig[:3, :3].ravel().tolist())
        lines += _opencv_matrix("T", 3, T_camera_rig[:3, 3].tolist())
    return "\n".join(lines) + "\n"


def _opencv_matrix(name: str, rows: int, data: Sequence[float]) -> list[str]:
    head = [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {len(data) // rows}", "   dt: d"]
    return [*head, f"   data: {numbers(data)}"]


class _CameraInfo(BaseModel):
    """Fields of the file with a counterpart in a rig; all others are listed as left out."""

    model_config = ConfigDict(extra="allow")

    image_width: int
    image_height: int
    camera_name: str = ""
    camera_matrix: MatrixNode
    distortion_model: str = "plumb_bob"
    distortion_coefficients: MatrixNode


def read_ros(text: str, *, name: str) -> CameraFile:
    """The camera of a file, by its `camera_name` or else named as the file is.

    Raises:
        BadInputError: a field is missing or wrong, or of another distortion model; the message names it.
    """
    found = validate(_CameraInfo, read_yaml(text, name=name), name=name)
    size = (found.image_width, found.image_height)
    lens = lens_of_ros(
        size, found.camera_matrix, found.distortion_coefficients, model=found.distortion_model, name=name
    )
    camera = PlacedCamera(found.camera_name or PurePath(name).stem, lens, None)
    return CameraFile((camera,), tuple(found.model_extra or ()))


def lens_of_ros(size: tuple[int, int], K: MatrixNode, D: MatrixNode, *, model: str, name: str) -> Lens:
    """The camera of ROS's distortion model; an empty name is that of no distortion.

    Raises:
        BadInputError: another model, or the matrix or the coefficients are not those of one.
    """
    if model not in ("", *BROWN_MODELS, FISHEYE_MODEL):
        raise foreign_lens(f"{name}: distortion_model", model)
    return lens_of(size, K, D, fisheye=model == FISHEYE_MODEL, name=name)


def write_ros(cameras: Sequence[PlacedCamera]) -> str:
    """A file that `camera_info_manager` reads; the mirror of `read_ros`.

    Raises:
        BadInputError: several cameras, or one with a place on the rig.
    """
    each = only_camera(cameras, format_name="ROS")
    if each.T_rig_camera is not None:
        raise not_held(each, "T_rig_camera", "camera_info has no place for it (publish it as a transform)")
    camera = each.camera
    K, (fx, fy), (cx, cy) = camera_matrix(camera), camera.focal_px, camera.centre_px
    model = "plumb_bob" if len(camera.distortion) == BROWN_MODELS["plumb_bob"] else "rational_polynomial"
    lines = [f"image_width: {camera.width}", f"image_height: {camera.height}", f'camera_name: "{each.name}"']
    lines += _ros_matrix("camera_matrix", 3, K)
    lines.append(f"distortion_model: {FISHEYE_MODEL if isinstance(camera, FisheyeCamera) else model}")
    lines += _ros_matrix("distortion_coefficients", 1, camera.distortion)
    lines += _ros_matrix("rectification_matrix", 3, IDENTITY)
    lines += _ros_matrix("projection_matrix", 3, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    return "\n".join(lines) + "\n"


def _ros_matrix(name: str, rows: int, data: Sequence[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(data) // rows}", f"  data: {numbers(data)}"]
