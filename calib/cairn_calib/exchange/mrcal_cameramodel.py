"""mrcal's .cameramodel: one camera a file, a Python dictionary with its lens, its image size and its place.

    {'lensmodel': 'LENSMODEL_OPENCV5', 'intrinsics': [fx, fy, cx, cy, k1, k2, p1, p2, k3],
     'extrinsics': [rx, ry, rz, tx, ty, tz], 'imagersize': [width, height]}

`extrinsics` maps points from the reference frame to the camera's (`rt_fromref`), radians and metres: T_camera_rig as a
vector. Brown's models are held (PINHOLE, OPENCV4, OPENCV5, OPENCV8, and OPENCV12 without thin prism); mrcal has no
Kannala-Brandt fisheye, and its splined and stereographic lenses are no rig's.
"""

import ast
from collections.abc import Sequence
from pathlib import PurePath
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_calib.exchange.placed_camera import (
    KIND,
    TEXT_BYTES_MAX,
    CameraFile,
    PlacedCamera,
    not_held,
    only_camera,
    validate,
)
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector, vector_from_transform
from cairn_calib.rig.poses import inverse
from cairn_map.errors import BadInputError

COEFFICIENTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
HELD = 8
Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Six = tuple[Number, Number, Number, Number, Number, Number]


class _Cameramodel(BaseModel):
    """Fields of the file with a counterpart in a rig; all others are listed as left out."""

    model_config = ConfigDict(extra="allow")

    lensmodel: str
    intrinsics: Annotated[tuple[float, ...], Field(min_length=4, max_length=10_000)]
    extrinsics: Six
    imagersize: tuple[int, int]


def read_mrcal(text: str, *, name: str) -> CameraFile:
    """The camera of a file, named as the file is.

    Raises:
        BadInputError: it is no such dictionary, or of a lens that a rig has not; the message names the field.
    """
    if len(text) > TEXT_BYTES_MAX:
        raise BadInputError(KIND, f"{name} must be at most {TEXT_BYTES_MAX} bytes, got {len(text)}")
    try:
        document = ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as exc:
        raise BadInputError(KIND, f"{name} is no .cameramodel: not a Python dictionary") from exc
    found = validate(_Cameramodel, document, name=name)
    if found.lensmodel not in COEFFICIENTS:
        raise BadInputError(
            KIND,
            f"{name}: lensmodel must be {', '.join(COEFFICIENTS)}, got {found.lensmodel[:60]!r}; "
            "mrcal-convert-lensmodel makes LENSMODEL_OPENCV8 of it",
        )
    distortion = found.intrinsics[4:]
    if len(distortion) != COEFFICIENTS[found.lensmodel]:
        wanted = COEFFICIENTS[found.lensmodel] + 4
        raise BadInputError(KIND, f"{name}: intrinsics of {found.lensmodel} are {wanted}, got {len(found.intrinsics)}")
    if any(distortion[HELD:]):
        raise BadInputError(KIND, f"{name}: intrinsics[12] on (thin prism) must be 0: rig.json has no such lens")
    lens = {
        "width": found.imagersize[0],
        "height": found.imagersize[1],
        "focal_px": found.intrinsics[:2],
        "centre_px": found.intrinsics[2:4],
        "distortion": distortion[:HELD] or (0.0,) * 5,
    }
    T_rig_camera = inverse(transform_from_vector(found.extrinsics))
    camera = PlacedCamera(PurePath(name).stem, validate(Camera, lens, name=name), T_rig_camera)
    return CameraFile((camera,), tuple(found.model_extra or ()))


def write_mrcal(cameras: Sequence[PlacedCamera]) -> str:
    """A file that `mrcal.cameramodel` reads; the mirror of `read_mrcal`.

    Raises:
        BadInputError: several cameras, or one that is no pinhole.
    """
    each = only_camera(cameras, format_name="mrcal")
    camera = each.camera
    if not isinstance(camera, Camera):
        raise not_held(each, "camera.model", "mrcal has no Kannala-Brandt fisheye")
    vector = [0.0] * 6 if each.T_rig_camera is None else vector_from_transform(inverse(each.T_rig_camera)).tolist()
    intrinsics = ", ".join(repr(float(value)) for value in camera.intrinsics)
    return (
        "{\n"
        f"    'lensmodel':  'LENSMODEL_OPENCV{len(camera.distortion)}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': [ {intrinsics} ],\n\n"
        "    # extrinsics are rt_fromref\n"
        f"    'extrinsics': [ {', '.join(map(repr, vector))} ],\n\n"
        f"    'imagersize': [ {camera.width}, {camera.height} ],\n"
        "}\n"
    )
