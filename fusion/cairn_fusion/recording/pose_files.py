"""Pose files: trajectories as they are published, recognised by their content.

form        content                                                   of a frame by   maps            axes
kitti       12 or 16 numbers a line: 3x4 or 4x4 by rows               number          camera to map   opencv
tum         time tx ty tz qx qy qz qw                                 time, s         sensor to map   opencv
euroc       csv: time, p x y z, q w x y z, ... of a body              time, ns        body to map     opencv
nerfstudio  transforms.json: frames of file_path, transform_matrix    file's name     camera to map   opengl
colmap      images.txt: id, q w x y z, t x y z, camera, name          file's name     map to camera   opencv
matrices    folder of text files, each with one matrix                number, name    camera to map   opencv

A KITTI line may begin with its frame's number (13 or 17 numbers). nerfstudio and COLMAP have no metric scale. This
module reads the numbers as they are written; conventions and frames are left to `frame_poses`.
"""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.exchange.yaml_text import document_of_yaml
from cairn_calib.rig.poses import Transform, check_transform, transform_from_quaternion
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.timed_lists import LIST_BYTES_MAX, Line, lines, read_text
from cairn_map.errors import BadInputError

JSON_BYTES_MAX = 16 << 20
"""Largest transforms.json: some 15 000 frames; parsed it takes up to 25 times its size."""
MATRIX_BYTES_MAX = 1 << 16
LINE_CHARACTERS_MAX = 4096
POSES_MAX = 500_000
"""Poses of one source, some 300 bytes each: fourteen hours at 10 Hz."""
W_FIRST = re.compile(r"#?\s*(?:timestamp|time)[^\n]*q\w*[_ .]?w\b[^,\n]*,[^,\n]*q\w*[_ .]?x\b", re.IGNORECASE)
"""Head of a csv whose quaternions begin with w."""
EUROC_COLUMNS = 8
"""Columns of EuRoC's csv that are used; velocities and biases follow."""
ABSOLUTE_S_MAX = 1e11
"""Seconds since 1970 in the year 5138: larger numbers are of a finer unit."""
INTERVAL_S_MIN = 1e-5
"""Shortest credible mean time between two poses."""


class PoseConvention(StrEnum):
    """Direction in which a published pose maps points."""

    CAMERA_TO_MAP = "camera_to_map"
    MAP_TO_CAMERA = "map_to_camera"


class Axes(StrEnum):
    """Axes of the sensor that a published pose is of."""

    OPENCV = "opencv"
    OPENGL = "opengl"
    ROS = "ros"


class PoseForm(StrEnum):
    """Published form of poses."""

    KITTI = "kitti"
    TUM = "tum"
    EUROC = "euroc"
    NERFSTUDIO = "nerfstudio"
    COLMAP = "colmap"
    MATRICES = "matrices"


class KeyKind(StrEnum):
    """Kind of key by which a frame finds its pose."""

    TIME = "time"
    NUMBER = "number"
    NAME = "name"


UNITS_PER_S = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Units of time stamps."""
NOT_METRIC = (PoseForm.NERFSTUDIO, PoseForm.COLMAP)
FORMS_TEXT = (
    "KITTI (12 numbers a line), TUM (time tx ty tz qx qy qz qw), EuRoC's csv, nerfstudio's transforms.json, COLMAP's "
    "images.txt, or a folder of matrices, one text file a frame"
)


@dataclass(frozen=True, slots=True)
class PoseRow:
    """One published pose, its numbers as they are written."""

    key: float | int | str
    """Time in seconds, frame number, or file name without folder and suffix."""
    T: Transform
    place: str
    """File and line, or file and frame; errors name it."""


@dataclass(slots=True)
class BadRows:
    """Rows of a source that are unusable: the first is an error, or all are counted and left out."""

    skip: bool
    count: int = 0
    first: str = ""

    def note(self, error: BadInputError) -> None:
        """Raise an error, or count it and keep the first one's text."""
        if not self.skip:
            raise BadInputError(error.kind, f"{error.message}; --skip-bad leaves such poses out") from error
        self.count += 1
        self.first = self.first or error.message


@dataclass(frozen=True, slots=True)
class PoseFile:
    """Poses of one file or folder."""

    path: Path
    form: PoseForm
    key: KeyKind
    rows: tuple[PoseRow, ...]
    """In order of their keys, each key once."""
    rounding: PoseRounding = field(default_factory=PoseRounding)


