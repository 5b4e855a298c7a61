"""A level as a camera sees it: its surfaces at their own heights, coloured by height, slope, step or difficulty.

    cells = {key: ground_cell(evidence, key, geometry, model)}       what is drawn of each: surfaces and obstacles
    ground = ground_columns(cells, geometry)                              columns, with what those around them say
    image = ground.seen(sight, T_map_camera, range_max_m=50)         for each pixel the surface that it sees
    layer_picture(image.values(Layer.SLOPE), image.seen, scale, shade=image.shade)

Surfaces and what is next to them are those of the page's level: a bridge stays over its road, and an obstacle, which
has no slope, is grey. Limits are those of a usual vehicle.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Flags, Floats, Int32s, Words32
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import HEIGHT_OFFSET, ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_map.queries.level.elevation import CLEARANCE_M, PLANE_MIN, STANDARD_VEHICLE
from cairn_map.queries.level.shown_surfaces import shown_surfaces
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.point_queries import first_of_kind
from cairn_map.render.camera_rays import CameraRays, checked_pose
from cairn_map.render.ground_kernels import Columns, see_ground_into, surroundings_into
from cairn_map.render.map_picture import Ages, not_level_error
from cairn_map.render.map_render import SurfaceImage, changed_at
from cairn_map.render.render_picture import GROUND_LAYERS, Layer

Item = TypeVar("Item", bound=np.generic)
FALL_MAX_M = 0.6
"""Surfaces are solid down to the lowest one around, but not as deep as this: below is another surface, or a hole."""
COLUMNS_MAX = 1 << 22
"""Columns of the cells of one picture, and of its table of cells. With `SPANS_MAX` 170 MB while it is made."""
SPANS_MAX = 1 << 20
"""Surfaces and obstacles of one picture."""
SHADE = 0.5
"""Change of brightness where the ground falls by its own width towards the lower right."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundCell:
    """Surfaces and obstacles of one cell of a level; immutable."""

    places: Words32
    """(R,) Morton codes inside the cell."""
    tops_m: Floats
    """(R,) height of each surface, and of the upper face of each obstacle's voxel, metres, map frame."""
    is_ground: Flags
    """(R,) True for surfaces."""
    odds: Floats
    """(R,) log-odds."""

    @property
    def size_bytes(self) -> int:
        """Memory held."""
        return self.places.nbytes + self.tops_m.nbytes + self.is_ground.nbytes + self.odds.nbytes


@dataclass(frozen=True, slots=True, eq=False)
class GroundImage:
    """Image of the ground that a camera sees."""

    ground: "GroundColumns"
    seen: SurfaceImage
    rows: Int32s
    """(H, W) span that each pixel sees, `NO_ROW` for none."""

    @property
    def shade(self) -> Floats:
        """(H, W) brightness, 1 for what is level or has no slope: slopes show as if light came from the upper left."""
        return self._of(1.0 + SHADE * np.clip(np.nan_to_num(self.ground.fall_x), -1.0, 1.0))

    def values(self, layer: Layer, ages: Ages | None = None) -> npt.NDArray[np.floating]:
        """(H, W) metres, degrees, 1 or seconds of a layer; NaN where nothing is seen, or it has no such value.

        Raises:
            BadInputError: kind `unknown_channel`: a level has no temperatures and no colours.
        """
        check_layer(self.ground.geometry, layer)
        match layer:
            case Layer.DEPTH:
                return self.seen.depth_m
            case Layer.AGE:
                if ages is None:
                    return np.full_like(self.seen.range_m, np.nan)
                return np.maximum(ages.now - changed_at(self.ground.keys, self.seen, ages.changes), 0)
            case Layer.HEIGHT:
                return self._of(self.ground.columns.tops)
            case Layer.SLOPE:
                return np.degrees(self._of(self.ground.around[:, 0]))
            case Layer.STEP:
                return self._of(self.ground.around[:, 2])
            case Layer.DIFFICULTY:
                return self._of(self.ground.difficulty)
            case _:
                with np.errstate(over="ignore"):
                    return self._of(1 / (1 + np.exp(-self.ground.odds)))

    def _of(self, values: Floats) -> Floats:
        """Values of the spans that are seen; NaN where none is."""
        found: Floats = np.append(values, np.nan)[self.rows]
        return found


