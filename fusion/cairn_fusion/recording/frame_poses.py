"""Poses of frames: each frame of a source finds its pose in a published pose file, under named conventions.

    PoseOptions -> read_frame_poses    once: every row becomes T_map_sensor, OpenCV axes, metres
                -> of_frames           the poses of a source's frames: by time, number or file name
                -> report              lines that state form, conventions, and all that was left out

Rows are refused, or with `skip_bad` counted and left out: no pose, times that run backwards, a jump. A frame finds its
pose by time between two neighbours at most `max_gap_s` apart, by the very number, or by the very name.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cairn_calib.rig.poses import Transform, inverse
from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.pose_files import (
    NOT_METRIC,
    UNITS_PER_S,
    Axes,
    BadRows,
    KeyKind,
    PoseConvention,
    PoseFile,
    PoseForm,
    PoseRow,
    body_sensor_of,
    read_pose_file,
)
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.timed_lists import TimedList
from cairn_fusion.recording.trajectory import Trajectory
from cairn_map.errors import BadInputError

MAX_GAP_S = 0.2
END_TOLERANCE_S = 1e-3
"""Time before the first or after the last pose that is taken for rounding of a time stamp."""
ROTATION_GRID, POSITION_GRID_M = 2.0**-40, 2.0**-30
"""Poses are rounded to these, so that one pose printed in several forms gives the same cells: 1e-12, and 1 nm."""
SMALL_EXTENT_M, LARGE_EXTENT_M = 0.01, 1000.0
"""Extents of a moving sensor's trajectory beyond which its unit is doubted."""
RIG = "rig"
"""Name of the rig itself among the things that poses are of."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
AXES_OPENCV: dict[Axes, tuple[tuple[float, ...], ...]] = {
    Axes.OPENCV: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    Axes.OPENGL: ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    Axes.ROS: ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
}
"""Rotations from OpenCV's axes to others: `p_axes = R p_opencv`."""
AXES_TEXT = {
    Axes.OPENCV: "x right, y down, z forward",
    Axes.OPENGL: "x right, y up, z backward",
    Axes.ROS: "x forward, y left, z up",
}
TITLES = {
    PoseForm.KITTI: "KITTI",
    PoseForm.TUM: "TUM",
    PoseForm.EUROC: "EuRoC",
    PoseForm.NERFSTUDIO: "nerfstudio",
    PoseForm.COLMAP: "COLMAP",
    PoseForm.MATRICES: "matrices",
}


class PoseOptions(BaseModel):
    """Description of a pose file; what is not given is the form's own."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: Path
    convention: PoseConvention | None = None
    axes: Axes | None = None
    scale: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    """Metres in a unit of its positions."""
    T_body_sensor: Path | None = None
    """File with the pose of the sensor on the body whose poses are published."""
    of: str | None = None
    """Camera of the rig, or `rig`."""
    time_unit: Annotated[str, Field(pattern="^(s|ms|us|ns)$")] | None = None
    max_gap_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    first_frame: int = 0
    """Number of the frame whose pose is the first line of KITTI's form."""
    max_jump_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 10.0
    skip_bad: bool = False


@dataclass(frozen=True, slots=True)
class FrameKey:
    """One frame, and all by which it can find its pose."""

    label: str
    number: int | None = None
    time_s: float | None = None
    names: tuple[str, ...] = ()
    """Names of its images, without folder and suffix."""


