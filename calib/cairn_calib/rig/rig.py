"""Rig: the cameras of one sensor head and the pose of each on it; `rig.json` on disk.

    {"format": "cairn-rig", "version": 1, "name": "orpheus-head",
     "cameras": {"tof": {"spectrum": "range", "camera": {...}, "T_rig_camera": [[...], ...]}, ...}}

`T_rig_camera` maps points from the camera's frame to the rig's, in metres. Which camera sees which
spectrum is part of the rig, so an image's meaning never depends on its file name. A camera without `model` is a
pinhole; a fisheye has `"model": "kb4"`, a spinning lidar `"model": "spinning"`. Optional parts are absent when unknown:
`sensing` and `range_bias` of a range camera, `calibration_sigma_px` of a camera, the robot's `body`, and the origin and
covariance of the numbers (`calibration`). Of a range camera's `sensing`,

    "sensing": {"sigma_m": [[0, 0.005], [3, 0.01], [10, 0.03]], "saturated_amplitude": 65535, "no_return_clears_m": 30}

each field that is absent is that of a usual sensor (`TIME_OF_FLIGHT`, `LIDAR`).
"""

import hashlib
from enum import StrEnum
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, field_validator, model_validator

from cairn_calib.rig.body import Body
from cairn_calib.rig.calibration import Calibration
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import Transform, check_transform
from cairn_calib.rig.radiometry import Radiometry
from cairn_calib.rig.range_bias import RangeBias, Real
from cairn_calib.rig.raster import Raster
from cairn_map.errors import BadInputError, first_error

Node = tuple[
    Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)],
    Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)],
]

RIG_BYTES_MAX = 4 << 20
"""A covariance of all parameters is 0.9 MB, a map of 640 x 480 pixels' offsets as much."""
VERSION = 1
Row = tuple[float, float, float, float]


class RangeSensing(BaseModel):
    """Noise and limits of a range camera, as its manufacturer states or a measurement shows them."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sigma_m: Annotated[tuple[Node, ...], Field(min_length=1, max_length=64)] | None = None
    """Range and standard deviation there, metres, by rising range: linear between two, constant beyond the ends."""
    saturated_amplitude: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Amplitude from which on too much light returned, and the range is void."""
    no_return_clears_m: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    """Range that a beam without return has found clear. Only for a sensor to which every surface within this range
    returns something: to a time-of-flight camera black, tilted or mirroring things return nothing."""

    @model_validator(mode="after")
    def _nodes_rise(self) -> Self:
        ranges_m = [range_m for range_m, _ in self.sigma_m or ()]
        if any(b <= a for a, b in pairwise(ranges_m)):
            raise ValueError(f"the ranges of sigma_m must rise, got {ranges_m}")
        return self

    def sigma_at(self, range_m: npt.NDArray[np.floating], *, usual: "RangeSensing") -> npt.NDArray[np.float64]:
        """(...) standard deviation at ranges, metres; by `usual` where this one does not say; NaN for NaN."""
        return np.asarray(np.interp(range_m, *self.sigma_nodes(usual=usual)))

    def sigma_nodes(self, *, usual: "RangeSensing") -> npt.NDArray[np.float64]:
        """(2, K) ranges, rising, and the standard deviation there, metres: linear between, constant beyond."""
        return np.array(self.sigma_m or usual.sigma_m or ((0.0, 0.0),), dtype=np.float64).T.copy()


TIME_OF_FLIGHT = RangeSensing(sigma_m=((0.0, 0.005), (3.0, 0.01), (6.0, 0.03)))
"""Usual time-of-flight camera: 5 mm at best, 1 cm at 3 m from a grey surface, growing with the square of the range
(MESA SR4000 and its kind)."""
LIDAR = RangeSensing(sigma_m=((0.0, 0.02),))
"""Usual spinning lidar: 2 cm at every range, as data sheets state."""

TIME_OF_FLIGHT_REACH_M, LIDAR_REACH_M = 10.0, 100.0
"""Greatest ranges of usual sensors, metres: beyond 10 m a time-of-flight camera wraps round (15 MHz), and the depth of
a stereo camera is noise; a spinning lidar sees walls to 100 m and farther."""


class Spectrum(StrEnum):
    """Quantity that a camera's pixels measure."""

    RANGE = "range"
    """Time of flight: metres along the beam, and optionally the amplitude (near infrared) that came back."""
    COLOUR = "colour"
    """Visible: sRGB, 8 bits."""
    THERMAL = "thermal"
    """Far infrared: apparent temperature in kelvin."""


def _model_of(camera: object) -> str | None:
    """Model of a camera in a document; None for an unknown one."""
    if not isinstance(camera, dict):
        return str(getattr(camera, "model", "pinhole"))
    if "model" not in camera:
        return "pinhole"
    return str(camera["model"]) if camera["model"] in ("kb4", "spinning") else None