Reader = Callable[[Path, PoseRounding, BadRows], Iterator[PoseRow]]


def read_pose_file(path: Path, bad: BadRows, *, time_unit: str | None = None) -> PoseFile:
    """All poses of a file or folder, its form recognised by its content.

    Args:
        path: file of any form, or a folder of matrices.
        bad: collector of poses that are none, and of times that run backwards.
        time_unit: of `UNITS_PER_S`, instead of the form's own.

    Raises:
        BadInputError: missing, too large, of no known form, without poses, or time stamps of another unit.
    """
    form = form_of(path)
    unit = time_unit or ("ns" if form is PoseForm.EUROC else "s")
    rounding = PoseRounding()
    found = list(_rows(form, path, UNITS_PER_S[unit], rounding, bad))
    if not found:
        raise BadInputError("no_poses", f"{path} holds no poses that can be used; it looks like {form}")
    key = _kind_of(form, found)
    rows = _unique(found, key, bad) if key is not KeyKind.TIME else _in_order(found, bad)
    if key is KeyKind.TIME:
        _check_times(path, rows, unit)
    return PoseFile(path, form, key, rows, rounding)


def form_of(path: Path) -> PoseForm:
    """Form of a file or folder, by its content.

    Raises:
        BadInputError: missing, or of no known form.
    """
    if path.is_dir():
        return PoseForm.MATRICES
    text = read_text(path, LIST_BYTES_MAX)
    if text.lstrip()[:1] == "{":
        return PoseForm.NERFSTUDIO
    first = next(lines(path), None)
    shown = "nothing" if first is None else repr(first.text[:80])
    if first is not None and len(first.text) <= LINE_CHARACTERS_MAX:
        words = first.text.replace(",", " ").split()
        if "," in first.text and len(words) >= EUROC_COLUMNS:
            # Of a csv with 8 columns only the head tells where the quaternion's w stands.
            head = text[:LINE_CHARACTERS_MAX].lstrip().split("\n", 1)[0]
            if len(words) == 17 or W_FIRST.match(head):
                return PoseForm.EUROC
        elif len(words) in (12, 13, 16, 17):
            return PoseForm.KITTI
        elif len(words) == 8:
            return PoseForm.TUM
        elif len(words) >= 10 and words[0].isdecimal() and words[8].isdecimal():
            return PoseForm.COLMAP
    raise BadInputError("unknown_poses", f"{path} holds poses of no known form, it begins with {shown}: {FORMS_TEXT}")


def body_sensor_of(path: Path) -> Transform:
    """`T_body_sensor` in a file: a `sensor.yaml` with `T_BS`, or a matrix in text.

    Raises:
        BadInputError: missing, or no transform.
    """
    if path.suffix not in (".yaml", ".yml"):
        return check_transform(_matrix(_numbers(path), str(path)), name=str(path))
    try:
        content = document_of_yaml(read_text(path, MATRIX_BYTES_MAX))
        entry = content["T_BS"] if isinstance(content, dict) else None
        values = np.array(entry["data"] if isinstance(entry, dict) else entry, np.float64)
    except (ValueError, TypeError, LookupError, OverflowError) as exc:
        raise BadInputError("bad_transform", f"{path} must hold a transform T_BS of 16 numbers: {exc}") from exc
    return check_transform(_matrix(values.ravel(), f"{path}: T_BS"), name=f"{path}: T_BS")


def _rows(form: PoseForm, path: Path, units_per_s: int, rounding: PoseRounding, bad: BadRows) -> Iterator[PoseRow]:
    """Rows in the order of the file; bad ones are noted and left out."""
    makers = {
        PoseForm.KITTI: _kitti,
        PoseForm.TUM: _tum,
        PoseForm.EUROC: _euroc,
        PoseForm.COLMAP: _colmap,
        PoseForm.NERFSTUDIO: _nerfstudio,
        PoseForm.MATRICES: _matrices,
    }
    for count, make in enumerate(makers[form](path, units_per_s)):
        if count >= POSES_MAX:
            raise BadInputError("too_many_poses", f"{path} has more than {POSES_MAX} poses; cut it into parts")
        try:
            yield make(rounding)
        except BadInputError as exc:
            bad.note(exc)


Row = Callable[[PoseRounding], PoseRow]
"""A row that is read when called, so that a bad one is caught alone."""


