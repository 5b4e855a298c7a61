"""Calibration targets: chessboards, grids of discs, boards with tags, and the order in which their points are named.

    (0, 0) (1, 0) (2, 0) ...  -> column, x        Point (column, row) is `row * columns + column`-th.
    (0, 1) (1, 1) ...                             The board's frame: x along a row, y along a column, z into the
      |                                           board, origin at point (0, 0); metres. Seen from the front it is
      v row, y                                    never mirrored: x turns to y clockwise.

Of a chessboard the points are its inner corners. Where one side has an odd and the other an even number of them,
half a turn swaps black and white, and that names the first corner: **the cell between (0, 0) and (1, 1) is printed
dark**. A thermal camera may see dark cells bright; that is the pair's polarity, and must not change the order.

Boards with tags name their points themselves, so that any part of one is enough. Seen upright:

    charuco      a chessboard with tags in its bright squares: its points are the inner corners
    aprilgrid    Kalibr's sheet: tags of 36h11 with black squares at their corners; its points are the four corners of
                 each tag, so that it has twice as many columns and rows of points as of tags
"""

import re
from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, first_error

Pattern = Literal["chessboard", "circles", "asymmetric-circles", "charuco", "aprilgrid", "points"]
CODED: tuple[Pattern, ...] = ("charuco", "aprilgrid")
"""Patterns with tags."""
Polarity = Literal["normal", "reversed"]
"""normal: the camera sees printed dark as dark; reversed: as bright."""
Side = Annotated[int, Field(ge=1, le=64)]
SIDE_MIN = 3
"""Columns and rows of a grid, at least."""
NAMED_MIN = 6
"""Named points of a board, at least; with fewer its pose is hardly more than noise."""
FLAT_SHARE = 0.05
"""Spread of named points across their longest line, as a share of it, at least."""
Place = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]


class NamedPoint(BaseModel):
    """A point of a board with a name of its own: a pin, a lamp, a heated dot."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=64)]
    place_m: tuple[Place, Place]
    """x and y in the board's frame, metres."""


