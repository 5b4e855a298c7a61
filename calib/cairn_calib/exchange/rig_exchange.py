"""Exchange of rigs with the files of Kalibr, OpenCV, ROS and mrcal: formats, and fields that one side cannot hold.

None of these formats states a camera's spectrum, a range camera's sensing, or any uncertainty. The caller gives the
spectrum; a field of a rig that the other file cannot hold is refused by name, until the caller names it to be left out.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from cairn_calib.exchange.camera_info_message import is_camera_info_message, read_camera_info_messages
from cairn_calib.exchange.camera_matrix_files import read_opencv, read_ros, write_opencv, write_ros
from cairn_calib.exchange.kalibr_camchain import read_kalibr, write_kalibr
from cairn_calib.exchange.mrcal_cameramodel import read_mrcal, write_mrcal
from cairn_calib.exchange.placed_camera import KIND, TEXT_BYTES_MAX, CameraFile, PlacedCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_map.errors import BadInputError, first_error

RIG, MESSAGE = "rig", "camera_info"
"""Forms of a file that are read next to those of `FORMATS`: cairn's own, and ROS's message as it is printed."""
DROPPABLE = ("T_rig_camera", "sensing", "calibration_sigma_px", "radiometry", "range_bias", "body", "calibration")
"""Fields of a rig that may be left out: none of them changes where a pixel of a camera looks in that camera's frame."""


@dataclass(frozen=True, slots=True)
class ExchangeFormat:
    """Reader and writer of one format; `holds_place` is True if it states a camera's pose."""

    read: Callable[..., CameraFile]
    write: Callable[[Sequence[PlacedCamera]], str]
    holds_place: bool


FORMATS = {
    "kalibr": ExchangeFormat(read_kalibr, write_kalibr, holds_place=True),
    "opencv": ExchangeFormat(read_opencv, write_opencv, holds_place=True),
    "ros": ExchangeFormat(read_ros, write_ros, holds_place=False),
    "mrcal": ExchangeFormat(read_mrcal, write_mrcal, holds_place=True),
}


def format_of_text(path: Path, text: str) -> str:
    """The format of a file, by its suffix and, where several share one, by its content.

    Raises:
        BadInputError: none of them.
    """
    if path.suffix == ".json":
        return RIG
    if path.suffix == ".cameramodel":
        return "mrcal"
    if re.search(r"^cam0\s*:", text, re.MULTILINE):
        return "kalibr"
    if text.lstrip("\ufeff").startswith("%YAML") or "!!opencv-matrix" in text:
        return "opencv"
    if re.search(r"^camera_matrix\s*:", text, re.MULTILINE):
        return "ros"
    if is_camera_info_message(text):
        return MESSAGE
    raise BadInputError(
        KIND,
        f"{path.name} is of no known format: expected rig.json, a .cameramodel, or YAML of Kalibr (cam0), OpenCV, "
        "or ROS (camera_matrix, or camera_info as ros2 topic echo prints it)",
    )


def read_text(path: Path) -> str:
    """The text of a camera file.

    Raises:
        BadInputError: it cannot be read, is too large or no text.
    """
    try:
        if path.stat().st_size > TEXT_BYTES_MAX:
            raise BadInputError(KIND, f"{path} must be at most {TEXT_BYTES_MAX} bytes, got {path.stat().st_size}")
        return path.read_text(encoding="utf-8")
    except OSError as exc:
        raise BadInputError(KIND, f"cannot read {path}: {exc.strerror}") from exc
    except UnicodeDecodeError as exc:
        raise BadInputError(KIND, f"{path} is no text: {exc.reason} at byte {exc.start}") from exc


def read_cameras(path: Path, text: str) -> CameraFile:
    """The cameras of another program's file, whatever its format.

    Raises:
        BadInputError: it is of no known format, or something in it is missing or wrong; the message names it.
    """
    source = format_of_text(path, text)
    if source == RIG:
        raise BadInputError("bad_arguments", f"{path.name} is a rig.json, not another program's file")
    read = read_camera_info_messages if source == MESSAGE else FORMATS[source].read
    return read(text, name=path.name)


def cameras_of_rig(rig: Rig, *, format_name: str, drop: Sequence[str] = ()) -> CameraFile:
    """Cameras of a rig for a format; fields that the format cannot hold must be dropped.

    Raises:
        BadInputError: the rig has fields that the format cannot hold; the message names all of them, and what to do.
    """
    held = FORMATS[format_name].holds_place
    said: list[str] = []
    placed = []
    for name, each in rig.cameras.items():
        if not isinstance(each.camera, Lens):
            raise BadInputError(
                KIND, f"cameras.{name}.camera: {format_name} has no spinning lidar; choose others with --camera"
            )
        optional = ("sensing", "calibration_sigma_px", "radiometry", "range_bias")
        said += [f"cameras.{name}.{field}" for field in optional if getattr(each, field)]
        is_said = held and "T_rig_camera" not in drop
        if not is_said and not np.array_equal(each.transform, np.eye(4)):
            said.append(f"cameras.{name}.T_rig_camera")
        placed.append(PlacedCamera(name, each.camera, each.transform if is_said else None))
    said += [field for field in ("body", "calibration") if getattr(rig, field)]
    refused = [field for field in said if field.rpartition(".")[2] not in drop]
    if refused:
        fields = dict.fromkeys(field.rpartition(".")[2] for field in refused)
        raise BadInputError(
            KIND, f"{format_name} cannot say {', '.join(refused)}; to leave that out, add --drop {','.join(fields)}"
        )
    return CameraFile(tuple(placed), (*said, *(f"cameras.{name}.spectrum" for name in rig.cameras)))


def choose_cameras(cameras: Sequence[PlacedCamera], names: Sequence[str]) -> tuple[PlacedCamera, ...]:
    """The cameras with these names, in this order; all of them where no name is given.

    Raises:
        BadInputError: there is no such camera, or two have one name.
    """
    by_name = {each.name: each for each in cameras}
    if len(by_name) < len(cameras):
        raise BadInputError(KIND, f"two cameras have one name: {', '.join(each.name for each in cameras)}")
    if missing := [name for name in names if name not in by_name]:
        raise BadInputError("unknown_camera", f"there is no camera {missing[0]!r}; there are {', '.join(by_name)}")
    return tuple(by_name[name] for name in names) if names else tuple(cameras)


def rig_of_cameras(cameras: Sequence[PlacedCamera], *, name: str, spectra: Mapping[str, Spectrum]) -> Rig:
    """A rig of cameras that were read from other files.

    Args:
        cameras: the cameras; a single one may be without a pose, and its frame is the rig's then.
        name: name of the rig.
        spectra: spectrum of each camera.

    Raises:
        BadInputError: a spectrum or a place is missing, or the name is none.
    """
    if unknown := [each.name for each in cameras if each.name not in spectra]:
        wanted = ",".join(f"{each}=colour" for each in unknown)
        raise BadInputError(
            KIND, f"which spectrum {', '.join(unknown)} sees is not in the file: add --spectrum {wanted}"
        )
    if len(cameras) == 1 and cameras[0].T_rig_camera is None:
        cameras = [replace(cameras[0], T_rig_camera=np.eye(4))]
    parts = {}
    for each in cameras:
        if each.T_rig_camera is None:
            raise BadInputError(KIND, f"where {each.name} is on the rig is not in the file (T_rig_camera)")
        parts[each.name] = mount_camera(spectra[each.name], each.camera, each.T_rig_camera)
    try:
        return Rig(name=name, cameras=parts)
    except ValidationError as exc:
        raise BadInputError("bad_rig", f"{name}: {first_error(exc)}") from exc
