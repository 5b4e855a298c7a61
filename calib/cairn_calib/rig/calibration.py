"""Origin and covariance of a rig's numbers: the `calibration` of `rig.json`.

    "calibration": {"software": "cairn 0.1.0", "made_s": 1763740800.0, "gauge": "tof",
     "units": {"length": "m", "angle": "rad", "image": "px", "distortion": "1"},
     "covariance": {"parameters": [{"camera": "tof", "name": "fx", "unit": "px"}, ...],
      "lower": [[0.04], [0.0, 0.05], ...]},
     "statistics": {"chi2": 1987.1, "degrees_of_freedom": 2010, "cameras": {"tof": {"images": 12, "points": 420,
      "outliers": 3, "rms_px": 0.09, "sigma_px": 0.1}}},
     "inputs": [{"name": "corners.json", "size_bytes": 81234, "sha256": "..."}]}

A pose has six parameters of its own, wherever it points: the true T_rig_camera is [exp(r) R | t + dt] for the stated
[R | t], with r = (rx, ry, rz) in radians about the rig's axes and dt = (tx, ty, tz) in metres along them. Of the
covariance the lower triangle is kept, row by row: a matrix that is not symmetric cannot be written down.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.rig.lens import Lens
from cairn_calib.rig.raster import Raster
from cairn_map.arrays import Floats

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Count = Annotated[int, Field(ge=0, le=1 << 40)]
Positive = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Unit = Literal["px", "1", "rad", "m"]

PARAMETERS_MAX = 240
"""Their covariance is 0.9 MB of JSON: a `rig.json` holds 4 MiB, and maybe a map of pixels besides."""
POSE_UNITS: dict[str, Unit] = {"rx": "rad", "ry": "rad", "rz": "rad", "tx": "m", "ty": "m", "tz": "m"}
PIXEL_NAMES = frozenset({"fx", "fy", "cx", "cy"})
INDEFINITE_SHARE = 1e-9
"""Share of the correlations' largest eigenvalue below which a negative one is rounding."""


class Units(BaseModel):
    """Units of all numbers of the file; there is no choice."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    length: Literal["m"] = "m"
    angle: Literal["rad"] = "rad"
    image: Literal["px"] = "px"
    distortion: Literal["1"] = "1"


class Parameter(BaseModel):
    """One number of one camera: of its intrinsics, or of its place on the rig."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera: Name
    name: Annotated[str, Field(max_length=8)]
    unit: Unit

    @model_validator(mode="after")
    def _unit_of_its_name(self) -> Self:
        if self.unit != unit_of(self.name):
            raise ValueError(f"the unit of {self.name[:8]} must be {unit_of(self.name)}, got {self.unit}")
        return self


class Covariance(BaseModel):
    """Covariance of some parameters, in the products of their units; those that are not listed were held fixed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    parameters: Annotated[tuple[Parameter, ...], Field(min_length=1, max_length=PARAMETERS_MAX)]
    lower: Annotated[tuple[tuple[Finite, ...], ...], Field(max_length=PARAMETERS_MAX)]

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if len(set(self.parameters)) < len(self.parameters):
            raise ValueError("a parameter is listed twice")
        lengths = [len(row) for row in self.lower]
        if lengths != list(range(1, len(self.parameters) + 1)):
            raise ValueError(f"lower must have rows of 1 to {len(self.parameters)} numbers, one for each parameter")
        matrix = self.matrix
        sigmas = np.sqrt(np.maximum(np.diag(matrix), 0))
        safe = np.where(sigmas > 0, sigmas, 1)
        with np.errstate(over="ignore"):
            correlations = matrix / safe[:, None] / safe
        if not np.isfinite(correlations).all() or (values := np.linalg.eigvalsh(correlations))[0] < -(
            INDEFINITE_SHARE * max(values[-1], 1.0)
        ):
            raise ValueError("lower is no covariance: it has a negative eigenvalue")
        return self

    @property
    def matrix(self) -> Floats:
        """(P, P) float64, symmetric."""
        matrix = np.zeros((len(self.lower), len(self.lower)))
        for n, row in enumerate(self.lower):
            matrix[n, : n + 1] = row
            matrix[: n + 1, n] = row
        return matrix

    @property
    def sigmas(self) -> Floats:
        """(P,) standard deviation of each parameter, in its unit."""
        return np.sqrt(np.diag(self.matrix))


class CameraStatistics(BaseModel):
    """Residuals of one camera's points; pixels of one axis, as mrcal states them (OpenCV's are sqrt(2) as large)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: Count
    points: Count
    outliers: Count
    """Points that were left out; they count in no other number."""
    rms_px: Positive
    """sqrt(sum of squares of x and y residuals / (2 points))."""
    sigma_px: Positive
    """Noise of its points as estimated together with everything else: residuals are smaller, for they were fitted."""


class Statistics(BaseModel):
    """Residuals of the whole rig, by the estimated noise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    chi2: Positive
    degrees_of_freedom: Count
    cameras: Annotated[dict[Name, CameraStatistics], Field(max_length=32)]
    scatter: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    """Variance by which images disagree, over that which the noise of their corners explains; the covariance has been
    enlarged by it. None: noise explains all."""


class InputFile(BaseModel):
    """One file that the numbers came from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=200)]
    size_bytes: Count
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Calibration(BaseModel, frozen=True):
    """The record of one calibration."""

    model_config = ConfigDict(extra="forbid")

    software: Annotated[str, Field(min_length=1, max_length=200)]
    made_s: Annotated[float, Field(ge=0, le=1e11)]
    """Seconds since 1970, UTC."""
    gauge: Name
    """The camera whose frame is the rig's: its T_rig_camera is the identity and has no uncertainty."""
    units: Units = Units()
    covariance: Covariance | None = None
    statistics: Statistics | None = None
    inputs: Annotated[tuple[InputFile, ...], Field(max_length=1000)] = ()

    def check_cameras(self, cameras: Mapping[str, Raster]) -> None:
        """Check that the calibration is of these cameras.

        Raises:
            ValueError: a camera that is not there, a parameter that its camera has not, or a pose of the gauge.
        """
        parameters = self.covariance.parameters if self.covariance is not None else ()
        measured = self.statistics.cameras if self.statistics is not None else {}
        for name in (self.gauge, *(each.camera for each in parameters), *measured):
            if name not in cameras:
                raise ValueError(f"calibration speaks of {name}; the rig has {', '.join(cameras)}")
        for each in parameters:
            lens = cameras[each.camera]
            known = () if each.camera == self.gauge else tuple(POSE_UNITS)
            known += lens.intrinsic_names if isinstance(lens, Lens) else ()
            if each.name not in known:
                raise ValueError(f"calibration: {each.camera} has no {each.name}; it has {', '.join(known) or 'none'}")


def unit_of(name: str) -> Unit:
    """The unit of a parameter."""
    return "px" if name in PIXEL_NAMES else POSE_UNITS.get(name, "1")


def covariance_from_matrix(names: Sequence[tuple[str, str]], matrix: npt.ArrayLike) -> Covariance:
    """The covariance of parameters by camera and name, of a (P, P) matrix; its halves' mean, so symmetric."""
    full = np.asarray(matrix, dtype=np.float64)
    mean = (full + full.T) / 2
    parameters = [Parameter(camera=camera, name=name, unit=unit_of(name)) for camera, name in names]
    return Covariance(
        parameters=tuple(parameters), lower=tuple(tuple(map(float, row[: n + 1])) for n, row in enumerate(mean))
    )
