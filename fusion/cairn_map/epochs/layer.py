"""The definition of a layer of a map: its grid and the length of its epochs. Its digest names all that is stored of it.

A layer is named by its definition, not by a number: two servers that define the same layer can be joined. A map without
epochs has one layer, whose digest is that of its geometry alone, as in format version 1.

A map may have further layers, at other resolutions (`LayerDefinition`). Each is a log of its own, with cells, cursors
and robots like a map's, under the name MAP.LAYER: what is said here of one layer holds in each (decision 033).
"""

import hashlib
import json
from functools import lru_cache
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_serializer, field_validator

from cairn_map.epochs.epoch import EPOCH_S_MAX, Epoch, epoch_of
from cairn_map.errors import ConflictError
from cairn_map.evidence.grid import Geometry

EVIDENCE = "evidence"
"""Name of a map's first layer."""
LAYERS_MAX = 16
"""Layers of a map, the first one included."""


Hex32 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
LayerName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
EpochLength = Annotated[int, Field(ge=1, le=EPOCH_S_MAX)]


class LayerIdentity(BaseModel, frozen=True):
    """Definition of a layer with epochs, as commits state it: its geometry by its digest."""

    model_config = ConfigDict(extra="forbid")

    geometry: Hex32
    epoch_s: EpochLength
    kind: Literal["evidence"] = "evidence"
    name: LayerName = EVIDENCE

    def digest(self) -> bytes:
        """SHA-256 (32 bytes) over the definition as JSON, with sorted keys."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).digest()


class LayerDefinition(BaseModel, frozen=True):
    """Definition of a further layer of a map, as the commit states it that begins the layer; for ever the same."""

    model_config = ConfigDict(extra="forbid")

    name: LayerName
    kind: Literal["evidence"] = "evidence"
    geometry: Geometry
    epoch_s: EpochLength | None = None
    """Length of an epoch, seconds; None: one sum for all times."""

    @field_validator("name")
    @classmethod
    def _is_further(cls, name: str) -> str:
        if name == EVIDENCE:
            raise ValueError(f"{EVIDENCE} is the layer that a map begins with; take another name")
        return name

    @field_serializer("geometry")
    def _whole(self, geometry: Geometry) -> dict[str, Any]:
        # Whatever else is left out: the depth that a reader would take for a missing one is not always the default.
        return geometry.model_dump(mode="json")

    def __str__(self) -> str:
        """Such as `layer fine: voxels of 0.01 m, cells of 128^3, channels colour, one sum for all times`."""
        epochs = "one sum for all times" if self.epoch_s is None else f"epochs of {self.epoch_s} s"
        return f"layer {self.name}: {self.geometry}, {epochs}"


class MapLayer(BaseModel, frozen=True):
    """One layer of a map."""

    model_config = ConfigDict(extra="forbid")

    geometry: Geometry = Geometry()
    epoch_s: EpochLength | None = None
    """Length of an epoch, seconds; None: one sum for all times, in the bytes of format version 1."""
    name: LayerName = EVIDENCE

    def __str__(self) -> str:
        """Such as `voxels of 0.04 m, cells of 128^3, channels colour, temperature, epochs of 120 s`."""
        return f"{self.geometry}, epochs of {self.epoch_s} s" if self.epoch_s is not None else str(self.geometry)

    @property
    def has_epochs(self) -> bool:
        """True if evidence is kept by epoch, in the bytes of format version 2."""
        return self.epoch_s is not None

    @property
    def identities(self) -> tuple[LayerIdentity, ...]:
        """Its definition, if it has epochs, as the commits of its map state it."""
        if self.epoch_s is None:
            return ()
        return (LayerIdentity(geometry=self.geometry.digest().hex(), epoch_s=self.epoch_s, name=self.name),)

    def epoch_at(self, time_s: float) -> Epoch:
        """Epoch of a time, UTC seconds since 1970.

        Raises:
            ConflictError: kind `not_known`: a map without epochs holds one sum, and knows nothing of earlier times.
            BadInputError: kind `bad_epoch`.
        """
        if self.epoch_s is None:
            raise ConflictError(
                "not_known",
                "this map has no epochs: it holds one sum for all times. Ask its server, which may have kept the "
                "commits, or make maps with `cairn map create --epoch 120`",
            )
        return epoch_of(time_s, self.epoch_s)

    def digest(self) -> bytes:
        """SHA-256 (32 bytes) over the definition; evidence can be added only if the digests are equal."""
        return _digest(self)

    @property
    def word(self) -> int:
        """Number of 64 bits that fingerprints of this layer's evidence are made with; 0 without epochs."""
        return int.from_bytes(self.digest()[:8], "little") if self.has_epochs else 0


@lru_cache(maxsize=64)
def _digest(layer: MapLayer) -> bytes:
    return layer.identities[0].digest() if layer.has_epochs else layer.geometry.digest()
