"""Drawing a map of which only some cells are read yet: those that a ray comes to are read, and no others.

An unread cell is as solid as rock to a ray. What hits one says that it is to be read; then the picture is made anew,
until no ray hits any. Whatever lies behind walls, or beside the view, stays unread.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cairn_map.arrays import Floats
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.frozen_map import FrozenMap
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.occupancy_states import CellStates, state_grid, states_of_counts
from cairn_map.queries.point_queries import first_of_kind
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.map_render import CellTables, MapRenderer, SurfaceImage
from cairn_map.render.node_tables import Table, mean_table, probability_table
from cairn_map.render.render_picture import Layer

ALL_OCCUPIED = np.full((1, 8, 2), ~np.uint64(0), np.uint64)


@dataclass(frozen=True, slots=True, eq=False)
class ReadCell:
    """A cell, ready to be drawn in one layer; nobody changes it.

    Of its sums nothing is kept but what that layer shows: a third of the memory, so that a cache holds thrice as many.
    """

    cell: BrickCell
    """Its bricks, all sums zero."""
    states: CellStates
    tables: CellTables

    @property
    def size_bytes(self) -> int:
        """Memory held."""
        tables = sum(table.nbytes for table in self.tables.tables.values())
        return self.cell.counts.brick_of.nbytes + self.states.words.nbytes + tables


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What a camera sees of a map, and the map of the cells that it took to know."""

    snapshot: MapSnapshot
    seen: SurfaceImage


def read_cell(cell: BrickCell, geometry: Geometry, model: SensorModel, layer: Layer) -> ReadCell:
    """A cell's states under a model, and what its nodes read in a layer.

    Raises:
        BadInputError: kind `unknown_channel`: the map has no such layer.
    """
    table: dict[Hashable, Table] = {}
    match layer:
        case Layer.PROBABILITY:
            table = {model: probability_table(cell, model)}
        case Layer.TEMPERATURE | Layer.COLOUR:
            kind = ChannelKind.TEMPERATURE if layer is Layer.TEMPERATURE else ChannelKind.COLOUR
            channel = first_of_kind(geometry, kind)
            table = {channel: mean_table(cell, channel, geometry)}
    zeros, words = cell.zeros(), states_of_counts(cell.counts, model).words
    return ReadCell(zeros, CellStates(zeros.counts, words), CellTables(zeros.counts, zeros.samples, table))


def draw_as_needed(
    renderer: MapRenderer,
    geometry: Geometry,
    model: SensorModel,
    here: Mapping[CellKey, ReadCell],
    unread: Collection[CellKey],
    read: Callable[[Sequence[CellKey]], Mapping[CellKey, ReadCell]],
    *,
    sight: CameraRays,
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
    nothing = read_cell(BrickCell(geometry), geometry, model, Layer.DEPTH)
    cells = [*have.values(), *(nothing for _ in left)]
    keys = (*have, *left)
    states = tuple(each.states for each in cells)
    grid = state_grid([cell_of_key(key) for key in keys], states, geometry)
    grid.bricks[len(have) :] = len(grid.words)
    grid = grid._replace(words=np.concatenate([grid.words, ALL_OCCUPIED]))
    return MapSnapshot(FrozenMap(geometry, model, keys, tuple(each.cell for each in cells), states, grid))
