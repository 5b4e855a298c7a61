"""Detection of a board in an image: its points with covariance, and the stage at which each attempt ended."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_map.arrays import Floats

FOUND = "found"
BY_HAND = "by hand"
"""Method of points that a person pointed at."""
NOT_REFUSED = "not refused, since it is pointed at"
"""Words before the reason of a gate that would have refused points by hand."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One method at one scale, and its outcome."""

    method: str
    scale: float
    stage: str
    """`found`, or the stage or gate that refused."""
    reason: str

    def __str__(self) -> str:
        return f"{self.method} x{self.scale:g}: {self.stage}{': ' if self.reason else ''}{self.reason}"


def pointed_attempt(found: str, odd: tuple[str, str] | None) -> Attempt:
    """Attempt on a board that a person pointed at: what was found, and the gate that would have refused it, and why."""
    return Attempt(BY_HAND, 1.0, FOUND, found if odd is None else f"{found}; {NOT_REFUSED}: {odd[1]}")


@dataclass(frozen=True, slots=True)
class Corners:
    """The points of a board in one image, in the board's order."""

    board: Board
    pixels: Floats
    """(N, 2) x, y; NaN where a point is hidden. For discs: the centroid of the disc's image."""
    covariance_px2: Floats
    """(N, 2, 2) pixels squared; NaN where a point is hidden."""

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(N,) True for each point that is there."""
        return np.isfinite(self.pixels[:, 0])


@dataclass(frozen=True, slots=True)
class Detection:
    """Corners, or None where none were found, and every attempt."""

    corners: Corners | None
    attempts: tuple[Attempt, ...]
    disc_pitches: float | None = None
    """Diameter of the board's discs as the image shows it, pitches."""
