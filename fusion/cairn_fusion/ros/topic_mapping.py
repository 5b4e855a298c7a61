"""Mapping of a bag's topics to cameras and poses: the YAML that `cairn robot inspect` proposes and `replay` follows.

name: lab-1
frames: {map: odom, base: base_link}
poses: {topic: /tf, max_gap_s: 0.2}
time_tolerance_s: 0.02
scans_per_measurement: 30
cameras:
  depth: {spectrum: range, topic: /camera/depth/image_raw, info: /camera/depth/camera_info, units_per_m: 1000}
  colour: {spectrum: colour, topic: /camera/color/image_raw, info: /camera/color/camera_info, labels: /segmentation}
label_names: {0: null, 7: wall, 11: chair}
"""

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from cairn_calib.exchange.yaml_text import document_of_yaml
from cairn_calib.rig.brown import Coefficients
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.raster import Side
from cairn_calib.rig.rig import Row, Spectrum
from cairn_fusion.clouds.sweep_image import virtual_lidar
from cairn_fusion.recording.recording_format import (
    Convention,
    Name,
    Positive,
    RangeEncoding,
    Seconds,
    ThermalEncoding,
    check_camera_name,
)
from cairn_fusion.recording.scan import LABEL_MAX
from cairn_fusion.recording.timed_lists import read_text
from cairn_fusion.ros.messages import RosCameraInfo
from cairn_map.errors import BadInputError, first_error
from cairn_map.evidence.channels import ClassName

MAPPING_BYTES_MAX = 1 << 20
TOPICS_FILE = "topics.yaml"
"""File next to a bag that says what its topics are, as a live robot's recording has it."""
DECIDE = "DECIDE"
"""Word of a proposed file where a fact is missing that only the maker of the bag knows."""
PLUMB_BOB = ("plumb_bob", "")
Topic = Annotated[str, Field(pattern=r"^\S{1,1024}$")]
Frame = Annotated[str, Field(pattern=r"^[^/\s]\S{0,254}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
LABEL_NUMBER = re.compile(r"0|[1-9][0-9]{0,4}")


def numbered(table: object) -> object:
    """A table of labels with whole numbers for keys, which JSON has as texts alone.

    Raises:
        ValueError: a key is no number of a label, or one stands twice.
    """
    if not isinstance(table, dict):
        return table
    found: dict[int, object] = {}
    for key, name in table.items():
        text = str(key)
        if isinstance(key, bool) or not LABEL_NUMBER.fullmatch(text) or int(text) > LABEL_MAX:
            raise ValueError(f"numbers of labels are whole ones from 0 to {LABEL_MAX}, got {text[:80]!r}")
        if int(text) in found:
            raise ValueError(f"label {text} stands twice")
        found[int(text)] = name
    return found


LabelTable = Annotated[dict[int, ClassName | None], BeforeValidator(numbered)]


class Model(BaseModel):
    """Immutable values; unknown fields are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Frames(Model):
    """Two frames of the tree of frames."""

    map: Frame
    """The frame that stays: the map's voxels are in it."""
    base: Frame
    """The frame that moves, and carries the cameras."""
    odom: Frame = "odom"
    """The frame in which the base never jumps (REP 105); it counts where it is on the way from the base to the map."""


class Poses(Model):
    """Source of poses."""

    topic: Topic = "/tf"
    """tf, nav_msgs/Odometry, or geometry_msgs/PoseStamped."""
    max_gap_s: Seconds = 0.2
    """Largest time between two poses for interpolation, seconds."""


class Corrections(Model):
    """Source of poses that a SLAM corrects afterwards; of live robots only."""

    topic: Topic
    """nav_msgs/Path: all poses of the way, each with its time, published again when they are optimised."""
    frame: Frame | None = None
    """Frame of the body that the poses are of; None: the base."""


class Intrinsics(Model):
    """A pinhole camera; pixels, the centre of the top-left pixel is (0, 0)."""

    width: Side
    height: Side
    focal_px: tuple[Positive, Positive]
    centre_px: tuple[Finite, Finite]
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3: ROS's plumb_bob."""


class LidarKind(StrEnum):
    """Kind of a topic of points."""

    SPINNING = "spinning"
    """Its beams are known: points are sorted into its raster."""
    CLOUD = "cloud"
    """Points without rows and rings: each is a beam of its own."""


class MappedLidar(Model):
    """A lidar; its frame is ROS's: x forward, y left, z up."""

    kind: LidarKind = LidarKind.SPINNING
    columns: Side | None = None
    """Columns of one turn; of a spinning lidar only."""
    elevations_deg: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=1024)] | None = None
    """Elevation of each beam, degrees, the highest first; of a spinning lidar only."""

    @model_validator(mode="after")
    def _is_lidar(self) -> Self:
        given = {self.columns is None, self.elevations_deg is None}
        if given != {self.kind is LidarKind.CLOUD}:
            raise ValueError("a spinning lidar has columns and elevations_deg, one of kind cloud has neither")
        self.lidar()
        return self

    def lidar(self) -> SpinningLidar:
        """The lidar as a camera model."""
        if self.columns is None or self.elevations_deg is None:
            return virtual_lidar()
        beams = self.elevations_deg
        return SpinningLidar(width=self.columns, height=len(beams), elevations_deg=beams)


