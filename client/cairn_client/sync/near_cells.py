"""Cells near a robot: those that it wants at all, and their order."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from cairn_client.sync.indexed_cells import IndexedCells
from cairn_map.evidence.cell_order import first_to_last
from cairn_map.evidence.grid import CELL_LIMIT, Cell

Wanted = Callable[[Cell], bool]
"""True for a cell that a low-end robot keeps."""


def within(position_m: npt.ArrayLike, *, radius_m: float, cell_edges_m: npt.ArrayLike) -> Wanted:
    """Cells, of edges along x, y and z, of which some point lies within a radius of a position."""
    centre, edges_m = np.asarray(position_m, dtype=np.float64), np.asarray(cell_edges_m, dtype=np.float64)

    def is_near(cell: Cell) -> bool:
        low = np.array(cell) * edges_m
        nearest = np.clip(centre, low, low + edges_m)
        return bool(np.linalg.norm(nearest - centre) <= radius_m)

    return is_near


def cell_at(position_m: Sequence[float], cell_edges_m: Sequence[float]) -> Cell:
    """The cell, of edges along x, y and z, that holds a position, or the outermost one in that direction."""
    numbers = (math.floor(value / edge_m) for value, edge_m in zip(position_m, cell_edges_m, strict=True))
    return Cell(*(max(-CELL_LIMIT, min(CELL_LIMIT - 1, number)) for number in numbers))


def in_order(listed: IndexedCells, near: Cell | None) -> npt.NDArray[np.uint64]:
    """(N,) numbers of the cells: those around a cell first, and hot ones before others (`cell_order`)."""
    table = listed.table
    order = first_to_last(listed.cells, near=near, changed=table["lm"], hottest_k=table["hottest_k"])
    keys: npt.NDArray[np.uint64] = table["key"][order]
    return keys
