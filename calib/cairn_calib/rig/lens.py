"""Interface of cameras with a lens: focal length, principal point, coefficients, and derivatives by all of them.

    point --(the model)--> place in the plane of unit focal length --focal_px, centre_px--> pixel

The models are next door: `camera.py` (pinhole with Brown's distortion) and `fisheye.py` (Kannala-Brandt). A solver sees
either as a vector of intrinsics with names: `fx, fy, cx, cy` and the model's coefficients. How a point moves with a
pose is `pose_vectors.py`; the two are chained by one matrix product.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field

from cairn_calib.rig.raster import Raster
from cairn_map.arrays import Floats

Focal = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Place = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, slots=True)
class Projection:
    """Pixels of points, and their derivatives; P is the number of intrinsics."""

    pixels: Floats
    """(..., 2) pixels of `project`; NaN where it gives NaN."""
    by_point: Floats
    """(..., 2, 3) pixels a metre, camera frame."""
    by_intrinsics: Floats
    """(..., 2, P) pixels a unit of each of `intrinsic_names`."""


@dataclass(frozen=True, slots=True)
class Unprojection:
    """Along which rays pixels look, and how these turn."""

    rays: Floats
    """(..., 3) unit vectors, camera frame; NaN where `unproject` says NaN."""
    by_pixel: Floats
    """(..., 3, 2) across the ray, radians a pixel."""
    by_intrinsics: Floats
    """(..., 3, P) radians a unit of each of `intrinsic_names`."""


class Lens(Raster, frozen=True):
    """A camera whose lens is a model with a few numbers."""

    focal_px: tuple[Focal, Focal]
    centre_px: tuple[Place, Place]
    distortion: tuple[float, ...]

    @property
    @abstractmethod
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the distortion coefficients, in the order of `distortion`."""

    @abstractmethod
    def plane_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """(..., 2, 3) and (..., 2, K): how the place in the plane of unit focal length moves with (..., 3) points, and
        with the coefficients; NaN for points that the model cannot see, finite beyond a fold.
        """

    @abstractmethod
    def plane(self, points: Floats) -> Floats:
        """(..., 2) places of (..., 3) points in the distorted plane of unit focal length; NaN for those not seen."""

    @property
    def intrinsic_names(self) -> tuple[str, ...]:
        """`fx`, `fy`, `cx`, `cy` (pixels), then the coefficients (no unit)."""
        return ("fx", "fy", "cx", "cy", *self.coefficient_names)

    @property
    def intrinsics(self) -> Floats:
        """(P,) the numbers of `intrinsic_names`."""
        return np.array([*self.focal_px, *self.centre_px, *self.distortion])

    def with_intrinsics(self, values: npt.ArrayLike) -> Self:
        """The same camera with other numbers, (P,) in the order of `intrinsic_names`; a solver's, so not checked."""
        numbers = [float(v) for v in np.asarray(values, dtype=np.float64)]
        if len(numbers) != len(self.intrinsic_names):
            raise ValueError(f"{len(self.intrinsic_names)} intrinsics are needed, got {len(numbers)}")
        parts = {"focal_px": tuple(numbers[:2]), "centre_px": tuple(numbers[2:4]), "distortion": tuple(numbers[4:])}
        return self.model_copy(update=parts)

    def project(self, points: npt.NDArray[np.floating]) -> Floats:
        """Pixels at which points of the camera frame appear.

        Eq. 6 of Kocmanova et al., then distortion, then the shift to the principal point.

        Args:
            points: (..., 3), metres (any scale), camera frame.

        Returns:
            (..., 2) float64 pixels (x, y); NaN for points that the model cannot see, and for those so far
            off the axis that the distortion would fold them back into the image.
        """
        plane = self.plane(np.asarray(points, dtype=np.float64))
        pixels: Floats = plane * np.array(self.focal_px) + np.array(self.centre_px)
        return pixels

    def pixel_gradients(self, points: npt.NDArray[np.floating]) -> Floats:
        """Derivatives of `project` by the points.

        Args:
            points: (..., 3), metres, camera frame.

        Returns:
            (..., 2, 3) float64, pixels a metre; NaN where `project` gives NaN for another reason than a fold.
        """
        by_point, _ = self.plane_gradients(np.asarray(points, dtype=np.float64))
        gradients: Floats = np.array(self.focal_px)[:, None] * by_point
        return gradients

    def projection(self, points: npt.NDArray[np.floating]) -> Projection:
        """`project` with its derivatives, for (..., 3) points, metres, camera frame."""
        p = np.asarray(points, dtype=np.float64)
        plane, focal = self.plane(p), np.array(self.focal_px)
        by_point, by_coefficient = self.plane_gradients(p)
        # pixel = focal * plane + centre, so the derivative by the focal length is the place in the plane.
        by_focal, by_centre = plane[..., None] * np.eye(2), np.broadcast_to(np.eye(2), (*plane.shape, 2))
        by_intrinsics = np.concatenate([by_focal, by_centre, focal[:, None] * by_coefficient], axis=-1)
        return Projection(plane * focal + np.array(self.centre_px), focal[:, None] * by_point, by_intrinsics)

    def unprojection(self, pixels: npt.NDArray[np.floating]) -> Unprojection:
        """`unproject` with its derivatives, for (..., 2) pixels.

        A ray moves just so that its pixel stays: with the projection's G = d pixel / d point and I = d pixel / d
        intrinsics, G dray + I dintrinsics = dpixel. G has the ray itself as its null space, so that its pseudo-inverse
        gives the change across the ray, which keeps it a unit vector.
        """
        rays = self.unproject(pixels)
        there = self.projection(rays)
        G = there.by_point
        # Pseudo-inverse G^T (G G^T)^-1, with the 2 x 2 inverse written out.
        square = G @ np.swapaxes(G, -1, -2)
        a, b, d = square[..., 0, 0], square[..., 0, 1], square[..., 1, 1]
        adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-b, a], axis=-1)], axis=-2)
        by_pixel = np.swapaxes(G, -1, -2) @ adjugate / (a * d - b * b)[..., None, None]
        return Unprojection(rays, by_pixel, -by_pixel @ there.by_intrinsics)