class MappedCamera(Model):
    """One camera: its topics, its pose, and the coding of its pixels."""

    spectrum: Spectrum
    topic: Topic | None = None
    """Topic of its pixels or points; None: of this camera label images alone are mapped."""
    amplitude: Topic | None = None
    """Topic of a range camera's images of its own light, same raster."""
    labels: Topic | None = None
    """Topic of label images in the camera's raster: numbers of `label_names`, with the stamp of the labelled image."""
    info: Topic | None = None
    """Topic of CameraInfo, of which the first message counts."""
    intrinsics: Intrinsics | None = None
    """Intrinsics instead of `info`."""
    lidar: MappedLidar | None = None
    """Raster instead of both: the topic holds the point clouds of a spinning lidar."""
    is_rectified: bool = Field(default=False, alias="rectified")
    """True for rectified images: of `info` then P counts, and no distortion."""
    frame: Frame | None = None
    """Optical frame; None: the frame that the images name."""
    T_base_camera: tuple[Row, Row, Row, Row] | None = None
    """Transform instead of `frame` and tf: from the camera (x right, y down, z forward) to the base; metres."""
    units_per_m: Positive = 1000.0
    """Counts per metre of range images with 16 bits; those with 32FC1 are metres."""
    convention: Convention = Convention.Z
    kelvin_per_count: Positive = 0.01
    kelvin_at_zero: Finite = 0.0

    @property
    def image_topics(self) -> tuple[str, ...]:
        """Topics of its pixels or points, the one that names its frame first."""
        return tuple(topic for topic in (self.topic, self.amplitude, self.labels) if topic is not None)

    @property
    def first_topic(self) -> str:
        """Topic of its pixels or points; without one that of its label images."""
        return self.image_topics[0]

    @property
    def is_loose(self) -> bool:
        """True if the topic's points have no raster."""
        return self.lidar is not None and self.lidar.kind is LidarKind.CLOUD

    @property
    def range_encoding(self) -> RangeEncoding:
        """Coding of 16-bit range."""
        return RangeEncoding(units_per_m=self.units_per_m, convention=self.convention)

    @property
    def thermal_encoding(self) -> ThermalEncoding:
        """Coding of temperature."""
        return ThermalEncoding(kelvin_per_count=self.kelvin_per_count, kelvin_at_zero=self.kelvin_at_zero)

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.topic is None and (self.labels is None or self.spectrum is Spectrum.RANGE):
            raise ValueError("give the topic of its images; only a camera of labels, and of no ranges, can be without")
        if sum(given is not None for given in (self.info, self.intrinsics, self.lidar)) != 1:
            raise ValueError("give either info, a CameraInfo topic, or intrinsics; or lidar, of point clouds")
        if self.lidar is not None and (self.spectrum is not Spectrum.RANGE or len(self.image_topics) > 1):
            raise ValueError("a lidar's spectrum is range, and it has neither amplitude nor labels")
        if self.amplitude is not None and self.spectrum is not Spectrum.RANGE:
            raise ValueError("amplitude is of range cameras")
        return self


