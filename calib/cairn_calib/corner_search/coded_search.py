"""Detection of a board with tags: tags name the corners, and the corners are fitted as those of a chessboard are.

    tags that agree -> corners next to what is known, predicted and fitted -> the same about those, until none is added
                    -> corners that their neighbours predict -> corners at the finest scale at which edges are sharp

Tags are only read, not measured: a corner counts because two edges cross where its neighbours say, with the right
colours. So corners of tags that are cut, blurred or hidden in part are found, too.
"""

from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.board_flatness import flat_view, straight_view
from cairn_calib.board.corner_detection import normalise_contrast
from cairn_calib.board.corner_gates import sound_corners
from cairn_calib.board.corner_refinement import fit_corners
from cairn_calib.board.corners import BY_HAND, FOUND, Attempt, Corners, Detection
from cairn_calib.board.grid_fit import CELL_PX, fit_sharpest, reduce_image
from cairn_calib.board.homography import fit_homography, map_points, steps_between
from cairn_calib.board.polarity import PolarityCandidates
from cairn_calib.corner_search.saddle_tags import tags_of_saddles
from cairn_calib.corner_search.tag_detection import OTHERS_MIN, BoardTags, Bytes, board_tags, detect_tags, other_tags
from cairn_calib.corner_search.tag_layout import free_reach, layouts_of
from cairn_map.arrays import Flags, Floats

Image = npt.NDArray[np.float32]

SCALES: tuple[tuple[int, tuple[float, ...]], ...] = (
    (400, (2.0, 4.0)),
    (1000, (1.0, 2.0)),
    (2000, (1.0, 0.5, 2.0)),
    (1 << 30, (0.5, 1.0, 0.25)),
)
"""Scales at which tags are searched, by the longest side up to which they apply, pixels."""
STRETCH = (1.0, 99.7)
"""Percentiles that become black and white."""
NEAR_PITCHES = 1.6
"""Pitches from what is known within which corners are searched next."""
BENDING_MIN = 16
"""Known places from which the bending of the lens is estimated."""
NEIGHBOURS, SLOPE_RIDGE = 8, 0.3
"""Nearest corners whose misses predict one, and the weight with which their change from pitch to pitch is held at 0."""
PASSES = 6
"""Rounds in which the worst corners are taken out, at most."""
ROUNDS = 40
"""Rounds of growth, at most: a board's longest side in pitches."""
SEEN_MIN = 6
"""Corners without which a view is worth nothing to a calibration."""
OFF_PITCHES, OFF_PX = 0.04, 0.7
"""Largest distance between a corner and where its neighbours predict it, pitches plus pixels."""


def coded_candidates(
    counts: Image, board: Board, *, polarity: Polarity | Literal["vote"], upright: bool, pointed: Floats | None
) -> PolarityCandidates:
    """A board with tags in an image; its points have the same names under either polarity.

    Args:
        counts: (H, W) counts of the image.
        board: the board.
        polarity: of the search; "vote": both.
        upright: without meaning here, since tags name the points.
        pointed: pixels of the four outer points, or of all, to about a tenth of a pitch.
    """
    if pointed is not None:
        return _candidates(_point(counts, board, pointed), BY_HAND, 1.0, [], None)
    ways: tuple[Polarity, ...] = ("normal", "reversed") if polarity == "vote" else (polarity,)
    attempts: list[Attempt] = []
    level = normalise_contrast(counts)
    even = _eight_bits(level)
    scales = next(scales for longest, scales in SCALES if max(counts.shape) <= longest)
    # The first polarity and scale at which tags lie as on the board, and corners lie about them.
    for scale in scales:
        sized = np.clip(np.rint(_resize(even.astype(np.float32), scale)), 0, 255).astype(np.uint8)
        for way in ways:
            image = np.asarray(sized if way == "normal" else 255 - sized, np.uint8)
            seen = detect_tags(image, board.dictionary or "", layouts_of(board)[0].border_bits)
            tags = board_tags(seen, board)
            if isinstance(tags, str):
                attempts.append(Attempt(f"tags, {way}", scale, "candidates" if len(seen.ids) < 2 else "tags", tags))
                if len(seen.ids) >= OTHERS_MIN:
                    # So many tags are no chance: another scale would say the same.
                    return _nothing(attempts)
                continue
            candidates = _candidates(_grow_from(counts, board, tags, scale), "tags", scale, attempts, way)
            if candidates.normal.corners is not None:
                return candidates
            attempts = list(candidates.normal.attempts)
    # Tags that are too small or too blurred for a detector of squares.
    for scale in scales:
        contrast = _resize(level, scale)
        for way in ways:
            tags = board_tags(tags_of_saddles(contrast, board, is_reversed=way == "reversed"), board)
            if not isinstance(tags, str):
                candidates = _candidates(_grow_from(counts, board, tags, scale), "saddles", scale, attempts, way)
                if candidates.normal.corners is not None:
                    return candidates
    if all(attempt.stage == "candidates" for attempt in attempts):
        named = other_tags([even, np.asarray(255 - even, np.uint8)], board)
        if named is not None:
            attempts.append(Attempt("other tags", 1.0, "tags", named))
    return _nothing(attempts)


