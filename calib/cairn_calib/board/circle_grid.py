"""Detection of grids of discs: the target for cameras to which edges are weak, as on heated metal.

    blobs like ellipses -> four of their hull as the board's outer discs -> all the others by a homography
    -> grey-weighted centroids -> gates

The centroid of a disc's image is measured, which is not the image of its centre: a tilted disc's nearer
half is larger. A model must project the rim and take the centroid of that (corner_residuals.py). Blur does not move it.
"""

from itertools import combinations

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.board_flatness import flat_limit_px, flat_rms_px
from cairn_calib.board.corner_detection import grey, normalise_contrast
from cairn_calib.board.corners import FOUND, Attempt, Corners, Detection
from cairn_calib.board.homography import fit_homography, map_points, steps_between
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Image = npt.NDArray[np.float32]

BLOCK_SHARES = (0.06, 0.03, 0.15, 0.4)
"""Sides of the adaptive threshold's neighbourhood that are tried in turn, shares of the image's shorter side."""
THRESHOLD_OFFSET = 0.08
"""Difference from the mean of its neighbourhood that makes a pixel dark, share of the image's contrast."""
AREA_MIN_PX = 12
"""Smallest area of a blob, pixels."""
AREA_MAX = 0.02
"""Largest area of a blob, share of the image."""
ELLIPSE_SHARE_MIN = 0.88
"""Area over that of the ellipse with the same moments: 1 for a disc, 0.95 for a square, less for anything else."""
AXES_RATIO_MIN = 0.3
"""Short axis of a disc's image over the long one, at least: tilted by 70 degrees."""
BLOB_PITCHES_MAX = 0.35
"""Pitches from a predicted disc to a blob, at most."""
BLOBS_MAX = 400
"""Blobs that are kept, the largest ones."""
HULL_MAX = 8
"""Vertices of a hull that may be the grid's outer four; those that stick out least are left out."""
SPECK_AREA_MAX = 0.12
"""Area of a speck of noise, at most, share of the usual blob's."""
SMOOTH_PX = 1.4
"""Standard deviation of the Gaussian before the threshold, pixels of the enlarged image."""
SEEN_MIN = 0.9
"""Share of the discs that must be seen."""
SCALES = ((320, (1.0, 2.0, 4.0)), (1000, (1.0, 2.0)), (1 << 30, (1.0,)))
"""Scales at which blobs are searched, by the longest side up to which they apply, pixels."""
RIM_PITCHES = 0.42
"""Pitches from a disc's centre beyond which there is ground, up to half a pitch along rows and columns."""
ASYMMETRIC_RIM, ASYMMETRIC_REACH = 0.55, 0.7
"""Pitches from and to which there is ground about asymmetric discs, whose neighbours are 1.41 pitches away."""
CONTRAST_RATIO = 3.0
"""Largest ratio between a disc's contrast and the usual one."""