@dataclass(frozen=True, slots=True, eq=False)
class GroundColumns:
    """Columns of a level's cells, rising in height, and what the columns around each surface say."""

    geometry: Geometry
    keys: tuple[CellKey, ...]
    columns: Columns
    slots: Int32s
    """(R,) index of each span's cell among the keys."""
    places: Words32
    """(R,) its Morton code there."""
    odds: Floats
    around: Floats
    """(R, 5) slope in radians, roughness, step, fall and obstacle in metres, of surfaces."""
    fall_x: Floats
    """(R,) fall towards the lower right, in parts of a column's width."""

    @property
    def difficulty(self) -> Floats:
        """(R,) the largest of slope, roughness, step and obstacle in parts of a usual vehicle's limits; NaN: none."""
        vehicle, (slope, roughness, step, _, obstacle) = STANDARD_VEHICLE, self.around.T
        found = np.fmax(slope / vehicle.slope_max_rad, roughness / vehicle.roughness_max_m)
        largest: Floats = np.fmax(found, np.maximum(step, obstacle) / vehicle.step_max_m)
        return largest

    def seen(
        self,
        sight: CameraRays,
        T_map_camera: npt.ArrayLike,
        *,
        range_max_m: float,
        on_share: Callable[[], None] = lambda: None,
    ) -> GroundImage:
        """The first surface or obstacle along each ray; `on_share` is called before each 8 rows, and may raise.

        Raises:
            BadInputError: kinds `bad_pose`, `bad_range`.
        """
        T = checked_pose(T_map_camera, reach_m=(CELL_LIMIT - 1) * self.geometry.cell_edges_m[2])
        if not 0 < range_max_m < np.inf:
            raise BadInputError("bad_range", f"the range must be above 0 and finite, metres; got {range_max_m}")
        H, W = sight.height, sight.width
        ranges, rows = np.empty((H, W), np.float32), np.empty((H, W), np.int32)
        for y in range(0, H, 8):
            on_share()
            rays, part = sight.rays[y : y + 8].reshape(-1, 3), slice(y * W, (y + 8) * W)
            see_ground_into(self.columns, T, rays, range_max_m, ranges.reshape(-1)[part], rows.reshape(-1)[part])
        slots = np.append(self.slots, np.int32(-1))[rows]
        places = np.append(self.places, np.uint32(0))[rows]
        return GroundImage(self, SurfaceImage(sight, ranges, slots, places, np.zeros((H, W), np.uint8)), rows)


def check_layer(geometry: Geometry, layer: Layer) -> None:
    """Refuse a layer that a map cannot be drawn in.

    Raises:
        BadInputError: kind `not_level`: heights, slopes, steps and difficulties of a layer of cubes; `unknown_channel`:
            a level has no temperatures and no colours.
    """
    if layer in GROUND_LAYERS and not geometry.is_flat:
        raise not_level_error(layer)
    if geometry.is_flat and layer in (Layer.TEMPERATURE, Layer.COLOUR):
        first_of_kind(geometry, ChannelKind.TEMPERATURE if layer is Layer.TEMPERATURE else ChannelKind.COLOUR)


def ground_cell(evidence: Evidence, key: CellKey, geometry: Geometry, model: SensorModel) -> GroundCell:
    """Surfaces and obstacles of a level's cell."""
    shown = shown_surfaces(evidence, geometry, model)
    height_m = geometry.voxel_height_m
    lower = deinterleave(shown.voxels.astype(np.uint64))[:, 2] + cell_of_key(key).k * geometry.side
    tops_m: Floats = (lower + 1) * np.float64(height_m)
    is_ground = np.zeros(len(shown), np.bool_)
    total, votes = shown.samples[:, geometry.planes_of(HEIGHT_OFFSET.name)].T
    is_ground[shown.sampled] = True
    tops_m[shown.sampled] = lower[shown.sampled] * height_m + total / votes * (HEIGHT_OFFSET.step / 1000)
    return GroundCell(shown.voxels, tops_m, is_ground, shown.log_odds(model).astype(np.float64))


