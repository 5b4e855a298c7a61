"""Recording: scans on disk, in order of time, read one at a time. RECORDING.md is the format.

    recording.json  rig.json  trajectory.txt  <camera>.txt ...
          |_____________|__________|______________|
                         open_recording            once: all lists, all paths, every scan's pose
                                |
                         Recording.scan(i)         each time: the images of one scan

Lists are checked whole when the recording is opened, pixels when they are read. Importers make a `Recording` of
foreign folders, so a program that replays one replays all.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import RIG_BYTES_MAX, Rig, rig_from_json
from cairn_fusion.recording.frame_poses import FrameKey, FramePoses, PoseOptions, read_frame_poses
from cairn_fusion.recording.images import read_colour, read_grey16, read_labels
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.recording_format import (
    BODY_FILE,
    CHANNEL,
    MEASUREMENTS_FILE,
    RIG_FILE,
    SCALARS_FILE,
    TRAJECTORY_FILE,
    RangeEncoding,
    RecordingHeader,
    ThermalEncoding,
    check_cameras,
    decode_kelvin,
    decode_range,
    path_inside,
    read_header,
)
from cairn_fusion.recording.scan import LabelNames, Scan, check_scan
from cairn_fusion.recording.timed_lists import Line, TimedList, Value, lines, read_text, time_and_rest, timed_list
from cairn_fusion.recording.trajectory import Trajectory, read_trajectory
from cairn_map.errors import BadInputError, NotFoundError


class ScanSource(Protocol):
    """Source of scans to replay: a `Recording`, an imported folder, a simulator."""

    @property
    def name(self) -> str:
        """Name of the source, as a map's log shows it."""
        ...

    @property
    def rig(self) -> Rig:
        """The cameras of every scan."""
        ...

    @property
    def rounding(self) -> PoseRounding:
        """Poses of the source that were not quite rotations, and the largest change."""
        ...

    @property
    def pose_notes(self) -> Sequence[str]:
        """Sentences about a pose file: its form and conventions, what was left out, and doubts."""
        ...

    @property
    def has_times(self) -> bool:
        """False if the scans' times are made up: they tell the order alone."""
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Scan]: ...

    def scan(self, index: int, /) -> Scan:
        """The scan of an index, 0 .. len - 1."""
        ...

    def place(self, index: int, /) -> tuple[float, Transform]:
        """Time and `T_map_rig` of the scan of an index; its images are not read."""
        ...

    def measurements(self) -> Sequence[range]:
        """The scan indices of each measurement; together all scans, each once, in order."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanFiles:
    """Paths of the images of one scan, checked to be inside the recording's folder, and the rest of the scan."""

    time_s: float
    T_map_rig: Transform
    range_camera: str
    range_path: Path
    amplitude_path: Path | None = None
    colour: Mapping[str, Path] = field(default_factory=dict)
    thermal: Mapping[str, Path] = field(default_factory=dict)
    labels: Mapping[str, Path] = field(default_factory=dict)
    scalars: Mapping[str, float] = field(default_factory=dict)
    T_map_body: Transform | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """Scans in order of time, read when asked for; see `ScanSource`."""

    name: str
    rig: Rig
    files: tuple[ScanFiles, ...]
    stops: tuple[range, ...]
    range_encodings: Mapping[str, RangeEncoding]
    thermal_encodings: Mapping[str, ThermalEncoding] = field(default_factory=dict)
    label_names: LabelNames = field(default_factory=dict)
    """Class of each number of the label images; None: it says nothing."""
    note: str = ""
    rounding: PoseRounding = field(default_factory=PoseRounding)
    """Poses that were not quite rotations."""
    pose_notes: Sequence[str] = ()
    """Sentences about a pose file."""
    has_times: bool = True

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Scan]:
        return map(self.scan, range(len(self.files)))

    def measurements(self) -> Sequence[range]:
        """The scan indices of each measurement, in order; together all scans, each once."""
        return self.stops

    def place(self, index: int, /) -> tuple[float, Transform]:
        """Time and `T_map_rig` of the scan of an index; its images are not read."""
        return self.files[index].time_s, self.files[index].T_map_rig

    def scan(self, index: int, /) -> Scan:
        """One scan, its images read from disk now.

        Raises:
            NotFoundError: `index` is not in 0 .. len - 1.
            BadInputError: an image has gone, or is not its camera's in size or kind.
            DamagedDataError: an image cannot be decoded.
        """
        if not 0 <= index < len(self.files):
            raise NotFoundError("no_such_scan", f"{self.name} has scans 0 to {len(self) - 1}, asked for {index}")
        files = self.files[index]
        counts = read_grey16(files.range_path, self._size(files.range_camera))
        camera = self.rig[files.range_camera].camera
        scan = Scan(
            time_s=files.time_s,
            T_map_rig=files.T_map_rig,
            range_camera=files.range_camera,
            range_m=decode_range(counts, camera, self.range_encodings[files.range_camera]),
            amplitude=read_grey16(files.amplitude_path, counts.shape[::-1]) if files.amplitude_path else None,
            colour={name: read_colour(path, self._size(name)) for name, path in files.colour.items()},
            thermal={
                name: decode_kelvin(read_grey16(path, self._size(name)), self.thermal_encodings[name])
                for name, path in files.thermal.items()
            },
            labels={name: read_labels(path, self._size(name)) for name, path in files.labels.items()},
            label_names=self.label_names if files.labels else {},
            scalars=files.scalars,
            T_map_body=files.T_map_body,
        )
        check_scan(scan, self.rig)
        return scan

    def _size(self, name: str) -> tuple[int, int]:
        camera = self.rig[name].camera
        return camera.width, camera.height


