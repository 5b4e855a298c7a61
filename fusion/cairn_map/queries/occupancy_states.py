"""Occupancy states of a map: unknown, free or occupied under one sensor model, as bits for kernels.

One brick of 512 voxels is 128 bytes here and 2048 in the map: the whole of a building fits a processor's cache.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Words
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.brick_counts import BrickCounts
from cairn_map.evidence.compact_cell import HeldCell, opened, sums_of
from cairn_map.evidence.grid import Cell, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, known, log_odds
from cairn_map.queries import occupancy_kernels as kernels
from cairn_map.queries.occupancy_kernels import Grid

HASH_BITS_MIN = 4
"""Bits of the smallest hash table."""


class State(IntEnum):
    """Occupancy of a voxel."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


@dataclass(frozen=True, slots=True, eq=False)
class CellStates:
    """States of one cell's bricks, and the sums from which they were made."""

    sums: tuple[object, ...]
    """`compact_cell.sums_of` the cell."""
    bricks: npt.NDArray[np.uint16]
    """(B,) Morton numbers of the bricks."""
    words: Words
    """(B, 8, 2) bits, laid out as in `occupancy_kernels.Grid`."""

    @property
    def size_bytes(self) -> int:
        """Memory held."""
        return self.bricks.nbytes + self.words.nbytes


def states_of_cell(cell: HeldCell, model: SensorModel) -> CellStates:
    """The states of one cell; one that is held as bytes is decoded for it."""
    bricks = opened(cell)
    return CellStates(sums_of(cell), bricks_of(bricks.counts), words_of_cell(bricks, model))


def bricks_of(counts: BrickCounts) -> npt.NDArray[np.uint16]:
    """(B,) Morton numbers of the bricks, in the order of the pool."""
    (numbers,) = np.nonzero(counts.brick_of >= 0)
    bricks = np.empty(len(counts.pool), np.uint16)
    bricks[counts.brick_of[numbers]] = numbers
    return bricks


def words_of_cell(cell: BrickCell, model: SensorModel) -> Words:
    """(B, 8, 2) states of one cell, as bits; exactly those of `Evidence.occupied`.

    Raises:
        ValueError: the cell is a reading under another sensor model.
    """
    pool = cell.counts.pool
    words = np.empty((len(pool), 8, 2), np.uint64)
    if cell.odds is not None:
        cell.odds.check_model(model)
        kernels.states_of_odds_into(pool, cell.odds.steps, words)
    elif pool.dtype == np.int16:
        tables = odds_of_counts(model)  # pyright: ignore[reportArgumentType]
        kernels.states_of_counts_into(pool, *tables, log_odds(model.p_occupied), words)
    else:
        rows = pool.reshape(-1, 2)
        for n, bits in ((kernels.OCCUPIED_BITS, model.occupied(rows)), (kernels.KNOWN_BITS, known(rows))):
            words[..., n] = np.packbits(bits, bitorder="little").view("<u8").reshape(-1, 8)
    return words


def state_grid(cells: Sequence[Cell], states: Sequence[CellStates], geometry: Geometry) -> Grid:
    """One grid of many cells' states; slots are in the order of `cells`."""
    C = len(cells)
    numbers_of_cells = np.array(cells, np.int64).reshape(C, 3)
    hash_bits = max(HASH_BITS_MIN, (4 * C).bit_length())
    numbers, slots = np.full(1 << hash_bits, -1, np.int64), np.zeros(1 << hash_bits, np.int32)
    kernels.fill_table_into(numbers_of_cells, numbers, slots, 64 - hash_bits)
    bricks = np.full((C, 8 ** (geometry.depth - 3)), kernels.NONE, np.int32)
    first = 0
    for slot, cell in enumerate(states):
        bricks[slot, cell.bricks] = np.arange(first, first + len(cell.bricks), dtype=np.int32)
        first += len(cell.bricks)
    words = np.concatenate([np.empty((0, 8, 2), np.uint64), *(cell.words for cell in states)])
    nothing = np.zeros(3, np.int64)
    low, high = (numbers_of_cells.min(axis=0), numbers_of_cells.max(axis=0) + 1) if C else (nothing, nothing)
    return Grid(
        edge_nm=geometry.voxel_edge_um * 1000,
        depth=geometry.depth,
        numbers=numbers,
        slots=slots,
        hash_shift=64 - hash_bits,
        cells=numbers_of_cells,
        low=low * geometry.side,
        high=high * geometry.side,
        bricks=bricks,
        words=words,
    )


@lru_cache(maxsize=4)
def odds_of_counts(model: SensorModel) -> tuple[Floats, Floats]:
    """Log-odds of each number of hits, and of misses: (65536,) each, by the 16 bits of a count."""
    counts = np.arange(1 << 16, dtype=np.uint16).view(np.int16)
    hits, misses = (np.multiply(counts, log_odds(p), dtype=np.float64) for p in (model.p_hit, model.p_miss))
    return hits, misses