def find_circles(
    image: npt.NDArray[np.generic],
    board: Board,
    *,
    polarity: Polarity = "normal",
    upright: bool = False,
    pointed: Floats | None = None,
) -> Detection:
    """The discs of a grid; arguments and errors are those of `find_chessboard`, `pointed` is that of `fit_pointed_at`.

    With normal polarity discs are darker than their ground.
    """
    counts = grey(image)
    signed = counts if polarity == "normal" else -counts
    # A person pointed at them: measure there.
    if pointed is not None:
        outer = [0, board.columns - 1, board.count - 1, board.count - board.columns]
        places = board.lattice()[outer] if len(pointed) == 4 else board.lattice()
        homography = fit_homography(places, pointed)
        found = "the discs pointed at lie on a line" if homography is None else _measure(signed, board, homography)
        return _detection([], "by hand", 1.0, found)
    if board.has_turn_symmetry and not upright:
        raise BadInputError(
            "board_turns",
            f"{board.columns}x{board.rows} {board.pattern} look the same after half a turn, so that their first "
            "disc is anybody's guess: use asymmetric circles with an odd number of rows, or say that the grid always "
            "stands upright",
        )
    # Every scale and neighbourhood, until the blobs form the grid.
    attempts: list[Attempt] = []
    for scale in next(scales for longest, scales in SCALES if max(counts.shape) <= longest):
        even = cv2.resize(normalise_contrast(signed), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        for block in BLOCK_SHARES:
            blobs = (_blobs(np.asarray(even, np.float32), block, board.count) + 0.5) / scale - 0.5
            homography = _homography_by_hull(blobs, board, upright=upright)
            found = (
                f"{len(blobs)} blobs, of which no {board.count} form the grid"
                if homography is None
                else _measure(signed, board, homography)
            )
            detection = _detection(attempts, "blobs", scale, found)
            if detection.corners is not None:
                return detection
            attempts = list(detection.attempts)
    return Detection(None, tuple(attempts))


def _detection(before: list[Attempt], method: str, scale: float, found: Corners | str) -> Detection:
    if isinstance(found, Corners):
        return Detection(found, (*before, Attempt(method, scale, FOUND, f"{found.seen.sum()} discs")))
    stage = "candidates" if "blobs" in found or "line" in found else "gates"
    return Detection(None, (*before, Attempt(method, scale, stage, found)))


def _blobs(even: Image, block: float, count: int) -> Floats:
    """(N, 2) centres of dark patches like ellipses, of about the most usual contrast and size."""
    even = np.asarray(cv2.GaussianBlur(even, (0, 0), SMOOTH_PX), np.float32)
    # Dark is darker than the mean about it.
    size = max(3, int(block * min(even.shape)) // 2 * 2 + 1)
    ground = cv2.blur(even, (size, size))
    dark = (even < ground - THRESHOLD_OFFSET).astype(np.uint8)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    centres, areas, depths = [], [], []
    for contour in contours:
        m = cv2.moments(contour)
        if not AREA_MIN_PX <= m["m00"] <= AREA_MAX * even.size:
            continue
        # The ellipse with the same second moments: squared half axes are 4 times these, its area 4 pi their root.
        xx, xy, yy = (m[name] / m["m00"] for name in ("mu20", "mu11", "mu02"))
        long, short = (float(v) for v in np.linalg.eigvalsh([[xx, xy], [xy, yy]])[::-1])
        if short <= AXES_RATIO_MIN**2 * long or m["m00"] < ELLIPSE_SHARE_MIN * 4 * np.pi * np.sqrt(long * short):
            continue
        x, y = m["m10"] / m["m00"], m["m01"] / m["m00"]
        centres.append((x, y))
        areas.append(m["m00"])
        depths.append(float((ground - even)[round(y), round(x)]))
    if not centres:
        return np.zeros((0, 2))
    # As deep as the deepest `count` blobs usually are, and no specks.
    order = np.argsort(-np.array(areas))[:BLOBS_MAX]
    area, depth = np.array(areas)[order], np.array(depths)[order]
    dark_as_usual = depth > np.median(np.sort(depth)[::-1][:count]) / CONTRAST_RATIO
    usual = float(np.median(area[dark_as_usual][:count])) if dark_as_usual.any() else 0.0
    return _drop_doubles(np.array(centres)[order][dark_as_usual & (area > SPECK_AREA_MAX * usual)])


def _drop_doubles(centres: Floats) -> Floats:
    """Centres, except those within 2 px of an earlier one, which are inner contours of the same blob."""
    away = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    return np.asarray(centres[~(np.tril(away < 2, k=-1)).any(axis=1)])


def _homography_by_hull(blobs: Floats, board: Board, *, upright: bool) -> Floats | None:
    """Homography from the lattice to the image that meets the most blobs; None if it meets too few."""
    if len(blobs) < SEEN_MIN * board.count:
        return None
    lattice = board.lattice()
    ends = np.array([0, board.columns - 1, board.count - 1, board.count - board.columns])
    best, best_met = None, SEEN_MIN * board.count - 1
    for cloud in _blob_clouds(blobs, board.count):
        # The grid's outer four discs are vertices of the hull, in clockwise order as the board's.
        hull = cv2.convexHull(cloud.astype(np.float32))[:, 0].astype(np.float64)
        if np.linalg.det(np.stack([hull[1] - hull[0], hull[2] - hull[1]])) < 0:
            hull = hull[::-1]
        hull = _simplify_hull(hull)
        # Try every four of them, from every first one.
        for four in combinations(range(len(hull)), 4):
            for turn in range(4):
                corners = hull[np.roll(four, turn)]
                homography = fit_homography(lattice[ends], corners)
                if homography is None:
                    continue
                at = map_points(homography, lattice)
                # An upright grid's rows run to the right, within 45 degrees.
                if upright and not at[board.columns - 1, 0] - at[0, 0] > abs(at[board.columns - 1, 1] - at[0, 1]):
                    continue
                met = _have_blob(homography, lattice, at, cloud)
                if met.sum() > best_met:
                    best_met = float(met.sum())
                    best = homography
    return best if best is None else _refit(best, lattice, blobs)


def _simplify_hull(hull: Floats) -> Floats:
    """Hull of at most `HULL_MAX` vertices, without those that add the least area."""
    while len(hull) > HULL_MAX:
        # Twice the area of the triangle that a vertex makes with its neighbours.
        to, back = np.roll(hull, -1, axis=0) - hull, np.roll(hull, 1, axis=0) - hull
        hull = np.delete(hull, int(np.abs(to[:, 0] * back[:, 1] - to[:, 1] * back[:, 0]).argmin()), axis=0)
    return hull


def _blob_clouds(blobs: Floats, count: int) -> list[Floats]:
    """Blobs that have two neighbours about as near as is usual, then all blobs: strays stand alone."""
    # The second nearest neighbour: column 0 is the blob itself.
    away = np.linalg.norm(blobs[:, None] - blobs[None], axis=2)
    second = np.sort(away, axis=1)[:, min(2, len(blobs) - 1)]
    near = second < 1.8 * np.median(second)
    return [blobs] if near.all() or near.sum() < SEEN_MIN * count else [blobs[near], blobs]


def _have_blob(homography: Floats, lattice: Floats, at: Floats, blobs: Floats) -> npt.NDArray[np.bool_]:
    """(N,) True for each disc with a blob where it is predicted."""
    pitch = np.linalg.norm(steps_between(homography, lattice), axis=2).min(axis=1)
    away = np.linalg.norm(at[:, None] - blobs[None], axis=2).min(axis=1)
    return np.asarray(away < BLOB_PITCHES_MAX * pitch)


def _refit(homography: Floats, lattice: Floats, blobs: Floats) -> Floats:
    """Homography from all discs that the given one meets."""
    for _ in range(2):
        at = map_points(homography, lattice)
        met = _have_blob(homography, lattice, at, blobs)
        nearest = np.linalg.norm(at[:, None] - blobs[None], axis=2).argmin(axis=1)
        again = fit_homography(lattice[met], blobs[nearest[met]])
        homography = homography if again is None else again
    return homography


def _measure(signed: Image, board: Board, homography: Floats) -> Corners | str:
    """Centroids by grey value about the predicted discs, or the reason of the gate that refuses."""
    lattice = board.lattice()
    steps = steps_between(homography, lattice)
    at = map_points(homography, lattice)
    pixels, covariance, contrast = (
        np.full((board.count, 2), np.nan),
        np.full((board.count, 2, 2), np.nan),
        np.zeros(board.count),
    )
    for index in range(board.count):
        centre = at[index]
        for _ in range(2):  # the second time about the first one's centroid
            centre, covariance[index], contrast[index] = _centroid(signed, centre, steps[index], board)
        pixels[index] = centre
    # Gates: contrast, orientation, flatness.
    usual = float(np.nanmedian(contrast))
    # Discs with a contrast far from the usual one are hidden or something else.
    sound = np.isfinite(pixels[:, 0]) & (contrast > usual / CONTRAST_RATIO) & (contrast < usual * CONTRAST_RATIO)
    if usual <= 0 or sound.sum() < SEEN_MIN * board.count:
        count = sound.sum() if usual > 0 else 0
        return f"{count} of {board.count} discs are darker than their ground (brighter, if reversed)"
    pixels[~sound], covariance[~sound] = np.nan, np.nan
    if np.linalg.det(steps).min() <= 0:
        return "the grid is mirrored or folded"
    rms = flat_rms_px(lattice[sound], pixels[sound], signed.shape)
    limit = flat_limit_px(float(np.linalg.norm(steps, axis=2).mean()))
    if rms > limit:
        return f"the discs lie {rms:.2f} px (rms) off a plane behind a lens, at most {limit:.2f}"
    return Corners(board, pixels, covariance)


def _centroid(signed: Image, centre: Floats, steps: Floats, board: Board) -> tuple[Floats, Floats, float]:
    """Centroid (2,), covariance (2, 2) px^2 and contrast of a dark disc; NaN and 0 where there is none."""
    nothing = np.full(2, np.nan), np.full((2, 2), np.nan), 0.0
    if not np.isfinite(centre).all():
        return nothing
    # The window about the disc must lie in the image.
    asymmetric = board.pattern == "asymmetric-circles"
    reach = (ASYMMETRIC_REACH if asymmetric else 0.5) * np.abs(steps).sum(axis=0)
    low, high = np.floor(centre - reach).astype(int), np.ceil(centre + reach).astype(int) + 1
    if (low < 0).any() or high[0] > signed.shape[1] or high[1] > signed.shape[0]:
        return nothing
    # In the lattice's units: the disc's own cell, and the ground in it.
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    cells = np.linalg.solve(steps.T, np.stack([x - centre[0], y - centre[1]]).reshape(2, -1)).reshape(2, *x.shape)
    radius = np.hypot(*cells)
    inside = radius < ASYMMETRIC_REACH if asymmetric else (np.abs(cells) < 0.5).all(axis=0)
    rim = inside & (radius > (ASYMMETRIC_RIM if asymmetric else RIM_PITCHES))
    if rim.sum() < 6:
        return nothing
    # Ground: a plane through the counts outside the disc. Weight: the depth below it.
    terms = np.stack([np.ones_like(x), x - centre[0], y - centre[1]], axis=-1)
    values = signed[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    ground, *_ = np.linalg.lstsq(terms[rim], values[rim], rcond=None)
    weight = np.where(inside, terms @ ground - values, 0.0)
    noise = float(np.mean((terms[rim] @ ground - values[rim]) ** 2) * rim.sum() / max(rim.sum() - 3, 1))
    total = float(weight.sum())
    if total <= 0:
        return nothing
    # The centroid, and its covariance by the noise of each pixel's weight.
    away = np.stack([x, y], axis=-1)
    found = (weight[..., None] * away).sum(axis=(0, 1)) / total
    off = (away - found)[inside]
    contrast = float(np.quantile(weight[inside], 0.9))
    return found, noise * (off.T @ off) / total**2, contrast
