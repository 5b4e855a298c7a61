"""What other cameras saw of the points that the range camera measured (chapter IV of Kocmanova et al.).

    range image --Eq. 1-4--> points in the range camera's frame --Eq. 5--> another camera's --Eq. 6--> its pixels

A camera that stands elsewhere may see something else in front of a point. A z-buffer finds that out; its bins are
as wide as the distance between neighbouring range pixels in the other image, else the sparse points of the coarse
camera would let the background shine through between them. In so wide a bin a slanted surface, such as the floor far
ahead, lies at many depths; how steep it is there is known from the neighbours in the range image.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.brown import radius_limit
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_calib.rig.rig import Rig
from cairn_fusion.transfer.transfer_kernels import hide_into, project_into, steps_of
from cairn_map.arrays import Floats

Pixels = npt.NDArray[np.int64]

BIN_MARGIN = 1.5
"""Bin width over the spacing of projected range pixels: they spread a little with obliqueness."""
DEPTH_TOLERANCE = 0.05
DEPTH_TOLERANCE_M = 0.03
"""A point is hidden if it lies deeper than the nearest of its bin by more than 5 %, 3 cm and what its surface's slant
makes of the bin's width."""
KERNEL_COEFFICIENTS = 5
"""Of the pinholes that the kernel knows; rational ones and other lenses take the longer way."""


class Label(IntEnum):
    """What became of a point in another camera's image."""

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
    """What the camera has there may be of another place (`certainty`, `samples`)."""
    BEYOND = 8
    """The beam went on behind a surface of the map: a mirror, or that is gone (`beyond_labels`)."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """Where points appear in a camera: (N, 2) int64 pixels (x, y), valid where the label is OK; (N,) labels."""

    pixels: Pixels
    labels: npt.NDArray[np.uint8]

    @property
    def ok(self) -> npt.NDArray[np.bool_]:
        """(N,) points that the camera sees."""
        return np.asarray(self.labels == Label.OK)

    def sample(self, image: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """(M, ...) values of the image at the M points with label OK, nearest pixel."""
        x, y = self.pixels[self.ok].T
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
    return camera.rays() * range_m.astype(np.float64)[..., None]


def depth_steps(points: Floats) -> Floats:
    """How steep the surface is at each range pixel: depth to the next pixel, of rows and columns together.

    Of the two neighbours on a line the closer in depth counts, so that the step beside an edge is not taken for slant.

    Args:
        points: (H, W, 3), metres, from `points_from_range`.

    Returns:
        (H, W) float64, metres, not negative; 0 where no neighbour has a range.
    """
    return steps_of(np.ascontiguousarray(points[..., 2]))


def transfer_points(
    points_src: Floats,
    rig: Rig,
    *,
    src: str,
    dst: str,
    steps_m: Floats | None = None,
    hidden_behind_m: float = DEPTH_TOLERANCE_M,
) -> Transfer:
    """Where points of one camera's frame appear in another's image.

    Args:
        points_src: (N, 3), metres, frame of camera `src`; NaN for no range.
        rig: with both cameras.
        src: the range camera.
        dst: the camera to look from.
        steps_m: (N,) `depth_steps` of the points; None: surfaces that face the camera.
        hidden_behind_m: how much deeper than what hides it a point must be, besides 5 % and slant; infinite: none is.
    """
    T_dst_src, seen_by = inverse(rig[dst].transform) @ rig[src].transform, rig[dst].camera
    N = len(points_src)
    pixels, depth_m, labels = np.empty((N, 2), np.int64), np.empty(N), np.empty(N, np.uint8)
    if isinstance(seen_by, Camera) and len(seen_by.distortion) == KERNEL_COEFFICIENTS:
        lens = np.array([*seen_by.focal_px, *seen_by.centre_px])
        coefficients, limit = np.array(seen_by.distortion), radius_limit(seen_by.distortion)
        points, size = np.ascontiguousarray(points_src, dtype=np.float64), (seen_by.width, seen_by.height)
        project_into(pixels, depth_m, labels, points, T_dst_src, lens, coefficients, limit, *size)
    else:
        points = transform_points(T_dst_src, points_src)
        exact = seen_by.project(points)
        seen = seen_by.contains(exact)
        labels[:] = np.where(np.isnan(points[:, 2]), Label.NO_RANGE, np.where(seen, Label.OK, Label.OUT_OF_VIEW))
        pixels[:], depth_m[:] = np.rint(np.where(seen[:, None], exact, 0)), np.linalg.norm(points, axis=1)
    if not _same_centre(T_dst_src):
        ratio = seen_by.focal_px[0] / rig[src].camera.focal_px[0]
        bin_px = int(np.ceil(BIN_MARGIN * max(ratio, 1)))
        slant_m = np.zeros(N) if steps_m is None else steps_m * (bin_px / ratio)
        bins = (-(-seen_by.width // bin_px), -(-seen_by.height // bin_px))
        hide_into(labels, pixels, depth_m, slant_m, bin_px, *bins, DEPTH_TOLERANCE, hidden_behind_m)
    return Transfer(pixels, labels)


def _same_centre(T_dst_src: Transform) -> bool:
    """Without parallax nothing can hide anything: both cameras look along the same rays."""
    return bool(np.linalg.norm(T_dst_src[:3, 3]) < 1e-9)