def _pose_lines(path: Path) -> Iterator[Line]:
    for line in lines(path):
        if len(line.text) > LINE_CHARACTERS_MAX:
            raise line.error(f"a line has at most {LINE_CHARACTERS_MAX} characters, got {len(line.text)}")
        yield line


def _kitti(path: Path, _: int) -> Iterator[Row]:
    def row(line: Line, number: int, rounding: PoseRounding) -> PoseRow:
        values = line.numbers(line.text, count)
        if count % 4 == 1:
            if not values[0].is_integer():
                raise line.error(f"a frame's number is expected first, got {values[0]!r}")
            number, values = int(values[0]), values[1:]
        place = f"{path}:{line.number}"
        return PoseRow(number, rounding.transform(_matrix(np.array(values), place), name=place), place)

    count = 0
    for number, line in enumerate(_pose_lines(path)):
        count = count or len(line.text.split())
        yield partial(row, line, number)


def _tum(path: Path, units_per_s: int) -> Iterator[Row]:
    def row(line: Line, rounding: PoseRounding) -> PoseRow:
        _, *t_q = line.numbers(line.text, 8)
        place = f"{path}:{line.number}"
        rounding.check_quaternion(t_q[3:], name=place)
        return PoseRow(_time_s(line.text.split()[0], units_per_s), transform_from_quaternion(t_q[:3], t_q[3:]), place)

    for line in _pose_lines(path):
        yield partial(row, line)


def _euroc(path: Path, units_per_s: int) -> Iterator[Row]:
    def row(line: Line, rounding: PoseRounding) -> PoseRow:
        words = line.text.replace(",", " ").split()[:EUROC_COLUMNS]
        _, x, y, z, qw, *q_xyz = line.numbers(" ".join(words), EUROC_COLUMNS)
        place = f"{path}:{line.number}"
        rounding.check_quaternion([*q_xyz, qw], name=place)
        return PoseRow(_time_s(words[0], units_per_s), transform_from_quaternion((x, y, z), [*q_xyz, qw]), place)

    for line in _pose_lines(path):
        yield partial(row, line)


def _colmap(path: Path, _: int) -> Iterator[Row]:
    def row(line: Line, rounding: PoseRounding) -> PoseRow:
        words = line.text.split(maxsplit=9)
        if len(words) != 10:
            raise line.error("an image's id, quaternion, translation, camera and name are expected")
        qw, *q_xyz_t = line.numbers(" ".join(words[1:8]), 7)
        place = f"{path}:{line.number}"
        q = [*q_xyz_t[:3], qw]
        rounding.check_quaternion(q, name=place)
        return PoseRow(_stem(words[9]), transform_from_quaternion(q_xyz_t[3:], q), place)

    # Every other line holds the image's points, and may be empty.
    raw = enumerate(read_text(path, LIST_BYTES_MAX).split("\n"), start=1)
    content = [(number, text) for number, text in raw if not text.lstrip().startswith("#")]
    for number, text in content[::2]:
        if text.strip():
            line = Line(path, number, text[:LINE_CHARACTERS_MAX].strip())
            yield partial(row, line)


def _nerfstudio(path: Path, _: int) -> Iterator[Row]:
    def row(n: int, frame: object, rounding: PoseRounding) -> PoseRow:
        place = f"{path}: frame {n}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise BadInputError("bad_recording", f"{place} has no file_path")
        try:
            values = np.array(frame.get("transform_matrix"), np.float64)
        except (ValueError, TypeError, OverflowError) as exc:
            raise BadInputError("bad_transform", f"{place} has no transform_matrix of numbers") from exc
        place = f"{place}, {frame['file_path'][:200]}"
        return PoseRow(_stem(frame["file_path"]), rounding.transform(_matrix(values.ravel(), place), name=place), place)

    try:
        content = json.loads(read_text(path, JSON_BYTES_MAX))
    except (ValueError, RecursionError) as exc:
        raise BadInputError("bad_recording", f"{path} is no JSON: {exc}") from exc
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list):
        raise BadInputError("unknown_poses", f"{path} is JSON without a list of frames: {FORMS_TEXT}")
    for n, frame in enumerate(frames):
        yield partial(row, n, frame)


