"""Gates that discs, and the grid that they make, must pass to count as the board's.

A fit is one of the board's discs if it is alike the others in contrast and crispness, round and of one size on the
board as the places of its neighbours show it, and where those around it predict it. A grid is the board if few discs
in view are missing, the lattice does not go on beyond its rim, and nothing like its discs lies between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.corners import Corners
from cairn_calib.board.discs.disc_lattice import NamedDiscs
from cairn_calib.board.discs.disc_outline import HARMONIC_SIGMAS, DiscFit, Outline
from cairn_calib.board.discs.local_map import local_map, predicted_by_others
from cairn_calib.board.discs.straightening import LatticeView, UnbentView, bent_view
from cairn_map.arrays import Flags, Floats

Image = npt.NDArray[np.float32]

SEEN_MIN = 0.9
"""Share of the discs wholly in view that must be seen."""
DISCS_MIN = 6
"""Discs without which a board has no pose."""
CONTRAST_RATIO = 3.0
"""Largest ratio between a disc's contrast and the usual one."""
MISFIT_MAX, MISFIT_RATIO, MISFIT_SPARE = 0.35, 3.0, 0.05
"""Root mean square residual of a disc's edge, share of its contrast; and against the grid's median: times and plus."""
CLUTTER_RATIO, CLUTTER_WEIGHT = 1.08, 8.0
"""Residual over the grid's median from which it shows clutter, and by how much its square counts in the covariance:
discs 0.4 of a pitch from clutter 8 times as bright were off by up to 6 of the sigmas that noise alone makes."""
RADIUS_RATIO = 1.25
"""Largest ratio between a disc's size on the board and the usual one."""
ROUND_RATIO = 1.35
"""Largest ratio of the axes of a disc on the board, as the places of its neighbours show it."""
MISS_STEPS, MISS_PX = 0.1, 1.0
"""Largest distance of a disc from where those around it predict it, steps plus pixels."""
LIKELY_SHARE, LIKELY_ODD_MAX = 0.25, 2.0
"""Share of a lattice's blobs that must look like discs before any is fitted, and the most of what is 1 for fits."""
CORNERED, CORNERED_SIGMAS = 0.04, 5.0
"""Fourth harmonic along the lattice's axes that is no disc's, share of the radius: 0.11 for a square; and in sigmas."""
BEYOND_SHARE = 0.5
"""Share of the places along a side of the board at which discs of the same lattice make it part of a larger pattern."""
SQUARES_SHARE, HALF_WAY = 0.9, 0.08
"""Share of the places next to a board's rim that are as dark as discs where these are squares of a chessboard; and by
how much its corners, half-way between two squares of one colour, may differ from the mean of both colours."""
GROUND_SAMPLES, NEAR_RADII, NEAR_STEPS = 7, 1.1, 0.08
"""Samples along each side between four discs; those nearer to a disc than so many radii and steps may be blurred."""
DARK_LEAST, DARK_MOST, DARK_DISCS = 0.06, 0.2, 0.5
"""Share of the ground between four discs that may be as dark as they are: that of half a disc, within bounds."""
ALIKE, ALONE = 0.3, 0.35
"""Largest difference in brightness between a board's discs and one more beyond its rim, and the least between that one
and the ground on its four diagonals, contrasts."""
OUTER_SHARE = 0.25
"""Share of the places next to a board's rim, wholly in view, that may have one; clutter is at some."""
DISC_PITCHES = (0.25, 1.0)
"""Diameter of a disc, pitches (of asymmetric circles: distances of neighbours)."""


