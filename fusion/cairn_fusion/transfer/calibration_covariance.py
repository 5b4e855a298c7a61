"""Covariance of a transferred pixel by the rig's calibration: G Cov G^T with the calibration's own covariance.

A point P = d u(x, I_s) along the ray of its pixel goes through the rig's frame to the other camera and its pixel (Eq.
1-6):

    p = pi( R_d^T ( exp(r_s) R_s d u + t_s + dt_s - t_d - dt_d ), I_d )

G is its derivative by all calibrated parameters: intrinsics I of both cameras, and of each pose the small turn r and
shift dt about the rig's axes, as `cairn_calib.rig.calibration` defines them. A rig without covariance may still state
one number a camera, `calibration_sigma_px`.
"""

import numpy as np

from cairn_calib.rig.calibration import POSE_UNITS
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import cross_matrix
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import Rig
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError


def calibration_covariance(points_src: Floats, rig: Rig, *, src: str, dst: str) -> Floats:
    """(N, 2, 2) covariance, px^2, of the pixels of one camera's points in another's image, by calibration alone.

    Args:
        points_src: (N, 3) metres, frame of `src`, each on the ray of its pixel there.
        rig: with both cameras, which have lenses; `src` may be a lidar.
        src: source camera.
        dst: camera with the pixels.
    """
    calibration = rig.calibration
    if calibration is None or calibration.covariance is None:
        sigma_px = rig[dst].calibration_sigma_px or 0.0
        return np.broadcast_to(sigma_px**2 * np.eye(2), (len(points_src), 2, 2)).copy()
    gradients = place_gradients(points_src, rig, src=src, dst=dst)
    covariance = calibration.covariance
    G = np.zeros((len(points_src), 2, len(covariance.parameters)))
    for n, each in enumerate(covariance.parameters):
        if (each.camera, each.name) in gradients:
            G[..., n] = gradients[each.camera, each.name]
    return np.asarray(G @ covariance.matrix @ np.swapaxes(G, -1, -2))


def place_gradients(points_src: Floats, rig: Rig, *, src: str, dst: str) -> dict[tuple[str, str], Floats]:
    """(N, 2) derivatives of the pixel in `dst` by camera and parameter, pixels a unit; none where src is dst."""
    if src == dst:
        return {}
    S, D = rig[src].transform, rig[dst].transform
    camera = lens_of(rig, dst)
    # Points about the rig's axes: turned by the source's rotation, and seen from the other camera's centre.
    from_rig = inverse(D)[:3, :3]
    turned = points_src @ S[:3, :3].T
    away = turned + S[:3, 3] - D[:3, 3]
    seen = camera.projection(transform_points(inverse(D) @ S, points_src))
    by_rig = seen.by_point @ from_rig
    # A small turn r moves a point p by r x p, a shift by itself; those of `dst` move it the other way.
    gradients = {
        **_named(src, tuple(POSE_UNITS), np.concatenate([-by_rig @ cross_matrix(turned), by_rig], axis=-1)),
        **_named(dst, tuple(POSE_UNITS), np.concatenate([by_rig @ cross_matrix(away), -by_rig], axis=-1)),
        **_named(dst, camera.intrinsic_names, seen.by_intrinsics),
    }
    # The source's intrinsics turn the ray of the pixel, along which the range stays.
    lens = rig[src].camera
    if isinstance(lens, Lens):
        rays = lens.unprojection(lens.project(points_src))
        by_ray = by_rig @ S[:3, :3] * np.linalg.norm(points_src, axis=1)[:, None, None]
        gradients |= _named(src, lens.intrinsic_names, by_ray @ rays.by_intrinsics)
    return gradients


def lens_of(rig: Rig, name: str) -> Lens:
    """The lens of a camera.

    Raises:
        BadInputError: it is a lidar, which has none.
    """
    camera = rig[name].camera
    if not isinstance(camera, Lens):
        raise BadInputError("bad_camera", f"{name} must have a lens, it is a {type(camera).__name__}")
    return camera


def pixel_gradients(points_src: Floats, rig: Rig, *, src: str, dst: str) -> Floats:
    """(N, 2, 2) derivative of the pixel in `dst` by that in `src`, pixels a pixel; NaN where `src` has no lens."""
    lens, camera = rig[src].camera, lens_of(rig, dst)
    if not isinstance(lens, Lens):
        return np.full((len(points_src), 2, 2), np.nan)
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    by_point = camera.pixel_gradients(transform_points(T_dst_src, points_src)) @ T_dst_src[:3, :3]
    rays = lens.unprojection(lens.project(points_src))
    return np.asarray(by_point @ rays.by_pixel * np.linalg.norm(points_src, axis=1)[:, None, None])


def _named(camera: str, names: tuple[str, ...], gradients: Floats) -> dict[tuple[str, str], Floats]:
    return {(camera, name): gradients[..., n] for n, name in enumerate(names)}
