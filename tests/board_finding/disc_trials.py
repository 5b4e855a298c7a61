"""Simulated grids of discs through lenses of 40 to 150 degrees, and boards that are searched where there is none."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from tests.fixtures.calib.disc_views import disc_view

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.discs.disc_grid import find_circles

OFF_DISCS = 0.3
"""By which a found disc may be off, its narrowest diameters; a wrong name is one or more."""
WAYS: tuple[Polarity, Polarity] = ("normal", "reversed")
EMPTY_BOARDS = (
    Board(pattern="circles", columns=4, rows=3, pitch_m=0.09, disc_m=0.06),
    Board(pattern="circles", columns=7, rows=5, pitch_m=0.05, disc_m=0.03),
    Board(pattern="asymmetric-circles", columns=4, rows=11, pitch_m=0.05, disc_m=0.03),
    Board(pattern="asymmetric-circles", columns=3, rows=5, pitch_m=0.05, disc_m=0.04),
)


@dataclass(frozen=True)
class DiscTrial:
    """Outcome of one grid of discs in one image."""

    seed: int
    text: str
    is_found: bool
    is_wrong: bool
    sigmas: npt.NDArray[np.float64]
    """(2 K,) errors of the discs found, x and y, in stated standard deviations."""

    def __str__(self) -> str:
        outcome = "found" if self.is_found else "wrong" if self.is_wrong else "not found"
        return f"seed {self.seed}: {outcome}: {self.text}"


def disc_trial(seed: int, *, whole: bool = True) -> DiscTrial:
    """The grid of one seed, searched with its own polarity."""
    view = disc_view(seed, whole=whole)
    detection = find_circles(view.image, view.board, polarity=WAYS[view.reversed], upright=view.board.has_turn_symmetry)
    if detection.corners is None:
        return DiscTrial(seed, f"{view.text}: {detection.attempts[-1]}", False, False, np.zeros(0))
    seen = detection.corners.seen
    off = (detection.corners.pixels - view.centroids)[seen]
    right = bool(np.abs(off).max() < OFF_DISCS * view.narrowest_px)
    variance = np.diagonal(detection.corners.covariance_px2[seen], axis1=1, axis2=2)
    return DiscTrial(
        seed, view.text, right, not right, np.abs(off / np.sqrt(variance)).ravel() if right else np.zeros(0)
    )


def false_grids(image: npt.NDArray[np.generic], seed: int) -> bool:
    """True if one of the boards, another for each seed, is found in an image without any, in either polarity."""
    board = EMPTY_BOARDS[seed // 17 % len(EMPTY_BOARDS)]
    return any(
        find_circles(image, board, polarity=way, upright=board.has_turn_symmetry).corners is not None for way in WAYS
    )
