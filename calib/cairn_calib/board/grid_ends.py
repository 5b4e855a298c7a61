"""Whether a board ends where its grid does: neither before, where strays stand for a row, nor after, if it goes on."""

import numpy as np

from cairn_calib.board.board_flatness import flat_view
from cairn_calib.board.corner_refinement import FittedCorners, fit_corners
from cairn_calib.board.fitted_grid import Judged, checker_signs
from cairn_calib.board.homography import steps_between
from cairn_map.arrays import Flags, Floats

RIM_SHARE = 0.5
"""Of an outer row or column of which more is seen, no proof is asked. Otherwise the others predict its places."""
RIM_MIN = 2
"""Of its places at least so many must look like corners; if none is crisp, as where outer cells are cut, half."""
PREDICTING_MIN = 8
"""Corners of fewer predict nothing."""
BEYOND_MAX = 0.6
"""Share of the places beyond a rim that may look like corners too."""
LIKE_CONTRAST = 0.6
"""Of the board's usual contrast."""
LIKE_MOVED = 0.15
"""Cells between where the others predict a corner and where one is: 0.00 to 0.05 of boards of which parts were hidden.
Where a smaller board's outer cells are cut, or its margin ends, what looks like corners is 0.32 to 0.54 off."""


def starts_and_ends(judged: Judged) -> str | None:
    """Whether the outer rows and columns are the board's: one stray beside a smaller board names all its rows."""
    board, kept, lattice = judged.board, judged.kept, judged.board.lattice()
    index = np.arange(board.count).reshape(board.rows, board.columns)
    lines = {
        "first row": index[0],
        "last row": index[-1],
        "first column": index[:, 0],
        "last column": index[:, -1],
    }
    for name, line in lines.items():
        seen = int(kept[line].sum())
        others = kept.copy()
        others[line] = False
        if seen > RIM_SHARE * len(line) or (seen > 0 and others.sum() < PREDICTING_MIN):
            continue
        like = int(_like_corners(judged, lattice[line], by=others)[0].sum()) if others.sum() >= PREDICTING_MIN else 0
        if like < (RIM_MIN if seen else RIM_SHARE * len(line)):
            return (
                f"{seen} of the {len(line)} corners of the {name} are there, and at {like} of their places something "
                "like one: they may be the next one's"
            )
    return None


def goes_on(judged: Judged) -> str | None:
    """Whether the pattern goes on: then these corners may be any part of it."""
    board = judged.board
    columns, rows = np.arange(board.columns, dtype=float), np.arange(board.rows, dtype=float)
    rims = {
        "left": np.column_stack([np.full(board.rows, -1.0), rows]),
        "right": np.column_stack([np.full(board.rows, float(board.columns)), rows]),
        "top": np.column_stack([columns, np.full(board.columns, -1.0)]),
        "bottom": np.column_stack([columns, np.full(board.columns, float(board.rows))]),
    }
    misfit = float(np.median(judged.fitted.misfit[judged.kept]))
    for name, rim in rims.items():
        like, fitted = _like_corners(judged, rim, by=judged.kept)
        with np.errstate(invalid="ignore"):
            alike = like & (fitted.misfit < 1.5 * misfit + 0.03)
        if alike.mean() > BEYOND_MAX:
            return f"the pattern goes on {name} of the board: {int(alike.sum())} of {len(rim)} places there are corners"
    return None


def _like_corners(judged: Judged, places: Floats, *, by: Flags) -> tuple[Flags, FittedCorners]:
    """(M,) at which places of the lattice corners are where those flagged in `by` predict them; and what was fitted."""
    fitted = fit_corners(judged.image, _predicted(judged, places, by), steps_between(judged.homography, places))
    usual = float(np.median(np.abs(judged.fitted.contrast[by])))
    way = 1.0 if np.nansum(judged.fitted.contrast * checker_signs(judged.board)) > 0 else -1.0
    signs = np.where(places.sum(axis=1) % 2 == 0, way, -way)
    with np.errstate(invalid="ignore"):
        like = (fitted.contrast * signs > LIKE_CONTRAST * usual) & (fitted.moved < LIKE_MOVED)
    return np.asarray(like), fitted


def _predicted(judged: Judged, places: Floats, by: Flags) -> Floats:
    """(M, 2) pixels of places of the lattice: a flat board behind a lens, corrected by what it misses nearby."""
    lattice, pixels = judged.board.lattice()[by], judged.fitted.pixels[by]
    view = flat_view(lattice, pixels, judged.image.shape)
    if view is None:
        return np.full_like(places, np.nan)
    nearest = np.argmin(np.linalg.norm(places[:, None] - lattice[None], axis=2), axis=1)
    return np.asarray(view.pixels(places) + (pixels - view.pixels(lattice))[nearest])