@dataclass(frozen=True, slots=True)
class GridFit:
    """Fitted discs of a board, in its order."""

    board: Board
    fits: tuple[DiscFit | None, ...]
    kept: Flags
    """(N,) True for each disc that is one of the board's."""
    in_view: Flags
    """(N,) True for each disc that lies wholly in the image."""

    @property
    def pixels(self) -> Floats:
        """(N, 2) centroids, NaN for discs that are not kept."""
        found = np.array([[np.nan] * 2 if each is None else each.centroid for each in self.fits])
        return np.where(self.kept[:, None], found, np.nan)

    def corners(self) -> Corners:
        """Centroids with covariance."""
        covariance = np.array([np.full((2, 2), np.nan) if each is None else each.covariance_px2 for each in self.fits])
        # Residuals beyond the grid's usual ones are no noise of single pixels, but clutter that reaches over the rim:
        # that moves a whole side of an outline.
        misfit = np.array([np.nan if each is None else each.misfit for each in self.fits])
        ratio = misfit / (CLUTTER_RATIO * np.median(misfit[self.kept]))
        covariance *= (1 + CLUTTER_WEIGHT * np.clip(ratio**2 - 1, 0, None))[:, None, None]
        return Corners(self.board, self.pixels, np.where(self.kept[:, None, None], covariance, np.nan))


def neighbour_step(board: Board) -> float:
    """Distance of a board's neighbouring discs, pitches."""
    return float(np.sqrt(2.0)) if board.pattern == "asymmetric-circles" else 1.0


def sound_discs(
    board: Board, fits: Sequence[DiscFit | None], shape: tuple[int, ...], *, least: int = DISCS_MIN
) -> Flags:
    """(N,) True for each fit that is a disc of this board: alike in contrast, crispness, size, roundness and place.

    Strays are sought until fewer than `least` discs are left. `shape` is that of the image.
    """
    there = np.array([each is not None for each in fits])
    if there.sum() < DISCS_MIN:
        return np.zeros(len(fits), np.bool_)
    contrast = np.array([np.nan if each is None else each.contrast for each in fits])
    misfit = np.array([np.nan if each is None else each.misfit for each in fits])
    with np.errstate(invalid="ignore"):
        usual = np.nanmedian(contrast)
        sound = there & (contrast > usual / CONTRAST_RATIO) & (contrast < usual * CONTRAST_RATIO)
        sound &= misfit < min(MISFIT_MAX, MISFIT_RATIO * float(np.nanmedian(misfit)) + MISFIT_SPARE)
    # Strays last, the worst first, since they spoil the predictions of those around them.
    while sound.sum() >= max(least, DISCS_MIN):
        off = _oddness(board, fits, sound, shape)
        worst = int(np.argmax(off))
        if off[worst] <= 1:
            break
        sound[worst] = False
    return np.asarray(sound)


def _oddness(board: Board, fits: Sequence[DiscFit | None], sound: Flags, shape: tuple[int, ...]) -> Floats:
    """(N,) by how much each sound disc is too large, too long or out of place; 1 is the most that is allowed."""
    lattice, step = board.lattice()[sound], neighbour_step(board)
    kept = [each for each, right in zip(fits, sound, strict=True) if right and each is not None]
    found, ellipses = (
        np.array(each) for each in zip(*((each.centroid, ellipse_of(each.outline)) for each in kept), strict=True)
    )
    off = _oddness_in(bent_view(lattice, found, shape), lattice, found, ellipses, step=step)
    result = np.zeros(len(sound))
    # One that folds the lattice bends all predictions.
    result[sound] = 9.0 if np.isinf(off).any() else off
    return result


def is_regular(lattice: Floats, found: Floats, ellipses: Floats, shape: tuple[int, ...], *, step: float) -> bool:
    """True if at least a quarter of a lattice's blobs look like discs of one board.

    Where they do not, no outline needs to be fitted. The bounds are those of `sound_discs`, but twice as wide, since
    blobs are not fitted and one stray bends the predictions of all those around it.

    Args:
        lattice: (N, 2) places of blobs.
        found: (N, 2) their centres, pixels.
        ellipses: (N, 2, 2) their shapes, pixels.
        shape: rows and columns of the image.
        step: distance of neighbours on the lattice.
    """
    # Most lenses bend too little to matter here, and the straightening is the slow part.
    return any(
        bool((_oddness_in(view(), lattice, found, ellipses, step=step) < LIKELY_ODD_MAX).mean() >= LIKELY_SHARE)
        for view in (UnbentView, lambda: bent_view(lattice, found, shape))
    )


