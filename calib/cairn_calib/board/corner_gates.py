"""Gates that a grid of corners must pass to count as the board: windows, tiles and brick walls have lattices too.

Each gate returns the reason for which it refuses, or None. Gates look at the fitted corners and at the image as
recorded, so that every detector's proposal is judged alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.board_flatness import flat_limit_px, flat_rms_px, flat_view
from cairn_calib.board.corner_refinement import FittedCorners, fit_corners
from cairn_calib.board.homography import map_points, steps_between
from cairn_map.arrays import Flags, Floats

Image = npt.NDArray[np.float32]

CELL_MIN_PX = 3.5
"""Shortest step from corner to corner, pixels. Below, the fit of a corner has fewer pixels than it needs."""
SEEN_MIN = 0.6
"""Share of the board's corners that must be seen."""
MISFIT_MAX = 0.45
"""Residuals of one corner, share of its contrast: noise of a tenth of the step from dark to bright is 0.2."""
MISFIT_RATIO, MISFIT_SPARE = 3.0, 0.05
"""Residuals of one corner are at most this many times the board's median, plus the second number (share of contrast):
an object that hides a corner in part pulls it by a third of a pixel."""
MISFIT_USUAL_MAX = 0.3
"""Median residuals of a board's corners, share of the contrast."""
MOVED_MAX = 0.4
"""Cells between a proposed corner and the fitted one."""
CONTRAST_RATIO = 4.0
"""Largest ratio between a corner's contrast and the board's usual one."""
UNEVEN_PX, UNEVEN_CELLS = 0.15, 0.03
"""Shift of every other line of corners to one side, pixels plus cells: of 240 boards at most 0.09 px or 0.018 cells,
of a fence 0.42 of 3.8 px."""
ALTERNATING_MIN = 0.9
"""Share of the pairs of neighbouring cells that must be one dark and one bright."""
EVEN = (0.7, 1.6)
"""Contrast of the corners over that of the cells between them: 0.95 to 1.25 of 300 boards, simulated and real ones.
Where dark and bright patches are of unequal size, as between the wires of a fence, it was 5.7."""
CELL_MIDDLE = 0.25
"""Half width of the middle of a cell, cells."""
RIM_SHARE = 0.5
"""Share of an outer row or column above which it is accepted as seen; below, the other corners predict its places."""
RIM_MIN = 2
"""Number of these places that must look like corners. Where no corner of the line was fitted, as where outer cells are
cut, it is `RIM_SHARE` of them."""
PREDICTING_MIN = 8
"""Corners without which no place is predicted."""
BEYOND_MAX = 0.6
"""Share of the places beyond a rim that may look like corners too."""
LIKE_CONTRAST = 0.6
"""Contrast of what looks like a corner, at least, over the board's usual contrast."""
LIKE_MOVED = 0.15
"""Cells between where the others predict a corner and where one is: 0.00 to 0.05 for boards with hidden parts.
Where a smaller board's outer cells are cut, or its margin ends, what looks like corners is 0.32 to 0.54 off."""


@dataclass(frozen=True, slots=True)
class FittedGrid:
    """A grid of fitted corners and the image in which it was found; arrays in the board's order."""

    image: Image
    board: Board
    fitted: FittedCorners
    homography: Floats

    @property
    def kept(self) -> Flags:
        """(N,) True for each corner that is there."""
        return np.isfinite(self.fitted.pixels[:, 0])

    @property
    def steps(self) -> Floats:
        """(N, 2, 2) pixels to the next column and row."""
        return steps_between(self.homography, self.board.lattice())


Gate = Callable[[FittedGrid], str | None]


def checker_signs(board: Board) -> Floats:
    """(N,) 1 where the cell towards the next column and row has the colour of the first cell, else -1."""
    return np.where(board.lattice().sum(axis=1) % 2 == 0, 1.0, -1.0)


