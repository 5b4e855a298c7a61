"""Any folder of frames as a recording: one file per frame and image, found by a pattern with `{id}` in it.

    frames/frame-{id}.depth.png  ->  ids 000000 000001 ...  ->  colour, thermal and pose of the same id

Depth, colour and thermal are registered: one raster, one camera model, so the rig's cameras `depth`, `colour` and
`thermal` are the same camera at the rig's origin. Images that are not registered need the recording format, with a rig
of its own.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path, PurePosixPath
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.rig.brown import Coefficients
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, inverse
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.recording.frame_poses import FrameKey, PoseOptions, axes_transform, read_frame_poses
from cairn_fusion.recording.images import image_header
from cairn_fusion.recording.pose_files import Axes, PoseConvention
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.recording import Recording, ScanFiles, measurements_of
from cairn_fusion.recording.recording_format import (
    Convention,
    Name,
    Positive,
    RangeEncoding,
    ThermalEncoding,
    path_inside,
)
from cairn_fusion.recording.timed_lists import TimedList, read_text
from cairn_map.errors import BadInputError

TEXT_BYTES_MAX = 1 << 16
"""Largest text file with a matrix."""
FRAME_ID = "{id}"
IMAGE_GAP_S = 0.02
"""Largest time between the depth image and another image of one frame, where names are times: half a frame at 25 Hz."""
FOLDER_NAMES = {
    "depth": ("depth", "depths", "depth_images", "d"),
    "colour": ("rgb", "color", "colour", "image", "images", "visible"),
    "thermal": ("thermal", "lwir", "infrared", "t"),
}
"""Names, in small letters, that publishers give the folders of images."""
IMAGE_NAME = re.compile(r"(\D*)(.*[0-9].*)(\.png|\.jpg|\.jpeg)", re.IGNORECASE)
FRAME_RANGE = re.compile(r"([0-9]{1,18})-([0-9]{1,18})")
DECIMAL_SECONDS = re.compile(r"[0-9]{1,12}\.[0-9]{1,12}")
NANOSECONDS = re.compile(r"[0-9]{16,19}")
Finite = Annotated[float, Field(allow_inf_nan=False)]


class FrameFolderOptions(BaseModel):
    """Description of a folder of frames; patterns are relative, and `{id}` is the frame's id, without a slash."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Name = "frames"
    note: str = ""
    depth: str
    """16-bit PNG; its ids are the frames."""
    colour: str | None = None
    thermal: str | None = None
    pose: str | None = None
    """4x4 or 3x4 matrix in text; without `{id}`, one file for all frames; None: poses come from a pose file."""
    intrinsics_file: str | None = None
    """3x3 matrix in text; else `focal_px` and `centre_px`."""
    focal_px: tuple[Positive, Positive] | None = None
    centre_px: tuple[Finite, Finite] | None = None
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_units_per_m: Positive = 1000.0
    depth_convention: Convention = Convention.Z
    pose_convention: PoseConvention = PoseConvention.CAMERA_TO_MAP
    axes: Axes = Axes.OPENCV
    """Axes of the camera that `pose` is of."""
    kelvin_per_count: Positive = 0.01
    kelvin_at_zero: Finite = 0.0
    frame_rate_hz: Positive = 1.0
    """Frame n of the folder (ids in order, numbers by value) is n / rate after the start, unless ids are times."""
    start_time_s: Finite = 0.0

    @model_validator(mode="after")
    def _complete(self) -> Self:
        for pattern in (self.depth, self.colour, self.thermal):
            if pattern is not None and FRAME_ID not in pattern:
                raise ValueError(f"an image pattern needs {FRAME_ID}, got {pattern!r}")
        given = (self.focal_px is not None, self.centre_px is not None)
        if given != (self.intrinsics_file is None,) * 2:
            raise ValueError("give either intrinsics_file, or both focal_px and centre_px")
        return self


