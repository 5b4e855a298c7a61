"""Surfaces in three spectra: one material, or two that alternate in a texture.

    visible         sRGB, times the light that falls on the face
    near infrared   light that returns to a lamp next to the lens: diffuse, glossy and retroreflecting parts
    far infrared    temperature and emissivity; what is not emitted is the surroundings' light, mirrored

A texture depends on the place alone, so all robots see the same there. Lengths along a surface, `uv`, are metres from
the middle of a box's face or a plane, arc length and height on a cylinder's side, arc length along the equator and
height on a sphere.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

from cairn_map.errors import BadInputError

Rgb = tuple[int, int, int]
TEMPERATURE_K = (50, 5000)
"""Temperatures of materials, surroundings and sky, kelvin: below 50 K the radiance underflows a float."""


class Optics(IntEnum):
    """Optical kind of a surface in visible and near infrared light. In the far infrared every surface is opaque."""

    OPAQUE = 0
    GLASS = 1
    """Lets it through, straight on: a pane. Its thickness does not bend the ray, nor does its back show."""
    MIRROR = 2
    """Sends it on by the law of reflection."""


@dataclass(frozen=True, slots=True)
class Material:
    """One material; the defaults are a grey wall at 20 C."""

    colour_srgb: Rgb = (128, 128, 128)
    temperature_k: float = 293.15
    emissivity: float = 0.95
    """In the far infrared, 8 to 14 um, 0 to 1; bare metal has 0.05 to 0.3, nearly everything else above 0.85."""
    reflectivity_nir: float = 0.5
    """Diffuse reflectivity for 850 nm light, 0 to 1."""
    gloss_nir: float = 0.0
    """Extra return of 850 nm light from a face turned to the lamp; fades within some 10 degrees."""
    retroreflection: float = 1.0
    """Light that returns to the lamp, as a multiple of a diffuse surface's; tape has several hundred."""
    optics: Optics = Optics.OPAQUE

    def __post_init__(self) -> None:
        fractions = (self.emissivity, self.reflectivity_nir, self.gloss_nir)
        if not (
            TEMPERATURE_K[0] <= self.temperature_k <= TEMPERATURE_K[1]
            and all(0 <= f <= 1 for f in fractions)
            and self.retroreflection >= 1
        ):
            raise BadInputError(
                "bad_surface",
                f"a material needs {TEMPERATURE_K[0]} to {TEMPERATURE_K[1]} K, fractions in 0..1 and a retroreflection "
                f"of at least 1, got {self.temperature_k} K, {fractions}, {self.retroreflection}",
            )
        if not all(0 <= value <= 255 for value in self.colour_srgb):
            raise BadInputError("bad_surface", f"a colour is three numbers in 0..255, got {self.colour_srgb}")


@dataclass(frozen=True, slots=True)
class Surface:
    """A material; or two that take turns along the surface, every `period_m`.

    Both periods finite is a checkerboard, one is stripes. The first square with both coordinates above `phase_m` is of
    `material`.
    """

    material: Material
    second: Material | None = None
    period_m: tuple[float, float] = (math.inf, math.inf)
    phase_m: tuple[float, float] = (0.0, 0.0)
    grain: float = 0.0
    """Largest relative change of the colour by an irregular pattern, 0 to 1."""
    grain_m: float = 0.05
    """Size of that pattern's spots."""

    def __post_init__(self) -> None:
        if not (min(self.period_m) > 0 and 0 <= self.grain < 1 and 0 < self.grain_m < math.inf):
            raise BadInputError(
                "bad_surface",
                "a surface needs positive periods, a grain in 0..1 and spots above 0 m, got "
                f"{self.period_m}, {self.grain}, {self.grain_m}",
            )
        if self.second is not None and self.second.optics is not self.material.optics:
            raise BadInputError("bad_surface", "both materials of a surface must have the same optics")

    @property
    def materials(self) -> tuple[Material, Material]:
        """Both materials; twice the same where the surface is plain."""
        return self.material, self.material if self.second is None else self.second
