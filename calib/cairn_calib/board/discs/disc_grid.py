"""Detection of a grid of discs: the target for cameras to which edges are weak, as on heated metal.

    blobs of every size -> walk from disc to disc -> the board's names -> outlines fitted -> gates

No stage assumes a lens: the walk predicts each disc by its neighbours, gates compare each disc with the parabola
through those around it, and the outline is that of the image itself. A disc that the image's border cuts, or that
something hides, is left out; what is left names the board if no disc is missing inside the image.

Who points at discs has the last word: gates then warn and do not refuse.
"""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_detection import grey
from cairn_calib.board.corners import BY_HAND, FOUND, Attempt, Detection, pointed_attempt
from cairn_calib.board.discs.blobs import FINEST_PX, Blobs, blob_ladder, merge
from cairn_calib.board.discs.disc_gates import (
    DISCS_MIN,
    GridFit,
    disc_pitches,
    ground_refusal,
    is_regular,
    neighbour_step,
    place_refusal,
    refusal,
    rim_refusal,
    seen_min,
    too_few_seen,
)
from cairn_calib.board.discs.disc_lattice import (
    NamedDiscs,
    Place,
    lattice_of,
    name_discs,
    sides,
    walk_from,
    walks,
)
from cairn_calib.board.discs.disc_outline import DiscFit
from cairn_calib.board.discs.grid_outlines import expect_grid, fit_grid, grow, missing_in_view
from cairn_calib.board.discs.local_map import local_map
from cairn_calib.board.homography import fit_homography, map_points
from cairn_calib.board.polarity import PolarityCandidates
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Image = npt.NDArray[np.float32]

NEAR_STEPS = 0.4
"""Distance from where a person points to the middle of the blob that is meant, at most, steps."""
NOISE_SHARE, SIGMA_RADII = 0.7, 0.1
"""Residual of a disc that is pointed at, share of its contrast, and its standard deviation, radii, at most."""
DISC_SHARE = 0.55
"""Diameter of a disc that is not stated, nor seen as a blob, steps."""


def find_circles(
    image: npt.NDArray[np.generic], board: Board, *, polarity: Polarity = "normal", upright: bool = False
) -> Detection:
    """The discs of a grid; arguments and errors are those of `find_chessboard`.

    With normal polarity discs are darker than their ground.
    """
    counts = grey(image)
    if board.has_turn_symmetry and not upright:
        raise BadInputError(
            "board_turns",
            f"{board.columns}x{board.rows} {board.pattern} look the same after half a turn, so that their first "
            "disc is anybody's guess: use asymmetric circles with an odd number of rows, or say that the grid always "
            "stands upright (--upright)",
        )
    # Discs are dark in what follows.
    dark = counts if polarity == "normal" else -counts
    attempts: list[Attempt] = []
    for scale, blobs in _blobs_by_size(dark):
        # The first size at which all gates are passed is the answer.
        found = _in_blobs(dark, board, blobs, upright=upright)
        stage, reason = (FOUND, _seen_text(found)) if isinstance(found, GridFit) else found
        attempts.append(Attempt("blobs", scale, stage, reason))
        if isinstance(found, GridFit):
            return Detection(found.corners(), tuple(attempts), disc_pitches(found))
    return Detection(None, tuple(attempts))


def _blobs_by_size(dark: Image) -> Iterator[tuple[float, Blobs]]:
    """Blobs of each step of the ladder with its scale, then those of all steps."""
    steps: dict[float, Blobs] = {}
    for wide, blobs in blob_ladder(dark):
        steps[wide] = blobs
        yield round(FINEST_PX / wide, 4), blobs
    yield 1.0, merge([steps[wide] for wide in sorted(steps)])


def _in_blobs(dark: Image, board: Board, blobs: Blobs, *, upright: bool) -> GridFit | tuple[str, str]:
    """The grid among blobs, or the stage and the reason of the lattice that came furthest."""
    # Of each lattice: its names, its outlines, the gates.
    best: tuple[str, str] | None = None
    largest = 0
    for walk in walks(blobs, board.count):
        largest = max(largest, len(walk))
        at = np.array(list(walk.values()), np.intp)
        # Walks go from square to square, whatever the board's pattern: their step is 1.
        if not is_regular(np.array(list(walk), np.float64), blobs.centres[at], blobs.shapes[at], dark.shape, step=1.0):
            continue
        more, lattice = blobs, walk
        named = name_discs(walk, board, blobs.centres, upright=upright)
        if len(named) != 1 or not named[0].met.all() or named[0].beyond:
            # Discs that made no blob, as next to a bright window, are fitted where the walk leads.
            more, lattice = grow(dark, board, blobs, walk)
            named = name_discs(lattice, board, more.centres, upright=upright)
        largest = max(largest, len(lattice))
        found = _best_named(dark, board, more, named, upright=upright)
        if isinstance(found, GridFit):
            return found
        best = best or found
    # No lattice has names: say how far it came.
    if best is not None:
        return best
    told = f"{len(blobs)} blobs like discs"
    if largest:
        return "candidates", f"{told}; the largest lattice has {largest}, which are not {board.columns}x{board.rows}"
    return "candidates", f"{told}, which make no lattice"