def ground_columns(cells: Mapping[CellKey, GroundCell], geometry: Geometry) -> GroundColumns:
    """Columns of some cells, in which those that lie above each other are one.

    Raises:
        BadInputError: kind `too_large`: too many columns or surfaces for one picture.
    """
    keys, parts = tuple(cells), list(cells.values())
    places = _joined([each.places for each in parts], np.uint32)
    slots = np.repeat(np.arange(len(parts), dtype=np.int32), [len(each.places) for each in parts])
    tables, first, table_of, T = _tables([cell_of_key(key)[:2] for key in keys])
    side = geometry.side
    if T * side * side > COLUMNS_MAX or len(places) > SPANS_MAX:
        raise BadInputError(
            "too_large",
            f"{T} columns of cells, of {side * side} each, and {len(places)} surfaces are in sight; lower range_m",
        )
    # Spans by table and column, from below.
    tops, is_ground = (
        _joined([each.tops_m for each in parts], np.float64),
        _joined([each.is_ground for each in parts], np.bool_),
    )
    numbers = deinterleave(places.astype(np.uint64))
    columns_of = table_of[slots] * (side * side) + numbers[:, 1] * side + numbers[:, 0]
    order = np.lexsort((tops, columns_of))
    tops, is_ground, slots, places = tops[order], is_ground[order], slots[order], places[order]
    ends = np.searchsorted(columns_of[order], np.arange(T * side * side + 1)).astype(np.int32)
    starts = np.concatenate([ends[:-1].reshape(T, side * side), ends[side * side :: side * side, None]], axis=1)
    columns = Columns(
        tables, first, geometry.depth, geometry.voxel_edge_m, starts, np.empty(T), np.empty(T), tops, tops, is_ground
    )
    around, fall_x = np.empty((len(tops), 5)), np.empty(len(tops))
    surroundings_into(columns, PLANE_MIN, FALL_MAX_M, CLEARANCE_M, around, fall_x)
    bottoms = tops - np.fmax(np.where(is_ground, around[:, 3], 0.0), geometry.voxel_height_m)
    ranges = [slice(*each) for each in zip(starts[:, 0].tolist(), starts[:, -1].tolist(), strict=True)]
    lows = np.array([bottoms[each].min(initial=np.inf) for each in ranges])
    highs = np.array([tops[each].max(initial=-np.inf) for each in ranges])
    columns = columns._replace(bottoms=bottoms, lows=lows, highs=highs)
    odds = _joined([each.odds for each in parts], np.float64)[order]
    return GroundColumns(geometry, keys, columns, slots, places, odds, around, fall_x)


def snapshot_ground(snapshot: MapSnapshot, are_wanted: Flags | None = None) -> GroundColumns:
    """Columns of a level's snapshot: of all cells, or of those of its (C,) cells that are wanted.

    Raises:
        BadInputError: kind `too_large`.
    """
    frozen = snapshot.frozen
    wanted = np.ones(len(frozen.keys), np.bool_) if are_wanted is None else are_wanted
    return ground_columns(
        {
            key: ground_cell(cell.packed(), key, frozen.geometry, frozen.model)
            for key, cell, is_wanted in zip(frozen.keys, frozen.cells, wanted.tolist(), strict=True)
            if is_wanted
        },
        frozen.geometry,
    )


def _tables(cells: Sequence[tuple[int, int]]) -> tuple[Int32s, npt.NDArray[np.int64], npt.NDArray[np.int64], int]:
    """Tables of columns of cells, (I, J) of one more than each number; the first cell; each cell's number; how many.

    Raises:
        BadInputError: kind `too_large`: the cells lie too far apart for one picture.
    """
    if not cells:
        return np.zeros((1, 1), np.int32), np.zeros(2, np.int64), np.empty(0, np.int64), 0
    places = np.array(cells, np.int64)
    first = places.min(axis=0)
    different, table_of = np.unique(places, axis=0, return_inverse=True)
    width, length = (places.max(axis=0) - first + 1).tolist()
    if width * length > COLUMNS_MAX:
        raise BadInputError(
            "too_large",
            f"the cells in sight span {width} x {length}, {COLUMNS_MAX} at most may be; lower range_m",
        )
    tables = np.zeros((width, length), np.int32)
    tables[tuple((different - first).T)] = np.arange(1, len(different) + 1)
    return tables, first, table_of.reshape(-1), len(different)


def _joined(parts: Sequence[npt.NDArray[Item]], dtype: type[Item]) -> npt.NDArray[Item]:
    return np.concatenate([np.empty(0, dtype), *parts])
