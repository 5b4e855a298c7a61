"""Snapshot of a map, and all queries of it: states and readings at points, rays, collisions, frontiers, layers.

    snapshot = robot.snapshot()
    snapshot.probability_at([[1.0, 2.0, 0.4]])                         # NaN where unknown
    snapshot.cast_rays(origins_m, directions, max_range_m=10).hit
    snapshot.sweep_box(T_map_body, [[-0.4, -0.3, 0.0], [0.4, 0.3, 0.6]]).first_occupied

A snapshot never changes, whatever the robot merges meanwhile: any number of threads may ask it, without a lock. Taking
the next one costs the cells that changed since, and sharing costs the map a copy of each cell that changes.

Points are (N, 3) metres in the map's frame, in anything that NumPy makes float64 of; a voxel is [low, low + edge) along
each axis, so a point on a border is in the upper one. NaN, infinity or a point outside the numbered space raises
`BadInputError` (`point_range`), another shape `bad_points`. A `box_m` is the (2, 3) lowest and highest corner, metres,
map frame, sides may be infinite: it holds the voxels whose centres it holds; without one, the whole map is meant.
Lengths are metres, temperatures kelvin (apparent), colours sRGB 0 to 255. Evidence is read under the snapshot's
`SensorModel`: probabilities are clamped, and a voxel without hits and misses is unknown. Of a map with epochs, what was
seen later outweighs what was seen before, and colours and temperatures are the newest; `seen_at` has the time at which
a voxel was seen last, perhaps by a camera without colour or temperature, `measured_at` that of a colour or temperature.
"""

from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.map_reading import MapReading
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import Cell, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import Reading, Voxels
from cairn_map.queries import body_queries, distance_queries, floor_grid, hot_spots, point_queries, region_queries
from cairn_map.queries.body_queries import PathStates
from cairn_map.queries.distance_queries import Nearest, RayEnds
from cairn_map.queries.floor_grid import Band, FloorGrid
from cairn_map.queries.frozen_map import Box, FreezableMap, FrozenMap, freeze
from cairn_map.queries.hot_spots import Spots
from cairn_map.queries.level.elevation import CLEARANCE_M, Elevation
from cairn_map.queries.occupancy_states import State
from cairn_map.queries.region_queries import MapImage

STANDARD_MODEL = SensorModel()


