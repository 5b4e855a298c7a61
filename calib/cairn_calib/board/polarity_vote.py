"""Whether a camera sees what is printed dark as dark or as bright, by a vote of its images.

       printed          normal           reversed       A board's margin is paper, as its bright cells are. From a cell
     +---------+      :         :      :#########:      outwards the image stays as it is to the margin's end if it is
     |  # # #  |      :  # # #  :      :## # # ##:      a cell of paper, and to the cell's end only if it is printed;
     |   # # # |      :   # # # :      :### # # #:      that tells which of bright and dark is paper. Half a turn of
     +---------+      :         :      :#########:      the board swaps the colours of cells, but not of the margin.

One image may mislead (a shadow, a margin that is cut off), so all images of one camera decide together. Of boards whose
cells reach a frame, which would be taken for the margin, one says the polarity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corners import Corners
from cairn_calib.board.homography import fit_homography, mapped
from cairn_map.arrays import Floats

INSIDE = 0.25
"""Cells from the outer corners outwards to where a cell's brightness is read: outer cells may be cut to half."""
OUTWARDS = np.arange(INSIDE, 1.6, 0.05)
"""Cells from the outer corners: as far as a change is looked for."""
LONGER = 0.1
"""Cells by which cells of paper go on for longer than those that are printed."""
PAIRS_MIN = 6
AGAINST_MAX = 1
"""Sides of the board that may say otherwise: of which the cells are cut, or on which something lies."""
MAJORITY = 0.75


@dataclass(frozen=True, slots=True)
class Vote:
    """How many images say what."""

    normal: int
    reversed: int

    @property
    def polarity(self) -> Polarity | None:
        """What three quarters of the votes say; None where they are split, or there are none."""
        if self.normal == self.reversed or max(self.normal, self.reversed) < MAJORITY * (self.normal + self.reversed):
            return None
        return "normal" if self.normal > self.reversed else "reversed"

    def __str__(self) -> str:
        return f"{self.normal} for normal, {self.reversed} for reversed"


def vote_of(polarities: Sequence[Polarity | None]) -> Vote:
    """The vote of a camera's images; None abstains."""
    return Vote(sum(each == "normal" for each in polarities), sum(each == "reversed" for each in polarities))


def margin_polarity(counts: npt.NDArray[np.float32], corners: Corners) -> Polarity | None:
    """What the margin of a chessboard says, None where it says nothing.

    Args:
        counts: (H, W) counts of the image.
        corners: found in it, in whichever order.
    """
    board = corners.board
    homography = fit_homography(board.lattice()[corners.seen], corners.pixels[corners.seen])
    if homography is None:
        return None
    longer = [_longer(_brightness(counts, mapped(homography, _beyond(board, side)))) for side in range(4)]
    sides = [told for each in longer if len(told := each[np.isfinite(each)])]
    if sum(map(len, sides)) < PAIRS_MIN:
        return None
    by = float(np.median(np.concatenate(sides)))
    against = sum(float(np.median(side)) * np.sign(by) < -LONGER for side in sides)
    if abs(by) <= LONGER or against > AGAINST_MAX:
        return None
    return "normal" if by > 0 else "reversed"


def turned(corners: Corners) -> Corners:
    """The same corners, named from the other end."""
    return Corners(corners.board, corners.pixels[::-1], corners.covariance_px2[::-1])


def _beyond(board: Board, side: int) -> Floats:
    """(K, T, 2) places in pitches: outwards from the outer row of corners, between each two of them."""
    along = np.arange((board.columns if side < 2 else board.rows) - 1) + 0.5
    last = (board.rows if side < 2 else board.columns) - 1.0
    across = -OUTWARDS if side % 2 == 0 else last + OUTWARDS
    grid = np.stack(np.broadcast_arrays(along[:, None], across), axis=-1)
    return grid if side < 2 else grid[..., ::-1]


def _longer(profiles: Floats) -> Floats:
    """(K - 1,) cells by which the bright one of two neighbouring cells goes on for longer than the dark one.

    Args:
        profiles: (K, T) counts from each outer cell outwards.
    """
    level = profiles[:, 0]
    middle = (level[1:] + level[:-1]) / 2

    def length(mine: Floats) -> Floats:
        ended = (mine > middle[:, None]) != (mine[:, :1] > middle[:, None])
        seen = np.isfinite(mine).all(axis=1) | (ended & np.isfinite(mine)).any(axis=1)
        at = np.where(ended.any(axis=1), ended.argmax(axis=1), len(OUTWARDS) - 1)
        return np.where(seen & np.isfinite(middle), OUTWARDS[at], np.nan)

    after = length(profiles[1:]) - length(profiles[:-1])
    return np.asarray(np.where(level[1:] > level[:-1], after, -after))


def _brightness(counts: npt.NDArray[np.float32], at: Floats) -> Floats:
    """(...,) counts between pixels, bilinear; NaN outside."""
    x, y = np.moveaxis(at, -1, 0)
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (y >= 0) & (x <= counts.shape[1] - 1.001) & (y <= counts.shape[0] - 1.001)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    left, top = x.astype(np.intp), y.astype(np.intp)
    s, t = x - left, y - top
    upper = (1 - s) * counts[top, left] + s * counts[top, left + 1]
    lower = (1 - s) * counts[top + 1, left] + s * counts[top + 1, left + 1]
    return np.where(inside, (1 - t) * upper + t * lower, np.nan)