def import_frames(
    folder: str | Path,
    options: FrameFolderOptions,
    *,
    frames: Sequence[str] | None = None,
    scans_per_measurement: int = 1,
    poses: PoseOptions | None = None,
) -> Recording:
    """A folder of frames as a recording; images are read when asked for.

    Args:
        folder: folder that the patterns are relative to.
        options: patterns and conventions.
        frames: only these ids, each in the folder, and ranges of them by number (`100-499`, both ends included);
            they keep the times and the order that they have among all.
        scans_per_measurement: group scans by this count.
        poses: pose file that counts instead of the options' `pose`.

    Raises:
        BadInputError: no frames, an image or pose missing for one of them, a path that leads out of the folder, a
            matrix that is none, or images that are not one raster.
    """
    root = Path(folder).resolve()
    ids = _frame_ids(root, options.depth)
    # Times count all frames of the folder, so that a choice of them keeps its times.
    wanted = set(ids) if frames is None else chosen_frames(ids, frames, root)
    chosen = [(n, frame_id) for n, frame_id in enumerate(ids) if frame_id in wanted]
    found = _frame_poses(root, options, chosen, poses)
    images = {pattern: _Images(root, pattern) for pattern in (options.colour, options.thermal) if pattern is not None}
    files = tuple(
        _scan_files(root, options, frame_id, images, time_s=_time_s(options, n, frame_id), T_map_rig=T)
        for (n, frame_id), T in zip(chosen, found.poses, strict=True)
        if T is not None
    )
    return Recording(
        name=options.name,
        note=options.note,
        rig=_registered_rig(root, options, files[0].range_path),
        files=files,
        stops=measurements_of(len(files), scans_per_measurement),
        range_encodings={
            "depth": RangeEncoding(units_per_m=options.depth_units_per_m, convention=options.depth_convention)
        },
        thermal_encodings={
            "thermal": ThermalEncoding(kelvin_per_count=options.kelvin_per_count, kelvin_at_zero=options.kelvin_at_zero)
        },
        has_times=_has_times(options, ids[0]),
        rounding=found.rounding,
        pose_notes=(*found.notes, *(note for one in images.values() for note in one.notes(len(files)))),
    )


def _frame_ids(root: Path, pattern: str) -> list[str]:
    """The ids that a pattern finds, numbers by value."""
    path_inside(root, pattern)
    pattern = PurePosixPath(pattern).as_posix()
    # As a glob, to find candidates, and as an expression, in which each further `{id}` must be the same.
    wanted = re.escape(pattern).replace(re.escape(FRAME_ID), r"(?P<id>[^/]+)", 1)
    wanted = wanted.replace(re.escape(FRAME_ID), r"(?P=id)")
    glob = "*".join(escape(part) for part in pattern.split(FRAME_ID))
    matches = (re.fullmatch(wanted, path.relative_to(root).as_posix()) for path in root.glob(glob))
    ids = [match["id"] for match in matches if match]
    if not ids:
        raise BadInputError("no_frames", f"no file in {root} fits {pattern}")
    return sorted(ids, key=frame_order)


def frame_order(frame_id: str) -> tuple[int, int, str]:
    """Key by which frames are sorted: numbers by value, then other ids."""
    return (0, int(frame_id), frame_id) if frame_id.isdecimal() else (1, 0, frame_id)


def chosen_frames(ids: Sequence[str], frames: Sequence[str], root: Path) -> set[str]:
    """Those of the ids that are named, or lie in a range of numbers.

    Raises:
        BadInputError: kind `unknown_frame`: nothing is chosen, or a name or range chooses nothing.
    """
    chosen: set[str] = set()
    unknown: list[str] = []
    for part in frames:
        ends = FRAME_RANGE.fullmatch(part)
        # A frame may be named 3-4 itself.
        if part in ids or ends is None:
            found = {part} & set(ids)
        else:
            first, last = int(ends[1]), int(ends[2])
            found = {each for each in ids if each.isdecimal() and first <= int(each) <= last}
        if not found:
            unknown.append(part)
        chosen |= found
    if unknown or not chosen:
        names = ", ".join(unknown[:10]) or "of an empty choice"
        raise BadInputError("unknown_frame", f"{root} has {len(ids)} frames, {ids[0]} to {ids[-1]}, but none {names}")
    return chosen


