"""Layered snapshot: the layers of one map together, of which the finest that knows a point answers for it.

    layers = cairn.open_layers("http://base:8750/maps/lab")
    layers.state_at([[1.0, 2.0, 0.4]])           # of the 1 cm layer where it was there, else of the 4 cm layer, ...
    layers.names_at([[1.0, 2.0, 0.4]])           # ["fine"]
    layers["evidence"].cast_rays(...)            # all other queries are asked of one layer

A layer knows a point if the voxel in which the point lies was hit or seen through in it. Occupancy is taken from that
layer whole, never mixed: evidence of two grids is not added up. A channel is read from the finest layer with samples of
it there, since a layer may know a place that only another one measured.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.voxels import Reading
from cairn_map.queries.frozen_map import as_points
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.occupancy_states import State


class LayeredSnapshot:
    """Snapshots of a map's layers; arrays in, arrays out, as `MapSnapshot`."""

    __slots__ = ("_layers",)

    def __init__(self, layers: Mapping[str, MapSnapshot]) -> None:
        """Take the layers by name, at least one.

        Raises:
            BadInputError: kind `bad_layer`: there is none.
        """
        if not layers:
            raise BadInputError("bad_layer", "a layered snapshot has one layer at least, got none")
        finest_first = sorted(layers, key=lambda name: (layers[name].geometry.voxel_edge_um, name))
        self._layers = {name: layers[name] for name in finest_first}

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
            if known is None or (found is not None and not _is_alike(known, found.channel)):
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
        answering = self._answering(points)
        found = np.full(len(points), unknown)
        for index, layer in enumerate(self._layers.values()):
            mine = answering == index
            if mine.any():
                found[mine] = ask(layer, points[mine])
        return found


def _is_alike(one: Channel, other: Channel) -> bool:
    return (one.kind, one.unit, one.classes) == (other.kind, other.unit, other.classes)


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