def _best_named(
    dark: Image, board: Board, blobs: Blobs, named: Sequence[NamedDiscs], *, upright: bool
) -> GridFit | tuple[str, str] | None:
    """The grid by the names under which the fewest discs are missing inside the image."""
    if not named:
        return None
    # A disc that is missing inside the image speaks against a name, one beyond its border does not; of two that are
    # as good the one that leans less is taken, if the board is known to be upright.
    lost = [(missing_in_view(dark, board, blobs, each), upright and each.is_leaning) for each in named]
    order = sorted(range(len(named)), key=lost.__getitem__)
    if len(named) > 1 and lost[order[0]] == lost[order[1]]:
        return "names", (
            f"{int(named[0].met.sum())} of {board.count} discs are there, and which ones of the board's they are is "
            "open: show at least one more row and column, or the end of the board"
        )
    best = named[order[0]]
    expected = expect_grid(board, blobs, best, dark.shape)
    if expected is None:
        return None
    # Fits are the slow part: what its place alone refuses, or too few discs, is not fitted to the end.
    refused = place_refusal(board, expected.in_view, best)
    if refused is not None:
        return refused
    in_view = int(expected.in_view.sum())
    found = fit_grid(dark, expected, least=seen_min(in_view))
    if found is None:
        return too_few_seen(f"at most {seen_min(in_view) - 1}", in_view)
    return refusal(found, best) or rim_refusal(dark, found) or ground_refusal(dark, found) or found


def _seen_text(found: GridFit) -> str:
    cut = found.board.count - int(found.in_view.sum())
    return f"{found.kept.sum()} discs" + (f", {cut} are cut by the image's border" if cut else "")


def fit_pointed_discs(
    image: npt.NDArray[np.generic], board: Board, pointed: Floats, *, polarity: Polarity = "normal"
) -> Detection:
    """The discs that a person pointed at, in the person's order; `pointed` is that of `fit_pointed_at`.

    Every disc with an outline at its place counts. What the gates would have refused is said with the attempt.
    """
    counts = grey(image)
    dark = counts if polarity == "normal" else -counts
    found, named = _at_pointed(dark, board, pointed)
    if found is None:
        reason = "the discs pointed at lie on a line: name them in the order that the help shows"
        return Detection(None, (Attempt(BY_HAND, 1.0, "candidates", reason),))
    # Gates are asked, but every fit counts, be it odd.
    odd = refusal(found, named)
    there = np.array([each is not None and _is_certain(each) for each in found.fits])
    chosen = GridFit(board, found.fits, there, found.in_view)
    if there.sum() < DISCS_MIN:
        kind = "darker" if polarity == "normal" else "brighter"
        reason = (
            f"at {there.sum()} of {board.count} places is a disc {kind} than its ground, at least {DISCS_MIN} must be: "
            "point at all discs, each to a third of its diameter"
        )
        return Detection(None, (Attempt(BY_HAND, 1.0, "refinement", reason),))
    return Detection(chosen.corners(), (pointed_attempt(_seen_text(chosen), odd),), disc_pitches(chosen))


def _is_certain(fit: DiscFit) -> bool:
    """True if there is a disc at all: noise has outlines, too, but no certain ones."""
    return (
        fit.misfit < NOISE_SHARE
        and float(np.trace(fit.covariance_px2)) < 2 * (SIGMA_RADII * fit.outline.radius_px) ** 2
    )


def _at_pointed(dark: Image, board: Board, pointed: Floats) -> tuple[GridFit | None, NamedDiscs]:
    """Discs fitted where a person points at all of them, or at the outer four."""
    outer = [0, board.columns - 1, board.count - 1, board.count - board.columns]
    named = outer if len(pointed) == 4 else list(range(board.count))
    nothing = NamedDiscs(np.full(board.count, -1, np.intp), 0)
    # A homography of what is pointed at holds near these places.
    homography = fit_homography(board.lattice()[named], pointed)
    if homography is None:
        return None, nothing
    # Blobs of every size; then the outlines, and what the gates think of them.
    blobs = merge([blobs for _, blobs in blob_ladder(dark)])
    blobs, own = _meant(blobs, board, np.asarray(named), pointed, homography)
    if len(pointed) == 4:
        own = _between(dark, board, blobs, own, homography)
    names = NamedDiscs(own, 0)
    expected = expect_grid(board, blobs, names, dark.shape)
    return None if expected is None else fit_grid(dark, expected), names


