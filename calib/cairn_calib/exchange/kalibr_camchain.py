"""Kalibr's camchain: all cameras of a rig in one YAML file, each placed by its predecessor.

    cam0: {camera_model: pinhole, intrinsics: [fu, fv, pu, pv], distortion_model: radtan, distortion_coeffs: [k1, ...],
           resolution: [width, height], rostopic: /left/image_raw}
    cam1: {..., T_cn_cnm1: [[...], ...]}           points from cam0's frame to cam1's, metres

`radtan` is Brown with four coefficients, `equidistant` is `fisheye.py`. Kalibr has no name for a camera: it is kept in
the topic. On reading, the rig's frame is cam0's.
"""

import re
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cairn_calib.exchange.placed_camera import KIND, CameraFile, PlacedCamera, not_held, validate
from cairn_calib.exchange.yaml_text import number, numbers, read_yaml
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import check_transform, inverse
from cairn_map.errors import BadInputError

RADTAN_COEFFICIENTS = 4
CAMERA_KEY = re.compile(r"cam\d+")
TOPIC = re.compile(r"/?([A-Za-z0-9][A-Za-z0-9_.-]{0,63})/image_raw")
IDENTITY = np.eye(4)
Row = tuple[float, float, float, float]


class _CamchainCamera(BaseModel):
    """Fields of one entry with a counterpart in a rig; all others are listed as left out."""

    model_config = ConfigDict(extra="allow")

    camera_model: Literal["pinhole"]
    intrinsics: tuple[float, float, float, float]
    distortion_model: Literal["radtan", "equidistant", "none"]
    distortion_coeffs: Annotated[tuple[float, ...], Field(max_length=4)] = ()
    resolution: tuple[int, int]
    rostopic: str | None = None
    T_cn_cnm1: tuple[Row, Row, Row, Row] | None = None


def read_kalibr(text: str, *, name: str) -> CameraFile:
    """The cameras of a camchain.

    Raises:
        BadInputError: a field is missing or wrong, or of another lens (omni, eucm, ds, fov); the message names it.
    """
    document = read_yaml(text, name=name)
    keys = [f"cam{n}" for n in range(sum(CAMERA_KEY.fullmatch(key) is not None for key in document))]
    if not keys or any(key not in document for key in keys):
        raise BadInputError(KIND, f"{name} must have the cameras cam0, cam1, ... without a gap")
    entries = [validate(_CamchainCamera, document[key], name=f"{name}: {key}") for key in keys]
    topics = [TOPIC.fullmatch(entry.rostopic or "") for entry in entries]
    names = [topic.group(1) for topic in topics if topic is not None]
    if len(set(names)) < len(entries):
        names = keys
    cameras, T_rig_before = [], IDENTITY
    for n, (key, entry) in enumerate(zip(keys, entries, strict=True)):
        if n:
            if entry.T_cn_cnm1 is None:
                raise BadInputError(KIND, f"{name}: {key}.T_cn_cnm1 is missing: it says where the camera is")
            T_rig_before = T_rig_before @ inverse(check_transform(entry.T_cn_cnm1, name=f"{name}: {key}.T_cn_cnm1"))
        cameras.append(PlacedCamera(names[n], _lens_of(entry, name=f"{name}: {key}"), T_rig_before))
    left = [f"{key}.{extra}" for key, entry in zip(keys, entries, strict=True) for extra in entry.model_extra or {}]
    left += [key for key in document if key not in keys]
    return CameraFile(tuple(cameras), tuple(field for field in left if not field.endswith(".cam_overlaps")))


def write_kalibr(cameras: Sequence[PlacedCamera]) -> str:
    """A camchain; the mirror of `read_kalibr`.

    Raises:
        BadInputError: a lens that Kalibr has not, or a first camera that is not where the rig's frame is.
    """
    first = cameras[0]
    if first.T_rig_camera is not None and not np.array_equal(first.T_rig_camera, IDENTITY):
        why = f"Kalibr places cameras from the first one, so {first.name}'s must be the identity; put the gauge first"
        raise not_held(first, "T_rig_camera", why)
    lines: list[str] = []
    T_before_rig = IDENTITY
    for n, each in enumerate(cameras):
        camera = each.camera
        model, coefficients = _distortion_of(each)
        lines.append(f"cam{n}:")
        if n:
            if each.T_rig_camera is None:
                raise not_held(each, "T_rig_camera", "Kalibr's T_cn_cnm1 needs it")
            T_cn_rig = inverse(each.T_rig_camera)
            lines.append("  T_cn_cnm1:")
            lines += [f"  - {numbers(row)}" for row in T_cn_rig @ inverse(T_before_rig)]
            T_before_rig = T_cn_rig
        lines.append(f"  cam_overlaps: {[other for other in range(len(cameras)) if other != n]}")
        lines.append("  camera_model: pinhole")
        lines.append(f"  distortion_coeffs: {numbers(coefficients)}")
        lines.append(f"  distortion_model: {model}")
        lines.append(f"  intrinsics: [{', '.join(map(number, (*camera.focal_px, *camera.centre_px)))}]")
        lines.append(f"  resolution: [{camera.width}, {camera.height}]")
        lines.append(f"  rostopic: /{each.name}/image_raw")
    return "\n".join(lines) + "\n"


def _lens_of(entry: _CamchainCamera, *, name: str) -> Lens:
    given = entry.distortion_coeffs
    wanted = 0 if entry.distortion_model == "none" else RADTAN_COEFFICIENTS
    if len(given) != wanted and any(given):
        raise BadInputError(
            KIND, f"{name}: distortion_coeffs of {entry.distortion_model} are {wanted}, got {len(given)}"
        )
    numbers_of_lens = {
        "width": entry.resolution[0],
        "height": entry.resolution[1],
        "focal_px": entry.intrinsics[:2],
        "centre_px": entry.intrinsics[2:],
        "distortion": given if len(given) == RADTAN_COEFFICIENTS else (0.0,) * 4,
    }
    return validate(FisheyeCamera if entry.distortion_model == "equidistant" else Camera, numbers_of_lens, name=name)


def _distortion_of(each: PlacedCamera) -> tuple[str, tuple[float, ...]]:
    camera = each.camera
    if isinstance(camera, FisheyeCamera):
        return "equidistant", camera.distortion
    if any(camera.distortion[RADTAN_COEFFICIENTS:]):
        held = dict(zip(camera.coefficient_names, camera.distortion, strict=True))
        names = ", ".join(f"{key} = {value:g}" for key, value in list(held.items())[RADTAN_COEFFICIENTS:] if value)
        told = (
            f"Kalibr's radtan has k1, k2, p1, p2 only, the lens has {names} (solve with --distortion to hold it at 0)"
        )
        raise not_held(each, "camera.distortion", told)
    return "radtan", camera.distortion[:RADTAN_COEFFICIENTS]
