"""Scan: a head pose and all its images.

    range_m      (H, W) float32   metres along each beam of `range_camera`; NaN = nothing came back (not "free")
    amplitude    (H, W) uint16    what the time-of-flight camera's own light returned
    colour       {camera: (H, W, 3) uint8}     sRGB, in R, G, B order
    thermal      {camera: (H, W) float32}      apparent temperature, kelvin; NaN = no reading
    labels       {camera: (H, W) uint8, uint16}   number of what each pixel shows, in the words of `label_names`
    scalars      {channel: float}              named readings at the rig's origin (dose, gas, ...)
    points_m     (N, 3) float32   metres, of a sweep without a raster; then range_m is its image to look at
    T_map_body   pose of the robot's body, so that its own points can be left out

Other conventions (z-depth, millimetres, raw counts) enter through `recording_format` only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, check_transform
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.recording.scan_units import check_ranges, check_temperatures, check_time
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import CLASS_NAME

Image = npt.NDArray[np.generic]
LabelNames = Mapping[int, str | None]
LABEL_MAX = 65535
"""Largest number of a label."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """All images of one head pose, at one time."""

    time_s: float
    """UTC, seconds since 1970."""
    T_map_rig: Transform
    """Pose of the rig."""
    range_camera: str
    """Camera of `range_m` and `amplitude`."""
    range_m: npt.NDArray[np.float32]
    points_m: npt.NDArray[np.float32] | None = None
    """Points that `range_camera` saw from its origin, in its frame; they, not `range_m`, become evidence."""
    amplitude: npt.NDArray[np.uint16] | None = None
    colour: Mapping[str, npt.NDArray[np.uint8]] = field(default_factory=dict)
    thermal: Mapping[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    labels: Mapping[str, npt.NDArray[np.uint8 | np.uint16]] = field(default_factory=dict)
    """Label images of the rig's cameras, of any spectrum, in the raster of their camera."""
    label_names: LabelNames = field(default_factory=dict)
    """Class of each number that a label image holds; None: such a pixel says nothing."""
    scalars: Mapping[str, float] = field(default_factory=dict)
    T_map_body: Transform | None = None
    """Pose of the frame of the rig's body; None: the body's boxes are in the rig's frame."""

    def __repr__(self) -> str:
        height, width = self.range_m.shape if self.range_m.ndim == 2 else (0, 0)
        images = [f"{self.range_camera} {width} x {height}", *self.colour, *self.thermal]
        points = "" if self.points_m is None else f", {len(self.points_m)} points"
        place = ", ".join(f"{value:.3f}" for value in self.T_map_rig[:3, 3])
        return f"Scan({self.time_s:.3f} s, at ({place}) m, {', '.join(images)}{points})"

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_map_rig", check_transform(self.T_map_rig, name="T_map_rig"))
        if self.T_map_body is not None:
            object.__setattr__(self, "T_map_body", check_transform(self.T_map_body, name="T_map_body"))
        if not isinstance(self.range_m, np.ndarray):
            # Above all no `DenseDepth`: a range filled in for viewing is no measurement.
            raise BadInputError("bad_scan", f"range_m must be an array of ranges, got {type(self.range_m).__name__}")
        if not np.isfinite(self.time_s):
            raise BadInputError("bad_scan", f"time_s must be finite seconds, got {self.time_s}")


def check_scan(scan: Scan, rig: Rig) -> None:
    """Refuse a scan whose images do not fit the rig's cameras in size, type or spectrum, or are in another unit.

    Raises:
        BadInputError: with the camera's name and what was expected; kind `bad_units`: `scan_units`.
    """
    for kind, images in (("colour", scan.colour), ("thermal", scan.thermal)):
        if not isinstance(images, Mapping):
            raise BadInputError(
                "bad_scan",
                f"{kind} must be a mapping from cameras to images, {{camera: array}}; got {type(images).__name__}",
            )
    _check_image(rig, scan.range_camera, scan.range_m, Spectrum.RANGE, np.float32)
    if scan.points_m is not None:
        _check_points(scan, scan.points_m)
    if scan.amplitude is not None:
        _check_image(rig, scan.range_camera, scan.amplitude, Spectrum.RANGE, np.uint16)
    for name, image in scan.colour.items():
        _check_image(rig, name, image, Spectrum.COLOUR, np.uint8)
        if image.ndim != 3 or image.shape[2] != 3:
            raise BadInputError("bad_scan", f"colour image of {name} must be (H, W, 3), got {image.shape}")
    for name, kelvin in scan.thermal.items():
        _check_image(rig, name, kelvin, Spectrum.THERMAL, np.float32)
        check_temperatures(name, kelvin)
    _check_labels(scan, rig)
    check_ranges(scan.range_camera, scan.range_m)
    check_time(scan.time_s)


def _check_image(rig: Rig, name: str, image: Image, spectrum: Spectrum, dtype: type[np.generic]) -> None:
    mounted = rig[name]
    if mounted.spectrum is not spectrum:
        raise BadInputError("bad_scan", f"camera {name} is {mounted.spectrum}, but a {spectrum} image came for it")
    if image.dtype != dtype:
        raise BadInputError("bad_scan", f"{spectrum} image of {name} must be {np.dtype(dtype)}, got {image.dtype}")
    mounted.camera.check_image(image, name=f"{spectrum} image of {name}")


def _check_labels(scan: Scan, rig: Rig) -> None:
    """Refuse a table with numbers or names that none may have, and label images that do not fit it or their camera."""
    for number, name in scan.label_names.items():
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or not 0 <= number <= LABEL_MAX:
            raise BadInputError(
                "bad_labels", f"a table of labels has numbers from 0 to {LABEL_MAX}, got {number!r:.80}"
            )
        if name is not None and not (isinstance(name, str) and CLASS_NAME.fullmatch(name)):
            raise BadInputError(
                "bad_labels",
                "the name of a label is 1 to 32 of a-z, 0-9 and _ and begins with a letter, or is None for one that "
                f"says nothing; got {name!r:.80} for {number}",
            )
    for name, image in scan.labels.items():
        if image.dtype not in (np.uint8, np.uint16) or image.ndim != 2:
            raise BadInputError(
                "bad_scan", f"labels of {name} must be (H, W) uint8 or uint16, got {image.dtype} of shape {image.shape}"
            )
        rig[name].camera.check_image(image, name=f"label image of {name}")
        found = np.flatnonzero(np.bincount(image.ravel(), minlength=1))
        strange = [number for number in found.tolist() if number not in scan.label_names]
        if strange:
            numbers = ", ".join(map(str, strange[:8]))
            raise BadInputError(
                "unknown_label", f"labels of {name} hold {numbers}, which the table does not name (null: says nothing)"
            )


def _check_points(scan: Scan, points: Image) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype != np.float32:
        raise BadInputError("bad_scan", f"points_m must be (N, 3) float32, got {points.dtype} of shape {points.shape}")
    if scan.amplitude is not None or scan.colour or scan.thermal or scan.labels:
        raise BadInputError("bad_scan", "points without a raster carry no amplitude, colour, temperature or labels")
