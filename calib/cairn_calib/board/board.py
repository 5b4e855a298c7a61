"""Calibration targets: chessboards and grids of discs, and the order in which their points are named.

    (0, 0) (1, 0) (2, 0) ...  -> column, x        Point (column, row) is `row * columns + column`-th.
    (0, 1) (1, 1) ...                             The board's frame: x along a row, y along a column, z into the
      |                                           board, origin at point (0, 0); metres. Seen from the front it is
      v row, y                                    never mirrored: x turns to y clockwise.

Of a chessboard the points are its inner corners. Where one side has an odd and the other an even number of them,
half a turn swaps black and white, and that names the first corner: **the cell between (0, 0) and (1, 1) is printed
dark**. A thermal camera may see dark cells bright; that is the pair's polarity, and must not change the order.
"""

import re
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Pattern = Literal["chessboard", "circles", "asymmetric-circles"]
Polarity = Literal["normal", "reversed"]
"""normal: the camera sees printed dark as dark; reversed: as bright."""
Side = Annotated[int, Field(ge=3, le=64)]
Length = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]


class Board(BaseModel):
    """One flat target: `columns` x `rows` points, `pitch_m` from one to the next.

    Of asymmetric circles, every second row is moved by half a step: rows are `pitch_m` apart, columns twice that.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    pattern: Pattern = "chessboard"
    columns: Side
    rows: Side
    pitch_m: Length
    disc_m: Length | None = None
    """Diameter of its discs. None: a chessboard, or unknown; then centroids are taken for the images of centres."""

    @model_validator(mode="after")
    def _check_disc(self) -> Self:
        if self.disc_m is None:
            return self
        apart = self.pitch_m * (2**0.5 if self.pattern == "asymmetric-circles" else 1.0)
        if self.pattern == "chessboard" or self.disc_m >= apart:
            raise ValueError(f"disc_m is the diameter of discs that are {apart:g} m apart, got {self.disc_m:g} m")
        return self

    @property
    def count(self) -> int:
        """Number of points."""
        return self.columns * self.rows

    @property
    def has_turn_symmetry(self) -> bool:
        """True if the board looks the same after a half or a quarter turn, so that no image shows its first point."""
        if self.pattern == "asymmetric-circles":
            return self.rows % 2 == 0
        return self.pattern == "circles" or (self.columns + self.rows) % 2 == 0

    def lattice(self) -> Floats:
        """(N, 2) place of each point in units of the pitch, in order."""
        column, row = np.meshgrid(np.arange(self.columns, dtype=np.float64), np.arange(self.rows, dtype=np.float64))
        if self.pattern == "asymmetric-circles":
            column = 2 * column + row % 2
        return np.stack([column.ravel(), row.ravel()], axis=-1)

    def points(self) -> Floats:
        """(N, 3) place of each point in the board's frame, metres, z = 0, in order."""
        return np.concatenate([self.lattice() * self.pitch_m, np.zeros((self.count, 1))], axis=1)


def board_size(text: str) -> tuple[int, int]:
    """Columns and rows from text such as `9x6`.

    Raises:
        BadInputError: it is no such text.
    """
    found = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text)
    if found is None or not all(3 <= int(side) <= 64 for side in found.groups()):
        raise BadInputError(
            "bad_board", f"a board is COLUMNSxROWS of inner corners, such as 9x6, 3 to 64 each, got {text!r}"
        )
    return int(found[1]), int(found[2])
