"""Rendering of a map that reads cells on demand: only those that a ray reaches are read.

An unread cell counts as solid rock. A ray that hits one requests it; then the image is rendered again, until no ray
hits an unread cell. All that lies behind walls, or outside of the view, stays unread.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cairn_map.arrays import Floats
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.compact_cell import sums_of
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.frozen_map import FrozenMap
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.occupancy_states import CellStates, bricks_of, state_grid, words_of_cell
from cairn_map.queries.point_queries import first_of_kind
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.map_render import CellTables, MapRenderer, SurfaceImage
from cairn_map.render.node_tables import Table, drawn_in_colours, mean_table, probability_table
from cairn_map.render.render_picture import Layer

ALL_OCCUPIED = np.full((1, 8, 2), ~np.uint64(0), np.uint64)
"""Words of the one brick of which unread cells are made."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadCell:
    """A cell, ready to be drawn in one layer; immutable.

    Its sums are dropped, but for those that the layer shows: a third of the memory, so that a cache holds three times
    as many cells.
    """

    cell: BrickCell
    """Its bricks, all sums zero."""
    states: CellStates
    tables: CellTables

    @property
    def size_bytes(self) -> int:
        """Memory held."""
        tables = sum(table.nbytes for table in self.tables.tables.values())
        return self.cell.counts.brick_of.nbytes + self.states.size_bytes + tables


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """The surfaces that a camera sees, and the map of the cells that were read for it."""

    snapshot: MapSnapshot
    seen: SurfaceImage


def read_cell(cell: BrickCell, geometry: Geometry, model: SensorModel, layer: Layer) -> ReadCell:
    """A cell's states under a model, and the readings of its nodes in a layer.

    Raises:
        BadInputError: kind `unknown_channel`: the map has no such layer.
    """
    table: dict[Hashable, Table] = {}
    match layer:
        case Layer.PROBABILITY:
            table = {model: probability_table(cell, model)}
        case Layer.TEMPERATURE | Layer.COLOUR:
            is_warmth = layer is Layer.TEMPERATURE
            channel = first_of_kind(geometry, ChannelKind.TEMPERATURE) if is_warmth else drawn_in_colours(geometry)
            table = {channel: mean_table(cell, channel, geometry)}
    zeros = cell.zeros()
    states = CellStates(sums_of(zeros), bricks_of(cell.counts), words_of_cell(cell, model))
    return ReadCell(zeros, states, CellTables(sums_of(zeros), zeros.counts.brick_of, table))


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
    """Drawing of a map from a camera; cells of `unread` are read when a ray reaches them.

    Args:
        renderer: for this drawing alone.
        geometry: of the map.
        model: of the map.
        here: cells that are read already.
        unread: keys of the other cells that may be seen.
        read: reads the cells of some of these keys.
        sight: the camera.
        T_map_camera: (4, 4) rigid.
        range_max_m: no ray goes farther.
    """
    # Each turn reads at least one cell, or ends.
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
    """The cells that are read in the first slots, then those that are not, solid."""
    nothing = read_cell(BrickCell(geometry), geometry, model, Layer.DEPTH)
    cells = [*have.values(), *(nothing for _ in left)]
    keys = (*have, *left)
    states = tuple(each.states for each in cells)
    grid = state_grid([cell_of_key(key) for key in keys], states, geometry)
    # All bricks of unread cells share one brick, in which every voxel is occupied.
    grid.bricks[len(have) :] = len(grid.words)
    grid = grid._replace(words=np.concatenate([grid.words, ALL_OCCUPIED]))
    return MapSnapshot(FrozenMap(geometry, model, keys, tuple(each.cell for each in cells), states, grid))