class Board(BaseModel):
    """One flat target: `columns` x `rows` points, `pitch_m` from one to the next.

    Of asymmetric circles, every second row is moved by half a step: rows are `pitch_m` apart, columns twice that. Of
    an AprilGrid `pitch_m` is from one tag to the next. Named points are one row, in their order, at places of their
    own; `pitch_m` is the smallest distance of two of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    pattern: Pattern = "chessboard"
    columns: Side
    rows: Side
    pitch_m: Length
    disc_m: Length | None = None
    """Diameter of its discs. None: a board with corners, or unknown; then centroids are taken for images of centres."""
    tag_m: Length | None = None
    """Edge of its tags, with their black border; None: a board without tags."""
    dictionary: Annotated[str, Field(max_length=20)] | None = None
    """Name of the set that its tags are of, such as `36h11` or `5x5_100`; None: a board without tags."""
    named: Annotated[tuple[NamedPoint, ...], Field(max_length=64)] | None = None
    """Points of the pattern `points`, which lie in a rectangle from (0, 0); None for grids."""

    @model_validator(mode="after")
    def _check_tags(self) -> Self:
        if (self.pattern in CODED) != (self.tag_m is not None) or (self.tag_m is None) != (self.dictionary is None):
            raise ValueError("tag_m and dictionary belong to boards with tags, and to them alone")
        if self.tag_m is not None and self.tag_m >= self.pitch_m:
            raise ValueError(f"tag_m is the edge of tags that are {self.pitch_m:g} m apart, got {self.tag_m:g} m")
        if self.pattern == "aprilgrid" and (self.columns % 2 or self.rows % 2):
            raise ValueError(f"an AprilGrid has two points a tag each way, got {self.columns} x {self.rows}")
        return self

    @model_validator(mode="after")
    def _check_disc(self) -> Self:
        if self.disc_m is None:
            return self
        apart = self.pitch_m * (2**0.5 if self.pattern == "asymmetric-circles" else 1.0)
        if "circles" not in self.pattern or self.disc_m >= apart:
            raise ValueError(f"disc_m is the diameter of discs that are {apart:g} m apart, got {self.disc_m:g} m")
        return self

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        if (self.pattern == "points") != (self.named is not None):
            raise ValueError("named are the points of the pattern points, and of no other")
        if self.named is None:
            if min(self.columns, self.rows) < SIDE_MIN:
                raise ValueError(f"a grid has {SIDE_MIN} columns and rows at least, got {self.columns} x {self.rows}")
            return self
        names = [each.name for each in self.named]
        if len(set(names)) < len(names) or len(names) < NAMED_MIN:
            raise ValueError(f"a board has {NAMED_MIN} named points at least, each once, got {', '.join(names)[:80]}")
        if (self.columns, self.rows) != (len(names), 1):
            raise ValueError(f"{len(names)} named points are 1 row of {len(names)} columns")
        return self

    @property
    def count(self) -> int:
        """Number of points."""
        return self.columns * self.rows

    @property
    def has_tags(self) -> bool:
        """True if tags name its points, whatever part of it is seen."""
        return self.pattern in CODED

    @property
    def has_turn_symmetry(self) -> bool:
        """True if the board looks the same after a half or a quarter turn, so that no image shows its first point."""
        if self.has_tags or self.pattern == "points":
            return False
        if self.pattern == "asymmetric-circles":
            return self.rows % 2 == 0
        return self.pattern == "circles" or (self.columns + self.rows) % 2 == 0

    def lattice(self) -> Floats:
        """(N, 2) place of each point in units of the pitch, in order."""
        if self.named is not None:
            return np.array([each.place_m for each in self.named]) / self.pitch_m
        column, row = np.meshgrid(np.arange(self.columns, dtype=np.float64), np.arange(self.rows, dtype=np.float64))
        if self.pattern == "asymmetric-circles":
            column = 2 * column + row % 2
        if self.pattern == "aprilgrid":
            column, row = (side // 2 + side % 2 * ((self.tag_m or 0.0) / self.pitch_m) for side in (column, row))
        return np.stack([column.ravel(), row.ravel()], axis=-1)

    def points(self) -> Floats:
        """(N, 3) place of each point in the board's frame, metres, z = 0, in order."""
        return np.concatenate([self.lattice() * self.pitch_m, np.zeros((self.count, 1))], axis=1)


def board_size(text: str, *, of: str = "inner corners", least: int = 3) -> tuple[int, int]:
    """Columns and rows from text such as `9x6`.

    Raises:
        BadInputError: it is no such text.
    """
    found = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text)
    if found is None or not all(least <= int(side) <= 64 for side in found.groups()):
        raise BadInputError(
            "bad_board", f"a board is COLUMNSxROWS of {of}, such as 9x6, {least} to 64 each, got {text!r}"
        )
    return int(found[1]), int(found[2])


def named_board(places_m: Mapping[str, tuple[float, float]]) -> Board:
    """The board of points by name, at places in any frame of the board's plane (x right, y down, metres).

    Raises:
        BadInputError: fewer than 6, more than 64, two at one place, or all in a line.
    """
    xy = np.array([*places_m.values()], np.float64).reshape(-1, 2)
    if len(xy) < NAMED_MIN or not np.isfinite(xy).all():
        raise BadInputError("bad_board", f"a board has {NAMED_MIN} named points at least, got {len(xy)}")
    xy = xy - xy.min(axis=0)
    apart = np.linalg.norm(xy[:, None] - xy, axis=-1)[~np.eye(len(xy), dtype=bool)]
    if apart.min() <= 0 or np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)[1] < FLAT_SHARE * apart.max():
        raise BadInputError("bad_board", "points of a board are at places of their own, and not all in one line")
    try:
        named = tuple(
            NamedPoint(name=name, place_m=(float(x), float(y))) for name, (x, y) in zip(places_m, xy, strict=True)
        )
        return Board(pattern="points", columns=len(named), rows=1, pitch_m=float(apart.min()), named=named)
    except ValidationError as exc:
        raise BadInputError("bad_board", first_error(exc)) from exc
