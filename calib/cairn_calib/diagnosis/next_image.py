"""Image to shoot next: of many places of the board, the one that would sharpen the rig most.

Each candidate adds its share to the normal equations (no residual is needed for that), and the probe points' variance
with it is compared to that without. The choice is put in words: where in whose image, how far, how tilted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.diagnosis.probe_points import Probes, image_grid
from cairn_calib.rig.pose_vectors import rotation_from_vector
from cairn_calib.solve.corner_residuals import CornerData, board_points, corner_block
from cairn_calib.solve.normal_equations import Loss, frame_shares
from cairn_calib.solve.rig_state import warp_shape
from cairn_calib.solve.solution import Solution
from cairn_map.arrays import Floats

COLUMNS, ROWS = 3, 3
"""Parts of an image in whose middles the board is tried."""
SHARES = (0.3, 0.55)
"""Shares of the image's width that the board fills."""
TILT_DEG = 35.0
"""Tilt of every candidate, degrees: boards seen from the front do not separate focal length and distance."""
TILTS = {"right": (0.0, -1.0), "left": (0.0, 1.0), "lower": (1.0, 0.0), "upper": (-1.0, 0.0)}
"""Edge of the board that is turned away, and the axis of that turn in the camera's frame."""
SEEN_SHARE = 0.6
"""Share of the board's points without which a camera may not find it; the one that it is aimed at must see all."""


@dataclass(frozen=True, slots=True)
class NextImage:
    """A place for the board."""

    camera: str
    pixel: tuple[float, float]
    """Pixel of the board's middle in that camera."""
    range_m: float
    edge: str
    """Edge of the board that is turned away."""
    gain: float
    """Share by which the probe points' variance falls with this one image of every camera that sees the board."""

    def __str__(self) -> str:
        x, y = self.pixel
        return (
            f"the board's middle at pixel ({x:.0f}, {y:.0f}) of {self.camera}, {self.range_m:.2f} m away, "
            f"its {self.edge} edge turned away by {TILT_DEG:g} degrees"
        )


def next_images(solution: Solution, probes: Sequence[Probes], *, count: int = 3) -> list[NextImage]:
    """The best places, each for itself, of different cameras or parts of an image; best first."""
    candidates = [each for n in range(len(solution.plan.cameras)) for each in _candidates(solution, n)]
    poses = np.stack([T for _, T in candidates])
    seen, shares = _shares(solution, poses)
    S, _, _, _ = solution.adjustment.normal.reduce()
    noise = _noise_px(solution)
    # Rows in units of each camera's own noise: a colour pixel is no range camera's pixel.
    target = np.zeros_like(S)
    for each in probes:
        G = each.rows.reshape(-1, solution.layout.size) / noise[each.camera]
        target += G.T @ G / len(G)
    # trace(target (S + share)^-1): the probe points' variance with the candidate. Its camera must see the whole board.
    before = float(np.sum(target * solution.covariance))
    gains = np.full(len(candidates), -1.0)
    for n, ((place, _), share) in enumerate(zip(candidates, shares, strict=True)):
        if seen[n, list(solution.plan.cameras).index(place.camera)] == 1:
            gains[n] = 1 - float(np.trace(np.linalg.solve(S + share, target))) / before
    # The best of each camera and part of its image.
    chosen: list[NextImage] = []
    for n in np.argsort(-gains):
        place = candidates[n][0]
        if gains[n] > 0 and all((place.camera, place.pixel) != (each.camera, each.pixel) for each in chosen):
            chosen.append(replace(place, gain=float(gains[n])))
        if len(chosen) == count:
            break
    return chosen


def _candidates(solution: Solution, camera: int) -> list[tuple[NextImage, Floats]]:
    """Places before one camera, with their T_rig_board."""
    lens = solution.state.lenses[camera]
    T_rig_camera = solution.state.T_rig_camera[camera]
    points = solution.views.board.points()
    middle, width_m = points.mean(axis=0), float(np.ptp(points[:, 0]))
    # Angle of the image's width: it gives the distance at which the board fills a share of it.
    left, right = lens.unproject(np.array([[0.0, lens.centre_px[1]], [lens.width - 1.0, lens.centre_px[1]]]))
    across = float(np.arccos(np.clip(left @ right, -1, 1)))
    name = solution.views.cameras[camera]
    result = []
    for pixel in image_grid(lens.width, lens.height, COLUMNS, ROWS):
        ray = lens.unproject(pixel)
        for share in SHARES:
            range_m = width_m / (2 * np.tan(max(share * across, 0.02) / 2))
            # The board's middle on the pixel's ray, tilted about an axis of the camera.
            for words, axis in TILTS.items():
                T = np.eye(4)
                T[:3, :3] = rotation_from_vector(np.radians(TILT_DEG) * np.array([*axis, 0.0]))
                T[:3, 3] = range_m * ray - T[:3, :3] @ middle
                place = NextImage(name, (float(pixel[0]), float(pixel[1])), float(range_m), words, 0.0)
                result.append((place, T_rig_camera @ T))
    return result


def _shares(solution: Solution, poses: Floats) -> tuple[Floats, Floats]:
    """(K, C) share of the board's points that each camera sees, and (K, P, P) share of each pose in the equations."""
    state = replace(solution.state, T_rig_board=poses)
    board = (solution.views.board.points(), warp_shape(solution.views.board))
    p_rig = board_points(state, *board) @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    blocks, seen = [], np.zeros((len(poses), len(state.lenses)))
    for sensor in solution.adjustment.problem.sensors:
        if not isinstance(sensor.data, CornerData):
            continue
        c = sensor.data.camera
        T = state.T_rig_camera[c]
        # Points of the board that are in this camera's image.
        inside = state.lenses[c].contains(state.lenses[c].project((p_rig - T[:3, 3]) @ T[:3, :3]))
        seen[:, c] = inside.mean(axis=1)
        frames = np.flatnonzero(seen[:, c] >= SEEN_SHARE)
        if not len(frames):
            continue
        # No residual is needed: pixels of 0 stand in, for only derivatives count.
        kept = inside[frames]
        whitening = np.broadcast_to(np.eye(2) / sensor.data.sigma_px, (*kept.shape, 2, 2))
        data = CornerData(c, frames, np.zeros((*kept.shape, 2)), whitening, kept, sensor.data.sigma_px)
        blocks.append(corner_block(data, state, solution.layout, board, Loss(sensor.whole_scale, kept, np.inf)))
    # The floor makes boards that hardly a camera sees solvable; they add nothing.
    shares, _ = frame_shares(blocks, solution.layout.size, len(poses), floor=1e-6)
    return seen, shares


def _noise_px(solution: Solution) -> dict[str, float]:
    return {
        solution.views.cameras[sensor.data.camera]: sensor.scale * sensor.data.sigma_px
        for sensor in solution.adjustment.problem.sensors
        if isinstance(sensor.data, CornerData)
    }
