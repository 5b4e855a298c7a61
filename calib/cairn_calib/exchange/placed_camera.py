"""Cameras as other calibration programs' files hold them: a name, a lens, and a place in a common frame.

    rig.json  <->  (PlacedCamera, ...)  <->  Kalibr, OpenCV, ROS, mrcal           a module each

Each format's module reads text into `CameraFile` and writes a sequence of placed cameras. A number that changes where a
pixel looks and has no counterpart on the other side is an error that names it; other fields of a file that no rig
holds are listed, so that a command can show them to its user.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import Transform
from cairn_map.errors import BadInputError, first_error

TEXT_BYTES_MAX = 1 << 24
"""Largest file, bytes: a .cameramodel with mrcal's whole solve is some hundred kilobytes."""
KIND = "bad_camera_file"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedCamera:
    """One camera; `T_rig_camera` is None where the format holds no pose."""

    name: str
    camera: Lens
    T_rig_camera: Transform | None

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise BadInputError(
                KIND, f"a camera's name must be letters, digits, _, . or -, at most 64, got {self.name[:80]!r}"
            )


@dataclass(frozen=True, slots=True)
class CameraFile:
    """The cameras of a file, and the fields of it that a rig does not hold."""

    cameras: tuple[PlacedCamera, ...]
    left_out: tuple[str, ...] = ()


def validate(model: type[Model], document: object, *, name: str) -> Model:
    """The data of a file as a model.

    Raises:
        BadInputError: a field is missing or wrong; the message names it.
    """
    try:
        return model.model_validate(document)
    except ValidationError as exc:
        raise BadInputError(KIND, f"{name}: {first_error(exc)}") from exc


def only_camera(cameras: Sequence[PlacedCamera], *, format_name: str) -> PlacedCamera:
    """The camera of a format that holds one.

    Raises:
        BadInputError: there are several.
    """
    if len(cameras) != 1:
        names = ", ".join(each.name for each in cameras)
        raise BadInputError(
            KIND,
            f"a file of {format_name} holds one camera, the rig has {names}: write them to one file each, with "
            "{camera} in OUT, or choose one with --camera",
        )
    return cameras[0]


def not_held(camera: PlacedCamera, field: str, why: str) -> BadInputError:
    """Error to raise where a format cannot hold a number."""
    return BadInputError(KIND, f"cameras.{camera.name}.{field}: {why}")


FOREIGN_LENSES = {
    "omni": "omnidirectional (Mei's unified model)",
    "ucm": "unified (UCM)",
    "eucm": "extended unified (EUCM)",
    "ds": "double sphere",
    "double_sphere": "double sphere",
    "fov": "FOV (Devernay and Faugeras)",
    "field_of_view": "FOV (Devernay and Faugeras)",
    "thin_prism_fisheye": "fisheye with thin prism",
}
"""Lens models that other programs calibrate and rig.json does not hold, by their names in files."""


def foreign_lens(name: str, model: str) -> BadInputError:
    """Error to raise where a file's lens is of a model that no rig holds: its name, and the way out.

    Args:
        name: the file and camera.
        model: the model as the file names it.
    """
    what = FOREIGN_LENSES.get(model.lower())
    return BadInputError(
        KIND,
        f"{name}: the lens is {what or 'of the model'} ({model[:40]!r} in the file); rig.json holds Brown's pinhole "
        "(radtan, plumb_bob, rational_polynomial) and Kannala and Brandt's fisheye (equidistant). Calibrate the same "
        "images with one of these: wide lenses by kalibr_calibrate_cameras --models pinhole-equi, or here by cairn "
        "calib corners and cairn calib solve --fisheye NAME",
    )