class MapSnapshot:
    """A map at one instant, under one inverse sensor model; arrays in, arrays out."""

    __slots__ = ("_frozen",)

    def __init__(self, frozen: FrozenMap) -> None:
        self._frozen = frozen

    def __repr__(self) -> str:
        return f"MapSnapshot({len(self._frozen.cells)} cells, {self.geometry})"

    def refreshed(self, whole: FreezableMap) -> Self:
        """Snapshot of the map as it is now; only the cells that changed since this snapshot are read again."""
        return type(self)(freeze(whole, self._frozen.model, earlier=self._frozen))

    @property
    def frozen(self) -> FrozenMap:
        """The frozen cells and states, for queries in other modules such as `map_render`."""
        return self._frozen

    @property
    def geometry(self) -> Geometry:
        """Voxel edge, cells and channels."""
        return self._frozen.geometry

    @property
    def model(self) -> SensorModel:
        """Inverse sensor model under which hits and misses are read."""
        return self._frozen.model

    @property
    def has_times(self) -> bool:
        """True if the map has epochs, so that `seen_at` and `measured_at` have answers."""
        return self._frozen.times is not None

    def state_at(self, points_m: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """(N,) `State`: 0 unknown, 1 free, 2 occupied."""
        return point_queries.states_at(self._frozen, points_m)

    def counts_at(self, points_m: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """(N, 2) hits and misses, in scans; zeros where unknown."""
        return point_queries.counts_at(self._frozen, points_m)

    def log_odds_at(self, points_m: npt.ArrayLike) -> Floats:
        """(N,) ln(p / (1 - p)), clamped; NaN where unknown."""
        return point_queries.log_odds_at(self._frozen, points_m)

    def probability_at(self, points_m: npt.ArrayLike) -> Floats:
        """(N,) probability that the voxel is occupied, clamped; NaN where unknown."""
        return point_queries.probability_at(self._frozen, points_m)

    def reading_at(self, points_m: npt.ArrayLike, channel: str) -> Reading:
        """Reading of a channel: mean (N,) in its unit, or (N, 3) for colours, and weight (N,), in samples.

        The mean is NaN where the weight is 0. Temperatures have a `spread`, too.

        Raises:
            BadInputError: kind `unknown_channel`: the map has no channel of that name.
        """
        return point_queries.reading_at(self._frozen, points_m, point_queries.channel_named(self._frozen, channel))

    def colour_at(self, points_m: npt.ArrayLike) -> Reading:
        """Mean (N, 3) sRGB 0 to 255, and weight, of the map's first colour channel."""
        return self._first_at(points_m, ChannelKind.COLOUR)

    def intensity_at(self, points_m: npt.ArrayLike) -> Reading:
        """Mean (N,) time-of-flight amplitude, counts, and weight, of the map's first intensity channel."""
        return self._first_at(points_m, ChannelKind.INTENSITY)

    def temperature_at(self, points_m: npt.ArrayLike) -> Reading:
        """Mean (N,), standard deviation of the samples (`spread`), kelvin, and weight; first temperature channel."""
        return self._first_at(points_m, ChannelKind.TEMPERATURE)

    def class_at(self, points_m: npt.ArrayLike) -> Reading:
        """Class with the most votes, of the map's channel of classes: its number (`mean`, (N,), NaN without votes), all
        votes (`weight`), True where it leads by less than two (`unsure`), and its name (`class_names`).
        """
        return self._first_at(points_m, ChannelKind.CLASSES)

    def seen_at(self, points_m: npt.ArrayLike) -> Floats:
        """(N,) first instant of the newest epoch in which the voxel was hit or seen through, UTC seconds since 1970.

        NaN where it never was, where it was only without a time, and everywhere in a map without epochs.
        """
        return point_queries.seen_at(self._frozen, points_m)

    def measured_at(self, points_m: npt.ArrayLike, channel: str) -> Floats:
        """(N,) first instant of the epoch of the newest samples in `reading_at`, UTC seconds since 1970.

        NaN where there are none, where these have no time, and everywhere in a map without epochs. Rows of the cells
        around the points are decoded, some milliseconds each: ask for many points at once.

        Raises:
            BadInputError: kind `unknown_channel`: the map has no channel of that name.
        """
        return point_queries.measured_at(self._frozen, points_m, point_queries.channel_named(self._frozen, channel))

    def cast_rays(
        self, origins_m: npt.ArrayLike, directions: npt.ArrayLike, *, max_range_m: float, ends_in_unknown: bool = False
    ) -> RayEnds:
        """Cast rays until they meet an occupied voxel.

        A ray meets a voxel if a part of it that is more than a point lies in it, or if it starts there; one along a
        border is in the upper voxel. A voxel at the maximum range itself is still met.

        Args:
            origins_m: (N, 3), anywhere; or one, for all directions.
            directions: (N, 3), map frame, of any finite length but 0; or one, for all origins.
            max_range_m: 0 or more; infinite for as far as the map goes.
            ends_in_unknown: True if an unknown voxel ends a ray, too; else it is seen through.
        """
        return distance_queries.cast(
            self._frozen, origins_m, directions, max_range_m=max_range_m, ends_in_unknown=ends_in_unknown
        )

    def check_box(self, T_map_body: npt.ArrayLike, box_m: npt.ArrayLike) -> PathStates:
        """States that a box meets at each pose of a path; `sweep_box` tests the way between the poses, too.

        A box meets the voxels that it overlaps; touching, to a millionth of a voxel, is not meeting.

        Args:
            T_map_body: (N, 4, 4) rigid transforms.
            box_m: (2, 3) lowest and highest corner, metres, body frame; finite, at most 16 cells long.
        """
        return body_queries.check_box(self._frozen, T_map_body, box_m)

    def check_sphere(self, centres_m: npt.ArrayLike, *, radius_m: float) -> PathStates:
        """States that a sphere meets at each of (N, 3) centres, as `check_box`."""
        return body_queries.check_sphere(self._frozen, centres_m, radius_m=radius_m)

    def sweep_box(self, T_map_body: npt.ArrayLike, box_m: npt.ArrayLike) -> PathStates:
        """States that a box meets on its way to each pose of a path, the pose included: straight, the shortest turn.

        The way is sampled wherever a point of the box has moved by half a voxel. Whatever it reports is met; a voxel
        that it misses is overlapped by less than a quarter of its edge: with a box larger by that to all sides nothing
        is missed.

        Args:
            T_map_body: (N, 4, 4) rigid transforms.
            box_m: as for `check_box`.

        Raises:
            BadInputError: as `check_box`; kind `too_large`: more than a million steps.
        """
        return body_queries.sweep_box(self._frozen, T_map_body, box_m)

    def sweep_sphere(self, centres_m: npt.ArrayLike, *, radius_m: float) -> PathStates:
        """States that a sphere meets on its straight ways to each of (N, 3) centres, as `sweep_box`."""
        return body_queries.sweep_sphere(self._frozen, centres_m, radius_m=radius_m)

    def nearest_occupied(self, points_m: npt.ArrayLike, *, radius_m: float) -> Nearest:
        """The nearest occupied voxel of each point, within a finite radius."""
        return distance_queries.nearest(self._frozen, points_m, State.OCCUPIED, radius_m=radius_m)

    def nearest_unknown(self, points_m: npt.ArrayLike, *, radius_m: float) -> Nearest:
        """The nearest unknown voxel of each point, within a finite radius; around the map all is unknown."""
        return distance_queries.nearest(self._frozen, points_m, State.UNKNOWN, radius_m=radius_m)

    def frontier(self, *, box_m: Box | None = None) -> npt.NDArray[np.int64]:
        """(M, 3) numbers of the free voxels with an unknown voxel at a face, cell by cell in Morton order.

        `grid.centres_of_voxels(numbers, snapshot.geometry)` are their centres.
        """
        return region_queries.frontier(self._frozen, box_m)

    def frontier_cells(self, *, box_m: Box | None = None) -> dict[Cell, int]:
        """The cells that hold frontier voxels, and how many: where to explore."""
        return region_queries.frontier_cells(self._frozen, box_m)

    def layer_at(self, z_m: float, what: str = "probability", *, box_m: Box | None = None) -> MapImage:
        """The horizontal layer of voxels at a height, as an image.

        Args:
            z_m: height, map frame.
            what: `state` (uint8), `probability`, `log_odds`, or a channel's name for its mean (float64, NaN where
                unknown).
            box_m: its x and y bound the image; its z does not matter.

        Raises:
            BadInputError: kind `too_large`: more than 67 million pixels.
        """
        return region_queries.layer(self._frozen, z_m, what, box_m)

    def height_map(self, *, box_m: Box | None = None) -> MapImage:
        """Height of the upper face of the highest occupied voxel of each column, metres; NaN where there is none.

        Indoors, give a `box_m` that ends below the ceiling.

        Raises:
            BadInputError: kind `too_large`: more than 67 million pixels.
        """
        return region_queries.height_map(self._frozen, box_m)

    def elevation(self, *, box_m: Box | None = None, clearance_m: float = CLEARANCE_M) -> Elevation:
        """A level layer's surface: height with its uncertainty, slope, roughness, steps and obstacles by column.

        Args:
            box_m: its x and y bound the image; voxels above or below its z are left out.
            clearance_m: height above the surface up to which things are obstacles.

        Raises:
            BadInputError: kind `not_level`: the layer has cubic voxels; `too_large`: more than 67 million pixels.
        """
        return region_queries.elevation(self._frozen, box_m, clearance_m)

    def floor_grid(self, *, ground_m: float, band_m: Band | None = None, box_m: Box | None = None) -> FloorGrid:
        """A storey as a ground robot sees it: 100 occupied, 0 free, -1 unknown, as in `nav_msgs/OccupancyGrid`.

        A column is occupied if a voxel of the band is. It is free if, from the band's top down, all is known free to
        an occupied voxel within the band's lowest height of the ground; else it is unknown.

        Args:
            ground_m: height of the storey's ground, metres, map frame; `grounds` finds it.
            band_m: lowest and highest height above the ground that the robot takes; None: 0.1 to 1.5 m, from a voxel
                on where voxels are coarser.
            box_m: its x and y bound the grid; its z does not matter.

        Raises:
            BadInputError: kind `bad_band`; `too_large`: more than 67 million pixels.
        """
        return floor_grid.floor_grid(self._frozen, ground_m, band_m, box_m)

    def grounds(self, *, band_m: Band | None = None) -> list[tuple[float, float]]:
        """Height (metres, map frame) and free area (square metres) of each storey's ground, the largest first.

        Raises:
            NotFoundError: kind `no_ground`: no column is free at any height.
        """
        return floor_grid.grounds(self._frozen, band_m)

    def hottest(self, n: int, *, min_probability: float = 0.5, box_m: Box | None = None) -> Voxels:
        """The n known voxels with the highest mean temperature, hottest first, fewer if there are no more.

        Voxels that were hit in two scans or that touch a surface come first; then the others, each of which may be
        a ghost that one beam left behind an edge. `counts`, `probability` and the reading's `sigma` say how sure
        each is.

        Args:
            n: number of voxels.
            min_probability: only voxels that are occupied with at least this probability.
            box_m: only voxels in this box.
        """
        return region_queries.hottest(self._frozen, n, min_probability=min_probability, box_m=box_m)

    def hot_spots(
        self,
        *,
        over_k: float = hot_spots.WARM_K,
        voxels_min: int = hot_spots.VOXELS_MIN,
        box_m: Box | None = None,
    ) -> Spots:
        """Connected occupied voxels above a temperature: confirmed spots first, then the others, each hottest first.

        A spot is confirmed if one of its voxels was hit in two scans, or if it has four: others may be ghosts. The
        times of samples are those of `measured_at`.

        Args:
            over_k: least temperature of each voxel, kelvin.
            voxels_min: least number of the voxels of a spot.
            box_m: only spots whose hottest voxel's centre lies in this box.
        """
        return hot_spots.spots_of_map(self._frozen, over_k=over_k, voxels_min=voxels_min, box_m=box_m)

    def voxels_in(self, box_m: Box | None = None) -> Voxels:
        """All voxels with evidence in a box, cell by cell in Morton order."""
        return region_queries.voxels_in_box(self._frozen, box_m, occupied_only=False)

    def occupied_in(self, box_m: Box | None = None) -> Voxels:
        """All occupied voxels in a box, cell by cell in Morton order."""
        return region_queries.voxels_in_box(self._frozen, box_m, occupied_only=True)

    def _first_at(self, points_m: npt.ArrayLike, kind: ChannelKind) -> Reading:
        return point_queries.reading_at(self._frozen, points_m, point_queries.first_of_kind(self.geometry, kind))


def snapshot_of(whole: FreezableMap, model: SensorModel = STANDARD_MODEL) -> MapSnapshot:
    """Snapshot of the map as it is now, read under a sensor model.

    If another thread changes the map, the caller holds it off meanwhile; a robot's `snapshot` does so.
    """
    return MapSnapshot(freeze(whole, model))


def snapshot_at(whole: HistoryMap, model: SensorModel, time_s: float) -> MapSnapshot:
    """Snapshot of a map as it was at a time (UTC seconds since 1970), by time of capture: to the end of its epoch.

    Raises:
        ConflictError: kind `not_known`: a map without epochs holds one sum, and knows nothing of earlier times.
        BadInputError: kind `bad_epoch`.
    """
    return snapshot_of(MapReading(whole.copy(), at=whole.layer.epoch_at(time_s)), model)
