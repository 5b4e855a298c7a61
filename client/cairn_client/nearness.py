"""What is near: which cells a robot wants at all, and which first."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from cairn_map.grid import CELL_LIMIT, Cell

Wanted = Callable[[Cell], bool]
"""Which cells a low-end robot keeps."""


def within(position_m: npt.ArrayLike, *, radius_m: float, cell_edge_m: float) -> Wanted:
    """Cells of which some point lies within a radius of a position."""
    centre = np.asarray(position_m, dtype=np.float64)

    def is_near(cell: Cell) -> bool:
        low = np.array(cell) * cell_edge_m
        nearest = np.clip(centre, low, low + cell_edge_m)
        return bool(np.linalg.norm(nearest - centre) <= radius_m)

    return is_near


def cell_at(position_m: Sequence[float], cell_edge_m: float) -> Cell:
    """The cell that holds a position in the map's frame, or the outermost one in that direction."""
    return Cell(*(max(-CELL_LIMIT, min(CELL_LIMIT - 1, math.floor(value / cell_edge_m))) for value in position_m))


def rings_between(cell: tuple[int, int, int], near: Cell | None) -> int:
    """How far a cell is from one, in cells along the farthest axis; 0 where there is none."""
    return max(abs(a - b) for a, b in zip(cell, near, strict=True)) if near is not None else 0
