"""Polarity of a camera: it sees printed dark as dark (normal) or as bright (reversed), by a vote of its images.

       printed          normal           reversed       A board's margin is paper, as its bright cells are. From a cell
     +---------+      :         :      :#########:      outwards the image stays as it is to the margin's end if it is
     |  # # #  |      :  # # #  :      :## # # ##:      a cell of paper, and to the cell's end only if it is printed;
     |   # # # |      :   # # # :      :### # # #:      that tells which of bright and dark is paper. Half a turn of
     +---------+      :         :      :#########:      the board swaps the colours of cells, but not of the margin.

One image may mislead (a shadow, a margin that is cut off), so all images of one camera decide together. Of boards whose
cells reach a frame, which would be taken for the margin, the user states the polarity.

Until the vote is settled, `PolarityCandidates` keeps an image's points as either polarity names them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_detection import find_chessboard, fit_pointed_at
from cairn_calib.board.corners import Corners, Detection
from cairn_calib.board.homography import fit_homography, map_points
from cairn_map.arrays import Floats

Grey = npt.NDArray[np.float32]

START_CELLS = 0.25
"""Cells from the outer corners outwards at which a cell's brightness is read: outer cells may be cut to half."""
PROFILE_CELLS = np.arange(START_CELLS, 1.6, 0.05)
"""Cells from the outer corners at which a profile is sampled for a change of brightness."""
LENGTH_DIFFERENCE_MIN = 0.1
"""Cells by which profiles over paper must be longer than those over printed cells for a vote."""
PAIRS_MIN = 6
"""Pairs of neighbouring outer cells without which an image has no vote."""
AGAINST_MAX = 1
"""Sides of the board that may contradict: their cells may be cut, or something may lie on them."""
MAJORITY = 0.75
"""Share of the votes that settles the polarity."""


@dataclass(frozen=True, slots=True)
class Vote:
    """Number of images for each polarity."""

    normal: int
    reversed: int

    @property
    def polarity(self) -> Polarity | None:
        """Polarity of at least three quarters of the votes; None where they are split, or there are none."""
        if self.normal == self.reversed or max(self.normal, self.reversed) < MAJORITY * (self.normal + self.reversed):
            return None
        return "normal" if self.normal > self.reversed else "reversed"

    def __str__(self) -> str:
        return f"{self.normal} for normal, {self.reversed} for reversed"


def count_votes(polarities: Sequence[Polarity | None]) -> Vote:
    """Votes of a camera's images; None abstains."""
    return Vote(sum(each == "normal" for each in polarities), sum(each == "reversed" for each in polarities))


def margin_polarity(counts: npt.NDArray[np.float32], corners: Corners) -> Polarity | None:
    """Polarity by the margin of a chessboard; None where it is not clear.

    Args:
        counts: (H, W) counts of the image.
        corners: found in it, named from either end.
    """
    board = corners.board
    homography = fit_homography(board.lattice()[corners.seen], corners.pixels[corners.seen])
    if homography is None:
        return None
    profiles = [_brightness(counts, map_points(homography, _outward_places(board, side))) for side in range(4)]
    longer = [_length_differences(each) for each in profiles]
    sides = [seen for each in longer if len(seen := each[np.isfinite(each)])]
    if sum(map(len, sides)) < PAIRS_MIN:
        return None
    # The median over all pairs decides, unless it is small or several sides contradict it.
    by = float(np.median(np.concatenate(sides)))
    against = sum(float(np.median(side)) * np.sign(by) < -LENGTH_DIFFERENCE_MIN for side in sides)
    if abs(by) <= LENGTH_DIFFERENCE_MIN or against > AGAINST_MAX:
        return None
    return "normal" if by > 0 else "reversed"


def reverse_corners(corners: Corners) -> Corners:
    """The corners, named from the other end."""
    return Corners(corners.board, corners.pixels[::-1], corners.covariance_px2[::-1])


def _outward_places(board: Board, side: int) -> Floats:
    """(K, T, 2) places in pitches, outwards from the outer row of corners, between each two of them.

    Sides 0 and 1 are the first and last row, 2 and 3 the first and last column.
    """
    along = np.arange((board.columns if side < 2 else board.rows) - 1) + 0.5
    last = (board.rows if side < 2 else board.columns) - 1.0
    across = -PROFILE_CELLS if side % 2 == 0 else last + PROFILE_CELLS
    grid = np.stack(np.broadcast_arrays(along[:, None], across), axis=-1)
    return grid if side < 2 else grid[..., ::-1]


def _length_differences(profiles: Floats) -> Floats:
    """(K - 1,) cells by which the profile of the bright one of two neighbouring cells is longer than the dark one's.

    Args:
        profiles: (K, T) counts from each outer cell outwards.
    """
    level = profiles[:, 0]
    middle = (level[1:] + level[:-1]) / 2

    def length(mine: Floats) -> Floats:
        # A profile ends where it crosses the middle between both cells; NaN where it leaves the image before that.
        ended = (mine > middle[:, None]) != (mine[:, :1] > middle[:, None])
        seen = np.isfinite(mine).all(axis=1) | (ended & np.isfinite(mine)).any(axis=1)
        at = np.where(ended.any(axis=1), ended.argmax(axis=1), len(PROFILE_CELLS) - 1)
        return np.where(seen & np.isfinite(middle), PROFILE_CELLS[at], np.nan)

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


@dataclass(frozen=True, slots=True)
class PolarityCandidates:
    """Detections in one image under either polarity, and the one for which the image votes."""

    normal: Detection
    reversed: Detection
    vote: Polarity | None

    @property
    def likely(self) -> Detection:
        """Detection under the polarity for which the image votes."""
        return self.detection(self.vote or "normal")

    def detection(self, polarity: Polarity) -> Detection:
        """Detection under a polarity, with its points in the order that they have then."""
        return self.normal if polarity == "normal" else self.reversed

    def filter(self, check: Callable[[Detection], Detection]) -> "PolarityCandidates":
        """Candidates after a check of both detections; a detection that fails it has no vote."""
        kept = PolarityCandidates(check(self.normal), check(self.reversed), self.vote)
        return kept if kept.likely.corners is not None else replace(kept, vote=None)


def chessboard_candidates(
    counts: Grey, board: Board, *, polarity: Polarity | Literal["vote"], upright: bool, pointed: Floats | None
) -> PolarityCandidates:
    """A chessboard in an image; arguments and errors are those of `find_chessboard` and `fit_pointed_at`."""
    if pointed is not None:
        found = fit_pointed_at(counts, board, pointed)
        vote = None if found.corners is None else margin_polarity(counts, found.corners)
        return PolarityCandidates(found, found, vote)
    found = find_chessboard(counts, board, upright=upright)
    if found.corners is None:
        return PolarityCandidates(found, found, None)
    other = found if upright else Detection(reverse_corners(found.corners), found.attempts)
    return PolarityCandidates(found, other, margin_polarity(counts, found.corners) if polarity == "vote" else polarity)
