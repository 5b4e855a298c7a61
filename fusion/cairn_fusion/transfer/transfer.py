"""Transfer of the range camera's points into other cameras' images (chapter IV of Kocmanova et al.).

    range image --Eq. 1-4--> points in the range camera's frame --Eq. 5--> another camera's --Eq. 6--> its pixels

From the place of another camera, something else may hide a point. A z-buffer detects that; its bins are as wide as the
distance between neighbouring range pixels in the other image, or the background would be seen between the sparse points
of the coarse camera. In so wide a bin a slanted surface, such as the floor far ahead, lies at many depths; its slant is
known from the neighbours in the range image.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.brown import radius_limit
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_calib.rig.rig import Rig
from cairn_fusion.transfer.transfer_kernels import hide_into, project_into, steps_of
from cairn_map.arrays import Floats, Int32s

BIN_MARGIN = 1.5
"""Bin width over the spacing of projected range pixels: they spread a little with obliqueness."""
DEPTH_TOLERANCE = 0.05
DEPTH_TOLERANCE_M = 0.03
"""A point is hidden if it lies deeper than the nearest of its bin by more than 5 %, 3 cm and the depth that its slanted
surface spans in the bin."""
KERNEL_COEFFICIENTS = 5
"""Distortion coefficients of the pinholes that the kernel projects; other lenses are projected by their own class."""


class Label(IntEnum):
    """Result of the transfer of a point, or reason why a pixel has no value."""

    OK = 0
    OCCLUDED = 1
    OUT_OF_VIEW = 2
    NO_RANGE = 3
    SATURATED = 4
    """Too much light returned to the range camera."""
    FLYING = 5
    """A mixture of two surfaces."""
    NO_READING = 6
    """The camera sees it, and has no value there."""
    UNCERTAIN = 7
    """The camera's value there may belong to another place (`pixel_covariance`, `samples`)."""
    BEYOND = 8
    """The beam went on behind a surface of the map: a mirror, or a thing that is gone (`mirror_labels`)."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """Pixels of points in a camera's image: (2, N) x and y, valid where the label is OK; and (N,) labels."""

    pixels: Int32s
    labels: npt.NDArray[np.uint8]

    @property
    def ok(self) -> npt.NDArray[np.bool_]:
        """(N,) true for points that the camera sees."""
        return np.asarray(self.labels == Label.OK)

    def sample(self, image: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """(M, ...) values of the image at the M points with label OK, nearest pixel."""
        x, y = self.pixels[:, self.ok]
        return np.asarray(image[y, x])


def points_from_range(range_m: npt.NDArray[np.floating], camera: AnyCamera) -> Floats:
    """Points that the time-of-flight camera saw, in its own frame.

    Eq. 4 of Kocmanova et al.: the sensor measures along the beam, so the depth is z = d f / sqrt(x^2 + y^2 + f^2),
    with x, y in pixels from the principal point; Eq. 1 gives X and Y. With one undistorted unit ray per pixel both
    are one product, exact with lens distortion too.

    Args:
        range_m: (H, W), metres along each beam; NaN where nothing came back.
        camera: the range camera.

    Returns:
        (H, W, 3) float64, metres, camera frame; NaN where `range_m` is NaN.

    Raises:
        BadInputError: `range_m` is not the size of the camera's image.
    """
    camera.check_image(range_m, name="range image")
    # Eq. 4 and Eq. 1: a unit ray times the range along it.
    return camera.rays() * range_m.astype(np.float64)[..., None]


def depth_steps(points: Floats) -> Floats:
    """Slant of the surface at each range pixel: difference of depth to the next pixel, along rows plus along columns.

    Of the two neighbours on a line the closer in depth counts, so that the step at an edge is not taken for slant.

    Args:
        points: (H, W, 3), metres, from `points_from_range`.

    Returns:
        (H, W) float64, metres, not negative; 0 where no neighbour has a range.
    """
    return steps_of(np.ascontiguousarray(points[..., 2]))


@dataclass(frozen=True, slots=True, eq=False)
class CameraPair:
    """A range camera and another camera of its rig, with what the transfer of every scan needs."""

    T_dst_src: Transform
    """Eq. 5's transform: source camera to rig to destination camera."""
    seen_by: AnyCamera
    pinhole: tuple[Floats, Floats, float, int, int] | None
    """Arguments of `project_into`; None for lenses that it does not know."""
    bins: tuple[float, int, int, int] | None
    """Range pixels along a bin, its edge in pixels, columns and rows; None: nothing can hide anything."""

    @classmethod
    def of(cls, rig: Rig, *, src: str, dst: str) -> Self:
        """The pair of the range camera `src` and the camera `dst`."""
        T_dst_src, seen_by = inverse(rig[dst].transform) @ rig[src].transform, rig[dst].camera
        pinhole = bins = None
        # Eq. 6: the kernel knows the lens that nearly all cameras have.
        if isinstance(seen_by, Camera) and len(seen_by.distortion) == KERNEL_COEFFICIENTS:
            lens, coefficients = np.array([*seen_by.focal_px, *seen_by.centre_px]), np.array(seen_by.distortion)
            limit = _square_limit(radius_limit(seen_by.distortion))
            pinhole = (lens, coefficients, limit, seen_by.width, seen_by.height)
        if not _same_centre(T_dst_src):
            # Bins as wide as the points are apart. A slant is that along one range pixel, of which a bin spans
            # bin_px / ratio.
            ratio = seen_by.focal_px[0] / rig[src].camera.focal_px[0]
            bin_px = int(np.ceil(BIN_MARGIN * max(ratio, 1)))
            bins = (bin_px / ratio, bin_px, -(-seen_by.width // bin_px), -(-seen_by.height // bin_px))
        return cls(T_dst_src, seen_by, pinhole, bins)


def transfer_points(
    points_src: Floats,
    pair: CameraPair,
    *,
    steps_m: Floats | None = None,
    hidden_behind_m: float = DEPTH_TOLERANCE_M,
) -> Transfer:
    """Pixels of a range camera's points in another camera's image, and their labels.

    Args:
        points_src: (3, N), metres, frame of the range camera; NaN for no range.
        pair: both cameras.
        steps_m: (N,) `depth_steps` of the points; None: surfaces that face the camera.
        hidden_behind_m: depth behind the nearest point of its bin beyond which a point is hidden, besides 5 % and
            slant; infinite: none is.
    """
    N = points_src.shape[1]
    pixels, depth_m, labels = np.empty((2, N), np.int32), np.empty(N), np.empty(N, np.uint8)
    # Stage 1: into the other camera's frame (Eq. 5) and image (Eq. 6).
    if pair.pinhole is not None:
        points = np.ascontiguousarray(points_src, dtype=np.float64)
        project_into(pixels, depth_m, labels, points, pair.T_dst_src, *pair.pinhole)
    else:
        # Other lenses: the same by their own projection.
        points = transform_points(pair.T_dst_src, points_src.T)
        exact = pair.seen_by.project(points)
        seen = pair.seen_by.contains(exact)
        labels[:] = np.where(np.isnan(points[:, 2]), Label.NO_RANGE, np.where(seen, Label.OK, Label.OUT_OF_VIEW))
        pixels[:], depth_m[:] = np.rint(np.where(seen[:, None], exact, 0)).T, np.linalg.norm(points, axis=1)
    # Stage 2: occlusion, by a z-buffer.
    if pair.bins is not None:
        slant_m = np.zeros(N) if steps_m is None else steps_m
        hide_into(labels, pixels, depth_m, slant_m, *pair.bins, DEPTH_TOLERANCE, hidden_behind_m)
    return Transfer(pixels, labels)


@lru_cache(maxsize=64)
def _square_limit(radius: float) -> float:
    """The least square whose root, as it is rounded, is not less than a radius: no root need be taken of each point."""
    # From below, step by step: the product is at most a few steps off.
    square = radius * radius
    while math.sqrt(square) >= radius:
        square = math.nextafter(square, 0.0)
    while math.sqrt(square) < radius:
        square = math.nextafter(square, math.inf)
    return square


def _same_centre(T_dst_src: Transform) -> bool:
    """True if both cameras look along the same rays: without parallax nothing can hide anything."""
    return bool(np.linalg.norm(T_dst_src[:3, 3]) < 1e-9)
