"""ROS's camera_info YAML (camera_calibration_parsers): one camera a file, without a place on the rig.

    image_width, image_height, camera_name, camera_matrix, distortion_model, distortion_coefficients,
    rectification_matrix, projection_matrix

`plumb_bob` is Brown with five coefficients, `rational_polynomial` with eight, `equidistant` is `fisheye.py`. The last
two matrices speak of the rectified image, which is no matter of the camera: on writing they are those of the camera
alone, on reading they are left out.
"""

from collections.abc import Sequence
from pathlib import PurePath

from pydantic import BaseModel, ConfigDict

from cairn_calib.exchange.camera_matrix import MatrixNode, camera_matrix, lens_of
from cairn_calib.exchange.placed_camera import KIND, Foreign, PlacedCamera, checked, not_held, only_camera
from cairn_calib.exchange.yaml_text import numbers, read_yaml
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_map.errors import BadInputError

BROWN_MODELS = {"plumb_bob": 5, "rational_polynomial": 8}
FISHEYE_MODEL = "equidistant"
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class _CameraInfo(BaseModel):
    """What of the file has a counterpart in a rig; the rest is listed."""

    model_config = ConfigDict(extra="allow")

    image_width: int
    image_height: int
    camera_name: str = ""
    camera_matrix: MatrixNode
    distortion_model: str = "plumb_bob"
    distortion_coefficients: MatrixNode


def read_ros(text: str, *, name: str) -> Foreign:
    """The camera of a file, by its `camera_name` or else named as the file is.

    Raises:
        BadInputError: a field is missing or wrong, or of another distortion model; the message names it.
    """
    found = checked(_CameraInfo, read_yaml(text, name=name), name=name)
    if found.distortion_model not in (*BROWN_MODELS, FISHEYE_MODEL):
        known = ", ".join((*BROWN_MODELS, FISHEYE_MODEL))
        raise BadInputError(KIND, f"{name}: distortion_model must be {known}, got {found.distortion_model[:40]!r}")
    lens = lens_of(
        (found.image_width, found.image_height),
        found.camera_matrix,
        found.distortion_coefficients,
        fisheye=found.distortion_model == FISHEYE_MODEL,
        name=name,
    )
    camera = PlacedCamera(found.camera_name or PurePath(name).stem, lens, None)
    return Foreign((camera,), tuple(found.model_extra or ()))


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
    lines += _matrix("camera_matrix", 3, K)
    lines.append(f"distortion_model: {FISHEYE_MODEL if isinstance(camera, FisheyeCamera) else model}")
    lines += _matrix("distortion_coefficients", 1, camera.distortion)
    lines += _matrix("rectification_matrix", 3, IDENTITY)
    lines += _matrix("projection_matrix", 3, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    return "\n".join(lines) + "\n"


def _matrix(name: str, rows: int, data: Sequence[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(data) // rows}", f"  data: {numbers(data)}"]