@dataclass(slots=True)
class FramePoses:
    """Poses of one source, and counts of what was found and left out."""

    options: PoseOptions
    file: PoseFile
    rows: tuple[PoseRow, ...]
    """`T_map_sensor`, OpenCV axes, metres; or of the rig, its own axes."""
    conventions: str
    bad: BadRows
    lines: list[str] = field(default_factory=list)
    """Sentences about frames and poses without each other."""
    _by_times: Trajectory | None = None

    @property
    def rounding(self) -> PoseRounding:
        """Poses that were not quite rotations."""
        return self.file.rounding

    def of_frames(self, frames: Sequence[FrameKey], *, max_gap_s: float = MAX_GAP_S) -> list[Transform | None]:
        """The pose of each frame; None for frames without a pose that `skip_bad` leaves out.

        Raises:
            BadInputError: `no_pose`: no frame has a pose, or one has none and `skip_bad` is not set.
        """
        if self.options.max_gap_s is not None:
            max_gap_s = self.options.max_gap_s
        found = self._by_time(frames, max_gap_s) if self.is_by_time else self._by_key(frames)
        missing = [frame.label for frame, T in zip(frames, found, strict=True) if T is None]
        if missing:
            what = f"{len(missing)} of {len(frames)} frames have no pose in {self.file.path}, the first is {missing[0]}"
            if len(missing) == len(frames) or not self.options.skip_bad:
                hint = self._hint(frames, max_gap_s)
                way_out = "" if len(missing) == len(frames) else "; --skip-bad leaves such frames out"
                raise BadInputError("no_pose", f"{what}: {hint}{way_out}")
            self.lines.append(f"{what}: left out")
        return found

    @property
    def is_by_time(self) -> bool:
        """True if a frame finds its pose by time."""
        return self.file.key is KeyKind.TIME

    def pose_near(self, time_s: float) -> Transform:
        """The pose at a time, of poses by time; before the first and after the last pose that one.

        Raises:
            BadInputError: `no_pose`: the neighbours are too far apart.
        """
        first_s, last_s = float(self.rows[0].key), float(self.rows[-1].key)
        max_gap_s = MAX_GAP_S if self.options.max_gap_s is None else self.options.max_gap_s
        return self._trajectory().pose_at(min(max(time_s, first_s), last_s), max_gap_s=max_gap_s)

    def report(self) -> list[str]:
        """Sentences that state the form, the conventions, what was left out, and doubts."""
        path, count = self.file.path.name, len(self.rows)
        said = [f"poses: {TITLES[self.file.form]} ({path}), {self.conventions}, {count} poses"]
        if self.bad.count:
            said.append(f"{self.bad.count} poses of {path} are left out; the first: {self.bad.first}")
        t = np.array([row.T[:3, 3] for row in self.rows])
        extent_m = float(np.linalg.norm(t.max(axis=0) - t.min(axis=0)))
        if 0 < extent_m < SMALL_EXTENT_M or extent_m > LARGE_EXTENT_M:
            said.append(
                f"doubt: the poses of {path} span {extent_m:.4g} m in all; if their unit is not the metre, give "
                "--scale METRES_PER_UNIT"
            )
        return said + self.lines

    def _trajectory(self) -> Trajectory:
        if self._by_times is None:
            times_s = np.array([float(row.key) for row in self.rows])
            self._by_times = Trajectory(self.file.path, TimedList(times_s, tuple(row.T for row in self.rows)))
        return self._by_times

    def _by_time(self, frames: Sequence[FrameKey], max_gap_s: float) -> list[Transform | None]:
        trajectory = self._trajectory()
        times_s = trajectory.poses.times_s
        found: list[Transform | None] = []
        for frame in frames:
            if frame.time_s is None:
                raise BadInputError(
                    "no_pose",
                    f"the poses of {self.file.path} are by time, and {frame.label} has no time: its name is no time "
                    "stamp; give --frame-rate HZ, or poses by number",
                )
            # Time stamps of frames and poses are printed with different digits: at both ends that is no gap.
            near_s = min(max(frame.time_s, float(times_s[0])), float(times_s[-1]))
            time_s = near_s if abs(near_s - frame.time_s) <= END_TOLERANCE_S else frame.time_s
            try:
                found.append(trajectory.pose_at(time_s, max_gap_s=max_gap_s))
            except BadInputError:
                found.append(None)
        self.lines.append(f"poses are interpolated between neighbours at most {max_gap_s:g} s apart")
        return found

    def _by_key(self, frames: Sequence[FrameKey]) -> list[Transform | None]:
        poses = {row.key: row.T for row in self.rows}
        keys: Sequence[int | str | None]
        if self.file.key is KeyKind.NAME:
            keys = [next((name for name in frame.names if name in poses), None) for frame in frames]
        elif all(frame.number is None for frame in frames):
            # Frames without numbers go by their order, which is only safe if there are as many poses.
            if len(frames) != len(self.rows):
                raise BadInputError(
                    "no_pose",
                    f"{self.file.path} has {len(self.rows)} poses, the source {len(frames)} frames without numbers: "
                    "only as many can be matched by their order",
                )
            self.lines.append("frames have no numbers: the n-th has the n-th pose")
            return [row.T for row in self.rows]
        else:
            keys = [frame.number for frame in frames]
        used = {key for key in keys if key is not None}
        unused = [row for row in self.rows if row.key not in used]
        if unused:
            self.lines.append(
                f"{len(unused)} of {len(self.rows)} poses of {self.file.path.name} have no frame, the first is "
                f"{unused[0].place}"
            )
        return [None if key is None else poses.get(key) for key in keys]

    def _hint(self, frames: Sequence[FrameKey], max_gap_s: float) -> str:
        """The likely cause of frames without poses."""
        first, last = self.rows[0].key, self.rows[-1].key
        if self.file.key is KeyKind.TIME:
            times_s = [frame.time_s for frame in frames if frame.time_s is not None]
            text = f"frames are from {min(times_s):.6f} to {max(times_s):.6f} s, poses from {first:.6f} to {last:.6f} s"
            text += f" with gaps of at most {max_gap_s:g} s allowed (--max-pose-gap)"
            ratio = (float(last) - float(first)) / max(max(times_s) - min(times_s), 1e-12)
            unit = next((unit for unit, n in UNITS_PER_S.items() if n > 1 and 0.5 < ratio / n < 2), None)
            return text + (f"; the poses' times look like {unit}: --pose-time-unit {unit}" if unit else "")
        if self.file.key is KeyKind.NUMBER:
            return f"poses are of the frames {first} to {last} (--first-frame shifts the lines of a file)"
        return f"poses are of images such as {first}, frames have images such as {', '.join(frames[0].names)}"


