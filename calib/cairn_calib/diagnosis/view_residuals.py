"""Residuals of each image's corners at a solution, and the corners that were left out."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.solve.corner_residuals import CornerData, corner_misses
from cairn_calib.solve.rig_state import warp_shape
from cairn_calib.solve.solution import Solution
from cairn_map.arrays import Floats


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
    for sensor in solution.adjusted.problem.sensors:
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
