"""Finding a chessboard in an image of any spectrum, and refusing what only looks like one.

    stretch -> for each method and scale: proposal -> edges fitted on the image as recorded -> order -> gates

The first proposal that passes every gate is the answer; each attempt leaves a line that says at which stage it ended.
Methods: saddles at several scales (saddle_grid.py: partly hidden boards, no quiet border needed), then, where these
make a part of a board, OpenCV's detector. Small images are enlarged for proposals only. Neither the detector's origin
nor its polarity is trusted: the fitted contrasts say which cells are bright, and `polarity` how the board's dark cells
look in this camera.
"""

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_gates import refusal, sound_corners
from cairn_calib.board.corner_refinement import FittedCorners, fit_corners
from cairn_calib.board.corners import FOUND, Attempt, Corners, Detection
from cairn_calib.board.fitted_grid import Judged, checker_signs
from cairn_calib.board.homography import fit_homography, mapped, steps_between
from cairn_calib.board.saddle_grid import NoGrid, saddle_grid
from cairn_calib.board.saddle_points import saddle_points
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Image = npt.NDArray[np.float32]

SCALES: tuple[tuple[int, tuple[float, ...]], ...] = (
    (256, (2.0, 4.0, 1.0)),
    (800, (1.0, 0.5, 0.7, 2.0)),
    (1 << 30, (0.5, 1.0, 0.25)),
)
"""Of images of up to so many pixels' longest side: time-of-flight, thermal, colour."""
RADON_SCALES = (4.0, 2.0, 1.0, 0.5, 0.25)
RADON_CELL_PX = 24.0
"""Cells of about this size suit OpenCV's detector."""
STRETCH = (1.0, 99.7)
"""Percentiles that become 0 and 1."""
HOPE = (0.3, 1.3)
"""Corners of the largest lattice of saddles, over the board's, at which OpenCV's detector is asked. It takes most of
the time, and found 1 of 142 boards that were too blurred or noisy for saddles, none of 4 000 others. Its older one,
findChessboardCorners, found none of them."""
PASSES = 4
"""At most, over corners that are predicted from those that were fitted before."""
SHADE = 0.15
"""Standard deviation of the Gaussian that takes shading out of 16-bit images, share of the longest side."""


def find_chessboard(
    image: npt.NDArray[np.generic], board: Board, *, polarity: Polarity = "normal", upright: bool = False
) -> Detection:
    """The corners of a chessboard.

    Args:
        image: (H, W) counts of any number type, as recorded.
        board: the chessboard.
        polarity: how the camera sees what is printed dark.
        upright: the board's rows run within 90 degrees (of a square board 45) of the image's rows, which names the
            first corner where colours cannot.

    Returns:
        What was found. Corners that are hidden are NaN.

    Raises:
        BadInputError: colours do not tell the first corner of this board, and it is not said to be upright; or the
            image is not one.
    """
    if board.turns_unseen and not upright:
        raise BadInputError(
            "board_turns",
            f"a board of {board.columns}x{board.rows} inner corners looks the same after half a turn, so that its "
            "first corner is anybody's guess: use one with an odd and an even side, or say that it always "
            "stands upright",
        )
    counts = grey(image)
    attempts: list[Attempt] = []
    even = stretched(counts)
    largest, cell_px = 0, 0.0
    for scale in next(scales for longest, scales in SCALES if max(counts.shape) <= longest):
        proposal = saddle_grid(saddle_points(_scaled(even, scale)), board)
        attempt, corners = _judged(proposal, "saddles", scale, counts, board, polarity, upright)
        attempts.append(attempt)
        if corners is not None:
            return Detection(corners, tuple(attempts))
        if isinstance(proposal, NoGrid) and proposal.largest > largest:
            largest, cell_px = proposal.largest, proposal.step_px / scale
    if not HOPE[0] * board.count <= largest <= HOPE[1] * board.count or cell_px == 0:
        return Detection(None, tuple(attempts))
    scale = min(RADON_SCALES, key=lambda scale: abs(np.log(scale * cell_px / RADON_CELL_PX)))
    attempt, corners = _judged(_by_radon(_scaled(even, scale), board), "radon", scale, counts, board, polarity, upright)
    return Detection(corners, (*attempts, attempt))