def _meant(
    blobs: Blobs, board: Board, named: npt.NDArray[np.intp], pointed: Floats, homography: Floats
) -> tuple[Blobs, npt.NDArray[np.intp]]:
    """Blobs and the (N,) index of each named point's: the one there, or one of the usual size."""
    # The steps at each named disc: by its named neighbours, or by the homography of the outer four.
    lattice, step = board.lattice(), neighbour_step(board)
    known, places = (pointed, lattice[named]) if len(pointed) > 4 else (map_points(homography, lattice), lattice)
    _, steps = local_map(places, known, lattice[named], step=step)
    own = np.full(board.count, -1, np.intp)
    share = board.disc_m / board.pitch_m if board.disc_m else DISC_SHARE * step
    # The nearest blob of about a disc's size.
    found: list[float] = []
    for n, at, each in zip(named.tolist(), pointed, steps, strict=True):
        away = np.linalg.norm((blobs.centres - at) @ np.linalg.inv(each), axis=1) / step
        # In pitches: something much smaller or larger than a disc is none.
        radius = np.sqrt(np.linalg.det(blobs.shapes) / abs(float(np.linalg.det(each)))) / step
        away = np.where((radius > 0.12) & (radius < 0.55), away, np.inf)
        if len(away) and away.min() < NEAR_STEPS:
            own[n] = int(away.argmin())
            found.append(float(radius[own[n]]) * step)
    # Where no blob is, a disc of the usual size is searched.
    usual = float(np.median(found)) if found and not board.disc_m else share / 2
    for n, at, each in zip(named.tolist(), pointed, steps, strict=True):
        if own[n] < 0:
            blobs = blobs.with_one(at, _symmetric(usual * each.T), 1.0)
            own[n] = len(blobs) - 1
    return blobs, own


def _symmetric(shape: Floats) -> Floats:
    """(2, 2) symmetric shape of the same ellipse."""
    values, vectors = np.linalg.eigh(shape @ shape.T)
    return np.asarray((vectors * np.sqrt(values)) @ vectors.T)


def _between(
    dark: Image, board: Board, blobs: Blobs, outer: npt.NDArray[np.intp], homography: Floats
) -> npt.NDArray[np.intp]:
    """(N,) blobs of all discs, from the outer four inwards: near these a homography holds, whatever the lens does."""
    places = [(int(i), int(j)) for i, j in lattice_of(board)]
    at_place = dict(zip(places, board.lattice(), strict=True))
    known: dict[Place, int] = {places[n]: int(outer[n]) for n in np.flatnonzero(outer >= 0)}
    # The steps from each corner to its neighbours, which start the walk.
    for corner in list(known):
        for near in sides(corner):
            if near not in at_place:
                continue
            here, there = map_points(homography, np.array([at_place[corner], at_place[near]]))
            guess = blobs.centres[known[corner]] + there - here
            away = np.linalg.norm(blobs.centres - guess, axis=1) / np.linalg.norm(there - here)
            if away.min() < NEAR_STEPS and int(away.argmin()) not in known.values():
                known[near] = int(away.argmin())
    # On from there, disc by disc.
    lattice = walk_from(blobs, known)
    return np.array([lattice.get(place, -1) for place in places], np.intp)


def disc_candidates(
    counts: npt.NDArray[np.float32],
    board: Board,
    *,
    polarity: Polarity | Literal["vote"],
    upright: bool,
    pointed: Floats | None,
) -> PolarityCandidates:
    """A grid of discs in an image; arguments and errors are those of `find_circles`.

    With the wrong polarity no disc is found, so the image votes for the only polarity with a detection.
    """
    # Both polarities, unless one is stated.
    tried: list[Polarity] = ["normal", "reversed"] if polarity == "vote" else [polarity]
    found = [
        find_circles(counts, board, polarity=each, upright=upright)
        if pointed is None
        else fit_pointed_discs(counts, board, pointed, polarity=each)
        for each in tried
    ]
    seen: list[Polarity] = [way for way, each in zip(tried, found, strict=True) if each.corners is not None]
    if len(seen) == 2:
        # Pointed at: with the wrong polarity only some gaps between discs look like discs.
        discs = [0 if each.corners is None else int(each.corners.seen.sum()) for each in found]
        seen = [] if discs[0] == discs[1] else [tried[int(np.argmax(discs))]]
    return PolarityCandidates(found[0], found[-1], seen[0] if len(seen) == 1 else None)
