"""By how much ranges miss the board's plane: what the range camera's images add to the normal equations.

    true range = (n . (o - c) + w) / (n . v)      n, o: the board's normal and origin, w: its warp there; v: the pixel's
    residual   = (true + bias - measured) / s     ray, c: the camera; all in the rig's frame, metres

Every pixel that looks at the inside of the board measures its plane, whatever is printed on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board import Board
from cairn_calib.board_views import RangeView
from cairn_calib.normal_equations import Block, Indices, Loss
from cairn_calib.range_bias import SCALE_AT, bias_shapes
from cairn_calib.rig_state import Layout, RigState, warp_at_places

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

PIXELS_MAX = 400
"""Of one image, evenly spread: more would only say the same again."""
PIXELS_MIN = 12
WARP_ROUNDS = 3
"""Of finding where a ray meets the bent board; each is a thousand times nearer."""
INSIDE = 0.0
"""How far inside the outermost corners a pixel's middle must be, in pitches: half a cell of board is around them."""


@dataclass(frozen=True, slots=True)
class RangeData:
    """Ranges of one camera, V views of at most M pixels; `measured` is False where there is none."""

    camera: int
    frames: Indices
    """(V,)"""
    pixels: Floats
    """(V, M, 2)"""
    range_m: Floats
    """(V, M)"""
    measured: Flags
    """(V, M)"""
    sigma_m: float
    """Expected standard deviation."""


def range_data(
    camera: int, views: Sequence[RangeView], frames: Sequence[str], state: RigState, board: Board, *, sigma_m: float
) -> RangeData | None:
    """The pixels that look at the board, where it is by a first solution; None where there are hardly any."""
    lens = state.lenses[camera]
    chosen = []
    for view in views:
        if view.frame not in frames:
            continue
        lens.check_image(view.range_m, name=f"range image of frame {view.frame}")
        pixels = _inside(view.range_m, lens.rays(), state, camera, frames.index(view.frame), board)
        if len(pixels) >= PIXELS_MIN:
            chosen.append((frames.index(view.frame), pixels, view.range_m[pixels[:, 1], pixels[:, 0]]))
    if not chosen:
        return None
    width = max(len(pixels) for _, pixels, _ in chosen)
    pixels_px, range_m = np.zeros((len(chosen), width, 2)), np.ones((len(chosen), width))
    measured = np.zeros((len(chosen), width), bool)
    for n, (_, pixels, ranges) in enumerate(chosen):
        pixels_px[n, : len(pixels)], range_m[n, : len(pixels)] = pixels, ranges
        measured[n, : len(pixels)] = True
    indices = np.array([frame for frame, _, _ in chosen], np.intp)
    return RangeData(camera, indices, pixels_px, range_m, measured, sigma_m)


def plane_ranges(data: RangeData, state: RigState, board: Board) -> Floats:
    """(V, M) ranges at which the pixels' rays meet the board, metres."""
    return _met(data, state, board, state.lenses[data.camera].unproject(data.pixels)).range_m


