"""Corner residuals and their derivatives by every parameter: one camera's share of the normal equations.

    board --scale, warp--> (x, y, z) --T_rig_board--> rig --T_rig_camera^-1--> camera --lens--> pixel
    residual = W (pixel - corner) / s       W^T W: the inverse of the corner's covariance; s: the sensor's own scale

A board's point moves with its pose by dt + dr x (R p); the rig's camera moves the other way. So one matrix, pixels by
a point of the rig, makes all columns.

The predicted pixel of a disc is the centroid of its image (`disc_shift`). How that shift from the centre's image
changes with the parameters is left out of the derivatives: it is a few thousandths of how the centre's image changes,
and steps converge to the same place within such a share of a standard deviation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.lens import Lens
from cairn_calib.solve.board_views import BoardView
from cairn_calib.solve.normal_equations import Block, Indices, Loss
from cairn_calib.solve.rig_state import ParameterLayout, RigState
from cairn_map.arrays import Flags, Floats

RIM_POINTS = 48
"""Points of the regular polygon that stands for a disc's rim: its centroid errs by 1 / 48^2 of the disc's shift."""


@dataclass(frozen=True, slots=True)
class CornerData:
    """All corners of one camera, V views of N points; hidden points have whitening 0."""

    camera: int
    frames: Indices
    """(V,)"""
    pixels: Floats
    """(V, N, 2)"""
    whitening: Floats
    """(V, N, 2, 2)"""
    seen: Flags
    """(V, N)"""
    sigma_px: float
    """Root mean square of the stated standard deviations, one axis."""
    disc_radius_m: float = 0.0
    """0: points, or discs of unknown size, whose centroids are taken for their centres."""


def corner_data(camera: int, views: Sequence[BoardView], frames: Sequence[str]) -> CornerData:
    """The corners of a camera's views as arrays."""
    seen = np.stack([view.corners.seen for view in views])
    covariance = np.stack([view.corners.covariance_px2 for view in views])
    seen &= np.isfinite(covariance).all(axis=(2, 3))
    # Hidden points have no covariance: any invertible one does, for their whitening is then set to 0.
    safe = np.where(seen[..., None, None], covariance, np.eye(2))
    # cov = L L^T, so W = L^-1 gives W^T W = cov^-1.
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(safe)), np.float64) * seen[..., None, None]
    variance = np.trace(covariance[seen], axis1=1, axis2=2).mean() / 2
    return CornerData(
        camera,
        np.array([frames.index(view.frame) for view in views], np.intp),
        np.where(seen[..., None], np.stack([view.corners.pixels for view in views]), 0.0),
        whitening,
        seen,
        float(np.sqrt(variance)),
        (views[0].corners.board.disc_m or 0.0) / 2,
    )


def board_points(state: RigState, lattice: Floats, shape: Floats) -> Floats:
    """(N, 3) points of the actual board, metres: (N, 3) stated ones, scaled, and bent by their (N, 2) warp shape."""
    points = state.scale * lattice
    points[:, 2] += shape @ state.warp_m
    return points


def corner_misses(data: CornerData, state: RigState, lattice: Floats, shape: Floats) -> Floats:
    """(V, N, 2) predicted minus found, pixels; 0 where hidden; NaN where the model cannot see a point."""
    T_rig_board, T_rig_camera = state.T_rig_board[data.frames], state.T_rig_camera[data.camera]
    # board -> rig -> camera, as drawn above; R^T by multiplying rows from the right.
    p_rig = (
        board_points(state, lattice, shape) @ np.swapaxes(T_rig_board[:, :3, :3], 1, 2) + T_rig_board[:, None, :3, 3]
    )
    p_camera = (p_rig - T_rig_camera[:3, 3]) @ T_rig_camera[:3, :3]
    predicted = state.lenses[data.camera].project(p_camera)
    if data.disc_radius_m:
        predicted = predicted + _disc_shift(data, state, p_camera)
    return np.where(data.seen[..., None], predicted - data.pixels, 0.0)


def _disc_shift(data: CornerData, state: RigState, p_camera: Floats) -> Floats:
    R_rig_camera = state.T_rig_camera[data.camera, :3, :3]
    R_camera_board = R_rig_camera.T @ state.T_rig_board[data.frames, :3, :3]
    return disc_shift(state.lenses[data.camera], p_camera, R_camera_board, state.scale * data.disc_radius_m)


