"""Rays of a camera: one for each pixel, and the angle between neighbouring pixels. Any lens is a table of rays.

    CameraRays(rig["colour"].camera.rays())                     a calibrated camera, distortion and all
    pinhole(640, 480, focal_px=500)                        an ideal one, to look from anywhere
    look_at((1, 2, 1.2), (4, 2, 1.0))                      T_map_camera of an eye and its target

Camera frame: x right, y down, z forward; the centre of the top-left pixel is (0, 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Scalar = TypeVar("Scalar", bound=np.generic)

PIXELS_MAX = 1 << 24
UNIT_TOLERANCE = 1e-6
"""Largest deviation of a ray's length from 1."""
RIGID_TOLERANCE = 1e-6
"""Largest deviation of an entry of R^T R from the unit matrix's."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraRays:
    """Rays of a camera's pixels, and their spacing."""

    rays: Floats
    """(H, W, 3) unit vectors, camera frame; NaN for pixels that look nowhere."""
    pixel_rad: float = field(init=False)
    """The largest angle between neighbouring pixels; of an ideal camera, that in the middle."""

    def __post_init__(self) -> None:
        rays = np.ascontiguousarray(self.rays, dtype=np.float64)
        if rays.ndim != 3 or rays.shape[2] != 3 or not 4 <= rays[..., 0].size <= PIXELS_MAX or min(rays.shape[:2]) < 2:
            raise BadInputError(
                "bad_camera", f"rays must be (H, W, 3), 2 x 2 to {PIXELS_MAX} pixels, got {self.rays.shape}"
            )
        length = np.linalg.norm(rays, axis=2)
        if not (np.abs(length[~np.isnan(length)] - 1) < UNIT_TOLERANCE).all():
            raise BadInputError("bad_camera", "a camera's rays must be unit vectors, or NaN")
        object.__setattr__(self, "rays", rays)
        gaps = [np.linalg.norm(rays[1:] - rays[:-1], axis=2), np.linalg.norm(rays[:, 1:] - rays[:, :-1], axis=2)]
        known = [gap[gap > 0] for gap in gaps]  # NaN is not
        object.__setattr__(self, "pixel_rad", max((float(gap.max()) for gap in known if gap.size), default=1.0))

    def every(self, step: int) -> "CameraRays":
        """The camera with only the middle pixel of each `step` x `step`, as `middles` takes them."""
        return self if step == 1 else _every(self, step)

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.rays.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.rays.shape[1])


@lru_cache(maxsize=8)
def _every(sight: CameraRays, step: int) -> CameraRays:
    return CameraRays(middles(sight.rays, step))


