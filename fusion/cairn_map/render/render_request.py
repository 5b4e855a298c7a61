"""Request for a rendered picture: the query of `GET .../main/render`, and the options of `cairn map render`."""

from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cairn_map.arrays import Floats
from cairn_map.epochs.moment import TimeText
from cairn_map.errors import BadInputError, first_error
from cairn_map.render.camera_rays import CameraRays, look_at, pinhole
from cairn_map.render.pose_spread import SIGMA_MAX_M, SIGMA_MAX_RAD, PoseSpread
from cairn_map.render.render_picture import SCALES, Layer, Scale

SIDE_MAX = 4096
REQUEST_PIXELS_MAX = 1280 * 960
RANGE_MAX_M = 50.0
PLACE_MAX_M = 1e7
Place = Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M)]
Part = Annotated[float, Field(ge=-1, le=1)]
Side = Annotated[int, Field(ge=2, le=SIDE_MAX)]
Level = Annotated[float, Field(gt=-1e9, lt=1e9)]
TURN_TOLERANCE = 1e-3
LOWER_CHARACTERS_MAX = 1000


class RenderRequest(BaseModel):
    """A camera, its pose, and the layer to draw."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    x: Place
    """x, y, z: place of the camera, metres, map frame."""
    y: Place
    z: Place
    qx: Part = 0.0
    """qx, qy, qz, qw: rotation of the camera, the unit quaternion of T_map_camera; x right, y down, z forward."""
    qy: Part = 0.0
    qz: Part = 0.0
    qw: Part = 1.0
    width: Side = 640
    height: Side = 480
    focal_px: Annotated[float, Field(ge=1, le=1e6)] = 500.0
    cx: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    """cx, cy: principal point, pixels; None: the middle."""
    cy: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    layer: Layer = Layer.TEMPERATURE
    low: Level | None = None
    """low, high: ends of the scale, in the layer's unit; None: those of `SCALES`."""
    high: Level | None = None
    range_m: Annotated[float, Field(gt=0, le=RANGE_MAX_M)] = 20.0
    """Maximum range of a ray, metres."""
    sigma_m: Annotated[float, Field(ge=0, le=SIGMA_MAX_M)] = 0.0
    """sigma_m, sigma_rad: standard deviations of the pose along and about any one axis; the picture is blurred by
    them, or withheld."""
    sigma_rad: Annotated[float, Field(ge=0, le=SIGMA_MAX_RAD)] = 0.0
    covariance_lower: Annotated[str, Field(max_length=LOWER_CHARACTERS_MAX)] | None = None
    """Covariance of the pose, in place of the two sigmas: 21 numbers with commas between, as
    `pose_spread.PoseSpread.of_lower` takes them."""
    format: Literal["png", "npz"] = "png"
    at: TimeText | None = None
    """Time at which the map is read; None: now."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.width * self.height > REQUEST_PIXELS_MAX:
            raise ValueError(f"a picture has at most {REQUEST_PIXELS_MAX} pixels, not {self.width} x {self.height}")
        if abs(float(np.linalg.norm(self._turn)) - 1) > TURN_TOLERANCE:
            raise ValueError("qx, qy, qz, qw must be a unit quaternion")
        low, high = self._ends
        if not low < high:
            raise ValueError(f"the scale must go from a low to a higher value, got {low} and {high}")
        if self.covariance_lower is not None and (self.sigma_m or self.sigma_rad):
            raise ValueError("give sigma_m and sigma_rad, or covariance_lower, not both")
        _ = self.spread
        return self

    @property
    def _turn(self) -> Floats:
        return np.array([self.qx, self.qy, self.qz, self.qw])

    @property
    def _ends(self) -> tuple[float, float]:
        usual = SCALES[self.layer]
        return (usual.low if self.low is None else self.low, usual.high if self.high is None else self.high)

    @property
    def scale(self) -> Scale:
        """Colour scale of the layer."""
        return Scale(self.layer, *self._ends)

    @property
    def spread(self) -> PoseSpread | None:
        """Uncertainty of `T_map_camera`; None if it is exact."""
        if self.covariance_lower is None:
            found = PoseSpread.of_sigmas(self.sigma_m, self.sigma_rad)
        else:
            try:
                found = PoseSpread.of_lower(tuple(float(part) for part in self.covariance_lower.split(",")))
            except BadInputError as exc:
                raise ValueError(exc.message) from exc
        return None if found.is_exact else found

    @property
    def sight(self) -> CameraRays:
        """The camera."""
        middle = (self.width - 1) / 2, (self.height - 1) / 2
        centre = middle[0] if self.cx is None else self.cx, middle[1] if self.cy is None else self.cy
        return _camera(self.width, self.height, self.focal_px, centre)

    @property
    def T_map_camera(self) -> Floats:
        """A rigid transform, (4, 4)."""
        x, y, z, w = self._turn / np.linalg.norm(self._turn)
        T = np.eye(4)
        T[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        T[:3, 3] = self.x, self.y, self.z
        return T


def request_from(
    eye_m: tuple[float, float, float], target_m: tuple[float, float, float], **about: object
) -> RenderRequest:
    """Request for a picture from an eye, with a target in its middle; `about` are further fields.

    Raises:
        BadInputError: kind `bad_view`: a field is out of its range; the message names it.
    """
    x, y, z = eye_m
    qx, qy, qz, qw = _quaternion(look_at(eye_m, target_m)[:3, :3])
    try:
        return RenderRequest.model_validate({"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw, **about})
    except ValidationError as exc:
        raise BadInputError("bad_view", f"cannot look so: {first_error(exc)}") from exc


@lru_cache(maxsize=2)
def _camera(width: int, height: int, focal_px: float, centre_px: tuple[float, float]) -> CameraRays:
    """An ideal camera, cached: a viewer that looks around requests the same one again. Each takes 30 MB at most."""
    return pinhole(width, height, focal_px=focal_px, centre_px=centre_px)


def _quaternion(R: Floats) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    x, y, z, w = np.clip(np.linalg.eigh(K)[1][:, -1], -1, 1).tolist()
    return x, y, z, w
