"""Simulated boards over distance, tilt, blur, noise and polarity: chessboards and grids of discs."""

from dataclasses import dataclass, replace

import numpy as np
from tests.fixtures.calib.board_images import (
    BOARD,
    COLOUR,
    DISC,
    THERMAL,
    TOF,
    Floats,
    Image,
    cell_px,
    picture,
    pose,
    truth,
)

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_detection import find_chessboard
from cairn_calib.board.discs.disc_grid import find_circles
from cairn_calib.solve.corner_residuals import disc_shift

SPECTRA = {"tof": TOF, "thermal": THERMAL, "colour": COLOUR}
BLUR_PX = {"tof": (0.3, 0.7), "thermal": (0.5, 1.5), "colour": (0.4, 1.5)}
CONTRAST = (10.0, 60.0)
"""Between bright and dark, in standard deviations of the noise."""
TILT_DEG = 45.0
DISCS = Board(pattern="asymmetric-circles", columns=4, rows=11, pitch_m=0.05)
TARGETS = {"chessboard": BOARD, "discs": DISCS}
DISC_PX = 2.0
"""Radius of the smallest discs."""
OFF_CELLS = 0.3
"""By which a found corner may be off, cells; a wrong order is a cell or more."""


@dataclass(frozen=True)
class Trial:
    """One board in one image."""

    seed: int
    board: Board
    image: Image
    at: Floats
    polarity: Polarity
    cell_px: float
    tilt_deg: float
    blur_px: float
    contrast: float

    def __str__(self) -> str:
        return (
            f"cells {self.cell_px:.1f} px, tilt {self.tilt_deg:.0f} deg, blur {self.blur_px:.2f} px, "
            f"contrast {self.contrast:.0f} x noise, {self.polarity}"
        )


def trial(name: str, seed: int, *, target: str = "chessboard") -> Trial:
    """The board of one seed."""
    board = TARGETS[target]
    rng = np.random.default_rng([seed, 17])
    spectrum = SPECTRA[name]
    contrast = float(np.exp(rng.uniform(*np.log(CONTRAST))))
    polarity: Polarity = "normal" if rng.random() < 0.5 else "reversed"
    low, high = sorted((spectrum.dark, spectrum.bright))
    spectrum = replace(
        spectrum,
        blur_px=float(rng.uniform(*BLUR_PX[name])),
        noise=(high - low) / contrast,
        dark=low if polarity == "normal" else high,
        bright=high if polarity == "normal" else low,
    )
    T = pose(rng, spectrum, board=board, tilt_deg=TILT_DEG)
    while target == "discs" and DISC * cell_px(spectrum, T, board) / np.sqrt(2) < DISC_PX:
        T = pose(rng, spectrum, board=board, tilt_deg=TILT_DEG)
    tilt = float(np.degrees(np.arccos(np.clip(T[2, 2], -1, 1))))
    image = picture(spectrum, T, rng, board=board)
    at = truth(spectrum, T, board=board)
    if target == "discs":
        points = board.points() @ T[:3, :3].T + T[:3, 3]
        at = at + disc_shift(spectrum.camera, points[None], T[None, :3, :3], DISC * board.pitch_m)[0]
    cell = cell_px(spectrum, T, board)
    return Trial(seed, board, image, at, polarity, cell, tilt, spectrum.blur_px, contrast)


def found_rightly(each: Trial) -> bool:
    """Whether its board is found, with each point where it is."""
    find = find_chessboard if each.board is BOARD else find_circles
    corners = find(each.image, each.board, polarity=each.polarity).corners
    return corners is not None and bool(np.nanmax(np.abs(corners.pixels - each.at)) < OFF_CELLS * each.cell_px)