def grey(image: npt.NDArray[np.generic]) -> Image:
    """(H, W) float32 of an image of one channel.

    Raises:
        BadInputError: it has more channels, or is too small for a board.
    """
    if image.ndim != 2 or min(image.shape) < 16 or not np.issubdtype(image.dtype, np.number):
        raise BadInputError("image_type", f"corners need one channel of at least 16 x 16 pixels, got {image.shape}")
    return np.nan_to_num(image.astype(np.float32))


def stretched(counts: Image) -> Image:
    """Contrast of about 1, without the slow change of brightness over the image."""
    low, high = np.percentile(counts, STRETCH)
    flat = np.clip((counts - low) / max(float(high - low), 1e-9), -0.5, 1.5).astype(np.float32)
    small = cv2.resize(flat, (32, 32), interpolation=cv2.INTER_AREA)
    shade = cv2.GaussianBlur(small, (0, 0), SHADE * 32)
    shade = cv2.resize(shade, flat.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(flat - shade, np.float32)


def _scaled(even: Image, scale: float) -> Image:
    if scale == 1:
        return even
    way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(even, None, fx=scale, fy=scale, interpolation=way), np.float32)


def _judged(
    proposal: Floats | NoGrid,
    method: str,
    scale: float,
    counts: Image,
    board: Board,
    polarity: Polarity,
    upright: bool,
) -> tuple[Attempt, Corners | None]:
    """How it ends with a proposal in an image that was enlarged by `scale`."""
    if isinstance(proposal, NoGrid):
        return Attempt(method, scale, "candidates", proposal.reason), None
    judged = fitted_grid((proposal + 0.5) / scale - 0.5, counts, board)
    if judged is None:
        reason = "the edges that cross at the proposed corners cannot be fitted"
        return Attempt(method, scale, "refinement", reason), None
    judged = _ordered(judged, polarity=polarity, upright=upright)
    refused = refusal(judged)
    if refused is not None:
        return Attempt(method, scale, *refused), None
    corners = Corners(board, judged.fitted.pixels, judged.fitted.covariance_px2)
    return Attempt(method, scale, FOUND, f"{judged.kept.sum()} corners"), corners


def fitted_grid(grid: Floats, counts: Image, board: Board) -> Judged | None:
    """Proposed corners, fitted; those that are hidden or wrong are looked for where the others predict them."""
    lattice, signs = board.lattice(), checker_signs(board)
    guesses = grid.reshape(-1, 2).copy()
    fitted = None
    for _ in range(PASSES):
        known = np.isfinite(guesses[:, 0])
        homography = fit_homography(lattice[known], guesses[known]) if known.sum() >= 8 else None
        if homography is None:
            return None
        guesses = np.where(known[:, None], guesses, _predicted(homography, lattice, guesses, known))
        steps = steps_between(homography, lattice)
        fitted = _only(fit_corners(counts, guesses, steps), signs, apart_px=0.5 * _shortest(steps))
        guesses = fitted.pixels
        if not np.isnan(guesses).any():
            break
    known = np.isfinite(guesses[:, 0])
    homography = fit_homography(lattice[known], guesses[known]) if known.sum() >= 8 else None
    return None if homography is None or fitted is None else Judged(counts, board, fitted, homography)


def _predicted(homography: Floats, lattice: Floats, guesses: Floats, known: npt.NDArray[np.bool_]) -> Floats:
    """Where corners should be: the homography, with what it misses at the nearest known corner."""
    plain = mapped(homography, lattice)
    off = np.where(known[:, None], guesses - plain, 0)
    away = np.where(known, np.linalg.norm(lattice[:, None] - lattice[None], axis=2), np.inf)
    return np.asarray(plain + off[away.argmin(axis=1)])


def _shortest(steps: Floats) -> float:
    return float(np.nan_to_num(np.linalg.norm(steps, axis=2), nan=np.inf).min())


