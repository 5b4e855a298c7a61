"""Places of the tags of a board, and how far about its corners nothing else is printed.

    aprilgrid, seen upright            charuco
      6   7   8      tags rise           #  0  #  1  #     tags lie in the bright squares, row by row downwards;
      3   4   5      from the            2  #  3  #  4     before OpenCV 4.6 a board with an even number of rows
      0   1   2      lower left          #  5  #  6  #     began with a bright square (legacy)

Places are in the lattice of `Board.lattice`: pitches from the board's first point, x along rows, y down.
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.board.board import Board
from cairn_calib.corner_search.tag_codes import dictionary_of
from cairn_map.arrays import Floats

APRILGRID_BORDER_BITS, CHARUCO_BORDER_BITS = 2, 1
"""Width of a tag's black border, in its bits."""
SQUARES_MAX = 65
"""Columns of squares or tags that are tried where a board has other ones than stated."""


@dataclass(frozen=True, slots=True)
class TagLayout:
    """A board's tags, numbered on beyond its last one, so that a larger board is recognised."""

    board: Board
    columns: int
    """Tags in a row of an AprilGrid; squares in a row of a ChArUco board."""
    is_legacy: bool = False

    @property
    def border_bits(self) -> int:
        """Width of a tag's black border, in its bits."""
        return APRILGRID_BORDER_BITS if self.board.pattern == "aprilgrid" else CHARUCO_BORDER_BITS

    @property
    def count(self) -> int:
        """Number of the board's tags."""
        if self.board.pattern == "aprilgrid":
            return self.board.columns * self.board.rows // 4
        squares = (self.board.columns + 1) * (self.board.rows + 1)
        return (squares + self.is_legacy) // 2

    def corners(self, tag: int) -> Floats:
        """(4, 2) place of a tag's corners: upper left, upper right, lower right, lower left, seen upright."""
        edge = (self.board.tag_m or 0.0) / self.board.pitch_m
        if self.board.pattern == "aprilgrid":
            low = np.array([tag % self.columns, self.board.rows // 2 - 1 - tag // self.columns], np.float64)
        else:
            row, column = self._square(tag)
            # The first point is the lower right corner of the first square.
            low = np.array([column, row]) - 1 + (1 - edge) / 2
        return np.asarray(low + edge * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))

    def _square(self, tag: int) -> tuple[int, int]:
        """Row and column of a tag's square: of each two rows, one begins with a tag."""
        first = 0 if self.is_legacy else 1
        tags = [(self.columns + 1 - first) // 2, (self.columns + first) // 2]
        row, within = tag // sum(tags) * 2, tag % sum(tags)
        if within >= tags[0]:
            row, within, first = row + 1, within - tags[0], 1 - first
        return row, 2 * within + first


def layouts_of(board: Board, columns: int | None = None) -> list[TagLayout]:
    """The layouts that a board may have; with another number of columns, those of a board with that many."""
    own = board.columns // 2 if board.pattern == "aprilgrid" else board.columns + 1
    layouts = [TagLayout(board, columns or own)]
    if board.pattern == "charuco" and board.rows % 2:
        # An even number of rows of squares.
        layouts.append(TagLayout(board, columns or own, is_legacy=True))
    return layouts


def free_reach(board: Board) -> float:
    """Pitches about a corner, along rows and columns, within which there are but the two edges that cross there."""
    tag = (board.tag_m or 0.0) / board.pitch_m
    if board.pattern == "charuco":
        return (1 - tag) / 2
    bits = dictionary_of(board.dictionary or "").markerSize + 2 * APRILGRID_BORDER_BITS
    return min(tag * APRILGRID_BORDER_BITS / bits, 1 - tag)
