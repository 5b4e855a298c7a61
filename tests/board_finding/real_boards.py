"""Boards of a real recording, changed as cameras would: turned, inverted, blurred, smaller, with noise, or near."""

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from tests.fixtures.calib.board_images import BOARD

from cairn_calib.board.board import Polarity
from cairn_calib.board.corner_detection import find_chessboard, grey
from cairn_calib.board.polarity import margin_polarity

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
CELL_MIN_PX = 7.0
OFF_CELLS = 0.1
"""By which a corner may lie elsewhere than in the image as recorded, cells."""
BLUR_PX, NOISE = (0.3, 1.0), (1.0, 10.0)
"""In the changed image; noise in counts of 255."""
NEAR_SCALES, NEAR_BLUR_PX = (1.5, 2.0, 3.0, 4.0), 4.0
"""Enlargements of near boards; blur in pixels of the image as recorded."""


@dataclass(frozen=True)
class Change:
    """What became of an image."""

    image: Bytes
    at: Floats
    """Where the corners must be, in order."""
    polarity: Polarity
    cell_px: float
    text: str


@cache
def recorded() -> tuple[tuple[str, Bytes, Floats], ...]:
    """Names, images and corners of OpenCV's stereo pairs; none where they are not at hand."""
    folder = os.environ.get("CAIRN_TEST_DATA")
    found = []
    for path in sorted((Path(folder) / "opencv_stereo_chess").glob("*.jpg")) if folder else []:
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        corners = find_chessboard(image, BOARD).corners
        if corners is None:
            raise AssertionError(f"{path.name}: no board in the image as recorded")
        found.append((path.stem, image, corners.pixels))
    return tuple(found)


def changed(seed: int) -> Change:
    """One of the recorded images and what one seed makes of it."""
    rng = np.random.default_rng([seed, 31])
    name, image, at = recorded()[int(rng.integers(len(recorded())))]
    cell = float(np.nanmin(np.linalg.norm(np.diff(at.reshape(BOARD.rows, BOARD.columns, 2), axis=1), axis=-1)))
    scale = float(np.exp(rng.uniform(np.log(min(1.0, CELL_MIN_PX / cell)), 0.0)))
    size = tuple(round(scale * side) for side in image.shape[::-1])
    values = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    at = (at + 0.5) * np.divide(size, image.shape[::-1]) - 0.5
    turns = int(rng.integers(4))
    for _ in range(turns):
        at = np.column_stack([at[:, 1], values.shape[1] - 1 - at[:, 0]])
        values = np.rot90(values)
    blur, noise = float(rng.uniform(*BLUR_PX)), float(rng.uniform(*NOISE))
    values = cv2.GaussianBlur(np.ascontiguousarray(values), (0, 0), blur)
    polarity: Polarity = "normal" if rng.random() < 0.5 else "reversed"
    values = (values if polarity == "normal" else 255 - values) + rng.normal(0, noise, values.shape)
    text = f"{name} x{scale:.2f}, turned {90 * turns} deg, blur {blur:.1f} px, noise {noise:.1f}, {polarity}"
    return Change(np.clip(values, 0, 255).astype(np.uint8), at, polarity, cell * scale, text)


def near(seed: int) -> Change:
    """One of the recorded images as a camera close to the board would see it: cut, enlarged, inverted, blurred."""
    rng = np.random.default_rng([seed, 37])
    name, image, at = recorded()[int(rng.integers(len(recorded())))]
    cell = float(np.nanmin(np.linalg.norm(np.diff(at.reshape(BOARD.rows, BOARD.columns, 2), axis=1), axis=-1)))
    # What is left about the outer corners, cells of the image as recorded.
    around = cell * float(rng.choice([0.45, 1.3, 9.0]))
    low = np.clip(np.nanmin(at, axis=0) - around, 0, None).astype(int)
    high = np.clip(np.nanmax(at, axis=0) + around + 1, 0, image.shape[::-1]).astype(int)
    scale = float(rng.choice(NEAR_SCALES))
    cut = image[low[1] : high[1], low[0] : high[0]]
    values = cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    blur = scale * float(rng.uniform(0, NEAR_BLUR_PX))
    if blur > 0.2:
        values = cv2.GaussianBlur(values, (0, 0), blur)
    polarity: Polarity = "normal" if rng.random() < 0.5 else "reversed"
    values = np.asarray(values if polarity == "normal" else 255 - values, np.uint8)
    text = f"{name} x{scale:g}, {around / cell:g} cells about it, blur {blur:.1f} px, {polarity}"
    return Change(values, (at - low + 0.5) * scale - 0.5, polarity, cell * scale, text)


def found_by_opencv(change: Change) -> bool:
    """True if one of OpenCV's two detectors finds the board."""
    size = (BOARD.columns, BOARD.rows)
    return bool(cv2.findChessboardCorners(change.image, size)[0] or cv2.findChessboardCornersSB(change.image, size)[0])


def found_as_recorded(change: Change) -> bool:
    """Whether each corner is found again, in the same order."""
    corners = find_chessboard(change.image, BOARD, polarity=change.polarity).corners
    return corners is not None and bool(
        np.nanmax(np.abs(corners.pixels - change.at)) < OFF_CELLS * change.cell_px + 0.1
    )


def voted(change: Change) -> Polarity | None:
    """For which polarity the changed image votes; None if for none."""
    corners = find_chessboard(change.image, BOARD).corners
    return None if corners is None else margin_polarity(grey(change.image), corners)
