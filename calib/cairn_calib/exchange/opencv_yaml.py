"""OpenCV's YAML (FileStorage), with the names of its calibration samples: one camera a file.

    image_width, image_height, camera_matrix, distortion_coefficients, fisheye_model (1: cv2.fisheye)
    R, T: where the camera is, as stereoCalibrate says it: p_camera = R p_rig + T, metres; optional

A file of `stereo_calib` (M1, D1, M2, D2) has no image size, so it is refused by the field that is missing.
"""

from collections.abc import Sequence
from pathlib import PurePath
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cairn_calib.exchange.camera_matrix import MatrixNode, camera_matrix, lens_of
from cairn_calib.exchange.placed_camera import KIND, Foreign, PlacedCamera, checked, only_camera
from cairn_calib.exchange.yaml_text import numbers, read_yaml
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.poses import checked_transform, inverse
from cairn_map.errors import BadInputError


class _OpencvCamera(BaseModel):
    """What of the file has a counterpart in a rig; the rest is listed."""

    model_config = ConfigDict(extra="allow")

    image_width: int
    image_height: int
    camera_matrix: MatrixNode
    distortion_coefficients: MatrixNode
    fisheye_model: Annotated[int, Field(ge=0, le=1)] = 0
    R: MatrixNode | None = None
    T: MatrixNode | None = None


def read_opencv(text: str, *, name: str) -> Foreign:
    """The camera of a file, named as the file is.

    Raises:
        BadInputError: a field is missing or wrong; the message names it.
    """
    found = checked(_OpencvCamera, read_yaml(text, name=name), name=name)
    size, is_fisheye = (found.image_width, found.image_height), found.fisheye_model == 1
    lens = lens_of(size, found.camera_matrix, found.distortion_coefficients, fisheye=is_fisheye, name=name)
    T_rig_camera = None
    if found.R is not None or found.T is not None:
        if found.R is None or found.T is None or (len(found.R.data), len(found.T.data)) != (9, 3):
            raise BadInputError(KIND, f"{name}: R (3x3) and T (3x1) must both be there, or neither")
        T_camera_rig = np.eye(4)
        T_camera_rig[:3, :3], T_camera_rig[:3, 3] = np.reshape(found.R.data, (3, 3)), found.T.data
        T_rig_camera = inverse(checked_transform(T_camera_rig, name=f"{name}: R"))
    return Foreign((PlacedCamera(PurePath(name).stem, lens, T_rig_camera),), tuple(found.model_extra or ()))


def write_opencv(cameras: Sequence[PlacedCamera]) -> str:
    """A file that `cv2.FileStorage` and YAML readers take; the mirror of `read_opencv`."""
    each = only_camera(cameras, format_name="OpenCV")
    camera = each.camera
    lines = ["%YAML 1.1", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    lines.append(f"fisheye_model: {int(isinstance(camera, FisheyeCamera))}")
    lines += _matrix("camera_matrix", 3, camera_matrix(camera))
    lines += _matrix("distortion_coefficients", len(camera.distortion), camera.distortion)
    if each.T_rig_camera is not None:
        T_camera_rig = inverse(each.T_rig_camera)
        lines += _matrix("R", 3, T_camera_rig[:3, :3].ravel().tolist())
        lines += _matrix("T", 3, T_camera_rig[:3, 3].tolist())
    return "\n".join(lines) + "\n"


def _matrix(name: str, rows: int, data: Sequence[float]) -> list[str]:
    head = [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {len(data) // rows}", "   dt: d"]
    return [*head, f"   data: {numbers(data)}"]