def _oddness_in(view: LatticeView, lattice: Floats, found: Floats, ellipses: Floats, *, step: float) -> Floats:
    """(N,) by how much each disc of a lattice is too large, too long or out of place; arguments as in `is_regular`.

    Infinite where the lattice is folded, or mirrored.
    """
    # On the board, as far as a homography and the lens's strongest bending say; parabolas follow the rest.
    places, shrink = view.places(found), view.jacobian(found)
    _, steps = local_map(lattice, places, lattice, step=step)
    folded = ~(np.linalg.det(steps) >= 1e-3) | ~(np.linalg.det(np.nan_to_num(shrink)) > 0)
    steps = np.where(folded[:, None, None], np.eye(2), steps)
    # The disc on the board: its image's ellipse in units of the steps there.
    own = np.linalg.inv(np.swapaxes(steps, 1, 2)) @ np.where(folded[:, None, None], np.eye(2), shrink) @ ellipses
    axes = np.linalg.svd(own, compute_uv=False)
    radius = np.sqrt(axes[:, 0] * axes[:, 1])
    size = np.exp(np.abs(np.log(radius / np.median(radius))))
    miss = np.linalg.norm(predicted_by_others(lattice, places, step=step) - places, axis=1)
    length = np.sqrt(np.abs(np.linalg.det(steps))) * step
    off = np.maximum(np.log(size) / np.log(RADIUS_RATIO), np.log(axes[:, 0] / axes[:, 1]) / np.log(ROUND_RATIO))
    pixel = np.sqrt(np.abs(np.linalg.det(shrink)))
    off = np.maximum(off, miss / (MISS_STEPS * length + MISS_PX * pixel))
    low, high = DISC_PITCHES
    off = np.where((2 * radius > low * step) & (2 * radius < high * step), off, 9.0)
    return np.where(folded, np.inf, off)


def ellipse_of(outline: Outline) -> Floats:
    """(2, 2) image of the unit circle with the fitted radius and second harmonic."""
    a0, a2, b2 = outline.harmonics[:3]
    return np.asarray(outline.shape @ ((1 + a0) * np.eye(2) + np.array([[a2, b2], [b2, -a2]])))


def seen_min(in_view: int) -> int:
    """Discs that must be seen of those wholly in view."""
    return max(DISCS_MIN, int(np.ceil(SEEN_MIN * in_view)))


def too_few_seen(seen: str, in_view: int) -> tuple[str, str]:
    """The gate that refuses a grid of which too few discs are seen, and why; `seen` is their number, in words."""
    return "discs", (
        f"{seen} of the {in_view} discs in view have an outline like the others', at least {SEEN_MIN:.0%} must: "
        "let nothing lie on the board, and let it be evenly warm or lit"
    )


def refusal(found: GridFit, named: NamedDiscs) -> tuple[str, str] | None:
    """The gate that refuses a grid, and why; None where all let it pass."""
    seen, in_view = int(found.kept.sum()), int(found.in_view.sum())
    board = found.board
    if seen < seen_min(in_view):
        return too_few_seen(str(seen), in_view)
    if seen < 0.5 * board.count:
        return _too_few_in_view(seen, board)
    corners_sigmas = _cornered(found)
    if corners_sigmas is not None:
        return "roundness", (
            f"they have corners as squares have ({corners_sigmas:.0f} sigma): of a chessboard leave out --pattern"
        )
    return place_refusal(board, found.in_view, named)