def sound_corners(fitted: FittedCorners, signs: Floats) -> npt.NDArray[np.bool_]:
    """(N,) True for each fitted corner that looks like a corner of one chessboard.

    Args:
        fitted: the corners.
        signs: (N,) 1 or -1, the checker's sign at each; either all agree with the contrasts or all disagree.
    """
    there = np.isfinite(fitted.pixels[:, 0])
    # Three tests: the sign and size of the contrast, the residuals, and the distance from the proposal.
    signed = np.where(there, fitted.contrast, 0) * signs
    if not there.any():
        return there
    # Contrasts follow the checker, or its negative: the board's order is not settled yet.
    way = 1.0 if np.median(signed[there]) > 0 else -1.0
    signed = signed * way
    usual = float(np.median(signed[there]))
    alike = (signed > usual / CONTRAST_RATIO) & (signed < usual * CONTRAST_RATIO)
    misfit = np.nan_to_num(fitted.misfit, nan=9.0)
    # Relative to the board's median, since all corners of a blurred or noisy image fit worse.
    crisp = misfit < min(MISFIT_MAX, MISFIT_RATIO * float(np.median(misfit[there])) + MISFIT_SPARE)
    return np.asarray(there & alike & crisp & (np.nan_to_num(fitted.moved, nan=9.0) < MOVED_MAX))


def refusal(grid: FittedGrid) -> tuple[str, str] | None:
    """The first gate that refuses, and why; None where all let it pass."""
    for name, gate in GATES:
        reason = gate(grid)
        if reason is not None:
            return name, reason
    return None


def _enough_corners(grid: FittedGrid) -> str | None:
    count = int(grid.kept.sum())
    if count < SEEN_MIN * grid.board.count:
        total = grid.board.count
        return f"{count} of {total} corners are crossings of two sharp edges, at least {SEEN_MIN:.0%} are needed"
    return None


def _outer_lines(grid: FittedGrid) -> str | None:
    """Gate of the outer rows and columns: each must be the board's own.

    A single stray next to a smaller board would shift the names of all its rows.
    """
    board, kept, lattice = grid.board, grid.kept, grid.board.lattice()
    # Few corners of a line are proof only if something at the line's other places looks like corners, too.
    index = np.arange(board.count).reshape(board.rows, board.columns)
    lines = {
        "first row": index[0],
        "last row": index[-1],
        "first column": index[:, 0],
        "last column": index[:, -1],
    }
    for name, line in lines.items():
        seen = int(kept[line].sum())
        # Without the line itself the other corners predict where its corners are.
        others = kept.copy()
        others[line] = False
        if seen > RIM_SHARE * len(line) or (seen > 0 and others.sum() < PREDICTING_MIN):
            continue
        like = int(_look_like_corners(grid, lattice[line], by=others)[0].sum()) if others.sum() >= PREDICTING_MIN else 0
        if like < (RIM_MIN if seen else RIM_SHARE * len(line)):
            return (
                f"{seen} of the {len(line)} corners of the {name} are there, and at {like} of their places something "
                "like one: they may be the next one's"
            )
    return None


def _orientation(grid: FittedGrid) -> str | None:
    return None if np.linalg.det(grid.steps[grid.kept]).min() > 0 else "the grid is mirrored or folded"


def _cell_size(grid: FittedGrid) -> str | None:
    shortest = float(np.linalg.norm(grid.steps[grid.kept], axis=2).min())
    if shortest < CELL_MIN_PX:
        return f"cells are {shortest:.1f} px small, at least {CELL_MIN_PX} px are needed: come nearer or tilt less"
    return None


def _separation(grid: FittedGrid) -> str | None:
    pixels = grid.fitted.pixels[grid.kept]
    # Two names at one place mean that a line was counted twice.
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    apart[np.diag_indices(len(pixels))] = np.inf
    shortest = np.linalg.norm(grid.steps[grid.kept], axis=2).min()
    return None if apart.min() > 0.5 * shortest else f"two corners lie {apart.min():.1f} px from each other"


def _flatness(grid: FittedGrid) -> str | None:
    # One radial term covers usual lenses; walls and windows at different depths do not fit.
    rms = flat_rms_px(grid.board.lattice()[grid.kept], grid.fitted.pixels[grid.kept], grid.image.shape)
    cell = float(np.linalg.norm(grid.steps[grid.kept], axis=2).mean())
    limit = flat_limit_px(cell)
    return None if rms < limit else f"the corners lie {rms:.2f} px (rms) off a plane behind a lens, at most {limit:.2f}"