def range_block(data: RangeData, state: RigState, layout: Layout, board: Board, loss: Loss) -> Block:
    """The camera's share; its noise is `sigma_m` times the loss's scale."""
    c = data.camera
    seen = state.lenses[c].unprojection(data.pixels)
    met = _met(data, state, board, seen.rays)
    R_rig_camera = state.T_rig_camera[c, :3, :3]
    shapes = bias_shapes(state.lenses[c], data.pixels, met.range_m)
    n, v, d, slant = met.normals, met.rays, met.range_m, met.slant
    by_ray = -(d / slant)[..., None] * n
    columns = [
        np.squeeze((by_ray @ R_rig_camera)[..., None, :] @ seen.by_intrinsics, -2)[..., layout.intrinsic_columns[c]]
    ]
    at = [layout.intrinsic_at[c]]
    if len(layout.pose_at[c]):
        columns += [np.cross(v, by_ray), -n / slant[..., None]]
        at.append(layout.pose_at[c])
    if len(layout.warp_at):
        columns.append(met.warp_shape / slant[..., None])
        at.append(layout.warp_at)
    columns += [np.cross(n, met.off_board) / slant[..., None], n / slant[..., None]]
    # All so far move the true range, of which the bias scales.
    columns = [(1 + state.bias[SCALE_AT]) * column for column in columns]
    columns.insert(-2, shapes)
    at.append(layout.bias_at)
    noise_m = loss.scale * data.sigma_m
    residuals = np.where(data.measured, (d + shapes @ state.bias - data.range_m) / noise_m, 0.0)
    weights, cost = loss(residuals**2)
    root = np.sqrt(weights)
    J = np.nan_to_num(np.concatenate(columns, axis=-1) * (root / noise_m)[..., None])
    J_t = np.swapaxes(J, 1, 2)
    pull = -(J_t @ (root * residuals)[..., None])[..., 0]
    return Block(np.concatenate(at), data.frames, J_t @ J, pull, residuals[..., None], cost)


@dataclass(frozen=True, slots=True)
class _Met:
    """Where rays meet the board, in the rig's frame."""

    normals: Floats
    """(V, M, 3) of the bent board, there; 1 long but for the bend."""
    rays: Floats
    """(V, M, 3)"""
    slant: Floats
    """(V, M) n . v"""
    range_m: Floats
    """(V, M)"""
    off_board: Floats
    """(V, M, 3) from where the ray meets it to the board's origin."""
    warp_shape: Floats
    """(V, M, 2)"""


def _met(data: RangeData, state: RigState, board: Board, rays_camera: Floats) -> _Met:
    T_rig_camera, T_rig_board = state.T_rig_camera[data.camera], state.T_rig_board[data.frames]
    R_rig_board = T_rig_board[:, :3, :3]
    n = R_rig_board[:, :, 2]
    v = rays_camera @ T_rig_camera[:3, :3].T
    slant = np.einsum("vi,vmi->vm", n, v)
    offset = T_rig_board[:, :3, 3] - T_rig_camera[:3, 3]
    flat_m = np.einsum("vi,vi->v", n, offset)[:, None] / slant
    range_m, places, shape = flat_m, np.empty(0), np.empty(0)
    for _ in range(WARP_ROUNDS):
        places = (range_m[..., None] * v - offset[:, None]) @ R_rig_board
        shape = warp_at_places(board, places[..., :2])
        range_m = flat_m + (shape @ state.warp_m) / slant
    last = board.points()[:, :2].max(axis=0)
    slopes = -4 / last * (2 * places[..., :2] / last - 1) * state.warp_m
    local = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1) @ np.swapaxes(R_rig_board, 1, 2)
    slant = np.einsum("vmi,vmi->vm", local, v)
    return _Met(local, v, slant, range_m, offset[:, None] - range_m[..., None] * v, shape)


def _inside(
    range_m: npt.NDArray[np.floating], rays: Floats, state: RigState, camera: int, frame: int, board: Board
) -> npt.NDArray[np.intp]:
    """(M, 2) pixels whose rays meet the board inside its corners, where a range was measured."""
    T_camera_board = np.linalg.inv(state.T_rig_camera[camera]) @ state.T_rig_board[frame]
    n, o = T_camera_board[:3, 2], T_camera_board[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = (rays * ((n @ o) / (rays @ n))[..., None] - o) @ T_camera_board[:3, :2]
        last = board.points()[:, :2].max(axis=0)
        inside = ((places > INSIDE * board.pitch_m) & (places < last - INSIDE * board.pitch_m)).all(axis=-1)
        inside &= np.isfinite(range_m) & (rays @ n * (n @ o) > 0)
    y, x = np.nonzero(inside)
    step = max(1, -(-len(x) // PIXELS_MAX))
    return np.stack([x, y], axis=-1)[::step]
