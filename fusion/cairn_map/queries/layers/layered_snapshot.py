"""Layered snapshot: the layers of one map together, of which the finest that knows a point answers for it.

    layers = cairn.open_layers("http://base:8750/maps/lab")
    layers.state_at([[1.0, 2.0, 0.4]])           # of the 1 cm layer where it was there, else of the 4 cm layer, ...
    layers.names_at([[1.0, 2.0, 0.4]])           # ["fine"]
    layers.cast_rays(origins_m, directions, max_range_m=10).names
    layers["evidence"].frontier()                # all other queries are asked of one layer

A layer knows a point if the voxel in which the point lies was hit or seen through in it. Occupancy is taken from that
layer whole, never mixed: evidence of two grids is not added up. A channel is read from the finest layer with samples of
it there, since a layer may know a place that only another one measured. Sets of voxels, and what is made of them, are
those of `finest_voxels`: a coarse obstacle stays where finer layers know a part of its voxel only.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import check_cubes
from cairn_map.evidence.voxels import Reading, Voxels
from cairn_map.queries import region_queries
from cairn_map.queries.frozen_map import Box, FrozenMap, as_points
from cairn_map.queries.layers.finest_voxels import are_alike, finest_states, voxels_by_layer
from cairn_map.queries.layers.layered_rays import LayeredEnds, cast_layers, nearest_of_layers
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.occupancy_states import State
from cairn_map.queries.region_queries import MapImage, check_pixels, pixel_centres, plane_values


class LayeredSnapshot:
    """Snapshots of a map's layers; arrays in, arrays out, as `MapSnapshot`."""

    __slots__ = ("_finest", "_finest_cubes", "_layers")

    def __init__(self, layers: Mapping[str, MapSnapshot]) -> None:
        """Take the layers by name, at least one.

        Raises:
            BadInputError: kind `bad_layer`: there is none.
        """
        if not layers:
            raise BadInputError("bad_layer", "a layered snapshot has one layer at least, got none")
        finest_first = sorted(layers, key=lambda name: (layers[name].geometry.voxel_edge_um, name))
        self._layers = {name: layers[name] for name in finest_first}
        self._finest: dict[str, FrozenMap] | None = None
        self._finest_cubes: dict[str, FrozenMap] | None = None

    def __repr__(self) -> str:
        edges = ", ".join(f"{name} {layer.geometry.voxel_edge_m:g} m" for name, layer in self._layers.items())
        return f"LayeredSnapshot({edges})"

    def __getitem__(self, name: str) -> MapSnapshot:
        """One layer.

        Raises:
            NotFoundError: kind `no_map`: there is no such layer.
        """
        if name not in self._layers:
            raise NotFoundError("no_map", f"there is no layer {name[:32]!r}, but {', '.join(self._layers)}")
        return self._layers[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the layers, the finest first."""
        return tuple(self._layers)

    def names_at(self, points_m: npt.ArrayLike) -> list[str | None]:
        """Name of the layer that answers for each of (N, 3) points; None where no layer knows anything."""
        names = (*self._layers, None)
        return [names[index] for index in self._answering(points_m)]

    def state_at(self, points_m: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """(N,) `State`: 0 unknown, 1 free, 2 occupied."""
        return self._taken(points_m, np.uint8(State.UNKNOWN), lambda layer, points: layer.state_at(points))

    def probability_at(self, points_m: npt.ArrayLike) -> Floats:
        """(N,) probability that the voxel is occupied, clamped; NaN where unknown."""
        return self._taken(points_m, np.nan, lambda layer, points: layer.probability_at(points))

    def log_odds_at(self, points_m: npt.ArrayLike) -> Floats:
        """(N,) ln(p / (1 - p)), clamped; NaN where unknown."""
        return self._taken(points_m, np.nan, lambda layer, points: layer.log_odds_at(points))

    def seen_at(self, points_m: npt.ArrayLike) -> Floats:
        """(N,) first instant of the newest epoch in which the voxel was seen, as `MapSnapshot.seen_at`."""
        return self._taken(points_m, np.nan, lambda layer, points: layer.seen_at(points))

    def reading_at(self, points_m: npt.ArrayLike, channel: str) -> Reading:
        """Reading of a channel, each point's from the finest layer with samples of it there.

        Layers whose channel of this name has another kind or unit than the finest one's are left out.

        Raises:
            BadInputError: kind `unknown_channel`: no layer has a channel of that name.
        """
        points = as_points(points_m, "points")
        found: Reading | None = None
        for layer in self._layers.values():
            known = layer.geometry.channel(channel)
            if known is None or (found is not None and not are_alike(known, found.channel)):
                continue
            read = layer.reading_at(points, channel)
            found = read if found is None else _filled(found, read)
        if found is None:
            raise BadInputError("unknown_channel", f"no layer of the map has a channel {channel[:64]!r}")
        return found

    def class_at(self, points_m: npt.ArrayLike) -> Reading:
        """Classes, as `MapSnapshot.class_at`, of the finest layer with a channel of classes.

        Raises:
            BadInputError: kind `unknown_channel`: no layer has one.
        """
        for layer in self._layers.values():
            if any(channel.kind is ChannelKind.CLASSES for channel in layer.geometry.channels):
                return layer.class_at(points_m)
        raise BadInputError("unknown_channel", "no layer of the map has a channel of classes")

    def cast_rays(self, origins_m: npt.ArrayLike, directions: npt.ArrayLike, *, max_range_m: float) -> LayeredEnds:
        """Cast rays until they come to a point that the finest layer that knows it has as occupied.

        Args:
            origins_m: (N, 3), anywhere; or one, for all directions.
            directions: (N, 3), map frame, of any finite length but 0; or one, for all origins.
            max_range_m: 0 or more; infinite for as far as the map goes.

        Raises:
            BadInputError: as `MapSnapshot.cast_rays`; kind `level_layer`: no layer has cubes.
        """
        return cast_layers(self._cubes(), origins_m, directions, max_range_m=max_range_m)

    def nearest_occupied(self, points_m: npt.ArrayLike, *, radius_m: float) -> LayeredEnds:
        """The nearest occupied voxel of layers with cubes, for each of (N, 3) points, within a finite radius.

        Of voxels that a finer layer of cubes shows its own count (`finest_voxels`). What gives way to a level counts:
        a level has no distances.

        Raises:
            BadInputError: as `MapSnapshot.nearest_occupied`; kind `level_layer`: no layer has cubes.
        """
        if self._finest_cubes is None:
            self._finest_cubes = finest_states(self._cubes(), None)
        return nearest_of_layers(self._finest_cubes, points_m, radius_m=radius_m)

    def occupied_in(self, box_m: Box | None = None) -> dict[str, Voxels]:
        """Occupied voxels in a box by layer, the finest first: those that no finer layer shows (`finest_voxels`)."""
        return voxels_by_layer(self._without_shown(box_m), box_m, occupied_only=True)

    def voxels_in(self, box_m: Box | None = None) -> dict[str, Voxels]:
        """All voxels with evidence in a box, as `occupied_in`."""
        return voxels_by_layer(self._without_shown(box_m), box_m, occupied_only=False)

    def layer_at(self, z_m: float, what: str = "probability", *, box_m: Box | None = None) -> MapImage:
        """A horizontal plane at a height, each pixel's centre by the finest layer that knows it, as an image.

        Its pixels are as wide as the voxels of the finest layer with cells in the box; arguments as of
        `MapSnapshot.layer_at`.

        Raises:
            BadInputError: as there; kind `too_large`: more than 67 million pixels: give a box, or ask one layer.
        """
        ask = self._points_of(what)
        x, y, edge_m = self._pixels(box_m)
        return MapImage(plane_values(x, y, z_m, ask), _origin(x, y), edge_m)

    def _points_of(self, what: str) -> Callable[[Floats], npt.NDArray[Any]]:
        """Query that `layer_at` makes of each point: its state, probability, log odds, or the mean of a channel."""
        match what:
            case "state":
                return self.state_at
            case "probability":
                return self.probability_at
            case "log_odds":
                return self.log_odds_at
        return lambda points_m: self.reading_at(points_m, what).mean

    def height_map(self, *, box_m: Box | None = None) -> MapImage:
        """Height of the upper face of each column's highest voxel of `occupied_in`, metres; NaN where there is none.

        Pixels as those of `layer_at`.

        Raises:
            BadInputError: kind `too_large`, as there.
        """
        x, y, edge_m = self._pixels(box_m)
        heights = np.full((len(y), len(x)), np.nan)
        for frozen in self._without_shown(box_m).values():
            image = region_queries.height_map(frozen, box_m)
            H, W = image.values.shape
            if not (H and W):
                continue
            # Pixels of this layer that hold the centres.
            columns, lines = (
                np.floor((centres_m - first_m) / image.edge_m + 0.5).astype(np.int64)
                for centres_m, first_m in zip((x, y), image.origin_m, strict=True)
            )
            held_x, held_y = (columns >= 0) & (columns < W), (lines >= 0) & (lines < H)
            part = np.ix_(held_y, held_x)
            heights[part] = np.fmax(heights[part], image.values[np.ix_(lines[held_y], columns[held_x])])
        return MapImage(heights, _origin(x, y), edge_m)

    def _cubes(self) -> dict[str, FrozenMap]:
        """Layers of cubes, the finest first.

        Raises:
            BadInputError: kind `level_layer`: there is none.
        """
        found = {name: layer.frozen for name, layer in self._layers.items() if not layer.geometry.is_flat}
        if not found:
            check_cubes(next(iter(self._layers.values())).geometry)
        return found

    def _without_shown(self, box_m: Box | None) -> dict[str, FrozenMap]:
        """`finest_states` of all layers, in a box; of the whole map made once, and two threads make equal ones."""
        if self._finest is not None:
            return self._finest
        found = finest_states({name: layer.frozen for name, layer in self._layers.items()}, box_m)
        if box_m is None:
            self._finest = found
        return found

    def _pixels(self, box_m: Box | None) -> tuple[Floats, Floats, float]:
        """Centres along x and along y, and edge, of an image: of the finest layer with cells in a box.

        Raises:
            BadInputError: kind `too_large`.
        """
        spans = [(layer.geometry, *layer.frozen.voxels_of_box(box_m)) for layer in self._layers.values()]
        spans = [(geometry, low, high) for geometry, low, high in spans if (low < high)[:2].all()]
        if not spans:
            return np.empty(0), np.empty(0), next(iter(self._layers.values())).geometry.voxel_edge_m
        edge_um = spans[0][0].voxel_edge_um
        # The box of all layers' columns, in whole pixels.
        first = np.min([low[:2] * geometry.voxel_edge_um // edge_um for geometry, low, _ in spans], axis=0)
        end = np.max([-(-high[:2] * geometry.voxel_edge_um // edge_um) for geometry, _, high in spans], axis=0)
        check_pixels(first, end)
        x, y = (pixel_centres(int(first[axis]), int(end[axis]), edge_um) for axis in (0, 1))
        if box_m is not None:
            box = np.asarray(box_m, np.float64)
            x, y = (each[(each >= box[0, axis]) & (each <= box[1, axis])] for axis, each in enumerate((x, y)))
        return x, y, edge_um / 1e6

    def _answering(self, points_m: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """(N,) place of the finest layer that knows each point; the number of layers where none does."""
        points = as_points(points_m, "points")
        answering = np.full(len(points), len(self._layers))
        for index, layer in reversed(list(enumerate(self._layers.values()))):
            answering[layer.state_at(points) != State.UNKNOWN] = index
        return answering

    def _taken(
        self,
        points_m: npt.ArrayLike,
        unknown: np.uint8 | float,
        ask: Callable[[MapSnapshot, Floats], npt.NDArray[Any]],
    ) -> npt.NDArray[Any]:
        """(N,) answers, each of the layer that answers for the point."""
        points = as_points(points_m, "points")
        if len(self._layers) == 1:  # it knows no more of unknown points than `unknown`
            return ask(next(iter(self._layers.values())), points)
        answering = self._answering(points)
        found = np.full(len(points), unknown)
        for index, layer in enumerate(self._layers.values()):
            mine = answering == index
            if mine.any():
                found[mine] = ask(layer, points[mine])
        return found


def _origin(x: Floats, y: Floats) -> tuple[float, float]:
    """Centre of the first pixel; of an image without pixels, the origin."""
    return (float(x[0]), float(y[0])) if len(x) and len(y) else (0.0, 0.0)


def _filled(fine: Reading, coarse: Reading) -> Reading:
    """A reading, with another layer's where it has no samples."""
    take = (fine.weight == 0) & (coarse.weight > 0)
    mean = np.where(take[:, None] if fine.mean.ndim == 2 else take, coarse.mean, fine.mean)
    spread = fine.spread
    if fine.spread is not None and coarse.spread is not None:
        spread = np.where(take, coarse.spread, fine.spread)
    unsure = fine.unsure
    if fine.unsure is not None and coarse.unsure is not None:
        unsure = np.where(take, coarse.unsure, fine.unsure)
    weight = np.where(take, coarse.weight, fine.weight)
    return replace(fine, mean=mean, weight=weight, spread=spread, measured_s=None, unsure=unsure)