def corner_derivatives(
    data: CornerData, state: RigState, layout: ParameterLayout, lattice: Floats, shape: Floats
) -> tuple[Floats, Floats, Indices]:
    """Misses (V, N, 2) of `corner_misses`, derivatives (V, N, 2, K + 6), and (K,) positions of the shared columns."""
    c = data.camera
    T_rig_board, T_rig_camera = state.T_rig_board[data.frames], state.T_rig_camera[c]
    R_rig_board, R_rig_camera = T_rig_board[:, :3, :3], T_rig_camera[:3, :3]
    turned = board_points(state, lattice, shape) @ np.swapaxes(R_rig_board, 1, 2)
    q = turned + T_rig_board[:, None, :3, 3] - T_rig_camera[:3, 3]
    # G: pixels by a point of the rig, which makes the columns of all poses.
    there = state.lenses[c].projection(q @ R_rig_camera)
    G = (there.by_point.reshape(-1, 3) @ R_rig_camera.T).reshape(there.by_point.shape)
    # Columns: free intrinsics, the camera's pose, warp, scale; last the six of each view's board.
    at = [layout.intrinsic_at[c], layout.pose_at[c], layout.warp_at, layout.scale_at]
    ends = np.cumsum([len(each) for each in at]).tolist()
    J = np.empty((*there.pixels.shape, ends[-1] + 6))
    J[..., : ends[0]] = there.by_intrinsics[..., layout.intrinsic_columns[c]]
    if len(layout.pose_at[c]):
        # A turned camera: dp = q x dr, as seen by it.
        _cross_rows_into(J[..., ends[0] : ends[0] + 3], G, q)
        J[..., ends[0] + 3 : ends[1]] = -G
    # Warp moves points along the board's normal, scale along the lattice.
    if len(layout.warp_at):
        J[..., ends[1] : ends[2]] = (G @ R_rig_board[:, None, :, 2:]) * shape[:, None, :]
    if len(layout.scale_at):
        J[..., ends[2]] = np.einsum("vnij,vnj->vni", G, lattice @ np.swapaxes(R_rig_board, 1, 2))
    # The board's rotation and translation: dp = dr x p + dt.
    _cross_rows_into(J[..., ends[3] : ends[3] + 3], G, -turned)
    J[..., ends[3] + 3 :] = G
    predicted = there.pixels
    if data.disc_radius_m:
        predicted = predicted + _disc_shift(data, state, q @ R_rig_camera)
    misses = np.where(data.seen[..., None], predicted - data.pixels, 0.0)
    return misses, J, np.concatenate(at)


def corner_block(
    data: CornerData,
    state: RigState,
    layout: ParameterLayout,
    board: tuple[Floats, Floats],
    loss: Loss,
) -> Block:
    """The camera's share of the normal equations; `board` is lattice and warp shape.

    The loss weighs each point by the length of its whitened residual (iteratively reweighted least squares).
    """
    misses, J, at = corner_derivatives(data, state, layout, *board)
    whitening = data.whitening / loss.scale
    # r = W miss / s; weights of the loss by the length of r.
    residuals = _whiten(whitening, misses[..., None])[..., 0]
    weights, cost = loss(np.sum(residuals**2, axis=-1))
    root = np.sqrt(weights)[..., None]
    views, points = data.seen.shape
    r = (root * residuals).reshape(views, 2 * points, 1)
    J = _whiten(root[..., None] * whitening, J).reshape(views, 2 * points, -1)
    J_t = np.swapaxes(J, 1, 2)
    return Block(at, data.frames, J_t @ J, -(J_t @ r)[..., 0], residuals, cost)


def _whiten(whitening: Floats, J: Floats) -> Floats:
    """(V, N, 2, K) lower triangular (V, N, 2, 2) times (V, N, 2, K): twice as fast as a product of little matrices."""
    result = np.empty_like(J)
    np.multiply(whitening[..., 0, 0, None], J[..., 0, :], out=result[..., 0, :])
    np.multiply(whitening[..., 1, 1, None], J[..., 1, :], out=result[..., 1, :])
    result[..., 1, :] += whitening[..., 1, 0, None] * J[..., 0, :]
    return result


def _cross_rows_into(out: Floats, G: Floats, points: Floats) -> None:
    """(V, N, 2, 3) rows g x p of (V, N, 2, 3) rows and (V, N, 3) points into `out`: g . (p x dr) = dr . (g x p)."""
    px, py, pz = (points[..., None, axis] for axis in range(3))
    out[..., 0] = G[..., 1] * pz - G[..., 2] * py
    out[..., 1] = G[..., 2] * px - G[..., 0] * pz
    out[..., 2] = G[..., 0] * py - G[..., 1] * px


def disc_shift(lens: Lens, p_camera: Floats, R_camera_board: Floats, radius_m: float) -> Floats:
    """(V, N, 2) pixels from the images of discs' centres to the centroids of their images.

    A tilted disc's nearer half is larger, and a lens bends it: the centroid, which is measured, is not where the centre
    appears. Heikkila 2000 gives a closed form for a pinhole; here the rim is projected through the whole lens and the
    centroid of that polygon taken, which holds for any lens.

    Args:
        lens: the camera.
        p_camera: (V, N, 3) centres, metres.
        R_camera_board: (V, 3, 3) of the boards they lie on, whose z is the discs' axis.
        radius_m: of the discs.

    Returns:
        Centroid minus centre; NaN where the lens cannot see all of a disc.
    """
    angle = np.linspace(0, 2 * np.pi, RIM_POINTS, endpoint=False)
    rim = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ np.swapaxes(R_camera_board[..., :2], 1, 2)
    # Centroid of a polygon by its cross products, about the centre's image, so that nothing large cancels.
    at = lens.project(p_camera[:, :, None] + rim[:, None]) - lens.project(p_camera)[:, :, None]
    after = np.roll(at, -1, axis=2)
    cross = at[..., 0] * after[..., 1] - after[..., 0] * at[..., 1]
    weighted = ((at + after) * cross[..., None]).sum(axis=2)
    return np.asarray(weighted / (3 * cross.sum(axis=2)[..., None]))