def image_patterns(folder: Path) -> dict[str, str]:
    """Patterns of the images in a folder whose own folders are named as publishers name them, by kind of image."""
    patterns: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        kind = next((kind for kind, names in FOLDER_NAMES.items() if path.name.lower() in names), None)
        if kind is None or kind in patterns or not path.is_dir():
            continue
        # The prefix and the suffix that most of the names have, such as `frame-` and `.png`.
        parts = [match.groups() for one in path.iterdir() if (match := IMAGE_NAME.fullmatch(one.name))]
        counts = Counter((prefix, suffix) for prefix, _, suffix in parts)
        if counts:
            (prefix, suffix), _ = counts.most_common(1)[0]
            patterns[kind] = f"{path.name}/{prefix}{FRAME_ID}{suffix}"
    return patterns


class _Images:
    """Images of one pattern: of a frame the one with its id, or, where ids are times, the nearest one."""

    def __init__(self, root: Path, pattern: str) -> None:
        self._root = root
        self._pattern = pattern
        self._by_time: TimedList[str] | None = None
        self._missing = 0

    def of(self, frame_id: str) -> Path | None:
        """The image of a frame; None if names are times, and none is near.

        Raises:
            BadInputError: kind `missing_image`: names are no times, and there is none of this id.
        """
        path = path_inside(self._root, self._pattern.replace(FRAME_ID, frame_id))
        if path.is_file():
            return path
        time_s = id_time_s(frame_id)
        if time_s is None:
            raise BadInputError(
                "missing_image", f"frame {frame_id} of {self._root} lacks {self._pattern.replace(FRAME_ID, frame_id)}"
            )
        if self._by_time is None:
            timed = sorted((t, one) for one in _frame_ids(self._root, self._pattern) if (t := id_time_s(one)))
            self._by_time = TimedList(np.array([t for t, _ in timed]), tuple(one for _, one in timed))
        near = self._by_time.nearest(time_s, max_gap_s=IMAGE_GAP_S)
        self._missing += near is None
        return None if near is None else path_inside(self._root, self._pattern.replace(FRAME_ID, near))

    def notes(self, count: int) -> list[str]:
        """Sentences about frames without an image, and about images that are only near."""
        if self._by_time is None:
            return []
        text = f"{self._pattern}: of each frame the image nearest in time, at most {IMAGE_GAP_S:g} s away"
        return [text + (f"; {self._missing} of {count} frames have none" if self._missing else "")]


def _scan_files(
    root: Path,
    options: FrameFolderOptions,
    frame_id: str,
    images: Mapping[str, _Images],
    *,
    time_s: float,
    T_map_rig: Transform,
) -> ScanFiles:
    colour = images[options.colour].of(frame_id) if options.colour else None
    thermal = images[options.thermal].of(frame_id) if options.thermal else None
    return ScanFiles(
        time_s=time_s,
        T_map_rig=T_map_rig,
        range_camera="depth",
        range_path=path_inside(root, options.depth.replace(FRAME_ID, frame_id)),
        colour={} if colour is None else {"colour": colour},
        thermal={} if thermal is None else {"thermal": thermal},
    )


@dataclass(frozen=True, slots=True)
class _Found:
    """Poses of the chosen frames, None for those left out, and what is said about them."""

    poses: Sequence[Transform | None]
    rounding: PoseRounding
    notes: tuple[str, ...] = ()


def _frame_poses(
    root: Path, options: FrameFolderOptions, chosen: Sequence[tuple[int, str]], poses: PoseOptions | None
) -> _Found:
    """The pose of each chosen frame, from a pose file or from the options' pattern; a static pose is read once."""
    if poses is not None:
        sheet = root / "sensor.yaml"
        found = read_frame_poses(poses, camera_body=sheet if sheet.is_file() else None)
        keys = [_frame_key(root, options, n, frame_id) for n, frame_id in chosen]
        return _Found(found.of_frames(keys), found.rounding, tuple(found.report()))
    if options.pose is None:
        raise BadInputError(
            "bad_option", "a folder of frames needs poses: --pose PATTERN, or --poses FILE of a published form"
        )
    rounding = PoseRounding()
    if FRAME_ID not in options.pose:
        static = _pose(root, options.pose, options, rounding)
        return _Found([static] * len(chosen), rounding)
    each = [_pose(root, options.pose.replace(FRAME_ID, frame_id), options, rounding) for _, frame_id in chosen]
    return _Found(each, rounding)


