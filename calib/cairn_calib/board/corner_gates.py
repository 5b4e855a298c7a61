"""What a grid of corners must pass to be believed: windows, tiles and brick walls have lattices too.

Each gate returns why it refuses, or None. They look at the fitted corners and at the image as recorded, so whichever
detector proposed the grid, it is judged alike.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board_flatness import flat_limit_px, flat_rms_px
from cairn_calib.board.corner_refinement import FittedCorners
from cairn_calib.board.fitted_grid import Gate, Judged, checker_signs
from cairn_calib.board.grid_ends import goes_on, starts_and_ends
from cairn_calib.board.homography import mapped
from cairn_map.arrays import Floats

CELL_MIN_PX = 3.5
"""Shortest step from corner to corner. Below, the fit has fewer pixels than it needs."""
SEEN_MIN = 0.6
MISFIT_MAX = 0.45
"""Residuals of one corner, share of its contrast: noise of a tenth of the step from dark to bright is 0.2."""
MISFIT_RATIO, MISFIT_SPARE = 3.0, 0.05
"""Of the board's usual misfit, and beside it: something that hides a corner in part pulls it by a third of a pixel."""
MISFIT_USUAL_MAX = 0.3
MOVED_MAX = 0.4
"""Cells between a proposed corner and the fitted one."""
CONTRAST_RATIO = 4.0
"""Between a corner's contrast and the board's usual one."""
UNEVEN_PX, UNEVEN_CELLS = 0.15, 0.03
"""Every other line of corners to one side: of 240 boards at most 0.09 px or 0.018 cells, of a fence 0.42 of 3.8 px."""
ALTERNATING_MIN = 0.9
EVEN = (0.7, 1.6)
"""Contrast of the corners over that of the cells between them: 0.95 to 1.25 of 300 boards, simulated and real ones.
Where dark and bright patches are of unequal size, as between the wires of a fence, it was 5.7."""
CELL_MIDDLE = 0.25
"""Half width of the middle of a cell, cells."""


def sound_corners(fitted: FittedCorners, signs: Floats) -> npt.NDArray[np.bool_]:
    """(N,) which fitted corners look like the corners of one chessboard.

    Args:
        fitted: the corners.
        signs: (N,) 1 or -1, the checker's sign at each; either all agree with the contrasts or all disagree.
    """
    there = np.isfinite(fitted.pixels[:, 0])
    signed = np.where(there, fitted.contrast, 0) * signs
    if not there.any():
        return there
    way = 1.0 if np.median(signed[there]) > 0 else -1.0
    signed = signed * way
    usual = float(np.median(signed[there]))
    alike = (signed > usual / CONTRAST_RATIO) & (signed < usual * CONTRAST_RATIO)
    misfit = np.nan_to_num(fitted.misfit, nan=9.0)
    crisp = misfit < min(MISFIT_MAX, MISFIT_RATIO * float(np.median(misfit[there])) + MISFIT_SPARE)
    return np.asarray(there & alike & crisp & (np.nan_to_num(fitted.moved, nan=9.0) < MOVED_MAX))


def refusal(judged: Judged) -> tuple[str, str] | None:
    """The first gate that refuses, and why; None where all let it pass."""
    for name, gate in GATES:
        reason = gate(judged)
        if reason is not None:
            return name, reason
    return None


def _seen(judged: Judged) -> str | None:
    count = int(judged.kept.sum())
    if count < SEEN_MIN * judged.board.count:
        total = judged.board.count
        return f"{count} of {total} corners are crossings of two sharp edges, at least {SEEN_MIN:.0%} are needed"
    return None


def _cell_size(judged: Judged) -> str | None:
    shortest = float(np.linalg.norm(judged.steps[judged.kept], axis=2).min())
    if shortest < CELL_MIN_PX:
        return f"cells are {shortest:.1f} px small, at least {CELL_MIN_PX} px are needed: come nearer or tilt less"
    return None


def _distinct(judged: Judged) -> str | None:
    pixels = judged.fitted.pixels[judged.kept]
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    apart[np.diag_indices(len(pixels))] = np.inf
    shortest = np.linalg.norm(judged.steps[judged.kept], axis=2).min()
    return None if apart.min() > 0.5 * shortest else f"two corners lie {apart.min():.1f} px from each other"


def _not_mirrored(judged: Judged) -> str | None:
    return None if np.linalg.det(judged.steps[judged.kept]).min() > 0 else "the grid is mirrored or folded"


def _flat(judged: Judged) -> str | None:
    rms = flat_rms_px(judged.board.lattice()[judged.kept], judged.fitted.pixels[judged.kept], judged.image.shape)
    cell = float(np.linalg.norm(judged.steps[judged.kept], axis=2).mean())
    limit = flat_limit_px(cell)
    return None if rms < limit else f"the corners lie {rms:.2f} px (rms) off a plane behind a lens, at most {limit:.2f}"


