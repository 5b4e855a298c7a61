"""How certain it is where a point appears: the calibration's covariance, carried into pixels.

    project_certain(rig, "left", points_rig)                    points of the rig's frame in a camera
    transfer_certain(rig, "tof", "left", pixels, range_m, ...)  pixels with range, carried to another camera: Eq. 1-6 of
                                                                Kocmanova et al., with the share of each source of error

Both read nothing but a `rig.json` with `calibration.covariance`. What that does not list counts as certain.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.calibration import POSE_UNITS
from cairn_calib.lens import Lens
from cairn_calib.pose_vectors import cross_matrix
from cairn_calib.rig import Rig
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CertainPixels:
    """Where points appear, and how certain that is."""

    pixels: Floats
    """(..., 2); NaN where the camera does not see a point."""
    covariance_px2: Floats
    """(..., 2, 2) by the calibration alone."""


@dataclass(frozen=True, slots=True)
class CertainTransfer:
    """Where pixels of one camera appear in another, and what makes that uncertain, by its sources."""

    pixels: Floats
    """(..., 2); NaN where the camera does not see a point."""
    calibration_px2: Floats
    """(..., 2, 2) of lenses and places."""
    centroid_px2: Floats
    """(..., 2, 2) of the pixel in the first camera."""
    range_px2: Floats
    """(..., 2, 2) of the range."""

    @property
    def covariance_px2(self) -> Floats:
        """(..., 2, 2) all together."""
        return self.calibration_px2 + self.centroid_px2 + self.range_px2


def project_certain(rig: Rig, camera: str, points_rig: npt.NDArray[np.floating]) -> CertainPixels:
    """Pixels of (..., 3) points, metres, rig frame (the gauge camera's), with covariance.

    Raises:
        BadInputError: no such camera, no lens, or the rig has no covariance.
    """
    points = np.asarray(points_rig, np.float64)
    pixels, _, columns = _seen(rig, camera, points)
    return CertainPixels(pixels, _carried(rig, {camera: columns}))


def transfer_certain(
    rig: Rig,
    source: str,
    target: str,
    pixels: npt.NDArray[np.floating],
    range_m: npt.NDArray[np.floating],
    *,
    pixel_sigma_px: float = 0.0,
    range_sigma_m: float = 0.0,
) -> CertainTransfer:
    """Pixels of `target` at which appears what `source` sees at pixels and ranges.

    Args:
        rig: with `calibration.covariance`.
        source: the camera of the pixels; with a lens.
        target: the other one.
        pixels: (..., 2), of `source`.
        range_m: (...), along the beam.
        pixel_sigma_px: standard deviation of the pixels, one axis.
        range_sigma_m: and of the ranges.

    Raises:
        BadInputError: no such camera, no lens, or the rig has no covariance.
    """
    lens, T_rig_source = _lens(rig, source), rig[source].transform
    seen = lens.unprojection(pixels)
    R = T_rig_source[:3, :3]
    q = np.asarray(range_m, np.float64)[..., None] * seen.rays @ R.T
    found, by_point, columns = _seen(rig, target, q + T_rig_source[:3, 3])
    by_pixel = by_point @ R @ seen.by_pixel * np.asarray(range_m)[..., None, None]
    by_range = by_point @ (seen.rays @ R.T)[..., None]
    own = {"": by_point @ R @ seen.by_intrinsics * np.asarray(range_m)[..., None, None]}
    intrinsics = dict(zip(lens.intrinsic_names, np.moveaxis(own[""], -1, 0), strict=True))
    # The source's camera turns and shifts its points: dp = dr x q + dt.
    pose = np.concatenate([-by_point @ cross_matrix(q), by_point], axis=-1)
    places = dict(zip(POSE_UNITS, np.moveaxis(pose, -1, 0), strict=True))
    return CertainTransfer(
        found,
        _carried(rig, {source: {**intrinsics, **places}, target: columns}),
        pixel_sigma_px**2 * by_pixel @ np.swapaxes(by_pixel, -1, -2),
        range_sigma_m**2 * by_range @ np.swapaxes(by_range, -1, -2),
    )


def _seen(rig: Rig, camera: str, points: Floats) -> tuple[Floats, Floats, dict[str, Floats]]:
    """Pixels, (..., 2, 3) by the point in the rig's frame, and (..., 2) by each number of the camera."""
    lens, T_rig_camera = _lens(rig, camera), rig[camera].transform
    R = T_rig_camera[:3, :3]
    q = points - T_rig_camera[:3, 3]
    there = lens.projection(q @ R)
    by_point = there.by_point @ R.T
    # p_camera = R^T exp(-dr) (p - t - dt): as seen from the camera points move by -dt - dr x q.
    pose = np.concatenate([by_point @ cross_matrix(q), -by_point], axis=-1)
    columns = dict(zip(lens.intrinsic_names, np.moveaxis(there.by_intrinsics, -1, 0), strict=True))
    return there.pixels, by_point, {**columns, **dict(zip(POSE_UNITS, np.moveaxis(pose, -1, 0), strict=True))}


def _carried(rig: Rig, columns: dict[str, dict[str, Floats]]) -> Floats:
    calibration = rig.calibration
    if calibration is None or calibration.covariance is None:
        raise BadInputError(
            "no_covariance", f"rig {rig.name} does not say how certain it is: solve it with cairn calib solve"
        )
    parameters = calibration.covariance.parameters
    used = [n for n, each in enumerate(parameters) if each.name in columns.get(each.camera, {})]
    covariance = calibration.covariance.matrix[np.ix_(used, used)]
    J = np.stack([columns[parameters[n].camera][parameters[n].name] for n in used], axis=-1)
    return np.asarray(J @ covariance @ np.swapaxes(J, -1, -2))


def _lens(rig: Rig, camera: str) -> Lens:
    lens = rig[camera].camera
    if not isinstance(lens, Lens):
        raise BadInputError(
            "no_lens", f"{camera} of rig {rig.name} is a lidar: it has no lens whose pixels could be carried"
        )
    return lens
