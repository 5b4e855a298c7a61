"""Simulated boards over distance, tilt, blur, noise and polarity."""

from dataclasses import dataclass, replace

import numpy as np
from tests.cairn_calib.board_images import BOARD, COLOUR, THERMAL, TOF, Floats, Image, cell_px, picture, pose, truth

from cairn_calib.board import Polarity
from cairn_calib.corner_detection import find_chessboard

SPECTRA = {"tof": TOF, "thermal": THERMAL, "colour": COLOUR}
BLUR_PX = {"tof": (0.3, 0.7), "thermal": (0.5, 1.5), "colour": (0.4, 1.5)}
CONTRAST = (10.0, 60.0)
"""Between bright and dark, in standard deviations of the noise."""
TILT_DEG = 45.0
OFF_CELLS = 0.3
"""By which a found corner may be off, cells; a wrong order is a cell or more."""


@dataclass(frozen=True)
class Trial:
    """One board in one image."""

    seed: int
    image: Image
    at: Floats
    polarity: Polarity
    cell_px: float
    tilt_deg: float
    blur_px: float
    contrast: float


def trial(name: str, seed: int) -> Trial:
    """The board of one seed."""
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
    T = pose(rng, spectrum, tilt_deg=TILT_DEG)
    tilt = float(np.degrees(np.arccos(np.clip(T[2, 2], -1, 1))))
    image = picture(spectrum, T, rng)
    return Trial(seed, image, truth(spectrum, T), polarity, cell_px(spectrum, T), tilt, spectrum.blur_px, contrast)


def found_rightly(each: Trial) -> bool:
    """Whether its board is found, with each corner where it is."""
    corners = find_chessboard(each.image, BOARD, polarity=each.polarity).corners
    return corners is not None and bool(np.nanmax(np.abs(corners.pixels - each.at)) < OFF_CELLS * each.cell_px)
