"""Outlines of all discs of a grid: of those that are blobs, and of those that the lattice predicts next to them.

Clutter next to a board, a shadow or a bright window take the blob of an outer disc away. So a lattice goes on, place by
place, wherever an outline like the others' can be fitted; where the discs end, the board ends.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.discs.blobs import Blobs
from cairn_calib.board.discs.disc_gates import (
    CONTRAST_RATIO,
    DISCS_MIN,
    MISFIT_MAX,
    MISS_STEPS,
    ROUND_RATIO,
    GridFit,
    ellipse_of,
    neighbour_step,
    sound_discs,
)
from cairn_calib.board.discs.disc_lattice import NamedDiscs, Place, around, sides
from cairn_calib.board.discs.disc_outline import DiscFit, Outline, first_outline, fit_outline, fit_outlines
from cairn_calib.board.discs.local_map import local_map
from cairn_map.arrays import Floats

Image = npt.NDArray[np.float32]


def missing_in_view(dark: Image, board: Board, blobs: Blobs, named: NamedDiscs) -> int:
    """Number of discs without a blob that would lie wholly in the image."""
    met, lattice = named.met, board.lattice()
    if met.all():
        return 0
    known = named.blobs[met]
    at, steps = local_map(lattice[met], blobs.centres[known], lattice[~met], step=neighbour_step(board))
    radius = _radius(
        blobs, known, local_map(lattice[met], blobs.centres[known], lattice[met], step=neighbour_step(board))[1]
    )
    return sum(is_inside(first_outline(a, radius * s.T), dark.shape) for a, s in zip(at, steps, strict=True))


def _radius(blobs: Blobs, known: npt.NDArray[np.intp], steps: Floats) -> float:
    """Usual radius of discs on the board, pitches, by their blobs and the steps there."""
    return float(np.median(np.sqrt(np.abs(np.linalg.det(blobs.shapes[known])) / np.abs(np.linalg.det(steps)))))


def grow(dark: Image, board: Board, blobs: Blobs, walk: dict[Place, int]) -> tuple[Blobs, dict[Place, int]]:
    """Blobs and a walk that goes on, disc by disc, wherever an outline can be fitted next to it."""
    lattice = dict(walk)
    refused: set[Place] = set()
    contrasts: list[float] = []
    longest = max(board.columns, board.rows) * (2 if board.pattern == "asymmetric-circles" else 1)
    while True:
        known = np.array(list(lattice), np.float64)
        at = np.array(list(lattice.values()), np.intp)
        edge = sorted({near for place in lattice for near in sides(place)} - set(lattice) - refused)
        edge = [each for each in edge if len([near for near in around(each) if near in lattice]) >= 2]
        # Far beyond the board nothing has to be known.
        edge = [each for each in edge if (np.ptp(np.vstack([known, each]), axis=0) <= longest).all()]
        if not edge or len(lattice) > 2 * board.count:
            return blobs, lattice
        pixels, steps = local_map(known, blobs.centres[at], np.array(edge, np.float64))
        radius = _radius(blobs, at, local_map(known, blobs.centres[at], known)[1])
        own = [first_outline(blobs.centres[n], blobs.shapes[n]) for n in at]
        if not contrasts:
            fits = [fit_outline(dark, each, []) for each in own[:: max(1, len(own) // 5)]]
            contrasts = [each.contrast for each in fits if each is not None] or [np.inf]
        for place, centre, step in zip(edge, pixels, steps, strict=True):
            refused.add(place)
            start = first_outline(centre, radius * step.T)
            if not is_inside(start, dark.shape):
                continue
            near = [each for each in own if np.linalg.norm(each.centre - centre) < 3 * np.abs(step).max() * 1.5]
            fitted = fit_outline(dark, start, near)
            if fitted is not None and _is_next(fitted, start, step, float(np.median(contrasts))):
                blobs = blobs.with_one(fitted.centroid, ellipse_of(fitted.outline), fitted.contrast)
                lattice[place] = len(blobs) - 1
                refused -= set(around(place))


def _is_next(fitted: DiscFit, start: Outline, step: Floats, usual: float) -> bool:
    """True if a fit at a predicted place is a disc of the same lattice."""
    axes = np.linalg.svd(np.linalg.inv(start.shape) @ ellipse_of(fitted.outline), compute_uv=False)
    miss = float(np.linalg.norm(np.linalg.inv(step.T) @ (fitted.centroid - start.centre)))
    return (
        usual / CONTRAST_RATIO < fitted.contrast < usual * CONTRAST_RATIO
        and fitted.misfit < MISFIT_MAX
        and miss < 2 * MISS_STEPS
        and axes[0] < ROUND_RATIO
        and axes[1] > 1 / ROUND_RATIO
    )


def fit_grid(dark: Image, board: Board, blobs: Blobs, named: NamedDiscs) -> GridFit | None:
    """Outlines of all discs that are named or predicted; None where too few are there to predict any."""
    met = named.met
    lattice, step = board.lattice(), neighbour_step(board)
    if met.sum() < DISCS_MIN:
        return None
    centres, shapes = blobs.centres[named.blobs], blobs.shapes[named.blobs]
    # What no blob was at is predicted from those around it.
    at, steps = local_map(lattice[met], centres[met], lattice, step=step)
    radius = _radius(blobs, named.blobs[met], steps[met])
    outlines: list[Outline | None] = []
    in_view = np.zeros(board.count, np.bool_)
    for n in range(board.count):
        guess = first_outline(centres[n], shapes[n]) if met[n] else first_outline(at[n], radius * steps[n].T)
        in_view[n] = is_inside(guess, dark.shape)
        fitted = None if met[n] or not in_view[n] else fit_outline(dark, guess, [])
        seen = fitted.outline if fitted else None
        outlines.append(guess if met[n] and in_view[n] else seen)
    fits = fit_outlines(dark, outlines)
    return GridFit(board, tuple(fits), sound_discs(board, fits, dark.shape), in_view)


def is_inside(outline: Outline, shape: tuple[int, ...]) -> bool:
    """True if the image's border does not cut an outline."""
    rim = outline.rim()
    return bool((rim >= 0.5).all() and (rim <= np.array(shape[::-1]) - 1.5).all())
