"""Sensor models: blur, noise and quantisation of a real camera, one model for each spectrum, with sources.

    colour    sub-pixel area, vignetting, blur, shot and read noise, 8 bits
    thermal   sub-pixel area, blur, radiance to counts (Planck), fixed pattern, temporal noise, 16 bits
    range     sub-pixel area as waves (flying pixels, wrap), saturation and blooming, noise by amplitude

The values are the project's standard noise, fixed once; what is measured on simulated images is measured with them.
Sources: PAPER.md section 2 for the cameras of Orpheus-X4. Range noise after Lange and Seitz (2001): the sigma of a
phase-measuring pixel is the background's share plus one that falls with the amplitude. Shot noise and vignetting as in
the EMVA 1288 standard and the cos^4 law. Radiance by FLIR's form of Planck's law, U = R / (exp(B / T) - F) + O.
"""

import math
import zlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Counts, Floats, Singles

COUNT_MAX = 65535


@dataclass(frozen=True, slots=True)
class ColourSensor:
    """A colour camera with a lens; TheImagingSource DFK23G445 unless said otherwise."""

    read_sigma: float = 3.0
    """Noise in the dark, of 255."""
    shot_per_value: float = 0.02
    """Variance that each of the 255 adds: sigma is 3.0 in black and 3.75 in white."""
    blur_px: float = 0.6
    """Sigma of the lens; with the pixel's area the contrast of the finest stripes, one pixel each, falls to 0.11."""
    vignetting: float = 1.0
    """Exponent of the cos^4 law: 1 for an uncorrected lens, 0 for no vignetting."""
    fineness: int = 2
    """Rays along a pixel's side where it sees more than one thing."""

    def sigma(self, value: Singles) -> Singles:
        """Standard deviation of the noise, of 255, at values 0 to 255."""
        sigma: Singles = np.sqrt(
            np.float32(self.read_sigma**2) + np.float32(self.shot_per_value) * np.clip(value, 0, 255)
        )
        return sigma


@dataclass(frozen=True, slots=True)
class ThermalSensor:
    """An uncooled microbolometer; FLIR Tau 640 unless said otherwise."""

    netd_k: float = 0.05
    """Temporal noise at 300 K; PAPER.md section 2."""
    fixed_pattern_k: float = 0.05
    """Residual of the pixels' own offsets after calibration, kelvin at 300 K; the same in all images."""
    blur_px: float = 0.7
    fineness: int = 3
    planck_r: float = 300_000.0
    planck_b: float = 1428.0
    """Kelvin; of the band 8 to 14 um, as in FLIR's own files."""
    planck_f: float = 1.0
    planck_o: float = 0.0

    def counts_of(self, kelvin: Floats) -> Floats:
        """Raw counts, not rounded, of a black body; 41 a kelvin at 300 K. 16 bits end at 831 K, and at 117 K."""
        return np.asarray(self.planck_r / (np.exp(self.planck_b / kelvin) - self.planck_f) + self.planck_o)

    def kelvin_of(self, counts: Floats) -> Floats:
        """The mirror of `counts_of`."""
        return np.asarray(self.planck_b / np.log(self.planck_r / (counts - self.planck_o) + self.planck_f))

    def raw_counts(self, kelvin: Singles) -> Counts:
        """(H, W) uint16, what the camera counted where a thermal image says so; exact for a noisy image."""
        return np.clip(np.rint(self.counts_of(kelvin.astype(np.float64))), 1, COUNT_MAX).astype(np.uint16)

    @property
    def counts_per_kelvin(self) -> float:
        """At 300 K."""
        step_k = 1e-3
        high, low = self.counts_of(np.array([300 + step_k / 2, 300 - step_k / 2]))
        return float((high - low) / step_k)


