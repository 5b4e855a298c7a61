"""Uncertainty of a camera's pixels in a world that is held to the boards (mrcal's projection uncertainty).

Turn a camera by a little and shift its principal point: its images are the same, only what "ahead" means has changed.
So a point is held not to the camera but to the boards; each moves it with its own error, and the mean of all is taken:
dp = mean over boards of dt + dr x (p - t) = tau + rho x p. The six numbers rho and tau have a covariance from the
solve, and are correlated with every camera.

Kogan, mrcal: "projection uncertainty", the mean-frames method. It does not depend on the gauge.
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.probe_points import image_grid
from cairn_calib.rig.pose_vectors import cross_matrix
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.projection_uncertainty import mounted_lens, projection_moves, transfer_certain
from cairn_calib.rig.rig import Rig
from cairn_calib.solve.solution import Solution
from cairn_map.arrays import Floats


@dataclass(frozen=True, slots=True)
class WorldCovariance:
    """(P + 6, P + 6) covariance: shared parameters, then rho (radians) and tau (metres) of the boards' mean."""

    matrix: Floats


def world_covariance(solution: Solution) -> WorldCovariance:
    """The joint covariance of the cameras and of the world that the boards make."""
    known, boards = solution.uncertainty, solution.state.T_rig_board
    count, size = len(boards), solution.layout.size
    # Of each board's errors r and t: rho = r, tau = t - r x t_board = t + [t_board]x r; then their mean.
    to_world = np.zeros((count, 6, 6))
    to_world[:, :3, :3] = to_world[:, 3:, 3:] = np.eye(3)
    to_world[:, 3:, :3] = cross_matrix(boards[:, :3, 3])
    # Boards move with the shared parameters by -C^-1 B^T, and each by its own error.
    moves = -(to_world @ known.by_shared).mean(axis=0)
    own = (to_world @ known.own @ np.swapaxes(to_world, 1, 2)).sum(axis=0) / count**2
    matrix = np.empty((size + 6, size + 6))
    matrix[:size, :size] = known.shared
    matrix[size:, :size] = moves @ known.shared
    matrix[:size, size:] = matrix[size:, :size].T
    matrix[size:, size:] = own + moves @ known.shared @ moves.T
    return WorldCovariance(matrix)


def pixel_covariance(
    solution: Solution, rig: Rig, world: WorldCovariance, camera: str, pixels: Floats, range_m: float
) -> Floats:
    """(..., 2, 2) covariance, pixels squared, of the pixels of the world's points that appear at (..., 2) pixels.

    `range_m` is their distance from the camera; give a large one for infinity.
    """
    lens = mounted_lens(rig, camera)
    T = rig[camera].transform
    points = range_m * lens.unproject(pixels) @ T[:3, :3].T + T[:3, 3]
    _, by_point, moves = projection_moves(rig, camera, points)
    rows = np.zeros((*pixels.shape, solution.layout.size + 6))
    for n, parameter in enumerate(solution.layout.names):
        if parameter in moves:
            rows[..., n] = moves[parameter]
    # dp = tau + rho x p, thus d(pixel) = G (tau - [p]x rho).
    rows[..., -6:-3] = -by_point @ cross_matrix(points)
    rows[..., -3:] = by_point
    return np.asarray(rows @ world.matrix @ np.swapaxes(rows, -1, -2))


def sigma_map(solution: Solution, rig: Rig, camera: str, range_m: float, *, columns: int = 24) -> Floats:
    """(rows, columns) standard deviation, pixels of one axis, over a camera's image, of points at a range."""
    lens = mounted_lens(rig, camera)
    rows = max(1, round(columns * lens.height / lens.width))
    grid = image_grid(lens.width, lens.height, columns, rows)
    covariance = pixel_covariance(solution, rig, world_covariance(solution), camera, grid, range_m)
    sigmas: Floats = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return sigmas.reshape(rows, columns)


def transfer_map(rig: Rig, source: str, target: str, range_m: float, *, columns: int = 24) -> Floats:
    """(rows, columns) standard deviation, over the image of `target`, of the pixels that `source` is transferred to.

    Pixels of one axis; NaN outside the view of `source`. The range is from `target`.
    """
    lens, other = mounted_lens(rig, target), mounted_lens(rig, source)
    rows = max(1, round(columns * lens.height / lens.width))
    T_source_target = inverse(rig[source].transform) @ rig[target].transform
    grid = image_grid(lens.width, lens.height, columns, rows)
    points = transform_points(T_source_target, range_m * lens.unproject(grid))
    pixels = other.project(points)
    seen = other.contains(pixels)
    sigmas = np.full(len(grid), np.nan)
    if seen.any():
        certain = transfer_certain(rig, source, target, pixels[seen], np.linalg.norm(points[seen], axis=1))
        sigmas[seen] = np.sqrt(np.trace(certain.calibration_px2, axis1=1, axis2=2) / 2)
    return sigmas.reshape(rows, columns)
