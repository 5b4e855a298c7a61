"""Statistics of views: coverage of each camera by the boards, and the residuals of each image's corners."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import inverse
from cairn_calib.solve.camera_alone import tilt_range_deg
from cairn_calib.solve.corner_residuals import CornerData, corner_misses
from cairn_calib.solve.rig_state import warp_shape
from cairn_calib.solve.solution import Solution
from cairn_map.arrays import Floats

CELLS = (8, 6)
"""Columns and rows into which an image is divided."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """Coverage of one camera."""

    camera: str
    images: int
    counts: npt.NDArray[np.intp]
    """(6, 8) corners in each part of the image."""
    radius_share: float
    """Distance of the outermost corner from the image's middle, over that of the image's corner."""
    tilt_deg: float
    """Largest angle between two boards."""
    lean_deg: float
    """Largest angle of a board from facing the camera."""
    nearest_m: float
    """Distance of the nearest board's middle."""
    farthest_m: float
    """Distance of the farthest board's middle."""

    @property
    def cell_share(self) -> float:
        """Share of the parts of the image with corners."""
        return float(np.mean(self.counts > 0))


def coverage(solution: Solution, camera: str) -> Coverage:
    """Coverage of a camera by the boards of a solution."""
    views = solution.views.of_camera(camera)
    width, height = solution.views.sizes_px[camera]
    pixels = np.concatenate([view.corners.pixels[view.corners.seen] for view in views])
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(CELLS[1], CELLS[0]), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
    )
    middle = np.array([width - 1, height - 1]) / 2
    frames = [solution.views.frames.index(view.frame) for view in views]
    T_camera_rig = inverse(solution.state.T_rig_camera[solution.views.cameras.index(camera)])
    T_camera_board = T_camera_rig @ solution.state.T_rig_board[frames]
    board_middle = solution.views.board.points().mean(axis=0)
    middles = T_camera_board[:, :3, :3] @ board_middle + T_camera_board[:, :3, 3]
    distances = np.linalg.norm(middles, axis=1)
    facing = np.einsum("fi,fi->f", T_camera_board[:, :3, 2], middles) / distances
    return Coverage(
        camera,
        len(views),
        counts.astype(np.intp),
        float(np.linalg.norm(pixels - middle, axis=1).max() / np.linalg.norm(middle)),
        tilt_range_deg(T_camera_board),
        float(np.degrees(np.arccos(np.clip(facing.min(), -1, 1)))),
        float(distances.min()),
        float(distances.max()),
    )


@dataclass(frozen=True, slots=True)
class ViewResiduals:
    """Residuals of one image."""

    camera: str
    frame: str
    image: str
    pixels: Floats
    """(M, 2) corners that were found."""
    misses_px: Floats
    """(M, 2) predicted minus found."""
    kept: npt.NDArray[np.bool_]
    """(M,) True for each corner that counts."""

    @property
    def outliers(self) -> int:
        """Number of corners that were left out."""
        return int(np.sum(~self.kept))

    @property
    def rms_px(self) -> float:
        """Root mean square of one axis, over the corners that count."""
        return float(np.sqrt(np.mean(self.misses_px[self.kept] ** 2))) if self.kept.any() else float("nan")


def view_residuals(solution: Solution) -> list[ViewResiduals]:
    """Residuals of every image, by camera and frame."""
    board = (solution.views.board.points(), warp_shape(solution.views.board))
    result = []
    for sensor in solution.adjustment.problem.sensors:
        if not isinstance(sensor.data, CornerData):
            continue
        misses = corner_misses(sensor.data, solution.state, *board)
        views = solution.views.of_camera(solution.views.cameras[sensor.data.camera])
        for n, view in enumerate(views):
            seen = sensor.there[n]
            result.append(
                ViewResiduals(
                    view.camera,
                    view.frame,
                    view.image,
                    sensor.data.pixels[n, seen],
                    misses[n, seen],
                    sensor.kept[n, seen],
                )
            )
    return result
