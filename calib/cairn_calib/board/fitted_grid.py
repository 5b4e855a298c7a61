"""A grid of fitted corners and the image in which it was found, for gates to judge."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.corner_refinement import FittedCorners
from cairn_calib.board.homography import steps_between
from cairn_map.arrays import Floats

Image = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Judged:
    """A grid and what was found about it; arrays in the board's order."""

    image: Image
    board: Board
    fitted: FittedCorners
    homography: Floats

    @property
    def kept(self) -> npt.NDArray[np.bool_]:
        """(N,) which corners are there."""
        return np.isfinite(self.fitted.pixels[:, 0])

    @property
    def steps(self) -> Floats:
        """(N, 2, 2) pixels to the next column and row."""
        return steps_between(self.homography, self.board.lattice())


Gate = Callable[[Judged], str | None]


def checker_signs(board: Board) -> Floats:
    """(N,) 1 where the cell towards the next column and row has the colour of the first cell, else -1."""
    return np.where(board.lattice().sum(axis=1) % 2 == 0, 1.0, -1.0)