class BagMapping(Model):
    """Mapping of a bag: the whole file."""

    name: Name = "bag"
    frames: Frames
    poses: Poses = Poses()
    corrections: Corrections | None = None
    time_tolerance_s: Seconds = 0.02
    """Largest time between the range image and another image, seconds."""
    scans_per_measurement: Annotated[int, Field(ge=1, le=4096)] = 1
    cameras: Annotated[dict[str, MappedCamera], Field(min_length=1, max_length=32)]
    label_names: LabelTable = {}
    """Class of each number that label images hold; null: such a pixel says nothing."""

    @model_validator(mode="after")
    def _has_ranges(self) -> Self:
        for name in self.cameras:
            try:
                check_camera_name(name)
            except BadInputError as exc:
                raise ValueError(exc.message) from exc
        if all(camera.spectrum is not Spectrum.RANGE for camera in self.cameras.values()):
            raise ValueError("one camera at least must have the spectrum range")
        labelled = [name for name, camera in self.cameras.items() if camera.labels is not None]
        if labelled and not self.label_names:
            raise ValueError(
                f"camera {labelled[0]} has labels: name their numbers, `label_names: {{0: null, 7: wall}}`"
            )
        if self.label_names and not labelled:
            raise ValueError("label_names is given, and no camera has a topic of labels")
        return self

    def topics(self) -> dict[str, str]:
        """Topics of images and camera infos, each with its purpose."""
        wanted: dict[str, str] = {}
        for name, camera in self.cameras.items():
            wanted |= {
                topic: f"{what} of camera {name}"
                for topic, what in (
                    (camera.topic, "images"),
                    (camera.amplitude, "amplitude"),
                    (camera.labels, "labels"),
                    (camera.info, "info"),
                )
                if topic is not None
            }
        return wanted


def mapping_next_to(bag: Path) -> BagMapping | None:
    """The mapping that a folder with a bag holds; None: there is none.

    Raises:
        BadInputError: as `mapping_of`.
    """
    path = bag / TOPICS_FILE
    return mapping_of(path) if path.is_file() else None


def mapping_of(path: Path) -> BagMapping:
    """The mapping in a YAML file.

    Raises:
        BadInputError: missing, too large, no YAML, or a field is missing or wrong; the message names it.
    """
    return mapping_from_yaml(read_text(path, MAPPING_BYTES_MAX), path)


def mapping_from_yaml(text: str, path: Path | str) -> BagMapping:
    """The mapping in a YAML text; errors as `mapping_of`.

    Raises:
        BadInputError: kind `undecided`: a question of the proposed file stands in it yet.
    """
    # A proposed file is valid but for its questions: a guess would be mapped as if it were known.
    open_lines = [f"line {n}: {line.strip()}" for n, line in enumerate(text.splitlines(), 1) if DECIDE in line]
    if open_lines:
        raise BadInputError(
            "undecided",
            f"{path} leaves something to decide: {'; '.join(open_lines)[:2000]}. Write what is true into the file, and "
            f"delete each line, or word, that says {DECIDE}",
        )
    try:
        content = document_of_yaml(text)
    except ValueError as exc:
        raise BadInputError("bad_mapping", f"{path} is no YAML: {exc}") from exc
    try:
        return BagMapping.model_validate(content)
    except ValidationError as exc:
        raise BadInputError(
            "bad_mapping", f"{path}: {first_error(exc)}; `cairn robot inspect BAG` proposes a file"
        ) from exc


def camera_of_info(info: RosCameraInfo, *, is_rectified: bool, name: str) -> Camera:
    """The pinhole camera that a CameraInfo describes.

    Raises:
        BadInputError: not calibrated, or a lens model that is no pinhole with Brown's distortion.
    """
    focal_centre = info.P[[0, 5, 2, 6]] if is_rectified else info.K[[0, 4, 2, 5]]
    fx, fy, cx, cy = (float(value) for value in focal_centre)
    if not (np.isfinite(focal_centre).all() and fx > 0 and fy > 0):
        raise BadInputError(
            "bad_intrinsics",
            f"{name} is not calibrated: its focal lengths are {fx:g} and {fy:g} px; give intrinsics instead of info",
        )
    # Missing coefficients are 0; more than five, or another model's, are refused unless they are 0 too.
    k1, k2, p1, p2, k3, *more = (*(() if is_rectified else info.distortion), 0.0, 0.0, 0.0, 0.0, 0.0)
    k = (k1, k2, p1, p2, k3)
    if any(more) or (info.model not in (*PLUMB_BOB, "rational_polynomial") and any(k)):
        raise BadInputError(
            "bad_intrinsics",
            f"{name} has the lens model {info.model[:40]!r} with {len(info.distortion)} coefficients, of which only "
            "plumb_bob's five are known; take the rectified images and say `rectified: true`",
        )
    try:
        return Camera(width=info.width, height=info.height, focal_px=(fx, fy), centre_px=(cx, cy), distortion=k)
    except ValidationError as exc:
        raise BadInputError("bad_intrinsics", f"{name}: {first_error(exc)}") from exc