def _evenly_spaced(judged: Judged) -> str | None:
    """Whether wide and narrow cells take turns along the rows or the columns."""
    lattice, pixels = judged.board.lattice()[judged.kept], judged.fitted.pixels[judged.kept]
    off = pixels - mapped(judged.homography, lattice)
    turns = np.where(lattice % 2 == 0, 1.0, -1.0)
    turns -= turns.mean(axis=0)
    uneven = float(np.linalg.norm(turns.T @ off / (turns**2).sum(axis=0)[:, None], axis=1).max())
    limit = UNEVEN_PX + UNEVEN_CELLS * float(np.linalg.norm(judged.steps[judged.kept], axis=2).mean())
    return None if uneven < limit else f"every other line of corners is {uneven:.2f} px off, at most {limit:.2f}"


def _crisp(judged: Judged) -> str | None:
    usual = float(np.median(judged.fitted.misfit[judged.kept]))
    if usual > MISFIT_USUAL_MAX:
        return f"what is no chessboard or noise is {usual:.2f} of the contrast, at most {MISFIT_USUAL_MAX}"
    return None


def _alternating(judged: Judged) -> str | None:
    """Means of the middles of cells whose four corners are there, each against its neighbours."""
    board = judged.board
    whole, middles, signs = _cells(judged)
    row, column = np.nonzero(whole)
    signed = middles * signs
    right = total = 0
    for down, across in ((0, 1), (1, 0)):
        ends = (row + down < board.rows - 1) & (column + across < board.columns - 1)
        r, c = row[ends], column[ends]
        both = whole[r + down, c + across]
        r, c = r[both], c[both]
        right += int((signed[r, c] + signed[r + down, c + across] > 0).sum())
        total += len(r)
    if total == 0 or right < ALTERNATING_MIN * total:
        return (
            f"{right} of {total} pairs of cells alternate between dark and bright, at least {ALTERNATING_MIN:.0%} must"
        )
    return None


def _even(judged: Judged) -> str | None:
    """Whether corners have the contrast that the cells between them have."""
    whole, middles, signs = _cells(judged)
    bright, dark = middles[whole & (signs > 0)], middles[whole & (signs < 0)]
    if not len(bright) or not len(dark):
        return "no four corners that enclose a bright cell, or a dark one, are there"
    half = float(np.median(bright) - np.median(dark)) / 2
    corners = float(np.median(np.abs(judged.fitted.contrast[judged.kept])))
    if not EVEN[0] * half < corners < EVEN[1] * half:
        ratio = corners / half if half > 0 else np.inf
        return f"corners have {ratio:.1f} times the contrast of cells, a chessboard's {EVEN[0]} to {EVEN[1]} times"
    return None


def _cells(judged: Judged) -> tuple[npt.NDArray[np.bool_], Floats, Floats]:
    """Of the (rows - 1, columns - 1) cells: whose four corners are there, brightness, and 1 for bright, -1 for dark."""
    board = judged.board
    kept = judged.kept.reshape(board.rows, board.columns)
    whole = kept[1:, 1:] & kept[1:, :-1] & kept[:-1, 1:] & kept[:-1, :-1]
    middles = _cell_means(judged).reshape(board.rows - 1, board.columns - 1)
    signs = np.where((np.arange(board.rows - 1)[:, None] + np.arange(board.columns - 1)) % 2 == 0, 1.0, -1.0)
    way = 1.0 if np.nansum(judged.fitted.contrast * checker_signs(board)) > 0 else -1.0
    return whole, middles, signs * way


def _cell_means(judged: Judged) -> Floats:
    """((rows - 1) * (columns - 1),) mean brightness of the middle of each cell, bilinear."""
    board, image = judged.board, judged.image
    grid = np.where(judged.kept[:, None], judged.fitted.pixels, mapped(judged.homography, board.lattice()))
    grid = grid.reshape(board.rows, board.columns, 2)
    samples = []
    for v in (0.5 - CELL_MIDDLE, 0.5, 0.5 + CELL_MIDDLE):
        for u in (0.5 - CELL_MIDDLE, 0.5, 0.5 + CELL_MIDDLE):
            at = (1 - v) * ((1 - u) * grid[:-1, :-1] + u * grid[:-1, 1:]) + v * (
                (1 - u) * grid[1:, :-1] + u * grid[1:, 1:]
            )
            x, y = np.clip(at[..., 0], 0, image.shape[1] - 1.001), np.clip(at[..., 1], 0, image.shape[0] - 1.001)
            left, top = x.astype(np.intp), y.astype(np.intp)
            s, t = x - left, y - top
            upper = (1 - s) * image[top, left] + s * image[top, left + 1]
            samples.append((1 - t) * upper + t * ((1 - s) * image[top + 1, left] + s * image[top + 1, left + 1]))
    return np.asarray(np.mean(samples, axis=0).ravel())


GATES: tuple[tuple[str, Gate], ...] = (
    ("corners", _seen),
    ("rims", starts_and_ends),
    ("orientation", _not_mirrored),
    ("cell size", _cell_size),
    ("distinct", _distinct),
    ("flatness", _flat),
    ("spacing", _evenly_spaced),
    ("crispness", _crisp),
    ("alternation", _alternating),
    ("evenness", _even),
    ("border", goes_on),
)
"""In the order in which they are asked: cheap ones first."""