def rim_refusal(dark: Image, found: GridFit) -> tuple[str, str] | None:
    """The gate that refuses a grid by the image beyond its rim, and why; None where it may be a whole board.

    Squares of a chessboard that are too small to have corners: the outer ones run into the margin of their board, so
    that the lattice ends there, but what is beyond its rim is as dark as they are. In between are corners: the mean of
    both colours, however blurred the image is.

    Discs of a larger pattern: beyond the rim lie others, whether they made blobs or not.
    """
    board, step = found.board, neighbour_step(found.board)
    known, pixels = board.lattice()[found.kept], found.pixels[found.kept]
    # Its neighbours, one after the other round a disc.
    sides = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)] if step > 1 else [(1, 0), (0, 1), (-1, 0), (0, -1)])
    # Counts at discs, at the ground between four of them, half-way to each neighbour, and beyond the rim.
    near = (known[:, None] + sides).reshape(-1, 2)
    is_disc = (np.abs(near[:, None] - board.lattice()).max(axis=2) < 1e-6).any(axis=1)
    diagonals = (sides + np.roll(sides, 1, axis=0)) / 2
    ground = (known[:, None] + diagonals).reshape(-1, 2)
    half_way = np.repeat(known, len(sides), axis=0)[is_disc] + np.tile(sides, (len(known), 1))[is_disc] / 2
    outer, outer_of = np.unique(near[~is_disc], axis=0, return_inverse=True)
    outside = (outer[:, None] + diagonals).reshape(-1, 2)
    values = [
        _counts_at(dark, local_map(known, pixels, places, step=step)[0])
        for places in (known, ground, half_way, outer, outside)
    ]
    if any(np.isnan(each).all() for each in values[:4]):
        return None
    disc, between = float(np.nanmedian(values[0])), float(np.nanmedian(values[1]))
    if disc == between:
        return None
    # 0 as the ground, 1 as a disc; NaN beyond the image, of which each comparison is false.
    corner, beyond, around = ((each - between) / (disc - between) for each in values[2:])
    is_corner, rim = abs(float(np.nanmedian(corner)) - 0.5) <= HALF_WAY, beyond[outer_of.ravel()]
    if is_corner and (rim[~np.isnan(rim)] > 0.5).mean() >= SQUARES_SHARE:
        return "rims", "what lies beyond the board's rim is like its discs: of a chessboard leave out --pattern"
    whole = np.column_stack([beyond, around.reshape(-1, len(sides))])
    whole = whole[~np.isnan(whole).any(axis=1)]
    more = int(((np.abs(whole[:, 0] - 1) < ALIKE) & (whole[:, 1:] < 1 - ALONE).all(axis=1)).sum())
    return _goes_on(more) if more > max(beyond_max(board), OUTER_SHARE * len(whole)) else None


def ground_refusal(dark: Image, found: GridFit) -> tuple[str, str] | None:
    """The gate that refuses a grid with other things like its discs between them, and why; None where it is a board.

    A perforated plate of which every other hole is named is such a grid, or keys of a keyboard a knight's move apart.
    """
    step, lattice = neighbour_step(found.board), found.board.lattice()
    # Four discs around each piece of ground, by their places.
    across, down = np.array([(1, 1), (-1, 1)] if step > 1 else [(1, 0), (0, 1)])
    at_place = {(round(x), round(y)): n for n, (x, y) in enumerate(lattice.tolist()) if found.kept[n]}
    corners = [
        [at_place.get((round(x), round(y)), -1) for x, y in place + np.array([0 * across, across, down, across + down])]
        for place in lattice
    ]
    fours = np.array([four for four in corners if min(four) >= 0])
    # Samples between them, but for the discs themselves and the blur of their edges.
    a, b = np.stack(np.meshgrid(*[(np.arange(GROUND_SAMPLES) + 0.5) / GROUND_SAMPLES] * 2)).reshape(2, -1)
    near = np.hypot(np.minimum(a, 1 - a), np.minimum(b, 1 - b))
    radius = disc_pitches(found) / (2 * step)
    is_ground = near > NEAR_RADII * radius + NEAR_STEPS
    if not len(fours) or is_ground.sum() < GROUND_SAMPLES:
        return None
    # Between the four it is bilinear enough, whatever the lens: nearest pixels are looked at.
    shares = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)[is_ground]
    counts = _counts_at(dark, (shares @ found.pixels[fours]).reshape(-1, 2)).reshape(len(fours), -1)
    disc = _counts_at(dark, found.pixels[fours.ravel()]).reshape(fours.shape).mean(axis=1)
    # Of each four: light and heat may change over a board.
    usual = np.median([each.contrast for each, kept in zip(found.fits, found.kept, strict=True) if kept and each])
    ground = np.maximum(np.nanpercentile(counts, 90, axis=1), disc + usual / 2)
    share = float(np.median((counts < (disc + ground)[:, None] / 2).mean(axis=1)))
    if share <= np.clip(DARK_DISCS * np.pi * radius**2 / is_ground.mean(), DARK_LEAST, DARK_MOST):
        return None
    return "ground", (
        f"of the ground between four of them {share:.0%} is as they are: state the whole board with --board, or cover "
        "what is not of it"
    )


