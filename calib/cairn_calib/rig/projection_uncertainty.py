"""Uncertainty of projected points: the calibration's covariance, propagated to pixels.

    project_certain(rig, "left", points_rig)                    points of the rig's frame in a camera
    transfer_certain(rig, "tof", "left", pixels, range_m, ...)  pixels with range, carried to another camera: Eq. 1-6 of
                                                                Kocmanova et al., with the share of each source of error

Both need only a `rig.json` with `calibration.covariance`. Parameters that it does not list count as certain.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.calibration import POSE_UNITS
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import cross_matrix
from cairn_calib.rig.rig import Rig
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Moves = dict[tuple[str, str], Floats]
"""(..., 2) pixels a unit of a parameter, by camera and name."""


@dataclass(frozen=True, slots=True)
class CertainPixels:
    """Pixels of points, with their covariance."""

    pixels: Floats
    """(..., 2); NaN where the camera does not see a point."""
    covariance_px2: Floats
    """(..., 2, 2) by the calibration alone."""


@dataclass(frozen=True, slots=True)
class CertainTransfer:
    """Pixels of one camera as they appear in another, with the covariance by its sources."""

    pixels: Floats
    """(..., 2); NaN where the camera does not see a point."""
    calibration_px2: Floats
    """(..., 2, 2) covariance by lenses and places."""
    centroid_px2: Floats
    """(..., 2, 2) covariance by the pixel in the first camera."""
    range_px2: Floats
    """(..., 2, 2) covariance by the range."""

    @property
    def covariance_px2(self) -> Floats:
        """(..., 2, 2) covariance by all sources."""
        return self.calibration_px2 + self.centroid_px2 + self.range_px2


def project_certain(rig: Rig, camera: str, points_rig: npt.NDArray[np.floating]) -> CertainPixels:
    """Pixels of (..., 3) points, metres, rig frame (the gauge camera's), with covariance.

    Raises:
        BadInputError: no such camera, no lens, or the rig has no covariance.
    """
    pixels, _, moves = _project_with_moves(rig, camera, np.asarray(points_rig, np.float64))
    return CertainPixels(pixels, _propagate(rig, moves))


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
    """Pixels of `target` at which the points appear that `source` sees at pixels and ranges.

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
    # Three independent sources: J cov J^T of the calibration, of the pixel, of the range.
    found, by_pixel, by_range, moves = _transfer(rig, source, target, pixels, range_m)
    return CertainTransfer(
        found,
        _propagate(rig, moves),
        pixel_sigma_px**2 * by_pixel @ np.swapaxes(by_pixel, -1, -2),
        range_sigma_m**2 * by_range @ np.swapaxes(by_range, -1, -2),
    )


def transfer_moves(
    rig: Rig, source: str, target: str, pixels: npt.NDArray[np.floating], range_m: npt.NDArray[np.floating]
) -> tuple[Floats, Moves]:
    """Pixels of `target` as above, and how they move with every parameter of both cameras."""
    found, _, _, moves = _transfer(rig, source, target, pixels, range_m)
    return found, moves


def projection_moves(rig: Rig, camera: str, points_rig: Floats) -> tuple[Floats, Floats, Moves]:
    """Pixels of (..., 3) points, rig frame; (..., 2, 3) by the point; and how they move by parameter."""
    return _project_with_moves(rig, camera, points_rig)


def _transfer(
    rig: Rig, source: str, target: str, pixels: npt.NDArray[np.floating], range_m: npt.NDArray[np.floating]
) -> tuple[Floats, Floats, Floats, Moves]:
    """Pixels, (..., 2, 2) by the pixel, (..., 2, 1) by the range, and by each parameter."""
    lens, T_rig_source = mounted_lens(rig, source), rig[source].transform
    # Eq. 1, 4 and 5: the pixel's ray times its range, then to the rig's frame; q: from the camera, rig axes.
    seen = lens.unprojection(pixels)
    R, far = T_rig_source[:3, :3], np.asarray(range_m, np.float64)[..., None]
    q = far * (seen.rays @ R.T)
    # Eq. 6: into the target.
    found, by_point, moves = _project_with_moves(rig, target, q + T_rig_source[:3, 3])
    # By the ray, and through it by the source's intrinsics and pixel.
    by_ray = far[..., None] * (by_point @ R)
    # The source's camera turns and shifts its points: dp = dr x q + dt.
    own = _by_name(source, lens, by_ray @ seen.by_intrinsics, -by_point @ cross_matrix(q), by_point)
    for parameter, move in own.items():
        # Of a camera to itself both come together.
        moves[parameter] = moves.get(parameter, 0.0) + move
    return found, by_ray @ seen.by_pixel, by_point @ (seen.rays @ R.T)[..., None], moves


def _project_with_moves(rig: Rig, camera: str, points: Floats) -> tuple[Floats, Floats, Moves]:
    """Pixels, (..., 2, 3) by the point in the rig's frame, and by each parameter of the camera."""
    lens, T_rig_camera = mounted_lens(rig, camera), rig[camera].transform
    R = T_rig_camera[:3, :3]
    q = points - T_rig_camera[:3, 3]
    there = lens.projection(q @ R)
    by_point = there.by_point @ R.T
    # p_camera = R^T exp(-dr) (p - t - dt): as seen from the camera points move by -dt - dr x q.
    moves = _by_name(camera, lens, there.by_intrinsics, by_point @ cross_matrix(q), -by_point)
    return there.pixels, by_point, moves


def _by_name(camera: str, lens: Lens, by_intrinsics: Floats, by_rotation: Floats, by_translation: Floats) -> Moves:
    names = (*lens.intrinsic_names, *POSE_UNITS)
    columns = np.moveaxis(np.concatenate([by_intrinsics, by_rotation, by_translation], axis=-1), -1, 0)
    return {(camera, name): column for name, column in zip(names, columns, strict=True)}


def _propagate(rig: Rig, moves: Moves) -> Floats:
    calibration = rig.calibration
    if calibration is None or calibration.covariance is None:
        raise BadInputError(
            "no_covariance", f"rig {rig.name} does not say how certain it is: solve it with cairn calib solve"
        )
    parameters = [(each.camera, each.name) for each in calibration.covariance.parameters]
    # Parameters that the covariance does not list are certain.
    used = [n for n, parameter in enumerate(parameters) if parameter in moves]
    covariance = calibration.covariance.matrix[np.ix_(used, used)]
    # Without an uncertain parameter J has no columns, and all is certain.
    J = np.empty((*next(iter(moves.values())).shape, len(used)))
    for column, n in enumerate(used):
        J[..., column] = moves[parameters[n]]
    return np.asarray(J @ covariance @ np.swapaxes(J, -1, -2))


def mounted_lens(rig: Rig, camera: str) -> Lens:
    """A camera's lens.

    Raises:
        BadInputError: no such camera, or a lidar.
    """
    lens = rig[camera].camera
    if not isinstance(lens, Lens):
        raise BadInputError("no_lens", f"{camera} of rig {rig.name} is a lidar: it has no lens to carry pixels by")
    return lens
