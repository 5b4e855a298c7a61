"""JSON messages about the layers of a map: a list of them, and what an operator adds."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.epochs.layer import EVIDENCE, EpochLength, LayerDefinition, LayerName
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.messages import IdText, MapInfo, MapNameText

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
    """Answer to it."""

    commit: IdText | None
    """Commit that defines the layer; None: an equal one was there."""
    layer: LayerInfo


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
