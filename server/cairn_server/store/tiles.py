"""Tiles: groups of 4^3 cells, and sums over them, so that no request reads a row for each cell of a map.

    map     totals: cells, bytes, those of history, sum of fingerprints, corner cells
    tile    newest change, cells, bytes, those of history, sum of fingerprints of its 64 cells
    cell

A fold and a heal keep them up in the transaction that writes the cells. The cells that changed since a log entry are
in the tiles that did; the sum of a box is that of the tiles inside it and of the cells of those at its border.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CELL_LIMIT, Cell, CellKey, cell_of_key, cells_of_keys
from cairn_map.kernels.morton_kernels import UInts, deinterleave, interleave
from cairn_server.store.store_rows import CellRow

TILE_BITS = 6
"""Bits of a cell's number that its tile's lacks: two for each axis."""
EDGE_BITS = TILE_BITS // 3
BOX_TILES_MAX = 4096
"""Tiles of a box that are looked up by their numbers; of a larger box those that the map has are looked through."""

Box = tuple[Cell, Cell]
"""Lowest and highest cell, both included."""
Corners = tuple[tuple[int, int, int], tuple[int, int, int]]
"""Lowest and highest index of cells along each axis, both included."""


def tile_of(key: int) -> int:
    """Number of a cell's tile."""
    return key >> TILE_BITS


def tiles_of(keys: Iterable[int]) -> list[int]:
    """Numbers of the tiles of these cells, each once, rising."""
    return sorted({tile_of(key) for key in keys})


def first_and_last_key(tile: int) -> tuple[int, int]:
    """Numbers of the first and the last cell of a tile."""
    return tile << TILE_BITS, ((tile + 1) << TILE_BITS) - 1


def is_in_box(keys: UInts, box: Box) -> npt.NDArray[np.bool_]:
    """(N,) True for each of N cells that lies in a box."""
    indices = cells_of_keys(keys)
    return np.asarray(((indices >= box[0]) & (indices <= box[1])).all(axis=1), np.bool_)


def tiles_in_box(box: Box) -> list[int] | None:
    """Numbers of all tiles that a box touches, rising; None: there are more than `BOX_TILES_MAX`."""
    low, high = (np.array(corner, np.int64) + CELL_LIMIT >> EDGE_BITS for corner in box)
    counts = high - low + 1
    if (counts <= 0).any():
        return []
    if float(counts.astype(np.float64).prod()) > BOX_TILES_MAX:
        return None
    axes = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)), indexing="ij")
    return sorted(interleave(np.stack([axis.ravel() for axis in axes], axis=1)).tolist())


def touches_box(tiles: UInts, box: Box) -> npt.NDArray[np.bool_]:
    """(N,) True for each of N tiles that has a cell in a box."""
    at = deinterleave(tiles)
    low, high = (np.array(corner, np.int64) + CELL_LIMIT >> EDGE_BITS for corner in box)
    return np.asarray(((at >= low) & (at <= high)).all(axis=1), np.bool_)


def is_inside_box(tiles: UInts, box: Box) -> npt.NDArray[np.bool_]:
    """(N,) True for each of N tiles whose cells all lie in a box."""
    first = (deinterleave(tiles) << EDGE_BITS) - CELL_LIMIT
    last = first + (1 << EDGE_BITS) - 1
    return np.asarray(((first >= box[0]) & (last <= box[1])).all(axis=1), np.bool_)


@dataclass(frozen=True, slots=True)
class TileSums:
    """Sums over the cells of a tile, or of a map."""

    lm: int = 0
    """Log entry that changed one of them last."""
    cells: int = 0
    """Those with a known voxel."""
    size_bytes: int = 0
    """Bytes of these cells, encoded."""
    fingerprint: Fingerprint = ZERO
    """Sum of their fingerprints."""
    history_bytes: int = 0
    """Bytes, of these, of rows that are older than the newest one of their cell."""

    def __add__(self, more: "TileSums") -> "TileSums":
        return TileSums(
            max(self.lm, more.lm),
            self.cells + more.cells,
            self.size_bytes + more.size_bytes,
            self.fingerprint + more.fingerprint,
            self.history_bytes + more.history_bytes,
        )

    def __sub__(self, less: "TileSums") -> "TileSums":
        return TileSums(
            self.lm,
            self.cells - less.cells,
            self.size_bytes - less.size_bytes,
            self.fingerprint - less.fingerprint,
            self.history_bytes - less.history_bytes,
        )


def change_of(before: CellRow | None, after: CellRow) -> TileSums:
    """Change of the sums by a cell that is written."""
    was, now = bool(before and before.voxels), bool(after.voxels)
    size_before, history_before = (before.size_bytes, before.history_bytes) if before and was else (0, 0)
    return TileSums(
        after.lm,
        now - was,
        (after.size_bytes if now else 0) - size_before,
        after.fingerprint - (before.fingerprint if before else ZERO),
        (after.history_bytes if now else 0) - history_before,
    )


@dataclass(slots=True)
class TileChanges:
    """Changes of a map's tiles and corners by cells that are written, one after the other."""

    corners: Corners | None
    """Corners of the cells with a voxel, before these changes and then after each; None: there is none."""
    tiles: dict[int, TileSums] = field(default_factory=dict)
    """Change of each tile."""
    total: TileSums = TileSums()
    has_emptied_border: bool = False
    """True if a cell at the corners lost its last voxel: `corners_of` finds them again."""

    def add(self, before: CellRow | None, after: CellRow) -> None:
        """Count a cell that is written in the place of another one, or of none."""
        change = change_of(before, after)
        tile = tile_of(after.key)
        self.tiles[tile] = self.tiles.get(tile, TileSums()) + change
        self.total += change
        if change.cells == 0:
            return
        cell = cell_of_key(after.key)
        if change.cells > 0:
            low, high = self.corners or (cell, cell)
            self.corners = _each(min, low, cell), _each(max, high, cell)
        elif self.corners and any(n in ends for n, *ends in zip(cell, *self.corners, strict=True)):
            self.has_emptied_border = True


def corners_of(tiles: UInts, keys_of: Callable[[list[int]], Iterable[CellKey]]) -> Corners | None:
    """Corners of the cells with a voxel.

    Args:
        tiles: numbers of the tiles with such cells.
        keys_of: such cells of these tiles; asked for those at the border only.
    """
    if not len(tiles):
        return None
    at = deinterleave(tiles)
    is_border = ((at == at.min(axis=0)) | (at == at.max(axis=0))).any(axis=1)
    cells = cells_of_keys(np.array(list(keys_of(tiles[is_border].tolist())), np.uint64))
    low, high = cells.min(axis=0).tolist(), cells.max(axis=0).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _each(choose: Callable[[int, int], int], a: tuple[int, int, int], b: tuple[int, int, int]) -> tuple[int, int, int]:
    return choose(a[0], b[0]), choose(a[1], b[1]), choose(a[2], b[2])