def open_recording(
    path: str | Path, *, scans_per_measurement: int | None = None, poses: PoseOptions | None = None
) -> Recording:
    """The recording in a folder: every list read and checked, no image decoded yet.

    Args:
        path: the folder that holds `recording.json`.
        scans_per_measurement: group scans by this count, whatever `measurements.txt` says; the last may be shorter.
        poses: pose file that counts instead of the recording's trajectory.

    Raises:
        BadInputError: not a recording, unfinished, or a file or line is wrong; the message has file and line.
    """
    folder = Path(path).resolve()
    header = read_header(folder)
    rig = rig_from_json(read_text(path_inside(folder, RIG_FILE), RIG_BYTES_MAX).encode())
    check_cameras(header, rig)
    rounding, found = PoseRounding(), None
    trajectory = None if poses is not None else read_trajectory(path_inside(folder, TRAJECTORY_FILE), rounding)
    files = _scan_files(folder, header, rounding, trajectory)
    if poses is not None:
        found = read_frame_poses(poses, rig)
        rounding = found.rounding
        files = _with_poses(folder, files, found)
    return Recording(
        name=header.name,
        rig=rig,
        files=files,
        stops=_measurements(folder, files, scans_per_measurement),
        range_encodings=header.range,
        thermal_encodings=header.thermal,
        label_names=_label_names(header),
        note=header.note,
        rounding=rounding,
        pose_notes=() if found is None else found.report(),
    )


def _with_poses(folder: Path, files: Sequence[ScanFiles], found: FramePoses) -> tuple[ScanFiles, ...]:
    """Scans with the poses of a pose file; those without one are left out.

    Raises:
        BadInputError: the recording has poses of the robot's body, which are in another frame.
    """
    if any(entry.T_map_body is not None for entry in files):
        raise BadInputError(
            "bad_option",
            f"{folder} has {BODY_FILE}, the poses of the robot's body in the frame of its own trajectory: other poses "
            "of the rig do not fit them",
        )
    keys = [
        FrameKey(
            label=f"scan {n} of {folder} ({entry.range_path.name})",
            number=n,
            time_s=entry.time_s,
            names=tuple(path.stem for path in (*entry.colour.values(), entry.range_path, *entry.thermal.values())),
        )
        for n, entry in enumerate(files)
    ]
    poses = found.of_frames(keys)
    return tuple(replace(entry, T_map_rig=T) for entry, T in zip(files, poses, strict=True) if T is not None)


def measurements_of(scan_count: int, scans_per_measurement: int) -> tuple[range, ...]:
    """Consecutive scans in groups of one size; the last may be shorter.

    Raises:
        BadInputError: the size is not positive.
    """
    if scans_per_measurement < 1:
        raise BadInputError("bad_measurement", f"scans per measurement must be at least 1, got {scans_per_measurement}")
    starts = range(0, scan_count, scans_per_measurement)
    return tuple(range(start, min(start + scans_per_measurement, scan_count)) for start in starts)


