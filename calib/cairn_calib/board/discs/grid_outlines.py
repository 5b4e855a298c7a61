"""Outlines of all discs of a grid: of those that are blobs, and of those that the lattice predicts next to them.

Clutter next to a board, a shadow or a bright window take the blob of an outer disc away. So a lattice goes on, place by
place, wherever an outline like the others' can be fitted; where the discs end, the board ends.
"""

from dataclasses import dataclass

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
    beyond_max,
    ellipse_of,
    neighbour_step,
    sound_discs,
)
from cairn_calib.board.discs.disc_lattice import NamedDiscs, Place, around, has_room, sides
from cairn_calib.board.discs.disc_outline import DiscFit, Outline, first_outline, fit_outline, fits_again, fits_alone
from cairn_calib.board.discs.local_map import local_map
from cairn_map.arrays import Flags, Floats

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
        # Far beyond the board nothing has to be known, nor where the pattern goes on beyond the board on all sides.
        edge = [each for each in edge if (np.ptp(np.vstack([known, each]), axis=0) <= longest).all()]
        if not edge or len(lattice) > 2 * board.count or not has_room(lattice, board, beyond_max=beyond_max(board)):
            return blobs, lattice
        pixels, steps = local_map(known, blobs.centres[at], np.array(edge, np.float64))
        radius = _radius(blobs, at, local_map(known, blobs.centres[at], known)[1])
        own = [first_outline(blobs.centres[n], blobs.shapes[n]) for n in at]
        if not contrasts:
            fits = [fit_outline(dark, each, []) for each in own[:: max(1, len(own) // 5)]]
            contrasts = [each.contrast for each in fits if each is not None]
            if not contrasts:
                return blobs, lattice
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


@dataclass(frozen=True, slots=True)
class ExpectedGrid:
    """Outlines that blobs and their lattice let expect of a board's discs, in its order."""

    board: Board
    outlines: tuple[Outline, ...]
    met: Flags
    """(N,) True for each disc with a blob; the others are predicted."""
    in_view: Flags
    """(N,) True for each disc that lies wholly in the image."""


def expect_grid(board: Board, blobs: Blobs, named: NamedDiscs, shape: tuple[int, ...]) -> ExpectedGrid | None:
    """Outlines of all discs that are named or predicted; None where too few are there to predict any.

    `shape` is that of the image.
    """
    met = named.met
    lattice, step = board.lattice(), neighbour_step(board)
    if met.sum() < DISCS_MIN:
        return None
    centres, shapes = blobs.centres[named.blobs], blobs.shapes[named.blobs]
    # What no blob was at is predicted from those around it.
    at, steps = local_map(lattice[met], centres[met], lattice, step=step)
    radius = _radius(blobs, named.blobs[met], steps[met])
    outlines = tuple(
        first_outline(centres[n], shapes[n]) if met[n] else first_outline(at[n], radius * steps[n].T)
        for n in range(board.count)
    )
    return ExpectedGrid(board, outlines, met, np.array([is_inside(each, shape) for each in outlines]))


def fit_grid(dark: Image, expected: ExpectedGrid, *, least: int = 0) -> GridFit | None:
    """Outlines of all discs as they are in an image; None once it is certain that fewer than `least` are sound."""
    spare = int(expected.in_view.sum()) - least
    outlines: list[Outline | None] = []
    for guess, met, in_view in zip(expected.outlines, expected.met, expected.in_view, strict=True):
        fitted = None if met or not in_view else fit_outline(dark, guess, [])
        seen = fitted.outline if fitted else None
        outlines.append(guess if met and in_view else seen)
        # Discs that the border cuts were never counted.
        spare -= bool(in_view) and outlines[-1] is None
        if spare < 0:
            return None
    first: list[DiscFit | None] = []
    for own, alone in zip(outlines, fits_alone(dark, outlines), strict=True):
        first.append(alone)
        spare -= own is not None and alone is None
        if spare < 0:
            return None
    fits: list[DiscFit | None] = [None] * len(first)
    for n, each in fits_again(dark, first):
        fits[n] = each
        # No sound disc fits worse: see `sound_discs`.
        spare -= each.misfit >= MISFIT_MAX
        if spare < 0:
            return None
    sound = sound_discs(expected.board, fits, dark.shape, least=least)
    return GridFit(expected.board, tuple(fits), sound, expected.in_view) if sound.sum() >= least else None


def is_inside(outline: Outline, shape: tuple[int, ...]) -> bool:
    """True if the image's border does not cut an outline."""
    rim = outline.rim()
    return bool((rim >= 0.5).all() and (rim <= np.array(shape[::-1]) - 1.5).all())
