"""Drawing a map of which only some cells are read yet: those that a ray comes to are read, and no others.

An unread cell is as solid as rock to a ray. What hits one says that it is to be read; then the picture is made anew,
until no ray hits any. Whatever lies behind walls, or beside the view, stays unread.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cairn_map.brick_cell import BrickCell
from cairn_map.frozen_map import Floats, FrozenMap
from cairn_map.grid import CellKey, Geometry, cell_of_key
from cairn_map.map_render import CellTables, MapRenderer, Seen
from cairn_map.map_snapshot import MapSnapshot
from cairn_map.sensor_model import SensorModel
from cairn_map.sight import Sight
from cairn_map.state_grid import CellStates, state_grid, states_of_counts

ALL_OCCUPIED = np.full((1, 8, 2), ~np.uint64(0), np.uint64)


@dataclass(frozen=True, slots=True, eq=False)
class ReadCell:
    """A cell, ready to be drawn; nobody changes it."""

    cell: BrickCell
    states: CellStates
    tables: CellTables

    @property
    def size_bytes(self) -> int:
        """Memory held, with tables of all that can be asked."""
        return self.cell.size_bytes + self.states.words.nbytes + 6 * 585 * 4 * len(self.states.words)


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What a camera sees of a map, and the map of the cells that it took to know."""

    snapshot: MapSnapshot
    seen: Seen


def read_cell(cell: BrickCell, model: SensorModel) -> ReadCell:
    """A cell's states under a model."""
    return ReadCell(cell, states_of_counts(cell.counts, model), CellTables(cell.counts, cell.samples))


def draw_as_needed(
    renderer: MapRenderer,
    geometry: Geometry,
    model: SensorModel,
    here: Mapping[CellKey, ReadCell],
    unread: Collection[CellKey],
    read: Callable[[Sequence[CellKey]], Mapping[CellKey, ReadCell]],
    *,
    sight: Sight,
    T_map_camera: Floats,
    range_max_m: float,
) -> Drawing:
    """What a camera sees; cells of `unread` are read when a ray comes to them.

    Args:
        renderer: for this drawing alone.
        geometry: of the map.
        model: of the map.
        here: cells that are read already.
        unread: the others that may be seen.
        read: brings some of them.
        sight: the camera.
        T_map_camera: (4, 4) rigid.
        range_max_m: no ray goes farther.
    """
    have, left = dict(here), sorted(set(unread) - set(here))
    while True:
        for key, known in have.items():
            renderer.kept[key] = known.tables
        snapshot = _partial(geometry, model, have, left)
        seen = renderer.nearest(snapshot, sight, T_map_camera, range_max_m=range_max_m)
        slots = np.unique(seen.slots)
        wanted = [left[slot - len(have)] for slot in slots.tolist() if slot >= len(have)]
        if not wanted:
            return Drawing(snapshot, seen)
        have.update(read(wanted))
        left = [key for key in left if key not in have]


def _partial(
    geometry: Geometry, model: SensorModel, have: Mapping[CellKey, ReadCell], left: Sequence[CellKey]
) -> MapSnapshot:
    """The cells at hand in the first slots, then those that are not, solid."""
    nothing = read_cell(BrickCell(geometry), model)
    cells = [*have.values(), *(nothing for _ in left)]
    keys = (*have, *left)
    states = tuple(each.states for each in cells)
    grid = state_grid([cell_of_key(key) for key in keys], states, geometry)
    grid.bricks[len(have) :] = len(grid.words)
    grid = grid._replace(words=np.concatenate([grid.words, ALL_OCCUPIED]))
    return MapSnapshot(FrozenMap(geometry, model, keys, tuple(each.cell for each in cells), states, grid))