def _frame_key(root: Path, options: FrameFolderOptions, n: int, frame_id: str) -> FrameKey:
    patterns = [pattern for pattern in (options.colour, options.depth, options.thermal) if pattern is not None]
    has_time = _has_times(options, frame_id)
    return FrameKey(
        label=f"frame {frame_id} of {root}",
        number=int(frame_id) if frame_id.isdecimal() else None,
        time_s=_time_s(options, n, frame_id) if has_time else None,
        names=(*(PurePosixPath(pattern.replace(FRAME_ID, frame_id)).stem for pattern in patterns), frame_id),
    )


def _has_times(options: FrameFolderOptions, frame_id: str) -> bool:
    """False if a made-up rate gives frames their times, which no pose file knows."""
    return id_time_s(frame_id) is not None or "frame_rate_hz" in options.model_fields_set


def _time_s(options: FrameFolderOptions, n: int, frame_id: str) -> float:
    named_s = id_time_s(frame_id)
    return options.start_time_s + n / options.frame_rate_hz if named_s is None else named_s


def id_time_s(frame_id: str) -> float | None:
    """The time that an id is: seconds with a point, or at least 16 digits of nanoseconds; else None."""
    if DECIMAL_SECONDS.fullmatch(frame_id):
        return float(frame_id)
    return int(frame_id) / 1e9 if NANOSECONDS.fullmatch(frame_id) else None


def _pose(root: Path, relative: str, options: FrameFolderOptions, rounding: PoseRounding) -> Transform:
    # A 3 x 4 matrix lacks the last row, which is the same in all of them.
    values = _numbers(path_inside(root, relative))
    if values.size == 12:
        values = np.append(values, (0, 0, 0, 1))
    if values.size != 16:
        raise BadInputError("bad_transform", f"{root / relative} must hold 16 or 12 numbers, got {values.size}")
    T = rounding.transform(values.reshape(4, 4), name=str(root / relative))
    T = inverse(T) if options.pose_convention is PoseConvention.MAP_TO_CAMERA else T
    return T if options.axes is Axes.OPENCV else T @ axes_transform(options.axes)


def _registered_rig(root: Path, options: FrameFolderOptions, first_depth: Path) -> Rig:
    """The one camera of the raster, once for every image that the folder has."""
    header = image_header(first_depth)
    focal_px, centre_px = _intrinsics(root, options)
    camera = Camera(
        width=header.width,
        height=header.height,
        focal_px=focal_px,
        centre_px=centre_px,
        distortion=options.distortion,
    )
    spectra = {"depth": Spectrum.RANGE}
    if options.colour:
        spectra["colour"] = Spectrum.COLOUR
    if options.thermal:
        spectra["thermal"] = Spectrum.THERMAL
    return Rig(
        name=options.name,
        cameras={name: mount_camera(spectrum, camera, np.eye(4)) for name, spectrum in spectra.items()},
    )


def _intrinsics(root: Path, options: FrameFolderOptions) -> tuple[tuple[float, float], tuple[float, float]]:
    if options.focal_px is not None and options.centre_px is not None:
        return options.focal_px, options.centre_px
    path = path_inside(root, options.intrinsics_file or "")
    # fx 0 cx, 0 fy cy, 0 0 1: no skew, and scaled to one.
    K = _numbers(path)
    if K.size != 9 or not np.array_equal(K[[1, 3, 6, 7, 8]], (0, 0, 0, 0, 1)) or K[0] <= 0 or K[4] <= 0:
        raise BadInputError("bad_intrinsics", f"{path} must hold fx 0 cx, 0 fy cy, 0 0 1; got {K.tolist()[:9]}")
    return (float(K[0]), float(K[4])), (float(K[2]), float(K[5]))


def _numbers(path: Path) -> npt.NDArray[np.float64]:
    """All numbers of a small text file, between blanks or commas."""
    words = read_text(path, TEXT_BYTES_MAX).replace(",", " ").split()
    try:
        values = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError as exc:
        raise BadInputError("bad_matrix", f"{path} must hold numbers only: {exc}") from exc
    if not np.isfinite(values).all():
        raise BadInputError("bad_matrix", f"{path} must hold finite numbers")
    return values