def _matrices(path: Path, _: int) -> Iterator[Row]:
    def row(file: Path, key: str | int, rounding: PoseRounding) -> PoseRow:
        return PoseRow(key, rounding.transform(_matrix(_numbers(file), str(file)), name=str(file)), str(file))

    stems: dict[Path, str] = {file: file.name.partition(".")[0] for file in sorted(path.glob("*.txt"))}
    if not stems:
        raise BadInputError("no_poses", f"{path} has no *.txt with a matrix, one file a frame")
    numbers = {file: re.findall(r"[0-9]{1,18}", stem) for file, stem in stems.items()}
    has_numbers = all(numbers.values())
    for file, stem in stems.items():
        key = int(numbers[file][-1]) if has_numbers else stem
        yield partial(row, file, key)


def _kind_of(form: PoseForm, rows: list[PoseRow]) -> KeyKind:
    if form in (PoseForm.TUM, PoseForm.EUROC):
        return KeyKind.TIME
    return KeyKind.NAME if isinstance(rows[0].key, str) else KeyKind.NUMBER


def _in_order(rows: list[PoseRow], bad: BadRows) -> tuple[PoseRow, ...]:
    """Rows whose times increase strictly."""
    kept: list[PoseRow] = []
    for row in rows:
        if kept and not float(row.key) > float(kept[-1].key):
            what = f"{row.place}: times must increase, got {row.key!r} s after {kept[-1].key!r} s"
            bad.note(BadInputError("bad_recording", what))
        else:
            kept.append(row)
    return tuple(kept)


def _unique(rows: list[PoseRow], key: KeyKind, bad: BadRows) -> tuple[PoseRow, ...]:
    """Rows of different keys, in order of these."""
    kept: dict[float | int | str, PoseRow] = {}
    for row in rows:
        if kept.setdefault(row.key, row) is not row:
            what = f"{row.place}: a second pose of {key} {row.key}, after {kept[row.key].place}"
            bad.note(BadInputError("bad_recording", what))
    if key is KeyKind.NAME:
        return tuple(sorted(kept.values(), key=lambda row: _natural(str(row.key))))
    return tuple(sorted(kept.values(), key=lambda row: int(row.key)))


def _check_times(path: Path, rows: tuple[PoseRow, ...], unit: str) -> None:
    """Refuse time stamps that are of another unit."""
    first_s, last_s = float(rows[0].key), float(rows[-1].key)
    latest_s = max(abs(first_s), abs(last_s))
    if latest_s > ABSOLUTE_S_MAX:
        likely = "ms" if latest_s < 1e14 else "us" if latest_s < 1e17 else "ns"
        raise BadInputError(
            "bad_time_unit",
            f"{path} has times up to {latest_s:.4g} {unit}, later than any date: if they are {likely}, give "
            f"--pose-time-unit {likely}",
        )
    interval_s = (last_s - first_s) / max(1, len(rows) - 1)
    if len(rows) > 2 and interval_s < INTERVAL_S_MIN:
        raise BadInputError(
            "bad_time_unit",
            f"{path} has {len(rows)} poses within {last_s - first_s:.3g} s if its times are {unit}: give their unit, "
            "e.g. --pose-time-unit s",
        )


def _time_s(word: str, units_per_s: int) -> float:
    # Nanoseconds since 1970 have more digits than a float: the division rounds once.
    return int(word) / units_per_s if word.isdecimal() and len(word) <= 19 else float(word) / units_per_s


def _matrix(values: npt.NDArray[np.float64], place: str) -> npt.NDArray[np.float64]:
    """(4, 4) of 12 or 16 numbers by rows."""
    if values.size == 12:
        values = np.append(values, (0, 0, 0, 1))
    if values.size != 16:
        raise BadInputError("bad_transform", f"{place} must hold 16 or 12 numbers, got {values.size}")
    return values.reshape(4, 4)


def _numbers(path: Path) -> npt.NDArray[np.float64]:
    """All numbers of a small text file, between blanks or commas."""
    words = read_text(path, MATRIX_BYTES_MAX).replace(",", " ").split()
    try:
        return np.array([float(word) for word in words], dtype=np.float64)
    except ValueError as exc:
        raise BadInputError("bad_matrix", f"{path} must hold numbers only: {exc}") from exc


def _stem(name: str) -> str:
    """File name without its folder and last suffix; both kinds of slash part folders."""
    base = name.replace("\\", "/").rpartition("/")[2]
    return base.rpartition(".")[0] or base


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sorting key in which numbers count by value."""
    parts = re.split(r"([0-9]{1,18})", name)
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts]
