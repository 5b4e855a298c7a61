"""Shapes of a time-of-flight camera's range bias, one number each; `range_bias.py` has the formula.

    offset_m, scale, radial_m, radial4_m                      always
    wiggleK_cos_m, wiggleK_sin_m                              where the ranges cover enough of the K-th wave's period
    faint_m                                                   where amplitudes are known and differ enough
    nodeR_C_m                                                 where residuals vary smoothly over the image

A phase is measured by a few samples of a wave that is no perfect sine: the range errs periodically with the phase
phi = 4 pi f d / c, f the modulation frequency ("circular error", "wiggling"). Once and twice a wave are crosstalk and
uneven gains; four times comes from the odd harmonics of the light in four samples (Lange 2000, section 2.2).

Nodes are a coarse grid over the image, linear between them. They are solved for with the boards' places, which would
otherwise absorb their part; in `rig.json` they are part of the map of the pixels (`pixel_offsets.py`).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cairn_calib.rig.raster import Raster
from cairn_map.arrays import Floats

LIGHT_M_S = 299_792_458.0
BIAS_NAMES = ("offset_m", "scale", "radial_m", "radial4_m")
BIAS_SIGMAS = (0.1, 0.01, 0.05, 0.02)
"""Priors of `BIAS_NAMES`, standard deviations from 0: metres, metres per metre, twice metres at the image's corner."""
WIGGLE_SIGMA_M, FAINT_SIGMA_M, NODE_SIGMA_M = 0.02, 0.02, 0.01
"""Priors, standard deviations from 0, metres: of a wave's cosine and sine, at half the usual amplitude, of a node."""


@dataclass(frozen=True, slots=True)
class RangeTerms:
    """Shapes of one bias: B of them, in the order of `names`."""

    modulation_hz: float | None = None
    harmonics: tuple[int, ...] = ()
    """Number of periods of each wave in one turn of the light's phase."""
    amplitude_at: float | None = None
    """Usual amplitude, counts; None: no shape depends on the amplitude."""
    nodes: tuple[int, int] | None = None
    """Columns and rows of a grid over the image; None: there is none."""

    @property
    def names(self) -> tuple[str, ...]:
        """(B,) names of the numbers; those in `_m` are metres, scale is metres per metre."""
        columns, rows = self.nodes or (0, 0)
        nodes = [f"node{row}_{column}_m" for row in range(rows) for column in range(columns)]
        return (*self.document_names, *nodes)

    @property
    def document_names(self) -> tuple[str, ...]:
        """Names of the numbers that `rig.json` states: all except the nodes, which are last."""
        waves = [f"wiggle{k}_{part}_m" for k in self.harmonics for part in ("cos", "sin")]
        return (*BIAS_NAMES, *waves, *(("faint_m",) if self.amplitude_at is not None else ()))

    @property
    def sigmas(self) -> tuple[float, ...]:
        """(B,) prior standard deviations of the numbers from 0."""
        faint = (FAINT_SIGMA_M,) if self.amplitude_at is not None else ()
        columns, rows = self.nodes or (0, 0)
        nodes = (NODE_SIGMA_M,) * (columns * rows)
        return (*BIAS_SIGMAS, *(WIGGLE_SIGMA_M,) * (2 * len(self.harmonics)), *faint, *nodes)

    def shapes(self, range_m: Floats, off_middle: Floats, faintness: Floats) -> Floats:
        """(..., D) metres that one unit of each of `document_names` adds to (...) true ranges.

        Args:
            range_m: (...) true ranges.
            off_middle: (...) squared distance from the image's middle, 1 at its corners.
            faintness: (...) `faintness`, 0 where it is unknown; unused without that shape.
        """
        columns = [np.ones_like(range_m), range_m, off_middle, off_middle**2]
        for k in self.harmonics:
            phase = self.phase_a_metre(k) * range_m
            columns += [np.cos(phase), np.sin(phase)]
        if self.amplitude_at is not None:
            columns.append(faintness)
        return np.stack(np.broadcast_arrays(*columns), axis=-1)

    def slopes(self, range_m: Floats) -> Floats:
        """(..., D) derivatives of `shapes` by the true range."""
        nothing = np.zeros_like(range_m)
        columns = [nothing, np.ones_like(range_m), nothing, nothing]
        for k in self.harmonics:
            turn = self.phase_a_metre(k)
            columns += [-turn * np.sin(turn * range_m), turn * np.cos(turn * range_m)]
        if self.amplitude_at is not None:
            columns.append(nothing)
        return np.stack(columns, axis=-1)

    def phase_a_metre(self, harmonic: int) -> float:
        """Phase of a wave per metre of range, radians."""
        return 4 * np.pi * harmonic * (self.modulation_hz or 0.0) / LIGHT_M_S

    def faintness(self, amplitude: Floats) -> Floats:
        """(...) usual over actual amplitude, minus 1: 1 at half of the usual; 0 where it is unknown (NaN)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            faint = (self.amplitude_at or 0.0) / amplitude - 1
        return np.where(np.isfinite(faint), faint, 0.0)


ALWAYS = RangeTerms()
"""Shapes that need no more than ranges."""


def wave_period_m(modulation_hz: float, harmonic: int) -> float:
    """Period of a wave in range, metres."""
    return LIGHT_M_S / (2 * modulation_hz * harmonic)


def off_middle(raster: Raster, pixels: Floats) -> Floats:
    """(...) squared distance of (..., 2) pixels from the image's middle, 1 at its corners."""
    return _off_middle(raster.width, raster.height, pixels)


def _off_middle(width: int, height: int, pixels: Floats) -> Floats:
    middle = np.array([width - 1, height - 1]) / 2
    # The single pixel of an image of one is its middle.
    return np.asarray(np.sum((pixels - middle) ** 2, axis=-1) / (float(np.sum(middle**2)) or 1.0))


@lru_cache(maxsize=16)
def off_middle_image(width: int, height: int) -> Floats:
    """(H, W) `off_middle` of every pixel, read-only."""
    y, x = np.mgrid[:height, :width]
    off = _off_middle(width, height, np.stack([x, y], axis=-1).astype(np.float64))
    off.setflags(write=False)
    return off