def read_frame_poses(options: PoseOptions, rig: Rig | None = None, *, camera_body: Path | None = None) -> FramePoses:
    """The poses of a file, under its conventions.

    Args:
        options: file and conventions.
        rig: of a source with several cameras; None: the source is one camera.
        camera_body: file with `T_body_sensor` that the source's layout has, for poses of a body.

    Raises:
        BadInputError: as `read_pose_file`; no metric scale; a jump; a body or camera that is not decided.
    """
    bad = BadRows(skip=options.skip_bad)
    file = read_pose_file(options.path, bad, time_unit=options.time_unit)
    if file.form in NOT_METRIC and options.scale is None:
        raise BadInputError(
            "no_scale",
            f"{options.path} is of {TITLES[file.form]}, whose positions have no metric scale: give "
            "--scale METRES_PER_UNIT (1, if they are known to be metres)",
        )
    of = _sensor(options, file, rig)
    after, conventions = _conventions(options, file, rig, of, camera_body)
    is_inverse = _direction(options, file) is PoseConvention.MAP_TO_CAMERA
    rows = []
    for row in file.rows:
        T = inverse(row.T) if is_inverse else row.T.copy()
        T[:3, 3] *= options.scale or 1.0
        key = int(row.key) + options.first_frame if file.form is PoseForm.KITTI else row.key
        rows.append(PoseRow(key, _on_grid(T @ after), row.place))
    steady = _without_jumps(rows, options, bad)
    return FramePoses(options, file, steady, conventions, bad)


def axes_transform(axes: Axes) -> Transform:
    """`T_axes_opencv`: points of a camera in OpenCV's axes, in other axes at the same place."""
    T = np.eye(4)
    T[:3, :3] = AXES_OPENCV[axes]
    return T


