"""Fit of a whole chessboard to proposed corners, at a scale at which its cells have the size that the gates know.

    proposal -> image reduced until cells are 16 to 32 px -> corners fitted, hidden ones predicted -> order -> gates
             -> corners fitted again at the finest scale at which their edges are sharp

What large, near cells add to a corner's window (soft edges, the grain of paper, light that flows over an edge) is of
the same size in cells as that of small ones, and is judged so. Hidden corners stay hidden.
"""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.corner_gates import LIKE_MOVED, FittedGrid, checker_signs, refusal, sound_corners
from cairn_calib.board.corner_refinement import FittedCorners, fit_corners
from cairn_calib.board.corners import Corners
from cairn_calib.board.homography import fit_homography, map_points, steps_between
from cairn_map.arrays import Flags, Floats

Image = npt.NDArray[np.float32]

PASSES = 4
"""Fits of the whole grid, at most; each predicts the corners that are lost from those that the one before kept."""
CELL_PX = 16.0
"""Cells are at least this large at the scale of the gates, pixels, and less than twice this, if the image allows."""
SHARP_PX = 2.5
"""Blur of edges, pixels, up to which a corner's window of 17 x 17 pixels holds them; softer ones are fitted at a
coarser scale."""
NO_FIT = "refinement", "the edges that cross at the proposed corners cannot be fitted"
MIRRORED = (
    "orientation",
    "the corners pointed at are those of a mirrored board: name the first, the end of its row, the end of the last row "
    "and its start",
)


def fit_board(
    grid: Floats, counts: Image, board: Board, *, order: Callable[[FittedGrid], FittedGrid]
) -> Corners | tuple[str, str]:
    """Corners of the board at proposed places; or the stage that refuses, and why.

    Args:
        grid: (rows, columns, 2) or (N, 2) proposed pixels, NaN where unknown.
        counts: (H, W) image as recorded.
        board: the chessboard.
        order: puts the board's first corner first.
    """
    factor = _factor(grid, board)
    found = _fit_reduced(grid, counts, board, factor)
    if found is None:
        return NO_FIT
    # Gates judge the board in its own order, at the reduced scale.
    found = order(found)
    return refusal(found) or _sharpen(found, counts, factor)


def fit_pointed_board(grid: Floats, counts: Image, board: Board) -> tuple[Corners | None, tuple[str, str] | None]:
    """Corners at places that a person pointed at, with the gate that would have refused them, and why.

    None, with the stage and the reason, where no corners are, or where they are those of a mirrored board. Arguments
    are those of `fit_board`.
    """
    factor = _factor(grid, board)
    found = _fit_reduced(grid, counts, board, factor)
    if found is None:
        return None, NO_FIT
    # No camera sees a board so, unless in a mirror: no answer to a wrong order would help a solve.
    if np.linalg.det(found.steps[found.kept]).max() < 0:
        return None, MIRRORED
    # The gate's word goes with the corners, and does not keep them back.
    return _sharpen(found, counts, factor), refusal(found)


def _factor(grid: Floats, board: Board) -> int:
    """Scale of the gates: a power of 2, so that pixels are means of whole pixels."""
    return 1 << max(0, int(np.floor(np.log2(max(_step_px(grid, board) / CELL_PX, 1.0)))))


def _fit_reduced(grid: Floats, counts: Image, board: Board, factor: int) -> FittedGrid | None:
    # Pixel centres are at whole numbers, so an image's edge is at -0.5 at every scale.
    return fit_grid((grid + 0.5) / factor - 0.5, reduce_image(counts, factor), board)


def _step_px(grid: Floats, board: Board) -> float:
    """Median step from corner to corner, pixels."""
    # Along rows and along columns, whatever is known.
    places = grid.reshape(board.rows, board.columns, 2)
    steps = [np.linalg.norm(np.diff(places, axis=k), axis=-1).ravel() for k in (0, 1)]
    return float(np.nanmedian(np.concatenate(steps)))


