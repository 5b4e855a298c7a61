"""What a solve is to find out: cameras and lenses, which numbers are free, what is known before, how noise is met.

Free by default, by spectrum (a lens's other coefficients are held at 0; k4 to k6 only by name):

    colour    fx fy cx cy  k1 k2 p1 p2 k3          thermal   fx fy cx cy  k1 k2 k3
    range     fx fy cx cy  k1 k2, k2 = 0 +- 0.3    a few coarse pixels cannot tell more

A prior is a pseudo-observation: a sum of numbers times coefficients is a value, give or take a standard deviation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cairn_calib.rig import Spectrum
from cairn_map.errors import BadInputError

FREE: dict[Spectrum, tuple[str, ...]] = {
    Spectrum.COLOUR: ("k1", "k2", "p1", "p2", "k3"),
    Spectrum.THERMAL: ("k1", "k2", "k3"),
    Spectrum.RANGE: ("k1", "k2"),
}
FISHEYE = ("k1", "k2", "k3", "k4")
BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
SHARED = ""
"""The owner of what belongs to no camera: the board's warp and scale."""
PITCH_SIGMA = 2e-4
"""Of the pitch of a printed board, relative: 20 um on 100 mm."""


@dataclass(frozen=True, slots=True)
class Prior:
    """sum(coefficient * parameter) = value +- sigma; parameters by owner (a camera, or `SHARED`) and name."""

    terms: tuple[tuple[str, str, float], ...]
    value: float
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPlan:
    """One camera: what it sees, its model, and the coefficients that are free."""

    spectrum: Spectrum
    model: str = "pinhole"
    """`pinhole` or `kb4`."""
    free: tuple[str, ...] | None = None
    """Names of free distortion coefficients; by default as usual for the spectrum."""

    def __post_init__(self) -> None:
        if self.model not in ("pinhole", "kb4"):
            raise BadInputError("bad_arguments", f"a lens is pinhole or kb4, got {self.model!r}")
        known = FISHEYE if self.model == "kb4" else BROWN
        if strange := [name for name in self.coefficients if name not in known]:
            raise BadInputError("bad_arguments", f"a {self.model} lens has {', '.join(known)}, got {strange[0]!r}")

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free distortion coefficients."""
        if self.free is not None:
            return self.free
        return FISHEYE if self.model == "kb4" else FREE[self.spectrum]


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """How noise is met: a robust loss, culling with re-admission, and a scale of noise for each sensor."""

    huber_sigmas: float = 1.5
    """Beyond that residuals pull with constant force, until outliers are known; infinite: never."""
    cull_sigmas: float = 4.0
    """Points further off are left out, and let in again if they fit later; infinite: never."""
    rounds: int = 8
    """Of estimating noise and culling, at most; 0: the corners' covariances are taken as stated."""


STATED = Noise(huber_sigmas=np.inf, cull_sigmas=np.inf, rounds=0)
"""Plain least squares with the corners' own covariances."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvePlan:
    """The whole of it; cameras by name, in the rig's order."""

    cameras: Mapping[str, CameraPlan]
    gauge: str
    """The camera whose frame is the rig's."""
    rig_name: str = "rig"
    pitch_sigma: float = PITCH_SIGMA
    """Of the board's pitch, relative; 0: exact."""
    warp: bool = True
    """Whether the board may be bent: a parabola along x and one along y."""
    priors: tuple[Prior, ...] = ()
    """Besides those that this module gives by itself."""
    usual_priors: bool = True
    """Whether those that few views or a coarse sensor need are added."""
    noise: Noise = field(default_factory=Noise)

    def __post_init__(self) -> None:
        if self.gauge not in self.cameras:
            raise BadInputError("unknown_camera", f"the gauge {self.gauge} is none of {', '.join(self.cameras)}")


def usual_plan(spectra: Mapping[str, Spectrum], *, rig_name: str = "rig", gauge: str | None = None) -> SolvePlan:
    """The plan for cameras by spectrum: gauge is the first range camera, all else as usual."""
    first_range = next((name for name, spectrum in spectra.items() if spectrum is Spectrum.RANGE), None)
    cameras = {name: CameraPlan(spectrum=spectrum) for name, spectrum in spectra.items()}
    return SolvePlan(cameras=cameras, gauge=gauge or first_range or next(iter(spectra)), rig_name=rig_name)