def _only(fitted: FittedCorners, signs: Floats, *, apart_px: float) -> FittedCorners:
    """The fitted corners, NaN for those that are no corners of this board.

    Where two names have come to one place, either may be wrong, so neither is kept: the others predict both anew.
    """
    lost = ~sound_corners(fitted, signs)
    apart = np.linalg.norm(fitted.pixels[:, None] - fitted.pixels[None], axis=2)
    apart[np.diag_indices(len(apart))] = np.inf
    with np.errstate(invalid="ignore"):
        lost |= ((apart < apart_px) & ~lost).any(axis=1)
    return FittedCorners(
        pixels=np.where(lost[:, None], np.nan, fitted.pixels),
        covariance_px2=np.where(lost[:, None, None], np.nan, fitted.covariance_px2),
        contrast=np.where(lost, np.nan, fitted.contrast),
        misfit=np.where(lost, np.nan, fitted.misfit),
        moved=np.where(lost, np.nan, fitted.moved),
    )


def _ordered(judged: Judged, *, polarity: Polarity, upright: bool) -> Judged:
    """The same grid, with the board's first corner first."""
    board = judged.board
    index = np.arange(board.count).reshape(board.rows, board.columns)
    if upright:
        turns = (0, 1, 2, 3) if board.columns == board.rows else (0, 2)
        grids = [judged.fitted.pixels[np.rot90(index, turn)] for turn in turns]
        turn = turns[int(np.argmax([np.nanmean(np.diff(grid[..., 0], axis=1)) for grid in grids]))]
    else:
        bright_first = np.nansum(judged.fitted.contrast * checker_signs(board)) > 0
        turn = 2 if bright_first == (polarity == "normal") else 0
    order = np.rot90(index, turn).ravel()
    f = judged.fitted
    turned_contrast = f.contrast[order] * (1 if turn % 2 == 0 else -1)
    fitted = FittedCorners(f.pixels[order], f.covariance_px2[order], turned_contrast, f.misfit[order], f.moved[order])
    lattice = board.lattice()
    known = np.isfinite(fitted.pixels[:, 0])
    homography = fit_homography(lattice[known], fitted.pixels[known])
    return Judged(judged.image, board, fitted, judged.homography if homography is None else homography)


def _by_radon(even: Image, board: Board) -> Floats | NoGrid:
    found, corners = cv2.findChessboardCornersSB(_eight_bits(even), (board.columns, board.rows), flags=0)
    return _proposal(found, corners, board)


def _proposal(found: bool, corners: npt.NDArray[np.generic] | None, board: Board) -> Floats | NoGrid:
    if not found or corners is None:
        return NoGrid("no board")
    grid = np.asarray(corners, np.float64).reshape(board.rows, board.columns, 2)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    # Seen from the front a board is not mirrored.
    return grid if across[0] * down[1] - across[1] * down[0] > 0 else grid[:, ::-1]


def _eight_bits(even: Image) -> npt.NDArray[np.uint8]:
    low, high = np.percentile(even, STRETCH)
    return np.asarray(np.clip((even - low) / max(float(high - low), 1e-9) * 255, 0, 255), np.uint8)


def fit_pointed_at(image: npt.NDArray[np.generic], board: Board, pointed: Floats) -> Detection:
    """The corners of a chessboard that a person pointed at, whose order is the person's.

    Args:
        image: (H, W) counts.
        board: any chessboard.
        pointed: pixels to about a third of a cell: (4, 2) first corner, end of first row, end of last row, start of
            last row; or (N, 2) all in order.
    """
    counts = grey(image)
    lattice = board.lattice()
    outer = [0, board.columns - 1, board.count - 1, board.count - board.columns]
    places = lattice[outer] if len(pointed) == 4 else lattice
    homography = fit_homography(places, pointed)
    if homography is None:
        return Detection(None, (Attempt("by hand", 1.0, "candidates", "the corners pointed at lie on a line"),))
    grid = mapped(homography, lattice) if len(pointed) == 4 else pointed
    judged = fitted_grid(grid, counts, board)
    if judged is None:
        return Detection(None, (Attempt("by hand", 1.0, "refinement", "no edges cross near the corners pointed at"),))
    refused = refusal(judged)
    if refused is not None:
        return Detection(None, (Attempt("by hand", 1.0, *refused),))
    found = Attempt("by hand", 1.0, FOUND, f"{judged.kept.sum()} corners")
    return Detection(Corners(board, judged.fitted.pixels, judged.fitted.covariance_px2), (found,))
