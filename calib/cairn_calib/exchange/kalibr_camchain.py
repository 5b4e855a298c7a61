"""Kalibr's camchain: all cameras of a rig in one YAML file, each placed by its predecessor.

    cam0: {camera_model: pinhole, intrinsics: [fu, fv, pu, pv], distortion_model: radtan, distortion_coeffs: [k1, ...],
           resolution: [width, height], rostopic: /left/image_raw}
    cam1: {..., T_cn_cnm1: [[...], ...]}           points from cam0's frame to cam1's, metres

A chain of cameras and an IMU (kalibr_calibrate_imu_camera) states `T_cam_imu`, points from the IMU's frame to the
camera's, next to that or instead of it; other programs' chains (OpenVINS) state its inverse `T_imu_cam`. On reading,
the rig's frame is cam0's, and the IMU's place is left out.

`radtan` is Brown with four coefficients, `equidistant` is `fisheye.py`. Kalibr has no name for a camera: it is kept in
the topic.
"""

import re
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cairn_calib.exchange.placed_camera import KIND, CameraFile, PlacedCamera, foreign_lens, not_held, validate
from cairn_calib.exchange.yaml_text import number, numbers, read_yaml
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import Transform, check_transform, inverse
from cairn_map.errors import BadInputError

RADTAN_COEFFICIENTS = 4
CAMERA_KEY = re.compile(r"cam\d+")
TOPIC = re.compile(r"/?([A-Za-z0-9][A-Za-z0-9_.-]{0,63})/image_raw")
IDENTITY = np.eye(4)
SAME_M, SAME_RAD = 1e-3, 1e-3
"""Distance and angle within which two statements of one place are the same, but for rounding."""
Row = tuple[float, float, float, float]
Rows = tuple[Row, Row, Row, Row]


class _CamchainCamera(BaseModel):
    """Fields of one entry with a counterpart in a rig; all others are listed as left out."""

    model_config = ConfigDict(extra="allow")

    intrinsics: tuple[float, float, float, float]
    distortion_model: str
    distortion_coeffs: Annotated[tuple[float, ...], Field(max_length=4)] = ()
    resolution: tuple[int, int]
    rostopic: str | None = None
    T_cn_cnm1: Rows | None = None
    T_cam_imu: Rows | None = None
    T_imu_cam: Rows | None = None

    def place_from_imu(self, name: str) -> Transform | None:
        """T_cam_imu, where the entry states it or its inverse.

        Raises:
            BadInputError: it is no transform.
        """
        if self.T_cam_imu is not None:
            return check_transform(self.T_cam_imu, name=f"{name}.T_cam_imu")
        if self.T_imu_cam is not None:
            return inverse(check_transform(self.T_imu_cam, name=f"{name}.T_imu_cam"))
        return None


def read_kalibr(text: str, *, name: str) -> CameraFile:
    """The cameras of a camchain.

    Raises:
        BadInputError: a field is missing or wrong, or of another lens (omni, eucm, ds, fov); the message names it.
    """
    document = read_yaml(text, name=name)
    keys = [f"cam{n}" for n in range(sum(CAMERA_KEY.fullmatch(key) is not None for key in document))]
    if not keys or any(key not in document for key in keys):
        raise BadInputError(KIND, f"{name} must have the cameras cam0, cam1, ... without a gap")
    entries = [_entry(document[key], name=f"{name}: {key}") for key in keys]
    topics = [TOPIC.fullmatch(entry.rostopic or "") for entry in entries]
    names = [topic.group(1) for topic in topics if topic is not None]
    if len(set(names)) < len(entries):
        names = keys
    places = _places(entries, [f"{name}: {key}" for key in keys])
    cameras = [
        PlacedCamera(names[n], _lens_of(entry, name=f"{name}: {key}"), places[n])
        for n, (key, entry) in enumerate(zip(keys, entries, strict=True))
    ]
    left = [f"{key}.{extra}" for key, entry in zip(keys, entries, strict=True) for extra in entry.model_extra or {}]
    left = [field for field in left if not field.endswith((".cam_overlaps", ".camera_model"))]
    # The first place of the IMU; the others follow from it and from the cameras' places.
    left += [
        f"{key}.{field}"
        for key, entry in zip(keys, entries, strict=True)
        for field in ("T_cam_imu", "T_imu_cam")
        if getattr(entry, field) is not None
    ][:1]
    return CameraFile(tuple(cameras), (*left, *(key for key in document if key not in keys)))


def _entry(document: object, *, name: str) -> _CamchainCamera:
    """One camera's fields, if its lens is one that a rig holds."""
    given = document if isinstance(document, dict) else {}
    if "camera_model" not in given:
        raise BadInputError(KIND, f"{name}: camera_model is missing: Kalibr's camchain has it for each camera")
    for field, known in (("camera_model", ("pinhole",)), ("distortion_model", ("radtan", "equidistant", "none"))):
        if field in given and given[field] not in known:
            raise foreign_lens(name, str(given[field]))
    return validate(_CamchainCamera, document, name=name)


def _places(entries: Sequence[_CamchainCamera], names: Sequence[str]) -> list[Transform]:
    """T_rig_camera of each camera: by its predecessor, else by the IMU; both, where both are there, must agree."""
    from_imu = [entry.place_from_imu(name) for entry, name in zip(entries, names, strict=True)]
    places: list[Transform] = [IDENTITY]
    for n, (entry, T_cn_imu) in enumerate(zip(entries, from_imu, strict=True)):
        if n == 0:
            continue
        # An earlier camera m of known place on the IMU: T_rig_cn = T_rig_cm T_cm_imu T_imu_cn.
        known = next(((m, T) for m, T in enumerate(from_imu[:n]) if T is not None), None)
        by_imu = None if known is None or T_cn_imu is None else places[known[0]] @ known[1] @ inverse(T_cn_imu)
        if entry.T_cn_cnm1 is not None:
            T_cn_cnm1 = check_transform(entry.T_cn_cnm1, name=f"{names[n]}.T_cn_cnm1")
            by_chain = places[-1] @ inverse(T_cn_cnm1)
            if by_imu is not None:
                _check_agreement(by_chain, by_imu, names[n])
            places.append(by_chain)
        elif by_imu is not None:
            places.append(by_imu)
        else:
            raise BadInputError(
                KIND,
                f"{names[n]}.T_cn_cnm1 is missing: it says where the camera is; T_cam_imu (or T_imu_cam) does so, too, "
                "if a camera before it has it as well",
            )
    return places


def _check_agreement(by_chain: Transform, by_imu: Transform, name: str) -> None:
    apart = inverse(by_chain) @ by_imu
    apart_m = float(np.linalg.norm(apart[:3, 3]))
    apart_rad = float(np.arccos(np.clip((np.trace(apart[:3, :3]) - 1) / 2, -1, 1)))
    if apart_m > SAME_M or apart_rad > SAME_RAD:
        raise BadInputError(
            KIND,
            f"{name}: its place by T_cn_cnm1 and its place by T_cam_imu differ by {1000 * apart_m:.3g} mm and "
            f"{np.degrees(apart_rad):.3g} degrees: take out the one that is wrong (T_cam_imu maps points from the IMU "
            "to the camera, T_imu_cam back)",
        )


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
