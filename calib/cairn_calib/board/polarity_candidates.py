"""What one image of a camera shows of a board before it is settled, by all of its images, which polarity it has."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.circle_grid import find_circles
from cairn_calib.board.corner_detection import find_chessboard, fit_pointed_at
from cairn_calib.board.corners import Detection
from cairn_calib.board.polarity_vote import margin_polarity, turned
from cairn_map.arrays import Floats

Grey = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Looked:
    """What was found with either polarity, and for which one the image votes."""

    normal: Detection
    reversed: Detection
    vote: Polarity | None

    @property
    def likely(self) -> Detection:
        """What the image alone would say."""
        return self.named(self.vote or "normal")

    def named(self, polarity: Polarity) -> Detection:
        """What was found, its points in the order that they have with a polarity."""
        return self.normal if polarity == "normal" else self.reversed

    def checked(self, check: Callable[[Detection], Detection]) -> "Looked":
        """The same of what passes a check; what does not pass has no vote."""
        kept = Looked(check(self.normal), check(self.reversed), self.vote)
        return kept if kept.likely.corners is not None else replace(kept, vote=None)


def looked_for_corners(
    counts: Grey, board: Board, *, polarity: Polarity | Literal["vote"], upright: bool, pointed: Floats | None
) -> Looked:
    """A chessboard in an image; arguments and errors as of `find_chessboard` and `fit_pointed_at`."""
    if pointed is not None:
        found = fit_pointed_at(counts, board, pointed)
        return Looked(found, found, None if found.corners is None else margin_polarity(counts, found.corners))
    found = find_chessboard(counts, board, upright=upright)
    if found.corners is None:
        return Looked(found, found, None)
    other = found if upright else Detection(turned(found.corners), found.attempts)
    return Looked(found, other, margin_polarity(counts, found.corners) if polarity == "vote" else polarity)


def looked_for_discs(
    counts: Grey, board: Board, *, polarity: Polarity | Literal["vote"], upright: bool, pointed: Floats | None
) -> Looked:
    """A grid of discs in an image; arguments and errors as of `find_circles`. With the wrong polarity none is found."""
    tried: list[Polarity] = ["normal", "reversed"] if polarity == "vote" else [polarity]
    found = [find_circles(counts, board, polarity=each, upright=upright, pointed=pointed) for each in tried]
    seen: list[Polarity] = [way for way, each in zip(tried, found, strict=True) if each.corners is not None]
    return Looked(found[0], found[-1], seen[0] if len(seen) == 1 else None)
