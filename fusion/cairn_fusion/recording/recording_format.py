"""Format of recordings: the header `recording.json`, the coding of pixels, the paths that it may name (RECORDING.md).

A recording may come from any source: every path in it must stay inside its folder, symbolic links included, or opening
it would expose other files of this machine.

A depth camera usually reports the distance along the optical axis (z), in integer millimetres or tenths; a
time-of-flight camera the distance along the beam. A mix-up bends every wall by up to 20 % at the image's corners, so
callers choose a function by convention: `range_from_z_depth` or `range_from_radial`.
"""

import json
import re
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lidar import AnyCamera, SpinningLidar
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.recording.timed_lists import read_text
from cairn_map.arrays import Counts
from cairn_map.errors import BadInputError, first_error
from cairn_map.evidence.channels import ClassName

Image = npt.NDArray[np.generic]
Ranges = npt.NDArray[np.float32]

HEADER_FILE = "recording.json"
RIG_FILE = "rig.json"
TRAJECTORY_FILE = "trajectory.txt"
BODY_FILE = "trajectory.body.txt"
"""No camera's list can have this name: a camera's has no dot."""
MEASUREMENTS_FILE = "measurements.txt"
SCALARS_FILE = "scalars.txt"
HEADER_BYTES_MAX = 1 << 20
CHANNEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
CAMERA_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""No dot: `<camera>.amplitude.txt` would be another camera's list."""
RESERVED_NAMES = frozenset(["trajectory", "measurements", "scalars"])
COUNT_MAX = 65535
PATH_LENGTH_MAX = 1024
NAME_BYTES_MAX = 255
"""Longest part of a path on all common file systems; a longer one would raise the system's own error."""

Metres = npt.NDArray[np.float32]
Kelvin = npt.NDArray[np.float32]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


LabelNumber = Annotated[str, Field(pattern=r"^(0|[1-9][0-9]{0,4})$")]
LabelTable = Annotated[dict[LabelNumber, ClassName | None], Field(min_length=1, max_length=COUNT_MAX + 1)]


class Convention(StrEnum):
    """Kind of distance in a depth pixel."""

    RANGE = "range"
    """Along the pixel's beam, as a time-of-flight camera measures."""
    Z = "z"
    """Along the optical axis, as most RGB-D cameras report."""


class RangeEncoding(BaseModel):
    """Coding of distance: counts = metres * units_per_m; count 0 = nothing came back."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units_per_m: Positive = 1000.0
    """Millimetres: 65.5 m at most, rounding 0.3 mm rms, where time of flight is noisy by centimetres."""
    convention: Convention = Convention.RANGE


class ThermalEncoding(BaseModel):
    """Coding of temperature: kelvin = counts * kelvin_per_count + kelvin_at_zero; count 0 = no reading."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kelvin_per_count: Positive = 0.01
    """655 K at most; a tenth of what an uncooled microbolometer resolves."""
    kelvin_at_zero: Annotated[float, Field(allow_inf_nan=False)] = 0.0


class RecordingHeader(BaseModel):
    """`recording.json`: the name, the recorded cameras and their coding, and limits on gaps in time."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["cairn-recording"] = "cairn-recording"
    version: Literal[1] = 1
    name: Name
    note: Annotated[str, Field(max_length=4096)] = ""
    range: dict[str, RangeEncoding]
    amplitude: tuple[str, ...] = ()
    colour: tuple[str, ...] = ()
    thermal: dict[str, ThermalEncoding] = Field(default_factory=dict)
    labels: Annotated[dict[str, LabelTable], Field(exclude_if=lambda tables: not tables)] = {}
    """Class of each number in each camera's label images; null: such a pixel says nothing. Written only where there are
    labels, for older readers refuse the field."""
    max_gap_s: Seconds = 0.0
    """Largest time between the range image and another camera's image, seconds; 0: the same time stamp."""
    max_pose_gap_s: Seconds = 0.0
    """Largest time between two poses for interpolation, seconds; 0: a pose with the same time stamp."""

    def to_json(self) -> bytes:
        """The bytes of `recording.json`; the mirror of `header_from_json`."""
        return self.model_dump_json(indent=1).encode() + b"\n"