def _scan_files(
    folder: Path, header: RecordingHeader, rounding: PoseRounding, trajectory: Trajectory | None
) -> tuple[ScanFiles, ...]:
    """One entry per range image, in order of time; other cameras' images by nearest time within `max_gap_s`.

    Without a trajectory the pose is the identity, until a pose file gives it.
    """
    body_path = path_inside(folder, BODY_FILE)
    body = read_trajectory(body_path, rounding) if body_path.exists() else None
    ranges = {name: _image_list(folder, f"{name}.txt") for name in header.range}
    amplitudes = {name: _image_list(folder, f"{name}.amplitude.txt") for name in header.amplitude}
    colours = {name: _image_list(folder, f"{name}.txt") for name in header.colour}
    thermals = {name: _image_list(folder, f"{name}.txt") for name in header.thermal}
    labels = {name: _image_list(folder, f"{name}.labels.txt") for name in header.labels}
    scalars = _scalar_lists(folder)
    files = [
        ScanFiles(
            time_s=time_s,
            T_map_rig=trajectory.pose_at(time_s, max_gap_s=header.max_pose_gap_s) if trajectory else np.eye(4),
            range_camera=camera,
            range_path=path,
            amplitude_path=_near(amplitudes, time_s, header.max_gap_s).get(camera),
            colour=_near(colours, time_s, header.max_gap_s),
            thermal=_near(thermals, time_s, header.max_gap_s),
            labels=_near(labels, time_s, header.max_gap_s),
            scalars=_near(scalars, time_s, header.max_gap_s),
            T_map_body=None if body is None else body.pose_at(time_s, max_gap_s=header.max_pose_gap_s),
        )
        for camera, images in ranges.items()
        for time_s, path in zip(images.times_s.tolist(), images.values, strict=True)
    ]
    # Stable: of cameras that fired together, the header's order decides.
    return tuple(sorted(files, key=lambda entry: entry.time_s))


def _label_names(header: RecordingHeader) -> dict[int, str | None]:
    """The one table of all cameras' labels.

    Raises:
        BadInputError: two cameras' tables differ.
    """
    tables = list(header.labels.values())
    if any(table != tables[0] for table in tables):
        raise BadInputError("bad_recording", "the label images of all cameras of a recording share one table")
    return {int(number): name for number, name in tables[0].items()} if tables else {}


def _near(lists: Mapping[str, TimedList[Value]], time_s: float, max_gap_s: float) -> dict[str, Value]:
    found = {name: values.nearest(time_s, max_gap_s=max_gap_s) for name, values in lists.items()}
    return {name: value for name, value in found.items() if value is not None}


def _image_list(folder: Path, name: str) -> TimedList[Path]:
    def image(line: Line, text: str) -> Path:
        try:
            path = path_inside(folder, text)
        except BadInputError as exc:
            raise line.error(exc.message, exc.kind) from exc
        if not path.is_file():
            raise line.error(f"{text[:200]} is missing, or is no file", "missing_image")
        return path

    return timed_list(path_inside(folder, name), image)


def _scalar_lists(folder: Path) -> dict[str, TimedList[float]]:
    """The readings of `scalars.txt` by channel; times increase strictly within a channel, and never go back."""
    path = path_inside(folder, SCALARS_FILE)
    readings: dict[str, list[tuple[float, float]]] = {}
    for line in lines(path) if path.exists() else ():
        time_s, rest = time_and_rest(line)
        channel, _, number = rest.partition(" ")
        if not CHANNEL.fullmatch(channel):
            raise line.error(f"a channel's name was expected, got {channel[:80]!r}")
        (value,) = line.numbers(number, 1)
        series = readings.setdefault(channel, [])
        if series and time_s <= series[-1][0]:
            raise line.error(f"times of {channel} must increase, got {time_s!r} after {series[-1][0]!r}")
        series.append((time_s, value))
    return {
        channel: TimedList(np.array([time_s for time_s, _ in series]), tuple(value for _, value in series))
        for channel, series in readings.items()
    }


def _measurements(folder: Path, files: Sequence[ScanFiles], size: int | None) -> tuple[range, ...]:
    """Groups by count if asked for, else by the intervals of `measurements.txt`, else every scan alone."""
    path = path_inside(folder, MEASUREMENTS_FILE)
    if size is not None or not path.exists():
        return measurements_of(len(files), 1 if size is None else size)
    # Each line takes the next scans up to its last time, so that all scans are in one measurement, in order.
    times_s = np.array([entry.time_s for entry in files])
    stops: list[range] = []
    start = 0
    for line in lines(path):
        first_s, last_s = line.numbers(line.text, 2)
        stop = int(np.searchsorted(times_s, last_s, side="right"))
        if int(np.searchsorted(times_s, first_s)) != start or stop <= start:
            raise line.error("a measurement must hold at least one scan, and start at the first not yet in one")
        stops.append(range(start, stop))
        start = stop
    if start != len(files):
        raise BadInputError("bad_recording", f"{path}: the scan at {files[start].time_s!r} is in no measurement")
    return tuple(stops)