def middles(image: npt.NDArray[Scalar], step: int) -> npt.NDArray[Scalar]:
    """(h, w, ...) image of the pixels in the middle of each `step` x `step` of (H, W, ...); the last may be cut."""
    rows, columns = (np.minimum(np.arange(step // 2, size + step // 2, step), size - 1) for size in image.shape[:2])
    return image[np.ix_(rows, columns)]


def pinhole(width: int, height: int, *, focal_px: float, centre_px: tuple[float, float] | None = None) -> CameraRays:
    """An ideal camera, with the principal point in the middle or at `centre_px` (x, y).

    Raises:
        BadInputError: kind `bad_camera`: an impossible size or focal length.
    """
    if not (0 < focal_px < np.inf and width * height <= PIXELS_MAX and min(width, height) >= 2):
        raise BadInputError("bad_camera", f"no camera has {width} x {height} pixels and a focal length of {focal_px}")
    centre_x, centre_y = ((width - 1) / 2, (height - 1) / 2) if centre_px is None else centre_px
    x, y = np.meshgrid((np.arange(width) - centre_x) / focal_px, (np.arange(height) - centre_y) / focal_px)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    if not np.isfinite(rays).all():
        raise BadInputError("bad_camera", f"the principal point must be finite, got {centre_px}")
    rays /= np.sqrt((rays * rays).sum(axis=2, keepdims=True))
    return CameraRays(rays)


def look_at(eye_m: Sequence[float], target_m: Sequence[float]) -> Floats:
    """`T_map_camera` (4, 4) of a camera at `eye_m` that has `target_m` in its middle, and the map's z axis upwards.

    Looking straight up or down, the map's x axis is to the right.

    Raises:
        BadInputError: kind `bad_pose`: both are the same place, or not finite.
    """
    eye, target = (np.asarray(place, np.float64).reshape(-1) for place in (eye_m, target_m))
    if eye.shape != (3,) or target.shape != (3,):
        raise BadInputError("bad_pose", f"a place is three numbers, metres; got {eye_m} and {target_m}")
    forward = target - eye
    distance = float(np.linalg.norm(forward))
    if not 1e-9 < distance < np.inf:
        raise BadInputError("bad_pose", f"the eye and what it looks at must be two places, got {eye_m} and {target_m}")
    forward /= distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, eye
    return T


def checked_pose(T_map_camera: npt.ArrayLike, *, reach_m: float) -> Floats:
    """(4, 4) float64 of a pose, checked to be a rigid transform within the numbered space.

    Raises:
        BadInputError: kind `bad_pose`.
    """
    T = np.require(T_map_camera, np.float64, ["C", "A", "W"])
    is_rigid = (
        T.shape == (4, 4)
        and bool(np.isfinite(T).all())
        and np.array_equal(T[3], [0, 0, 0, 1])
        and bool(np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() < RIGID_TOLERANCE)
        and float(np.linalg.det(T[:3, :3])) > 0
        and float(np.abs(T[:3, 3]).max()) < reach_m
    )
    if not is_rigid:
        raise BadInputError(
            "bad_pose", f"T_map_camera must be a (4, 4) rigid transform, its place within {reach_m:.0f} m of the origin"
        )
    return T


def cells_in_sight(
    cells: npt.NDArray[np.int64],
    sight: CameraRays,
    T_map_camera: Floats,
    *,
    edges_m: tuple[float, float, float],
    range_max_m: float,
) -> npt.NDArray[np.bool_]:
    """(C,) False for those of (C, 3) cells that are certainly not seen: outside of the cone of all rays, or too far."""
    half_m = float(np.linalg.norm(edges_m)) / 2  # of the sphere around a cell
    centres = ((cells + 0.5) * edges_m - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    away_m = np.linalg.norm(centres, axis=1)
    middle, widest = _span(sight)
    # Cells within range; then those whose sphere reaches into the cone around the middle ray.
    near = away_m - half_m <= range_max_m
    if np.isnan(widest) or widest == np.pi:  # nowhere, or all around
        return np.asarray(near & (widest == np.pi))
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.arccos(np.clip(centres @ middle / away_m, -1, 1))
        spread = np.arcsin(np.clip(half_m / away_m, 0, 1))
    return np.asarray(near & ((away_m <= half_m) | (off <= widest + spread)))


def with_cells_around(cells: npt.NDArray[np.int64], are_seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(C,) True for those of (C, 3) cells that are seen, or touch one that is."""
    turns = np.stack(np.meshgrid(*3 * [[-1, 0, 1]], indexing="ij"), axis=-1).reshape(-1, 3)
    wanted = {tuple(place) for turn in turns for place in (cells[are_seen] + turn).tolist()}
    return np.array([tuple(place) in wanted for place in cells.tolist()], np.bool_)


@lru_cache(maxsize=2)
def _span(sight: CameraRays) -> tuple[Floats, float]:
    """Mean direction of all rays, and the widest angle of one from it; pi: all around, NaN: no ray looks anywhere."""
    rays = sight.rays.reshape(-1, 3)
    rays = rays[~np.isnan(rays[:, 0])]
    if not len(rays):
        return np.zeros(3), np.nan
    middle = rays.mean(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 1e-6:
        return np.zeros(3), np.pi
    middle /= length
    return middle, float(np.arccos(np.clip((rays @ middle).min(), -1, 1)))