def header_from_json(text: str) -> RecordingHeader:
    """The header in the text of `recording.json`.

    Raises:
        BadInputError: not JSON, another format or version, or a field is missing or out of range.
    """
    try:
        if twice := keys_twice(text):
            raise BadInputError("bad_recording", f"{HEADER_FILE}: {twice[:64]!r} stands twice in one table")
        return RecordingHeader.model_validate_json(text)
    except ValidationError as exc:
        raise BadInputError("bad_recording", f"{HEADER_FILE}: {first_error(exc)}") from exc


def keys_twice(text: str) -> str:
    """A key that stands twice in one object of a JSON text, of which readers would take either; empty if none does."""
    twice: list[str] = []

    def seen(pairs: list[tuple[str, object]]) -> None:
        twice.extend(repeated([key for key, _ in pairs]))

    try:
        json.loads(text, object_pairs_hook=seen)
    except (ValueError, RecursionError):
        return ""  # no JSON: the header's own check says so
    return min(twice, default="")


def repeated(keys: Sequence[str]) -> list[str]:
    """Keys that are in a list more than once; time is linear, since a table of labels has up to 65 536."""
    return [key for key, count in Counter(keys).items() if count > 1] if len(set(keys)) < len(keys) else []


def read_header(folder: Path) -> RecordingHeader:
    """The header of a recording's folder.

    Raises:
        BadInputError: `unfinished_recording` when the writer never came to its end; else no recording, or a bad header.
    """
    if not (folder / HEADER_FILE).is_file() and (folder / RIG_FILE).is_file():
        raise BadInputError(
            "unfinished_recording", f"{folder} has {RIG_FILE} but no {HEADER_FILE}: it was never finished"
        )
    return header_from_json(read_text(path_inside(folder, HEADER_FILE), HEADER_BYTES_MAX))


def check_cameras(header: RecordingHeader, rig: Rig) -> None:
    """Refuse a header that names cameras which the rig lacks, or has with another spectrum.

    Raises:
        BadInputError: with the camera's name.
    """
    for spectrum, names in (
        (Spectrum.RANGE, [*header.range, *header.amplitude]),
        (Spectrum.COLOUR, header.colour),
        (Spectrum.THERMAL, header.thermal),
    ):
        for name in names:
            check_camera_name(name)
            if rig[name].spectrum is not spectrum:
                raise BadInputError(
                    "bad_recording", f"{HEADER_FILE} lists {name} as {spectrum}, the rig as {rig[name].spectrum}"
                )
    for name, encoding in header.range.items():
        if encoding.convention is Convention.Z and isinstance(rig[name].camera, SpinningLidar | FisheyeCamera):
            raise BadInputError(
                "bad_recording",
                f"{HEADER_FILE}: {name} looks all around, so its distances must be along the beam, not z",
            )
    for name, table in header.labels.items():
        check_camera_name(name)
        _ = rig[name]  # any spectrum: labels are of what a camera's raster shows
        if max(map(int, table)) > COUNT_MAX:
            raise BadInputError("bad_recording", f"{HEADER_FILE}: labels of {name} are numbers up to {COUNT_MAX}")
    if stray := set(header.amplitude) - set(header.range):
        raise BadInputError("bad_recording", f"{HEADER_FILE}: amplitude without range for {', '.join(sorted(stray))}")


def check_camera_name(name: str) -> None:
    """Refuse a camera whose name cannot be a file's."""
    if not CAMERA_NAME.fullmatch(name) or name in RESERVED_NAMES:
        raise BadInputError(
            "bad_recording",
            f"a recorded camera's name must be letters, digits, _ or -, and not reserved, got {name[:80]!r}",
        )


def path_inside(folder: Path, relative: str) -> Path:
    """Real path of a file that a recording names, certain to be inside the recording's folder.

    Raises:
        BadInputError: `unsafe_path`: absolute, with `..` or a backslash, or a link that leads outside.
    """
    parts = PurePosixPath(relative)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or re.search(r"[\\\x00-\x1f]", relative):
        raise BadInputError("unsafe_path", f"a path must be relative and stay in the folder, got {relative[:200]!r}")
    if len(relative) > PATH_LENGTH_MAX or any(len(part.encode()) > NAME_BYTES_MAX for part in parts.parts):
        raise BadInputError("unsafe_path", f"a path is too long for a file system: {relative[:200]!r}...")
    root = folder.resolve()
    try:
        path = (root / parts).resolve()
    except (OSError, RuntimeError) as exc:  # a loop of links
        raise BadInputError("unsafe_path", f"{relative[:200]!r} cannot be followed in {folder}") from exc
    if not path.is_relative_to(root):
        raise BadInputError("unsafe_path", f"{relative[:200]!r} leads out of {folder}")
    return path