def _resize(image: Image, scale: float) -> Image:
    # Reduced by areas, so that no pixel is skipped.
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=way), np.float32)


def _grow_from(counts: Image, board: Board, tags: BoardTags, scale: float) -> Corners | str:
    places = np.concatenate([tags.layout.corners(int(tag)) for tag in tags.tags.ids])
    return _grow(counts, board, places, (tags.tags.corners.reshape(-1, 2) + 0.5) / scale - 0.5)


def _nothing(attempts: list[Attempt]) -> PolarityCandidates:
    nothing = Detection(None, tuple(attempts))
    return PolarityCandidates(nothing, nothing, None)


def _candidates(
    found: Corners | str, method: str, scale: float, before: list[Attempt], vote: Polarity | None
) -> PolarityCandidates:
    if isinstance(found, str):
        detection = Detection(None, (*before, Attempt(method, scale, "corners", found)))
        return PolarityCandidates(detection, detection, None)
    done = Attempt(method, scale, FOUND, f"{found.seen.sum()} corners")
    detection = Detection(found, (*before, done))
    return PolarityCandidates(detection, detection, vote)


def _point(counts: Image, board: Board, pointed: Floats) -> Corners | str:
    """Corners of a board that a person pointed at."""
    lattice = board.lattice()
    if len(pointed) == 4:
        outer = [0, board.columns - 1, board.count - 1, board.count - board.columns]
        homography = fit_homography(lattice[outer], pointed)
        if homography is None:
            return "the corners pointed at lie on a line"
        pointed = map_points(homography, lattice)
    return _grow(counts, board, lattice, pointed)


def _eight_bits(even: Image) -> Bytes:
    low, high = np.percentile(even, STRETCH)
    return np.asarray(np.clip((even - low) / max(float(high - low), 1e-9) * 255, 0, 255), np.uint8)


def _grow(counts: Image, board: Board, places: Floats, pixels: Floats) -> Corners | str:
    """Corners of the board from a few known places.

    Args:
        counts: (H, W) image as recorded.
        board: the board.
        places: (M, 2) known places of the lattice: corners of tags, or the board's own points.
        pixels: (M, 2) where they are, to a pixel or two.
    """
    homography = fit_homography(places, pixels)
    if homography is None:
        return "the corners that are known lie on a line"
    # The scale at which a corner's free surroundings are as large as the cells of a small chessboard.
    reach_px = 2 * free_reach(board) * float(np.median(np.linalg.norm(steps_between(homography, places), axis=2)))
    factor = 1 << max(0, int(np.floor(np.log2(max(reach_px / CELL_PX, 1.0)))))
    image = reduce_image(counts, factor)
    lattice, signs = board.lattice(), corner_signs(board)
    reach, known_at = 2 * free_reach(board), (pixels + 0.5) / factor - 0.5
    found = np.full((board.count, 2), np.nan)
    kept, by_tags = np.zeros(board.count, bool), True
    for _ in range(ROUNDS):
        # What is next to anything known, predicted by it; all are fitted again, for the usual contrast and noise.
        anchors, at = lattice[kept], found[kept]
        if by_tags:
            anchors, at = np.concatenate([anchors, places]), np.concatenate([at, known_at])
        near = np.linalg.norm(lattice[:, None] - anchors[None], axis=2).min(axis=1) < NEAR_PITCHES
        guesses, steps = _predict(lattice, anchors, at, image.shape)
        guesses = np.where(kept[:, None], found, np.where(near[:, None], guesses, np.nan))
        fitted = fit_corners(image, guesses, reach * steps)
        grown = sound_corners(fitted, signs)
        if grown.sum() <= kept.sum():
            # Where tags help no more, fitted corners alone predict better than with the rough corners of tags.
            if not by_tags or kept.sum() < SEEN_MIN:
                break
            by_tags = False
            continue
        found, kept = np.where(grown[:, None], fitted.pixels, np.nan), grown
    # Each corner must lie where its neighbours predict it, without itself.
    sound = _lies_among_others(lattice, found, image.shape)
    if sound.sum() < SEEN_MIN:
        return f"{sound.sum()} corners are crossings of two edges where the tags say, at least {SEEN_MIN} are needed"
    _, steps = _predict(lattice, lattice[sound], found[sound], image.shape)
    fitted = fit_corners(image, np.where(sound[:, None], found, np.nan), reach * steps)
    fitted = fitted.only(sound & sound_corners(fitted, signs))
    guesses = (fitted.pixels + 0.5) * factor - 0.5
    return Corners(board, *fit_sharpest(counts, fitted, guesses, reach * factor * steps, signs=signs, factor=factor))


