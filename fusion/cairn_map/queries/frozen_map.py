"""Frozen maps: the cells and states of a map at one instant, in the layout that all queries read.

Cells share their arrays with the live map, which copies an array before it adds to it. So freezing costs only the
states of the cells that changed since the last time, and readers need no lock.

Of a map without epochs the cells are its sums; of one with them they are readings, each of one sensor model and time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.compact_cell import HeldCell, VoxelTimes, has_sums, opened
from cairn_map.evidence.grid import CELL_LIMIT, NANOMETRES, CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.occupancy_kernels import Grid, brick_corners_into
from cairn_map.queries.occupancy_states import CellStates, state_grid, states_of_cell

Box = Sequence[Sequence[float]] | npt.NDArray[np.floating]
"""(2, 3) lowest and highest corner, metres, map frame; infinite where a side is open."""


class FreezableMap(Protocol):
    """A map that can be frozen: an `EvidenceMap`, or the reading of a map with epochs at a time."""

    @property
    def geometry(self) -> Geometry:
        """Voxel edge, cells and channels."""
        ...

    def frozen_cells(self, model: SensorModel, /) -> Mapping[CellKey, HeldCell]:
        """All cells, rising in number, unaffected by later changes of the map; readings are made under this model.

        A cell of which `compact_cell.sums_of` gives the same objects as at the last freeze is not read again.
        """
        ...

    def frozen_times(self) -> VoxelTimes | None:
        """Times of voxels and of their samples, unaffected by later changes of the map; None: it has no epochs."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class FrozenMap:
    """Cells by slot, the states of their voxels under a sensor model, and the grid of these states for kernels."""

    geometry: Geometry
    model: SensorModel
    keys: tuple[CellKey, ...]
    cells: tuple[HeldCell, ...]
    states: tuple[CellStates, ...]
    grid: Grid
    times: VoxelTimes | None = None
    """Times of voxels and of their samples; None: the map has no epochs."""

    @property
    def reach_m(self) -> float:
        """Points must be nearer to the origin than this along every axis."""
        return (CELL_LIMIT - 1) * self.geometry.cell_edge_m

    def on_lattice(self, points_m: Floats) -> Floats:
        """(N, 3) points, of which the heights are stretched where voxels are flat, so that kernels see cubes."""
        geometry = self.geometry
        if not geometry.is_flat:
            return points_m
        points = points_m.copy()
        points[:, 2] *= geometry.voxel_edge_um / geometry.voxel_height_um
        return points

    @property
    def size_bytes(self) -> int:
        """Memory held besides the cells, which it shares with the live map."""
        # The cells' states are parts of the grid's words; each brick has its number besides.
        return self.grid.bricks.nbytes + self.grid.words.nbytes + 2 * len(self.grid.words)

    def bricks(self, slot: int) -> BrickCell:
        """Bricks of the cell in a slot, to be read; of one that is held as bytes, decoded now."""
        return opened(self.cells[slot])

    def brick_corners(self) -> Ints:
        """(B, 3) first voxels of all bricks."""
        corners = np.empty((len(self.grid.words), 3), np.int64)
        brick_corners_into(self.grid, corners)
        return corners

    def voxels_of_box(self, box_m: Box | None) -> tuple[Ints, Ints]:
        """Range of the voxels whose centres lie in a box: low and high (3,), high exclusive, within all cells' box.

        Raises:
            BadInputError: kind `bad_box`: not two corners, the lower first.
        """
        if box_m is None:
            return self.grid.low, self.grid.high
        box = np.asarray(box_m, np.float64)
        if box.shape != (2, 3) or not (box[0] <= box[1]).all():
            raise BadInputError("bad_box", f"a box is its lowest and its highest corner, (2, 3) metres; got {box_m!r}")
        box, edge_nm = self.on_lattice(box), self.grid.edge_nm
        limit_nm = self.reach_m * NANOMETRES
        nanometres = np.rint(np.clip(box * NANOMETRES, -limit_nm, limit_nm)).astype(np.int64)
        # The first centre, edge / 2 above a voxel's border, that is not below the corner.
        numbers = -((edge_nm - 2 * nanometres) // (2 * edge_nm))
        low, high = np.clip(numbers, self.grid.low, self.grid.high)
        return low, high


def freeze(whole: FreezableMap, model: SensorModel, *, earlier: FrozenMap | None = None) -> FrozenMap:
    """The map as it is now; states of cells that are unchanged since `earlier` are taken from it."""
    held = whole.frozen_cells(model)
    keys, cells = tuple(held), tuple(held.values())
    known: dict[CellKey, CellStates] = {}
    if earlier is not None and earlier.model == model:
        known = dict(zip(earlier.keys, earlier.states, strict=True))
    states = tuple(
        old if (old := known.get(key)) is not None and has_sums(cell, old.sums) else states_of_cell(cell, model)
        for key, cell in zip(keys, cells, strict=True)
    )
    grid = state_grid([cell_of_key(key) for key in keys], states, whole.geometry)
    # Each cell's states are a part of the grid's from here on: else all of them would be held twice.
    parts = np.split(grid.words, np.cumsum([len(state.words) for state in states[:-1]], dtype=np.int64))
    shared = tuple(replace(state, words=words) for state, words in zip(states, parts, strict=False))
    return FrozenMap(whole.geometry, model, keys, cells, shared, grid, whole.frozen_times())


def as_points(values: npt.ArrayLike, what: str) -> Floats:
    """(N, 3) float64, row by row.

    Raises:
        BadInputError: kind `bad_points`: another shape, or no numbers.
    """
    try:
        points = np.require(values, np.float64, ["C", "A", "W"])  # kernels are compiled for such alone
    except (TypeError, ValueError) as exc:
        raise BadInputError("bad_points", f"{what} must be numbers, (N, 3)") from exc
    if points.ndim != 2 or points.shape[1] != 3:
        raise BadInputError("bad_points", f"{what} must be (N, 3), got {points.shape}")
    return points


def check_within(inside: bool, frozen: FrozenMap) -> None:
    """Refuse points that a kernel found outside of the numbered space.

    Raises:
        BadInputError: kind `point_range`.
    """
    if not inside:
        raise BadInputError(
            "point_range", f"points must be finite and within {frozen.reach_m:.0f} m of the origin along every axis"
        )