def _spacing(grid: FittedGrid) -> str | None:
    """Gate of the spacing: wide and narrow cells must not take turns along the rows or the columns."""
    lattice, pixels = grid.board.lattice()[grid.kept], grid.fitted.pixels[grid.kept]
    off = pixels - map_points(grid.homography, lattice)
    # -1, 1, -1, ... along the columns and along the rows, about 0.
    turns = np.where(lattice % 2 == 0, 1.0, -1.0)
    # Least squares: the share of +1, -1, +1, ... along either axis in the misses of the homography.
    turns -= turns.mean(axis=0)
    # Shift of the odd lines against the even ones, pixels; the larger of rows and columns.
    uneven = float(np.linalg.norm(turns.T @ off / (turns**2).sum(axis=0)[:, None], axis=1).max())
    limit = UNEVEN_PX + UNEVEN_CELLS * float(np.linalg.norm(grid.steps[grid.kept], axis=2).mean())
    return None if uneven < limit else f"every other line of corners is {uneven:.2f} px off, at most {limit:.2f}"


def _crispness(grid: FittedGrid) -> str | None:
    usual = float(np.median(grid.fitted.misfit[grid.kept]))
    if usual > MISFIT_USUAL_MAX:
        return f"what is no chessboard or noise is {usual:.2f} of the contrast, at most {MISFIT_USUAL_MAX}"
    return None


def _alternation(grid: FittedGrid) -> str | None:
    """Gate of the checker: of two neighbouring cells whose corners are all there, one is dark and one is bright."""
    board = grid.board
    whole, middles, signs = _cells(grid)
    row, column = np.nonzero(whole)
    signed = middles * signs
    right = total = 0
    for down, across in ((0, 1), (1, 0)):
        # Neighbours with all corners there, one bright and one dark: signed brightnesses add up to more than 0.
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


def _evenness(grid: FittedGrid) -> str | None:
    """Gate of the contrast: corners have that of the cells between them."""
    whole, middles, signs = _cells(grid)
    bright, dark = middles[whole & (signs > 0)], middles[whole & (signs < 0)]
    if not len(bright) or not len(dark):
        return "no four corners that enclose a bright cell, or a dark one, are there"
    # Half the step from dark to bright, as the corners' fitted contrast is.
    half = float(np.median(bright) - np.median(dark)) / 2
    corners = float(np.median(np.abs(grid.fitted.contrast[grid.kept])))
    if not EVEN[0] * half < corners < EVEN[1] * half:
        ratio = corners / half if half > 0 else np.inf
        return f"corners have {ratio:.1f} times the contrast of cells, a chessboard's {EVEN[0]} to {EVEN[1]} times"
    return None


def _border(grid: FittedGrid) -> str | None:
    """Gate of the places beyond each rim: if the pattern goes on there, these corners may be any part of it."""
    board = grid.board
    columns, rows = np.arange(board.columns, dtype=float), np.arange(board.rows, dtype=float)
    # Places one step beyond each side of the grid.
    rims = {
        "left": np.column_stack([np.full(board.rows, -1.0), rows]),
        "right": np.column_stack([np.full(board.rows, float(board.columns)), rows]),
        "top": np.column_stack([columns, np.full(board.columns, -1.0)]),
        "bottom": np.column_stack([columns, np.full(board.columns, float(board.rows))]),
    }
    misfit = float(np.median(grid.fitted.misfit[grid.kept]))
    for name, rim in rims.items():
        like, fitted = _look_like_corners(grid, rim, by=grid.kept)
        with np.errstate(invalid="ignore"):
            alike = like & (fitted.misfit < 1.5 * misfit + 0.03)
        # A few chance corners outside are no board.
        if alike.mean() > BEYOND_MAX:
            return f"the pattern goes on {name} of the board: {int(alike.sum())} of {len(rim)} places there are corners"
    return None