@dataclass(frozen=True, slots=True)
class RangeSensor:
    """A time-of-flight camera; MESA SR4000 unless said otherwise."""

    wrap_m: float = 10.0
    """Range at which the phase wraps, metres: 15 MHz."""
    amplitude_at_1m: float = 20_000.0
    """Amplitude of a white surface seen head-on at 1 m: its range is lost to saturation nearer than 0.55 m."""
    amplitude_min: float = 130.0
    """No range below it. Plaster (0.65) head-on reaches 10 m; what returns more from farther away wraps."""
    amplitude_max: float = float(COUNT_MAX)
    """From here on too much light returned: amplitude stays there, no range."""
    amplitude_sigma: float = 6.0
    """Counts; what makes the phase noisy, by the same law, makes the amplitude noisy."""
    sigma_min_m: float = 0.005
    sigma_max_m: float = 0.03
    sigma_m: float = 0.01
    """At `reference_m` from a grey surface (0.5) seen head-on."""
    reference_m: float = 3.0
    fineness: int = 4
    blooming: float = 0.2
    """Share of the light above `amplitude_max` that goes to the pixels around a full one; 0 for none.

    Electrons leave a full pixel for the next, drains take the rest, and the lens scatters. With 0.2 the binary centroid
    of targets of 20 and 30 cm at 3 m has a sigma of 0.27 and 0.24 px (fixed: about 0.25), with 0 of 0.10 and 0.07 px;
    tests/cairn_sim/robots/test_targets.py.
    """
    blooming_spread: float = 1.5
    """Sigma of that light's logarithm, from pixel to pixel and from image to image: what returns too much light is
    tape, and one bead or crease returns many times what the next does."""

    def spill(self, received: Singles, rng: np.random.Generator) -> Singles:
        """(N,) counts that each of (N,) pixels gives to those around it: 0 where it is not full."""
        full = received >= self.amplitude_max
        spilled = np.zeros_like(received)
        factor = rng.lognormal(-(self.blooming_spread**2) / 2, self.blooming_spread, int(full.sum()))
        spilled[full] = self.blooming * factor * (received[full] - self.amplitude_max)
        return spilled

    def range_sigma_m(self, amplitude: npt.NDArray[np.floating] | Counts) -> Floats:
        """Standard deviation of the range, metres: sigma^2 = s0^2 + s1^2 / amplitude^2, bounded."""
        reference = self.amplitude_at_1m * 0.5 / self.reference_m**2
        s1 = math.sqrt(self.sigma_m**2 - self.sigma_min_m**2) * reference
        noise = s1 / np.maximum(np.asarray(amplitude, dtype=np.float64), 1.0)
        return np.minimum(np.hypot(self.sigma_min_m, noise), self.sigma_max_m)


Sensor = ColourSensor | ThermalSensor | RangeSensor


@dataclass(frozen=True, slots=True)
class Noise:
    """Seeded noise: an image's noise depends on the seed, the camera's name and the image's number alone.

    So images can be rendered in any order, on any number of threads, and are the same to the byte.
    """

    seed: int

    def of_image(self, camera: str, number: int) -> np.random.Generator:
        """The generator of one image; `number` counts the images of a recording."""
        return np.random.default_rng([self.seed, _number_of(camera), 1, number])

    def of_poses(self) -> np.random.Generator:
        """The generator of a drive's pose errors."""
        return np.random.default_rng([self.seed, 0, 2])

    def fixed_pattern(self, camera: str, shape: tuple[int, int]) -> Singles:
        """(H, W) standard normal, the same in all of a camera's images; read-only."""
        return _fixed_pattern(self.seed, camera, shape)


@lru_cache(maxsize=16)
def _fixed_pattern(seed: int, camera: str, shape: tuple[int, int]) -> Singles:
    pattern = np.random.default_rng([seed, _number_of(camera), 0]).standard_normal(shape, dtype=np.float32)
    pattern.setflags(write=False)
    return pattern


def _number_of(camera: str) -> int:
    return zlib.crc32(camera.encode())
