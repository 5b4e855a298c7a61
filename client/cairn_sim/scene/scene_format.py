"""Schema of a scene file, field by field; `scene_file` states the rules in words, and makes solids of the entries."""

import math
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, FailFast, Field, model_validator

from cairn_sim.scene.scene import SOLIDS_MAX

ZERO_C_K = 273.15

Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[^\x00-\x1f\x7f]*$")]
Colour = Annotated[str, Field(pattern=r"^#[0-9A-Fa-f]{6}$")]
Celsius = Annotated[float, Field(strict=True, ge=-220, lt=4000)]
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
Metres = Annotated[float, Field(strict=True, ge=-1e6, le=1e6)]
Size = Annotated[float, Field(strict=True, ge=1e-4, le=1e6)]
Period = Annotated[float, Field(strict=True, ge=1e-3)]
"""May be infinite."""
Degrees = Annotated[float, Field(strict=True, ge=-360, le=360)]
Seconds = Annotated[float, Field(strict=True, ge=0, le=1e9)]
Turn = Annotated[
    tuple[Degrees, Degrees, Degrees],
    BeforeValidator(lambda turn: turn if isinstance(turn, list | tuple) else (0.0, 0.0, turn)),
]
"""A single angle is about z."""
At = tuple[Metres, Metres, Metres]
ORIGIN: tuple[float, float, float] = (0.0, 0.0, 0.0)
HALF_TURN_DEG = 180.0
STRICT = ConfigDict(frozen=True, extra="forbid")


class MaterialEntry(BaseModel):
    """`surfaces.Material` as written."""

    model_config = STRICT

    colour: Colour
    temperature_c: Celsius | None = None
    """The scene's `ambient_c` when left out."""
    emissivity: Share = 0.95
    nir: Share = 0.5
    """Diffuse reflectivity at 850 nm."""
    gloss: Share = 0.0
    retroreflection: Annotated[float, Field(strict=True, ge=1, le=1e6)] = 1.0
    optics: Literal["opaque", "glass", "mirror"] = "opaque"


class SurfaceEntry(BaseModel):
    """`surfaces.Surface` as written; materials by name."""

    model_config = STRICT

    material: Name
    second: Name | None = None
    period_m: tuple[Period, Period] = (math.inf, math.inf)
    phase_m: tuple[Metres, Metres] = (0.0, 0.0)
    grain: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    grain_m: Annotated[float, Field(strict=True, ge=1e-3, le=1e6)] = 0.05


class SolidEntry(BaseModel):
    """One shape, where it is, and what it is of; part of an object, or by itself."""

    model_config = STRICT

    name: Name
    surface: Name
    temperature_c: Celsius | None = None
    from_: At | None = Field(default=None, alias="from")
    to: At | None = None
    box: tuple[Size, Size, Size] | None = None
    cylinder: tuple[Size, Size] | None = None
    sphere: Size | None = None
    plane: Literal[True] | None = None
    at: At | None = None
    turn_deg: Turn | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        corners = (self.from_ is not None, self.to is not None)
        given = [corners[0] or corners[1], *(s is not None for s in (self.box, self.cylinder, self.sphere, self.plane))]
        if sum(given) != 1 or corners[0] != corners[1]:
            raise ValueError("expected one shape: from and to, box, cylinder, sphere or plane")
        if self.from_ is not None and self.to is not None:
            if self.at is not None or self.turn_deg is not None:
                raise ValueError("expected no at and no turn_deg with from and to; use box")
            if not all(low < high for low, high in zip(self.from_, self.to, strict=True)):
                raise ValueError(f"expected from below to on each axis, got {self.from_} and {self.to}")
        return self


class ObjectEntry(BaseModel):
    """Solids relative to a foot."""

    model_config = STRICT

    parts: Annotated[tuple[SolidEntry, ...], Field(min_length=1), FailFast()]


class PlaceEntry(BaseModel):
    """An object somewhere, or several in a row."""

    model_config = STRICT

    object: Name
    name: Name
    at: At
    turn_deg: Turn = ORIGIN
    surfaces: dict[Name, Name] = Field(default_factory=dict)
    count: Annotated[int, Field(strict=True, ge=1, le=SOLIDS_MAX)] = 1
    step_m: At = ORIGIN


class AreaEntry(BaseModel):
    """Named group of solids, with the part of the scene that they stand in."""

    model_config = STRICT

    solids: Annotated[tuple[SolidEntry, ...], FailFast()] = ()
    places: Annotated[tuple[PlaceEntry, ...], FailFast()] = ()


class KeyframeEntry(BaseModel):
    """`movements.Keyframe` as written."""

    model_config = STRICT

    time_s: Seconds
    at: At = ORIGIN
    turn_deg: Turn = ORIGIN
    gone: Literal[True] | None = None

    @model_validator(mode="after")
    def _somewhere_or_gone(self) -> Self:
        if self.gone and self.model_fields_set & {"at", "turn_deg"}:
            raise ValueError("expected no at and no turn_deg with gone: what is gone is nowhere")
        return self


class MovingEntry(BaseModel):
    """An object that moves: `movements.MovingObject` as written."""

    model_config = STRICT

    name: Name
    object: Name
    at: At = ORIGIN
    turn_deg: Turn = ORIGIN
    surfaces: dict[Name, Name] = Field(default_factory=dict)
    keyframes: Annotated[tuple[KeyframeEntry, ...], Field(min_length=1), FailFast()]
    repeat_s: Annotated[float, Field(strict=True, gt=0, le=1e9)] | None = None

    @model_validator(mode="after")
    def _short_turns(self) -> Self:
        for number, (one, other) in enumerate(pairwise(self.keyframes)):
            turn_deg = max(abs(b - a) for a, b in zip(one.turn_deg, other.turn_deg, strict=True))
            if not (one.gone or other.gone) and turn_deg >= HALF_TURN_DEG:
                raise ValueError(
                    f"expected less than {HALF_TURN_DEG:g} degrees from keyframe to keyframe, as the shorter way is "
                    f"taken, got {turn_deg:g} from {number} to {number + 1}; put one between"
                )
        return self


class SceneFile(BaseModel):
    """A scene as written."""

    model_config = STRICT

    format: Literal["cairn-scene"]
    version: Annotated[int, Field(strict=True, ge=1, le=1)]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    note: Annotated[str, Field(max_length=4096)] = ""
    base: Name | None = None
    without: tuple[Name, ...] = ()
    ambient_c: Celsius = 20.0
    sky_c: Celsius | None = None
    sky: Colour = "#000000"
    materials: dict[Name, MaterialEntry] = Field(default_factory=dict)
    surfaces: dict[Name, SurfaceEntry] = Field(default_factory=dict)
    objects: dict[Name, ObjectEntry] = Field(default_factory=dict)
    areas: dict[Name, AreaEntry] = Field(default_factory=dict)
    moving: Annotated[tuple[MovingEntry, ...], FailFast()] = ()