def _counts_at(image: Image, pixels: Floats) -> Floats:
    """(N,) counts of the nearest pixels to (N, 2) places; NaN beyond the image."""
    x, y = np.rint(pixels).astype(np.intp).T
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    counts = np.full(len(pixels), np.nan)
    counts[inside] = image[y[inside], x[inside]]
    return counts


def beyond_max(board: Board) -> float:
    """Most discs of the same lattice that may lie next to a board's rim."""
    return BEYOND_SHARE * min(board.columns, board.rows)


def place_refusal(board: Board, in_view: Flags, named: NamedDiscs) -> tuple[str, str] | None:
    """The gate that refuses a grid by its place in the image and in its lattice alone, and why; None where it may pass.

    `in_view` is that of `GridFit`. No outline is needed, so that most lattices of clutter end here.
    """
    if (whole := int(in_view.sum())) < 0.5 * board.count:
        return _too_few_in_view(whole, board)
    if narrow := _open_sides(board, in_view):
        return "rims", (
            f"the {narrow} of the board are both cut by the image's border, so that it is open which discs these are: "
            "show at least one end of its rows and one of its columns"
        )
    if named.beyond > beyond_max(board):
        return _goes_on(named.beyond)
    return None


def _goes_on(beyond: int) -> tuple[str, str]:
    return "rims", (
        f"{beyond} more discs lie next to the board's rim in the same lattice: state the whole board with --board, or "
        "cover what is not of it; of a chessboard leave out --pattern"
    )


def _too_few_in_view(whole: int, board: Board) -> tuple[str, str]:
    return "discs", f"{whole} of {board.count} discs are wholly in view, at least half must be: move the board in"


def _cornered(found: GridFit) -> float | None:
    """Sigmas by which discs have four corners along or between the lattice's axes; None where they are round enough.

    Where discs are small, each alone tells little of it, but all together do.
    """
    lattice, pixels = found.board.lattice()[found.kept], found.pixels[found.kept]
    _, steps = local_map(lattice, pixels, lattice, step=neighbour_step(found.board))
    towards = weight = 0.0
    prior = HARMONIC_SIGMAS[-1] ** 2
    for each, step in zip(
        (f for f, kept in zip(found.fits, found.kept, strict=True) if kept and f), steps, strict=True
    ):
        # The fourth harmonic along the board's x axis, whose direction the outline's own frame shows.
        x, y = np.linalg.solve(each.outline.shape, step[0])
        angle = 4 * np.arctan2(y, x)
        along = np.array([np.cos(angle), np.sin(angle)])
        variance = float(along**2 @ each.fourth_variance)
        towards += float(along @ each.outline.harmonics[5:7]) / variance
        weight += max(1 / variance - 1 / prior, 0.0)
    if weight == 0 or abs(towards) < CORNERED * weight:
        return None
    sigmas = abs(towards) / np.sqrt(weight)
    return float(sigmas) if sigmas > CORNERED_SIGMAS else None


def _open_sides(board: Board, in_view: Flags) -> str | None:
    """Name of the two opposite sides that the image cuts; None where the board's place in the lattice is certain."""
    cut = ~in_view.reshape(board.rows, board.columns)
    if cut[0].any() and cut[-1].any():
        return "first and last row"
    if cut[:, 0].any() and cut[:, -1].any():
        return "first and last column"
    return None


def disc_pitches(found: GridFit) -> float:
    """Diameter of the board's discs in pitches, as its image shows: the median over its discs."""
    lattice = found.board.lattice()[found.kept]
    _, steps = local_map(lattice, found.pixels[found.kept], lattice, step=neighbour_step(found.board))
    area = np.array([_area(each.outline) for each, kept in zip(found.fits, found.kept, strict=True) if kept and each])
    return float(np.median(np.sqrt(4 * area / (np.pi * np.abs(np.linalg.det(steps))))))


def _area(outline: Outline) -> float:
    x, y = outline.rim().T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