class MountedCamera(BaseModel, frozen=True):
    """One camera and its place on the rig; a lidar's spectrum is range."""

    model_config = ConfigDict(extra="forbid")

    spectrum: Spectrum
    # One model is tried, not both: the message of a refusal is about what was meant.
    camera: Annotated[
        Annotated[Camera, Tag("pinhole")]
        | Annotated[FisheyeCamera, Tag("kb4")]
        | Annotated[SpinningLidar, Tag("spinning")],
        Discriminator(
            _model_of,
            custom_error_type="camera_model",
            custom_error_message="model must be 'kb4' (a fisheye), 'spinning' (a lidar), or absent (a pinhole)",
        ),
    ]
    T_rig_camera: tuple[Row, Row, Row, Row]
    sensing: RangeSensing | None = None
    """Noise and limits of a range camera."""
    calibration_sigma_px: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """Expected error of the range camera's points in this camera, its own pixels: one axis, standard deviation."""
    radiometry: Radiometry | None = None
    """Response of a thermal camera to temperature."""
    range_bias: RangeBias | None = None
    """Bias of a range camera with a lens."""

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        try:
            check_transform(self.T_rig_camera, name="T_rig_camera")
        except BadInputError as exc:
            raise ValueError(exc.message) from exc
        return self

    @model_validator(mode="after")
    def _lidar_measures_range(self) -> Self:
        if isinstance(self.camera, SpinningLidar) and self.spectrum is not Spectrum.RANGE:
            raise ValueError(f"a spinning lidar's spectrum must be range, got {self.spectrum}")
        return self

    @model_validator(mode="after")
    def _range_is_sensed_by_range_cameras(self) -> Self:
        if self.sensing is not None and self.spectrum is not Spectrum.RANGE:
            raise ValueError(f"sensing is of range cameras, not of {self.spectrum}")
        return self

    @model_validator(mode="after")
    def _temperatures_are_of_thermal_cameras(self) -> Self:
        if self.radiometry is not None and self.spectrum is not Spectrum.THERMAL:
            raise ValueError(f"radiometry is of thermal cameras, not of {self.spectrum}")
        return self

    @model_validator(mode="after")
    def _biases_are_of_range_cameras(self) -> Self:
        is_lidar = isinstance(self.camera, SpinningLidar)
        if self.range_bias is not None and (is_lidar or self.spectrum is not Spectrum.RANGE):
            other = "lidars" if is_lidar else str(self.spectrum)
            raise ValueError(f"range_bias is of range cameras with a lens, not of {other}")
        offsets = None if self.range_bias is None else self.range_bias.pixel_offsets
        if offsets is not None and (offsets.width, offsets.height) != (self.camera.width, self.camera.height):
            raise ValueError(
                f"range_bias.pixel_offsets must be of the camera's {self.camera.width} x {self.camera.height} pixels, "
                f"got {offsets.width} x {offsets.height}"
            )
        return self

    @property
    def transform(self) -> Transform:
        """`T_rig_camera` as (4, 4) float64, read-only."""
        return _rigid_transform(self.T_rig_camera)

    @property
    def known_sensing(self) -> RangeSensing:
        """Stated `sensing`; one without any statement where the rig has none."""
        return self.sensing or RangeSensing()

    @property
    def usual_reach_m(self) -> float:
        """Greatest range of a usual sensor of this kind, metres."""
        return LIDAR_REACH_M if isinstance(self.camera, SpinningLidar) else TIME_OF_FLIGHT_REACH_M

    def range_sigma_m(self, range_m: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """(...) standard deviation of the range camera at ranges, metres: as stated, else as is usual.

        The uncertainty of its `range_bias` is included, as if it were noise.
        """
        sigma_m = self.range_noise_m(range_m)
        return sigma_m if self.range_bias is None else np.hypot(sigma_m, self.range_bias.sigma_at(range_m))

    def range_sigma_image(self, range_m: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """(H, W) standard deviation at (H, W) ranges, metres, with each pixel's own uncertainty of `range_bias`."""
        if self.range_bias is None:
            return self.range_sigma_m(range_m)
        usual = self.known_sensing.sigma_at(range_m, usual=TIME_OF_FLIGHT)
        return np.hypot(usual, self.range_bias.sigma_image(self.camera, range_m))

    def range_noise_m(self, range_m: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """(...) standard deviation at ranges, metres, without the bias: independent from pixel to pixel."""
        return np.asarray(np.interp(range_m, *self.range_noise_nodes))

    @property
    def range_noise_nodes(self) -> npt.NDArray[np.float64]:
        """(2, K) ranges, rising, and the standard deviation there without the bias, metres: linear between."""
        return self.known_sensing.sigma_nodes(usual=LIDAR if isinstance(self.camera, SpinningLidar) else TIME_OF_FLIGHT)

    def true_ranges(
        self, range_m: npt.NDArray[Real], amplitude: npt.NDArray[np.generic] | None = None
    ) -> npt.NDArray[Real]:
        """(H, W) ranges, metres, of (H, W) that the range camera measured: without its bias.

        The same array where the rig states no bias. `amplitude` are counts, (H, W); None: the usual ones.

        Raises:
            BadInputError: an image has another size.
        """
        return range_m if self.range_bias is None else self.range_bias.true_image(self.camera, range_m, amplitude)

    def true_points(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """(N, 3) points in the range camera's frame, metres, of (N, 3) that it measured: each moved along its ray.

        The pixel of a point is where the camera sees it; its amplitude is taken for the usual one. The same array where
        the rig states no bias.

        Raises:
            BadInputError: a point is not in the camera's image, so it is of another sensor.
        """
        if self.range_bias is None:
            return points
        known = np.isfinite(points).all(axis=1) & points.any(axis=1)  # its own place is no point
        pixels = self.camera.project(points[known])
        if strange := int((~self.camera.contains(pixels)).sum()):
            raise BadInputError(
                "bad_points",
                f"{strange} of {len(points)} points are not in the image of the range camera ({self.camera.width} x "
                f"{self.camera.height} pixels), so its range_bias cannot be taken off: name the camera they are of",
            )
        measured_m = np.linalg.norm(points[known].astype(np.float64), axis=1)
        share = self.range_bias.true_at(self.camera, pixels, measured_m) / measured_m
        true = points.astype(np.float64)
        true[known] *= share[:, None]
        return true


@lru_cache(maxsize=256)
def _rigid_transform(rows: tuple[Row, Row, Row, Row]) -> Transform:
    # Kept: to make a rotation orthonormal takes 0.2 ms, as long as all the rest that is asked of a rig for a scan.
    T = check_transform(rows, name="T_rig_camera")
    T.setflags(write=False)
    return T


class Rig(BaseModel):
    """The cameras of one head by name; at least one, and all that are needed to read its images."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["cairn-rig"] = "cairn-rig"
    version: Literal[1] = 1
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    cameras: Annotated[dict[str, MountedCamera], Field(min_length=1, max_length=32)]
    body: Body | None = None
    """Shape of the robot that carries the rig."""
    calibration: Calibration | None = None
    """Origin of the numbers, and their covariance."""

    @field_validator("version", mode="before")
    @classmethod
    def _known_version(cls, value: object) -> object:
        if value != VERSION:
            raise ValueError(f"this cairn reads version {VERSION}, the file is of {value!r}: a newer cairn wrote it")
        return value

    @model_validator(mode="after")
    def _calibration_is_of_its_cameras(self) -> Self:
        if self.calibration is not None:
            self.calibration.check_cameras({name: each.camera for name, each in self.cameras.items()})
            gauge = self.calibration.gauge
            if not np.array_equal(self.cameras[gauge].transform, np.eye(4)):
                raise ValueError(f"calibration.gauge is {gauge}: its T_rig_camera must be the identity")
        return self

    def __getitem__(self, name: str) -> MountedCamera:
        try:
            return self.cameras[name]
        except KeyError:
            raise BadInputError(
                "unknown_camera", f"rig {self.name} has no camera {name!r}; it has {', '.join(self.cameras)}"
            ) from None

    def of_spectrum(self, spectrum: Spectrum) -> list[str]:
        """Names of the cameras of one spectrum, in the rig's order."""
        return [name for name, mounted in self.cameras.items() if mounted.spectrum is spectrum]

    def to_json(self) -> bytes:
        """The rig as `rig.json` bytes; the mirror of `rig_from_json`."""
        return self.model_dump_json(indent=1, exclude_none=True).encode() + b"\n"

    def digest(self) -> str:
        """SHA-256, in hex, of the JSON bytes; commits carry it, so that a bad calibration can be found and undone."""
        return hashlib.sha256(self.to_json()).hexdigest()


def mount_camera(spectrum: Spectrum, camera: Raster, T_rig_camera: Transform) -> MountedCamera:
    """A camera at a place given as an array."""
    rows = [tuple(float(v) for v in row) for row in np.asarray(T_rig_camera)]
    return MountedCamera.model_validate({"spectrum": spectrum, "camera": camera, "T_rig_camera": rows})


def rig_from_json(data: bytes) -> Rig:
    """The rig in `rig.json` bytes.

    Raises:
        BadInputError: not JSON, too large, or a field is missing or out of range; the message names the field.
    """
    if len(data) > RIG_BYTES_MAX:
        raise BadInputError("bad_rig", f"rig.json must be at most {RIG_BYTES_MAX} bytes, got {len(data)}")
    try:
        return Rig.model_validate_json(data)
    except ValidationError as exc:
        raise BadInputError("bad_rig", f"rig.json: {first_error(exc)}") from exc


def load_rig(path: Path | str) -> Rig:
    """The rig in a file.

    Raises:
        BadInputError: the file is missing or not a rig.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as exc:
        raise BadInputError("bad_rig", f"cannot read {path}: {exc.strerror}") from exc
    return rig_from_json(data)