def reduce_image(counts: Image, factor: int) -> Image:
    """Image of the means of squares of `factor` pixels; what is left at its right and bottom edge is cut."""
    height, width = (side // factor * factor for side in counts.shape)
    if factor == 1:
        return counts
    size = width // factor, height // factor
    return np.asarray(cv2.resize(counts[:height, :width], size, interpolation=cv2.INTER_AREA), np.float32)


def _sharpen(found: FittedGrid, counts: Image, factor: int) -> Corners:
    """Corners of a grid that passed the gates at a coarse scale, from the finest one at which their edges are sharp."""
    board, lattice = found.board, found.board.lattice()
    pixels = (found.fitted.pixels + 0.5) * factor - 0.5
    homography = fit_homography(lattice[found.kept], pixels[found.kept])
    if factor == 1 or homography is None:
        return Corners(board, pixels, found.fitted.covariance_px2 * factor**2)
    # Corners that the coarse scale lost at the image's border are searched where the others predict them.
    guesses = np.where(found.kept[:, None], pixels, _predict(homography, lattice, pixels, found.kept))
    steps = steps_between(homography, lattice)
    return Corners(
        board, *fit_sharpest(counts, found.fitted, guesses, steps, signs=checker_signs(board), factor=factor)
    )


def fit_sharpest(
    counts: Image, coarse: FittedCorners, guesses: Floats, steps: Floats, *, signs: Floats, factor: int
) -> tuple[Floats, Floats]:
    """Pixels (N, 2) and covariance (N, 2, 2) of corners at the finest scale at which their edges are sharp.

    Args:
        counts: (H, W) image as recorded.
        coarse: the corners as fitted in the image that is reduced by `factor`.
        guesses: (N, 2) pixels of the image as recorded, also of corners that are not in `coarse`; NaN for none.
        steps: (N, 2, 2) its pixels to the next column and row.
        signs: as of `sound_corners`.
        factor: a power of 2.
    """
    pixels, covariance = (coarse.pixels + 0.5) * factor - 0.5, coarse.covariance_px2 * factor**2
    # From the image as recorded to coarser ones, until edges are sharp enough for a window.
    finer = 1
    while finer < factor:
        fitted = fit_corners(reduce_image(counts, finer), (guesses + 0.5) / finer - 0.5, steps / finer)
        # A corner that is not sound at this scale keeps its place from the coarse one.
        sound = sound_corners(fitted, signs) & (fitted.moved < LIKE_MOVED)
        if 2 * sound.sum() >= np.isfinite(coarse.pixels[:, 0]).sum() and np.median(fitted.blur_px[sound]) <= SHARP_PX:
            pixels = np.where(sound[:, None], (fitted.pixels + 0.5) * finer - 0.5, pixels)
            covariance = np.where(sound[:, None, None], fitted.covariance_px2 * finer**2, covariance)
            break
        finer *= 2
    return pixels, covariance


def fit_grid(grid: Floats, counts: Image, board: Board) -> FittedGrid | None:
    """Grid of fitted corners from proposed ones; hidden or wrong ones are searched where the others predict them.

    Args:
        grid: (rows, columns, 2) or (N, 2) proposed pixels, NaN where unknown.
        counts: (H, W) image as recorded.
        board: the chessboard.

    Returns:
        The grid; None where fewer than 8 corners are left, or they determine no homography.
    """
    lattice, signs = board.lattice(), checker_signs(board)
    guesses = grid.reshape(-1, 2).copy()
    fitted = None
    for _ in range(PASSES):
        known = np.isfinite(guesses[:, 0])
        homography = fit_homography(lattice[known], guesses[known]) if known.sum() >= 8 else None
        if homography is None:
            return None
        # Predict what is missing, fit everything, and drop what is no corner of this board.
        guesses = np.where(known[:, None], guesses, _predict(homography, lattice, guesses, known))
        steps = steps_between(homography, lattice)
        fitted = fit_corners(counts, guesses, steps)
        fitted = fitted.only(_sound_and_apart(fitted, signs, apart_px=0.5 * _shortest_px(steps)))
        guesses = fitted.pixels
        if not np.isnan(guesses).any():
            break
    known = np.isfinite(guesses[:, 0])
    homography = fit_homography(lattice[known], guesses[known]) if known.sum() >= 8 else None
    return None if homography is None or fitted is None else FittedGrid(counts, board, fitted, homography)


def _predict(homography: Floats, lattice: Floats, guesses: Floats, known: npt.NDArray[np.bool_]) -> Floats:
    """(N, 2) predicted corners: the homography, plus its miss at the nearest known corner."""
    plain = map_points(homography, lattice)
    off = np.where(known[:, None], guesses - plain, 0)
    away = np.where(known, np.linalg.norm(lattice[:, None] - lattice[None], axis=2), np.inf)
    return np.asarray(plain + off[away.argmin(axis=1)])


def _shortest_px(steps: Floats) -> float:
    return float(np.nan_to_num(np.linalg.norm(steps, axis=2), nan=np.inf).min())


def _sound_and_apart(fitted: FittedCorners, signs: Floats, *, apart_px: float) -> Flags:
    """(N,) True for each fitted corner that is one of this board.

    Where two names have come to one place, either may be wrong, so neither is kept: the others predict both again.
    """
    # Corners that do not look like this board's, then those that coincide.
    sound = sound_corners(fitted, signs)
    apart = np.linalg.norm(fitted.pixels[:, None] - fitted.pixels[None], axis=2)
    apart[np.diag_indices(len(apart))] = np.inf
    with np.errstate(invalid="ignore"):
        return np.asarray(sound & ~((apart < apart_px) & sound).any(axis=1))