def decode_range(counts: Counts, camera: AnyCamera, encoding: RangeEncoding) -> Metres:
    """(H, W) float32 metres along the beam from counts; 0 becomes NaN."""
    convert = range_from_z_depth if encoding.convention is Convention.Z else range_from_radial
    return convert(counts, camera, units_per_m=encoding.units_per_m)


def encode_range(range_m: Metres, camera: AnyCamera, encoding: RangeEncoding) -> Counts:
    """(H, W) uint16 counts, rounded to the nearest; NaN becomes 0, and nothing else does.

    Raises:
        BadInputError: a range that is not positive, or too far for 16 bits in these units.
    """
    along = range_m * camera.rays()[..., 2] if encoding.convention is Convention.Z else range_m.astype(np.float64)
    if np.any(along <= 0):
        raise BadInputError("bad_scan", f"ranges must be positive or NaN, got {np.nanmin(along):.6g} m")
    return _counts(along * encoding.units_per_m, f"range in {encoding.units_per_m:g} units per metre")


def decode_kelvin(counts: Counts, encoding: ThermalEncoding) -> Kelvin:
    """(H, W) float32 kelvin from counts; 0 becomes NaN."""
    return kelvin_from_counts(
        counts, kelvin_per_count=encoding.kelvin_per_count, kelvin_at_zero=encoding.kelvin_at_zero
    )


def encode_kelvin(kelvin: Kelvin, encoding: ThermalEncoding) -> Counts:
    """(H, W) uint16 counts, rounded to the nearest; NaN becomes 0, and nothing else does.

    Raises:
        BadInputError: a temperature outside what 16 bits hold in this scale.
    """
    scaled = (kelvin.astype(np.float64) - encoding.kelvin_at_zero) / encoding.kelvin_per_count
    if np.any(scaled < 0):
        raise BadInputError("bad_scan", f"temperatures must be at least {encoding.kelvin_at_zero:g} K in this scale")
    return _counts(scaled, f"temperature at {encoding.kelvin_per_count:g} kelvin per count")


def _counts(scaled: npt.NDArray[np.float64], what: str) -> Counts:
    if np.any(scaled > COUNT_MAX + 0.5):
        raise BadInputError("bad_scan", f"{what} must fit 16 bits, got a count of {np.nanmax(scaled):.6g}")
    # A real reading must not round to 0, which means none; and 65535.5 rounds to even, beyond the type.
    rounded = np.clip(np.rint(scaled), 1, COUNT_MAX)
    return np.where(np.isnan(scaled), 0, rounded).astype(np.uint16)


def range_from_z_depth(depth: Image, camera: AnyCamera, *, units_per_m: float) -> Ranges:
    """Ranges along the beam from a z-depth image.

    Eq. 4 of Kocmanova et al. backwards: d = z / (z component of the pixel's unit ray).

    Args:
        depth: (H, W) any number type, distance along the optical axis; 0 or NaN where nothing came back.
        camera: the depth camera.
        units_per_m: depth units in one metre: 1000 for millimetres, 1 for metres.

    Returns:
        (H, W) float32, metres along each beam; NaN where nothing came back.

    Raises:
        BadInputError: wrong image size, or `units_per_m` not positive.
    """
    z_m = _metres(depth, camera, units_per_m)
    return (z_m / camera.rays()[..., 2]).astype(np.float32)


def range_from_radial(radial: Image, camera: AnyCamera, *, units_per_m: float) -> Ranges:
    """Ranges from an image that already holds distance along the beam; arguments as `range_from_z_depth`."""
    return _metres(radial, camera, units_per_m).astype(np.float32)


def kelvin_from_counts(counts: Image, *, kelvin_per_count: float, kelvin_at_zero: float = 0.0) -> Ranges:
    """Apparent temperature from linear radiometric counts: (H, W) float32 kelvin; count 0 means no reading (NaN)."""
    values = counts.astype(np.float64)
    return np.where(values > 0, values * kelvin_per_count + kelvin_at_zero, np.nan).astype(np.float32)


def _metres(image: Image, camera: AnyCamera, units_per_m: float) -> npt.NDArray[np.float64]:
    if not units_per_m > 0:
        raise BadInputError("bad_scale", f"units_per_m must be positive, got {units_per_m}")
    camera.check_image(image, name="depth image")
    metres = image.astype(np.float64) / units_per_m
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.nan)