def _look_like_corners(grid: FittedGrid, places: Floats, *, by: Flags) -> tuple[Flags, FittedCorners]:
    """(M,) True for each place of the lattice with a corner where those flagged in `by` predict it; and the fits."""
    # Fit at the predicted places, and compare sign, contrast and distance with the board's own corners.
    fitted = fit_corners(grid.image, _predict(grid, places, by), steps_between(grid.homography, places))
    usual = float(np.median(np.abs(grid.fitted.contrast[by])))
    # The checker goes on beyond the board with the same signs.
    way = 1.0 if np.nansum(grid.fitted.contrast * checker_signs(grid.board)) > 0 else -1.0
    signs = np.where(places.sum(axis=1) % 2 == 0, way, -way)
    with np.errstate(invalid="ignore"):
        like = (fitted.contrast * signs > LIKE_CONTRAST * usual) & (fitted.moved < LIKE_MOVED)
    return np.asarray(like), fitted


def _predict(grid: FittedGrid, places: Floats, by: Flags) -> Floats:
    """(M, 2) pixels of places of the lattice: a flat board behind a lens, plus its miss at the nearest corner."""
    lattice, pixels = grid.board.lattice()[by], grid.fitted.pixels[by]
    view = flat_view(lattice, pixels, grid.image.shape)
    if view is None:
        return np.full_like(places, np.nan)
    nearest = np.argmin(np.linalg.norm(places[:, None] - lattice[None], axis=2), axis=1)
    return np.asarray(view.pixels(places) + (pixels - view.pixels(lattice))[nearest])


def _cells(grid: FittedGrid) -> tuple[npt.NDArray[np.bool_], Floats, Floats]:
    """(rows - 1, columns - 1) cells: True where all four corners are there, brightness, 1 for bright or -1 for dark."""
    board = grid.board
    kept = grid.kept.reshape(board.rows, board.columns)
    whole = kept[1:, 1:] & kept[1:, :-1] & kept[:-1, 1:] & kept[:-1, :-1]
    middles = _cell_means(grid).reshape(board.rows - 1, board.columns - 1)
    signs = np.where((np.arange(board.rows - 1)[:, None] + np.arange(board.columns - 1)) % 2 == 0, 1.0, -1.0)
    way = 1.0 if np.nansum(grid.fitted.contrast * checker_signs(board)) > 0 else -1.0
    return whole, middles, signs * way


def _cell_means(grid: FittedGrid) -> Floats:
    """((rows - 1) * (columns - 1),) mean brightness of the middle of each cell, bilinear."""
    board, image = grid.board, grid.image
    # Hidden corners are where the homography puts them.
    places = np.where(grid.kept[:, None], grid.fitted.pixels, map_points(grid.homography, board.lattice()))
    places = places.reshape(board.rows, board.columns, 2)
    samples = []
    for v in (0.5 - CELL_MIDDLE, 0.5, 0.5 + CELL_MIDDLE):
        for u in (0.5 - CELL_MIDDLE, 0.5, 0.5 + CELL_MIDDLE):
            # Nine places about the middle, bilinear between the cell's four corners and again between pixels.
            at = (1 - v) * ((1 - u) * places[:-1, :-1] + u * places[:-1, 1:]) + v * (
                (1 - u) * places[1:, :-1] + u * places[1:, 1:]
            )
            x, y = np.clip(at[..., 0], 0, image.shape[1] - 1.001), np.clip(at[..., 1], 0, image.shape[0] - 1.001)
            left, top = x.astype(np.intp), y.astype(np.intp)
            s, t = x - left, y - top
            upper = (1 - s) * image[top, left] + s * image[top, left + 1]
            samples.append((1 - t) * upper + t * ((1 - s) * image[top + 1, left] + s * image[top + 1, left + 1]))
    return np.asarray(np.mean(samples, axis=0).ravel())


GATES: tuple[tuple[str, Gate], ...] = (
    ("corners", _enough_corners),
    ("rims", _outer_lines),
    ("orientation", _orientation),
    ("cell size", _cell_size),
    ("distinct", _separation),
    ("flatness", _flatness),
    ("spacing", _spacing),
    ("crispness", _crispness),
    ("alternation", _alternation),
    ("evenness", _evenness),
    ("border", _border),
)
"""Gates in order, cheap ones first; each name is the stage of a refused attempt."""