def corner_signs(board: Board) -> Floats:
    """(N,) 1 or -1 in turns: the cells that meet at a corner have the other colours at the next one."""
    column, row = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    return np.where((column + row).ravel() % 2 == 0, 1.0, -1.0)


def _predict(lattice: Floats, anchors: Floats, at: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """(N, 2) pixels and (N, 2, 2) steps of a pitch of places of the lattice; NaN where the anchors do not tell.

    A flat board behind a lens that is fitted to all anchors, plus the misses of those next to the place.
    """
    find = flat_view if len(anchors) >= BENDING_MIN else straight_view
    view = find(anchors, at, shape)
    if view is None:
        return np.full_like(lattice, np.nan), np.tile(np.eye(2), (len(lattice), 1, 1))
    away = np.linalg.norm(lattice[:, None] - anchors[None], axis=2)
    half = 0.5 * np.eye(2)
    steps = np.stack([view.pixels(lattice + h) - view.pixels(lattice - h) for h in half], axis=1)
    steps[~np.isfinite(steps).all(axis=(1, 2))] = np.eye(2)
    return view.pixels(lattice) + _misses_near(lattice, anchors, at - view.pixels(anchors), away), steps


def _misses_near(places: Floats, anchors: Floats, misses: Floats, away: Floats) -> Floats:
    """(N, 2) misses at places: those of the nearest anchors, linear in the lattice, flat where these leave that open.

    Args:
        places: (N, 2)
        anchors: (M, 2)
        misses: (M, 2) pixels.
        away: (N, M) distance from place to anchor; infinite for an anchor that must not count.
    """
    near = np.argsort(away, axis=1, kind="stable")[:, :NEIGHBOURS]
    apart = anchors[near] - places[:, None]
    terms = np.concatenate([np.ones((*apart.shape[:2], 1)), apart], axis=2)
    transposed = np.swapaxes(terms, 1, 2)
    # Least squares at each place, whose value there is the first unknown; the ridge holds slopes that nothing tells.
    normal = transposed @ terms + np.diag([1e-6, SLOPE_RIDGE, SLOPE_RIDGE])
    return np.asarray(np.linalg.solve(normal, transposed @ misses[near])[:, 0], np.float64)


def _lies_among_others(lattice: Floats, found: Floats, shape: tuple[int, ...]) -> Flags:
    """(N,) True for each corner that misses its place on a flat board behind a lens as its neighbours do."""
    sound = np.isfinite(found[:, 0])
    for _ in range(PASSES):
        kept = np.flatnonzero(sound)
        find = flat_view if len(kept) >= BENDING_MIN else straight_view
        view = find(lattice[kept], found[kept], shape) if len(kept) >= SEEN_MIN else None
        if view is None:
            break
        missed = found[kept] - view.pixels(lattice[kept])
        away = np.linalg.norm(lattice[kept][:, None] - lattice[kept][None], axis=2)
        away[np.diag_indices(len(kept))] = np.inf
        off_px = np.linalg.norm(missed - _misses_near(lattice[kept], lattice[kept], missed, away), axis=1)
        half = np.array([[0.5, 0.0]])
        pitch_px = np.linalg.norm(view.pixels(lattice[kept] + half) - view.pixels(lattice[kept] - half), axis=1)
        off = off_px / (OFF_PX + OFF_PITCHES * pitch_px)
        # A wrong corner spoils the view of the others, so the worst go first.
        worst = float(np.nan_to_num(off, nan=np.inf).max())
        if worst <= 1:
            break
        sound[kept[~(off <= max(1.0, worst / 2))]] = False
    return sound
