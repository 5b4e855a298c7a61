"""Plan of a solve: cameras and lenses, free parameters, priors, and the treatment of noise.

Free by default are fx fy cx cy k1 k2 p1 p2 k3 of every pinhole (k4 to k6 only by name; fisheyes have four others), with
the usual values of such lenses as priors (`priors.py`). Why so many: a coefficient that is wrongly held at 0 goes into
cx, cy and the places of the cameras. Simulated head, found corners, targets carried from the ToF camera to the others,
root mean square error against the truth, px, colour and thermal (stated sigma):

    free                              8 images, to the corners    22 images
    k1 k2 of range, k1 k2 k3 thermal  4.5 (4.0)  0.23 (0.07)      0.43 (0.10)  0.14 (0.02)
    all five, no priors               5.3 (4.0)  0.06 (0.03)      0.17 (0.09)  0.02 (0.02)
    all five, with priors             0.7 (0.5)  0.05 (0.03)      0.11 (0.08)  0.02 (0.02)

A prior is a pseudo-observation: a sum of numbers times coefficients is a value, give or take a standard deviation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from cairn_calib.rig.range_terms import RangeTerms
from cairn_calib.rig.rig import Spectrum
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

PINHOLE = ("k1", "k2", "p1", "p2", "k3")
FISHEYE = ("k1", "k2", "k3", "k4")
BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FOCAL_AND_CENTRE = ("fx", "fy", "cx", "cy")
SHARED = ""
"""The owner of what belongs to no camera: the board's warp and scale."""
PITCH_SIGMA = 2e-4
"""Relative standard deviation of a printed board's pitch: 20 um on 100 mm."""


@dataclass(frozen=True, slots=True)
class Prior:
    """sum(coefficient * parameter) = value +- sigma; parameters by owner (a camera, or `SHARED`) and name."""

    terms: tuple[tuple[str, str, float], ...]
    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class KnownNumbers:
    """Numbers of one camera that were known before the images: a data sheet's, a factory's, or last year's."""

    camera: str
    source: str
    """Origin, for people."""
    names: tuple[str, ...]
    """K intrinsics, or numbers of its place in the rig's frame: `tx`, `ty`, `tz`, metres, and the rotation vector of
    T_rig_camera `rx`, `ry`, `rz`, radians."""
    values: Floats
    """(K,)"""
    covariance: Floats
    """(K, K) of their errors, positive definite."""
    scale: float = 1.0
    """Factor of the standard deviations, above 1 where the images contradict them."""

    @classmethod
    def single(cls, camera: str, source: str, name: str, value: float, sigma: float) -> Self:
        """One number and its standard deviation."""
        return cls(camera, source, (name,), np.array([value]), np.array([[sigma**2]]))

    def priors(self) -> tuple[Prior, ...]:
        """Independent priors that say the same: W (x - values) = 0 +- scale with W^T W the covariance's inverse."""
        sigmas = np.sqrt(np.diag(self.covariance))
        # Scaled to correlations; one of 1 - 1e-10 is as good as 1, whatever rounding made of it.
        strengths, axes = np.linalg.eigh(self.covariance / sigmas[:, None] / sigmas)
        rows = (axes / np.sqrt(np.maximum(strengths, 1e-10))).T / sigmas
        return tuple(
            Prior(
                tuple((self.camera, name, float(each)) for name, each in zip(self.names, row, strict=True)),
                float(row @ self.values),
                self.scale,
            )
            for row in rows
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPlan:
    """Plan of one camera: its spectrum, its model, and the coefficients that are free."""

    spectrum: Spectrum
    model: str = "pinhole"
    """`pinhole` or `kb4`."""
    free: tuple[str, ...] | None = None
    """Names of free distortion coefficients; None: as usual for the model."""
    known: Mapping[str, float] = field(default_factory=dict)
    """Values of intrinsics that were known before: the solve starts there."""
    held: tuple[str, ...] = ()
    """Names of intrinsics that stay as they are known."""

    def __post_init__(self) -> None:
        if self.model not in ("pinhole", "kb4"):
            raise BadInputError("bad_arguments", f"a lens is pinhole or kb4, got {self.model!r}")
        known = FISHEYE if self.model == "kb4" else BROWN
        if strange := [name for name in self.coefficients if name not in known]:
            raise BadInputError("bad_arguments", f"a {self.model} lens has {', '.join(known)}, got {strange[0]!r}")

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free distortion coefficients."""
        free = self.free
        if free is None:
            free = FISHEYE if self.model == "kb4" else PINHOLE
        return tuple(name for name in free if name not in self.held)

    def is_free(self, name: str) -> bool:
        """True for each intrinsic that the solve changes."""
        return name in self.coefficients or (name in FOCAL_AND_CENTRE and name not in self.held)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePlan:
    """Treatment of noise: a robust loss, culling with re-admission, and a scale of noise for each sensor."""

    huber_sigmas: float = 1.5
    """Length of a residual beyond which it pulls with constant force, until outliers are known; infinite: none."""
    cull_sigmas: float = 4.0
    """Length of a residual beyond which its point is left out, and let in again if it fits later; infinite: none."""
    rounds: int = 8
    """Rounds of estimating noise and culling, at most; 0: the corners' covariances are taken as stated."""


STATED = NoisePlan(huber_sigmas=np.inf, cull_sigmas=np.inf, rounds=0)
"""Plain least squares with the corners' own covariances."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvePlan:
    """Plan of a whole rig; cameras by name, in the rig's order."""

    cameras: Mapping[str, CameraPlan]
    gauge: str
    """The camera whose frame is the rig's."""
    rig_name: str = "rig"
    pitch_sigma: float = PITCH_SIGMA
    """Relative standard deviation of the board's pitch; 0: exact."""
    warp: bool = True
    """True if the board may be bent: a parabola along x and one along y."""
    known: tuple[KnownNumbers, ...] = ()
    """Numbers that were known before the images, besides what is usual."""
    usual_priors: bool = True
    """True if the priors that few views or a coarse sensor need are added."""
    noise: NoisePlan = field(default_factory=NoisePlan)
    modulation_hz: float | None = None
    """Modulation of the range camera's light; None where unknown: then no circular error is estimated."""
    range_terms: RangeTerms | None = None
    """Shapes of the range camera's bias; None: those that the images determine."""

    def __post_init__(self) -> None:
        if self.gauge not in self.cameras:
            raise BadInputError("unknown_camera", f"the gauge {self.gauge} is none of {', '.join(self.cameras)}")


def usual_plan(spectra: Mapping[str, Spectrum], *, rig_name: str = "rig", gauge: str | None = None) -> SolvePlan:
    """Plan for cameras by spectrum: the gauge is the first range camera, else the first; everything else as usual."""
    first_range = next((name for name, spectrum in spectra.items() if spectrum is Spectrum.RANGE), None)
    cameras = {name: CameraPlan(spectrum=spectrum) for name, spectrum in spectra.items()}
    return SolvePlan(cameras=cameras, gauge=gauge or first_range or next(iter(spectra)), rig_name=rig_name)
