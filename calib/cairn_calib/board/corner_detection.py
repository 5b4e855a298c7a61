"""Detection of a chessboard in an image of any spectrum, which refuses what only looks like one.

    stretch -> for each method and scale: proposal -> edges fitted on the image as recorded -> order -> gates

The first proposal that passes every gate is the answer; each attempt leaves a line that says at which stage it ended.
Methods: saddles at several scales (saddle_grid.py: partly hidden boards, no quiet border needed), then, where these
make a part of a board, OpenCV's detector. Small images are enlarged for proposals only. Neither the detector's origin
nor its polarity is trusted: the fitted contrasts say which cells are bright, and `polarity` how the board's dark cells
look in this camera.
"""

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_gates import FittedGrid, checker_signs
from cairn_calib.board.corners import BY_HAND, FOUND, Attempt, Corners, Detection, pointed_attempt
from cairn_calib.board.grid_fit import NO_FIT, fit_board, fit_pointed_board
from cairn_calib.board.homography import fit_homography, map_points
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
"""Scales at which saddles are searched, by the longest side up to which they apply, pixels: time-of-flight and thermal
images are enlarged, large colour images reduced."""
RADON_SCALES = (4.0, 2.0, 1.0, 0.5, 0.25)
"""Scales at which OpenCV's detector is run: of these, the one that makes cells nearest to `RADON_CELL_PX`."""
RADON_CELL_PX = 24.0
"""Size of cells that suits OpenCV's detector, pixels."""
STRETCH = (1.0, 99.7)
"""Percentiles that become 0 and 1."""
RADON_LATTICE_SHARE = (0.3, 1.3)
"""Corners of the largest lattice of saddles, over the board's, at which OpenCV's detector is run. It takes most of
the time, and found 1 of 142 boards that were too blurred or noisy for saddles, none of 4 000 others. Its older one,
findChessboardCorners, found none of them."""
SHADE_SHARE = 0.15
"""Standard deviation of the Gaussian that takes shading out of 16-bit images, share of the longest side."""


def find_chessboard(
    image: npt.NDArray[np.generic], board: Board, *, polarity: Polarity = "normal", upright: bool = False
) -> Detection:
    """The corners of a chessboard.

    Args:
        image: (H, W) counts of any number type, as recorded.
        board: the chessboard.
        polarity: whether the camera sees printed dark as dark or as bright.
        upright: the board's rows run within 90 degrees (of a square board 45) of the image's rows, which names the
            first corner where colours cannot.

    Returns:
        The corners, NaN where hidden, or None; and every attempt.

    Raises:
        BadInputError: colours do not determine the first corner of this board, and it is not stated to be upright; or
            the array is no image.
    """
    # Without colours or a known way up the first corner cannot be named.
    if board.has_turn_symmetry and not upright:
        raise BadInputError(
            "board_turns",
            f"a board of {board.columns}x{board.rows} inner corners looks the same after half a turn, so that its "
            "first corner is anybody's guess: use one with an odd and an even side, or say that it always "
            "stands upright",
        )
    counts = grey(image)
    attempts: list[Attempt] = []
    even = normalise_contrast(counts)
    # Saddles at each scale; the first that passes all gates is the answer.
    largest, cell_px = 0, 0.0
    for scale in next(scales for longest, scales in SCALES if max(counts.shape) <= longest):
        proposal = saddle_grid(saddle_points(_resize(even, scale)), board)
        attempt, corners = _judge(proposal, "saddles", scale, counts, board, polarity, upright)
        attempts.append(attempt)
        if corners is not None:
            return Detection(corners, tuple(attempts))
        if isinstance(proposal, NoGrid) and proposal.largest > largest:
            largest, cell_px = proposal.largest, proposal.step_px / scale
    # OpenCV's detector, where saddles made about a board of corners, at the scale that suits it.
    if not RADON_LATTICE_SHARE[0] * board.count <= largest <= RADON_LATTICE_SHARE[1] * board.count or cell_px == 0:
        return Detection(None, tuple(attempts))
    scale = min(RADON_SCALES, key=lambda scale: abs(np.log(scale * cell_px / RADON_CELL_PX)))
    attempt, corners = _judge(_by_radon(_resize(even, scale), board), "radon", scale, counts, board, polarity, upright)
    return Detection(corners, (*attempts, attempt))


def grey(image: npt.NDArray[np.generic]) -> Image:
    """(H, W) float32 of an image of one channel.

    Raises:
        BadInputError: it has more channels, or is too small for a board.
    """
    if image.ndim != 2 or min(image.shape) < 16 or not np.issubdtype(image.dtype, np.number):
        raise BadInputError("image_type", f"corners need one channel of at least 16 x 16 pixels, got {image.shape}")
    return np.nan_to_num(image.astype(np.float32))