def _sensor(options: PoseOptions, file: PoseFile, rig: Rig | None) -> str:
    """Name of what the poses are of: a camera of the rig, or the rig."""
    if rig is None:
        return options.of or "camera"
    if options.of is not None:
        if options.of != RIG and options.of not in rig.cameras:
            raise BadInputError(
                "bad_option", f"--poses-of {options.of}: the rig has {', '.join(rig.cameras)}; or `{RIG}` for itself"
            )
        return options.of
    if file.form in (PoseForm.TUM, PoseForm.EUROC):
        return RIG
    raise BadInputError(
        "bad_option",
        f"{options.path} is of {TITLES[file.form]}: say what its poses are of, --poses-of {RIG} or a camera of "
        f"{', '.join(rig.cameras)}",
    )


def _conventions(
    options: PoseOptions, file: PoseFile, rig: Rig | None, of: str, camera_body: Path | None
) -> tuple[Transform, str]:
    """The transform that is multiplied from the right, and a sentence about it."""
    after = np.eye(4)
    words = [f"T_map_{of}" if _direction(options, file) is PoseConvention.CAMERA_TO_MAP else f"T_{of}_map, inverted"]
    # EuRoC's poses may be of a sensor of their own, whose place on the body its sensor.yaml states.
    own = options.path.parent / "sensor.yaml"
    if file.form is PoseForm.EUROC and own.is_file():
        after = after @ inverse(body_sensor_of(own))
        words.append(f"T_BS of {own} taken off")
    body = options.T_body_sensor or (camera_body if file.form is PoseForm.EUROC else None)
    if body is not None:
        after = after @ body_sensor_of(body)
        words.append(f"T_body_sensor of {body}")
    elif file.form is PoseForm.EUROC and of != RIG:
        raise BadInputError(
            "bad_option",
            f"{options.path} holds poses of a body, not of the camera: give --T-body-sensor FILE, the camera's "
            "sensor.yaml (T_BS) or a matrix in text",
        )
    axes = options.axes or (Axes.OPENGL if file.form is PoseForm.NERFSTUDIO else Axes.OPENCV)
    if of != RIG or options.axes is not None:
        after = after @ axes_transform(axes)
        words.append(f"{axes} axes ({AXES_TEXT[axes]})")
    if rig is not None and of != RIG:
        after = after @ inverse(rig[of].transform)
    if options.scale is not None:
        words.append(f"{options.scale:g} m in a unit")
    return after, ", ".join(words)


def _direction(options: PoseOptions, file: PoseFile) -> PoseConvention:
    own = PoseConvention.MAP_TO_CAMERA if file.form is PoseForm.COLMAP else PoseConvention.CAMERA_TO_MAP
    return options.convention or own


def _on_grid(T: Transform) -> Transform:
    """A pose rounded to the grids, so that digits that differ between printed forms are gone."""
    rounded = np.eye(4)
    rounded[:3, :3] = np.round(T[:3, :3] / ROTATION_GRID) * ROTATION_GRID
    rounded[:3, 3] = np.round(T[:3, 3] / POSITION_GRID_M) * POSITION_GRID_M
    return rounded + 0.0  # no negative zeros


def _without_jumps(rows: Sequence[PoseRow], options: PoseOptions, bad: BadRows) -> tuple[PoseRow, ...]:
    """Rows that lie near the one kept before."""
    kept: list[PoseRow] = []
    for row in rows:
        jump_m = math.dist(row.T[:3, 3], kept[-1].T[:3, 3]) if kept else 0.0
        if jump_m > options.max_jump_m:
            bad.note(
                BadInputError(
                    "pose_jump",
                    f"{row.place}: the pose jumps {jump_m:.4g} m from {kept[-1].place}, {options.max_jump_m:g} m are "
                    "allowed (--max-pose-jump); positions in millimetres need --scale 0.001",
                )
            )
        else:
            kept.append(row)
    if 2 * len(kept) < len(rows):
        raise BadInputError(
            "pose_jump",
            f"{options.path}: only {len(kept)} of {len(rows)} poses lie within {options.max_jump_m:g} m of the one "
            f"before: {bad.first}",
        )
    return tuple(kept)
