"""JSON messages about the layers of a map: a list of them, and what an operator adds."""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from cairn_map.epochs.layer import EVIDENCE, LAYERS_MAX, EpochLength, LayerDefinition, LayerName
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.messages import IdText, MapInfo, MapNameText, NameText

LAYER_FORMAT = 4
"""`Cairn-Format` from which on a client knows of layers: to others a server names none in its list of maps."""
KINDS_FORMAT = 5
"""`Cairn-Format` from which on a client knows channels of classes, flat voxels, and when log entries were received."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LayerInfo(_Model):
    """One layer of a map."""

    name: LayerName
    """`evidence`: the layer that the map begins with."""
    map: MapNameText
    """Name under which it is asked for, pushed to and fetched: MAP, or MAP.LAYER."""
    geometry: Geometry
    epoch_s: EpochLength | None
    """Length of an epoch, seconds; None: one sum for all times."""
    cells: Annotated[int, Field(ge=0)]
    size_bytes: Annotated[int, Field(ge=0)]
    """Sum of the encoded cells."""


class AddLayer(_Model):
    """Body of `POST /maps/{map}/layers`."""

    name: LayerName
    geometry: Geometry
    epoch_s: EpochLength | None = None
    """Length of an epoch, seconds; None: one sum for all times."""

    @property
    def definition(self) -> LayerDefinition:
        """The layer as its first commit states it.

        Raises:
            ValidationError: the name is that of the layer that a map begins with.
        """
        return LayerDefinition(name=self.name, geometry=self.geometry, epoch_s=self.epoch_s)


class LayerAdded(_Model):
    """Answer to `POST /maps/{map}/layers`."""

    commit: IdText | None
    """Commit that defines the layer; None: an equal one was there."""
    layer: LayerInfo


Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
BoxM = tuple[Corner, Corner]
"""Lowest and highest corner, metres, map frame."""


class MappedLayer(_Model):
    """One layer that a robot maps into: everywhere, or where its head is in a box, or is not in one."""

    layer: LayerName
    inside_m: BoxM | None = None
    outside_m: BoxM | None = None

    @model_validator(mode="after")
    def _boxes_are_some(self) -> Self:
        for box in (self.inside_m, self.outside_m):
            if box is not None and not all(low < high for low, high in zip(*box, strict=True)):
                raise ValueError("a box is its lowest and its highest corner, metres")
        return self

    def takes(self, place_m: Corner) -> bool:
        """True if a scan from a place, metres, map frame, goes into the layer."""
        return (self.inside_m is None or _is_in(place_m, self.inside_m)) and (
            self.outside_m is None or not _is_in(place_m, self.outside_m)
        )


class Assignment(_Model):
    """Layers of a map that a robot takes part in."""

    contributes: Annotated[tuple[MappedLayer, ...], Field(min_length=1, max_length=LAYERS_MAX)]
    """Those that it maps into, and keeps."""
    fetches: Annotated[tuple[LayerName, ...], Field(max_length=LAYERS_MAX)] = ()
    """Others that it keeps to read."""

    @model_validator(mode="after")
    def _layers_differ(self) -> Self:
        if len({*self.layers}) != len(self.layers):
            raise ValueError(f"a layer is named once, got {', '.join(self.layers)}")
        return self

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of all layers, first those that it maps into."""
        return (*(each.layer for each in self.contributes), *self.fetches)

    @property
    def summary(self) -> str:
        """Layers for people, such as `evidence, fine in a box; fetches wide`."""
        mapped = [
            each.layer + " in a box" * (each.inside_m is not None) + " outside of a box" * (each.outside_m is not None)
            for each in self.contributes
        ]
        return ", ".join(mapped) + (f"; fetches {', '.join(self.fetches)}" if self.fetches else "")

    def layers_at(self, place_m: Corner) -> tuple[str, ...]:
        """Names of the layers that take a scan from a place, metres, map frame."""
        return tuple(each.layer for each in self.contributes if each.takes(place_m))


class RobotAssignment(_Model):
    """Assignment of a robot on a map."""

    robot: NameText
    assignment: Assignment


def _is_in(place_m: Corner, box: BoxM) -> bool:
    return all(low <= at < high for low, at, high in zip(box[0], place_m, box[1], strict=True))


def is_listed(geometry: Geometry, known: int) -> bool:
    """True if a client of a `Cairn-Format` can read the grid of a layer; others refuse a whole list for one layer."""
    has_classes = any(channel.kind is ChannelKind.CLASSES for channel in geometry.channels)
    return known >= KINDS_FORMAT or not (has_classes or geometry.is_flat)


def layer_info(info: MapInfo) -> LayerInfo:
    """A map, or one of its layers, as a layer: by the name that it is asked for."""
    _, dot, name = info.name.partition(".")
    return LayerInfo(
        name=name if dot else EVIDENCE,
        map=info.name,
        geometry=info.geometry,
        epoch_s=info.epoch_s,
        cells=info.cells,
        size_bytes=info.size_bytes,
    )