def normalise_contrast(counts: Image) -> Image:
    """(H, W) image with a contrast of about 1, without the slow change of brightness over it."""
    # Percentiles, not extremes: hot spots and dead pixels must not set the contrast.
    low, high = np.percentile(counts, STRETCH)
    flat = np.clip((counts - low) / max(float(high - low), 1e-9), -0.5, 1.5).astype(np.float32)
    # The shade is smooth, so 32 x 32 pixels hold it.
    small = cv2.resize(flat, (32, 32), interpolation=cv2.INTER_AREA)
    shade = cv2.GaussianBlur(small, (0, 0), SHADE_SHARE * 32)
    shade = cv2.resize(shade, flat.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(flat - shade, np.float32)


def _resize(even: Image, scale: float) -> Image:
    if scale == 1:
        return even
    # Reduced by areas, so that no pixel is skipped.
    way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(even, None, fx=scale, fy=scale, interpolation=way), np.float32)


def _judge(
    proposal: Floats | NoGrid,
    method: str,
    scale: float,
    counts: Image,
    board: Board,
    polarity: Polarity,
    upright: bool,
) -> tuple[Attempt, Corners | None]:
    """Outcome of a proposal in an image that was enlarged by `scale`: refine, order, and pass the gates."""
    if isinstance(proposal, NoGrid):
        return Attempt(method, scale, "candidates", proposal.reason), None
    # Pixel centres are at whole numbers, so an image's edge is at -0.5 at every scale.
    found = fit_board(
        (proposal + 0.5) / scale - 0.5,
        counts,
        board,
        order=lambda grid_found: _order_as_board(grid_found, polarity=polarity, upright=upright),
    )
    if isinstance(found, Corners):
        return Attempt(method, scale, FOUND, f"{found.seen.sum()} corners"), found
    return Attempt(method, scale, *found), None


def _order_as_board(grid_found: FittedGrid, *, polarity: Polarity, upright: bool) -> FittedGrid:
    """Grid with the board's first corner first, by the image's rows (`upright`) or by the colours of its cells."""
    board = grid_found.board
    index = np.arange(board.count).reshape(board.rows, board.columns)
    if upright:
        # Of the turns that keep the board's shape, the one whose rows run most to the right.
        turns = (0, 1, 2, 3) if board.columns == board.rows else (0, 2)
        grids = [grid_found.fitted.pixels[np.rot90(index, turn)] for turn in turns]
        turn = turns[int(np.argmax([np.nanmean(np.diff(grid[..., 0], axis=1)) for grid in grids]))]
    else:
        # The board's first cell is printed dark; half a turn swaps the colours.
        bright_first = np.nansum(grid_found.fitted.contrast * checker_signs(board)) > 0
        turn = 2 if bright_first == (polarity == "normal") else 0
    fitted = grid_found.fitted.reorder(np.rot90(index, turn).ravel())
    if turn % 2:
        # A quarter turn swaps the cells that the sign of a contrast speaks of.
        fitted = replace(fitted, contrast=-fitted.contrast)
    lattice = board.lattice()
    known = np.isfinite(fitted.pixels[:, 0])
    homography = fit_homography(lattice[known], fitted.pixels[known])
    return FittedGrid(grid_found.image, board, fitted, grid_found.homography if homography is None else homography)


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
    """The corners of a chessboard that a person pointed at, in the person's order.

    Every corner with edges at its place counts. What the gates would have refused is said with the attempt.

    Args:
        image: (H, W) counts.
        board: any chessboard.
        pointed: pixels to about a third of a cell: (4, 2) first corner, end of first row, end of last row, start of
            last row; or (N, 2) all in order.
    """
    counts = grey(image)
    lattice = board.lattice()
    # Four clicks name the outer corners, more name every corner in order.
    outer = [0, board.columns - 1, board.count - 1, board.count - board.columns]
    places = lattice[outer] if len(pointed) == 4 else lattice
    homography = fit_homography(places, pointed)
    if homography is None:
        return Detection(None, (Attempt(BY_HAND, 1.0, "candidates", "the corners pointed at lie on a line"),))
    grid = map_points(homography, lattice) if len(pointed) == 4 else pointed
    corners, odd = fit_pointed_board(grid, counts, board)
    if corners is not None:
        return Detection(corners, (pointed_attempt(f"{corners.seen.sum()} corners", odd),))
    return Detection(None, (Attempt(BY_HAND, 1.0, *(odd or NO_FIT)),))
