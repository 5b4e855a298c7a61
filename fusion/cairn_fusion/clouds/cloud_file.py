"""One cloud of points in a file, of any form that is published.

    .pcd             Point Cloud Library: text, binary, compressed
    .ply             text, binary
    .bin             float32 x y z intensity (KITTI); .pcd.bin has a fifth, the ring (nuScenes)
    .las .laz        needs laspy
    .npy             (N, 3 or more), or fields x, y, z
    .xyz .txt .csv   lines of numbers: x y z first, or a line of names; blanks or commas between them

Sizes are checked before any array is made, and rows of no place become NaN.
"""

import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cairn_fusion.clouds.cloud_columns import FILE_BYTES_MAX, Column, PointCloud, bad_cloud, check_count, cloud_of
from cairn_fusion.clouds.pcd import read_pcd
from cairn_fusion.clouds.ply import read_ply
from cairn_map.errors import BadInputError

KITTI_VALUES, NUSCENES_VALUES = 4, 5
LAS_HEAD_BYTES_MIN, LAS_MINOR_AT = 227, 25
LAS_RECORDS_AT, LAS_RECORD_BYTES = slice(100, 104), 54
LAS_EXTENDED_AT, LAS_EXTENDED_BYTES = slice(243, 247), 60
NUSCENES_SUFFIX = ".pcd.bin"


def read_cloud(path: Path) -> PointCloud:
    """The points of a file, by its suffix.

    Raises:
        BadInputError: missing, of no known form, too large, cut off, or without x, y and z.
    """
    suffix = cloud_suffix(path)
    if suffix is None:
        raise BadInputError("bad_cloud", f"{path} is no cloud of points: {', '.join(READERS)} are read")
    try:
        size = path.stat().st_size
        if size > FILE_BYTES_MAX:
            raise bad_cloud(str(path), f"{size} bytes, at most {FILE_BYTES_MAX} are read")
        data = path.read_bytes()
    except OSError as exc:
        raise BadInputError("missing_file", f"cannot read {path}: {exc.strerror}") from exc
    return cloud_of(READERS[suffix](data, str(path)), str(path))


def cloud_suffix(path: Path) -> str | None:
    """The suffix of a cloud's file, of those that are read; None for other files."""
    suffixes = [path.suffix.lower()]
    if len(path.suffixes) > 1:
        suffixes.insert(0, "".join(path.suffixes[-2:]).lower())
    return next((suffix for suffix in suffixes if suffix in READERS), None)


def _read_bin(data: bytes, name: str, values: int = KITTI_VALUES) -> dict[str, Column]:
    if len(data) % (4 * values):
        raise bad_cloud(
            name, f"{len(data)} bytes are no points of {values} float32 values; it is cut off, or another form"
        )
    check_count(len(data) // (4 * values), name)
    return _named(np.frombuffer(data, "<f4").reshape(-1, values))


def _read_nuscenes(data: bytes, name: str) -> dict[str, Column]:
    return _read_bin(data, name, NUSCENES_VALUES)


def _read_npy(data: bytes, name: str) -> dict[str, Column]:
    try:
        file = io.BytesIO(data)
        version = np.lib.format.read_magic(file)
        head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = head(file)
        # The head announces a size; only what is there is read.
        if dtype.hasobject or math.prod(shape) * dtype.itemsize > len(data) - file.tell():
            raise ValueError("its head announces more than the file holds, or objects")
        values = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as exc:  # NumPy parses the head as Python, which raises errors of many kinds
        raise bad_cloud(name, f"it is no array of NumPy: {exc}") from exc
    check_count(len(values) if values.ndim else 0, name)
    if values.dtype.names is not None and values.ndim == 1:
        return {key: values[key] for key in values.dtype.names if not values.dtype[key].shape}
    return _table(values, name)


def _read_text(data: bytes, name: str) -> dict[str, Column]:
    start = data[: 1 << 14].decode("utf-8", "replace").lstrip("\ufeff")
    kept = [line for line in start.splitlines() if line.strip() and not line.lstrip().startswith(("#", "//"))]
    if not kept:
        return _named(np.zeros((0, 3)))
    # A first line of words names the columns.
    words = kept[0].replace(",", " ").replace(";", " ").split()
    names = None if _is_number(words[0]) else words
    skipped = 0 if names is None else start.splitlines().index(kept[0]) + 1
    delimiter = next((mark for mark in ",;" if mark in kept[0]), None)
    try:
        values = np.loadtxt(
            io.BytesIO(data), ndmin=2, skiprows=skipped, delimiter=delimiter, comments=("#", "//"), encoding="utf-8"
        )
    except ValueError as exc:
        raise bad_cloud(name, f"its lines are no points: {exc}") from exc
    check_count(len(values), name)
    if names is not None and len(names) == values.shape[1]:
        return {key: values[:, n] for n, key in enumerate(names)}
    return _table(values, name)


def _read_las(data: bytes, name: str) -> dict[str, Column]:
    try:
        import laspy
    except ImportError as exc:
        raise BadInputError("no_library", f"{name} needs laspy: pip install 'cairn-robotics[robot]'") from exc
    _check_las(data, name)
    try:
        with laspy.LasReader(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
            check_count(reader.header.point_count, name)
            if reader.header.point_count * reader.header.point_format.size > FILE_BYTES_MAX:
                raise ValueError("its head announces too many bytes")
            las = reader.read()
            with np.errstate(over="ignore", invalid="ignore"):  # scales of a damaged head
                columns: dict[str, Column] = {axis: np.asarray(getattr(las, axis), np.float64) for axis in "xyz"}
    except BadInputError:
        raise
    except BaseException as exc:  # laspy and its decoders raise errors of many kinds for damaged files
        # A panic of lazrs, which is Rust, is no Exception, and its class has no module to be imported from.
        if not isinstance(exc, Exception) and type(exc).__name__ != "PanicException":
            raise
        raise bad_cloud(name, f"laspy cannot read it: {exc}") from exc
    if "gps_time" in las.point_format.dimension_names:
        columns["gps_time"] = np.asarray(las.gps_time, np.float64)
    return columns


def _check_las(data: bytes, name: str) -> None:
    """Refuse a head that announces more records than the file can hold: laspy would make one object for each."""
    records = int.from_bytes(data[LAS_RECORDS_AT], "little") * LAS_RECORD_BYTES
    if data[LAS_MINOR_AT : LAS_MINOR_AT + 1] >= b"\4":
        records += int.from_bytes(data[LAS_EXTENDED_AT], "little") * LAS_EXTENDED_BYTES
    if len(data) < LAS_HEAD_BYTES_MIN or records > len(data):
        raise bad_cloud(
            name, f"{records} bytes of records are announced, {len(data)} are there; it is cut off, or damaged"
        )


def _table(values: Column, name: str) -> dict[str, Column]:
    if values.ndim != 2 or values.shape[1] < 3 or values.dtype.kind not in "fiu":
        raise bad_cloud(name, f"numbers in rows of x, y, z are expected, got {values.dtype} of shape {values.shape}")
    return _named(values)


def _named(values: Column) -> dict[str, Column]:
    """Columns of a table that begins with x, y, z; further ones have no name, so no meaning."""
    return {axis: values[:, n] for n, axis in enumerate("xyz")}


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


Reader = Callable[[bytes, str], dict[str, Column]]
READERS: dict[str, Reader] = {
    NUSCENES_SUFFIX: _read_nuscenes,
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".bin": _read_bin,
    ".las": _read_las,
    ".laz": _read_las,
    ".npy": _read_npy,
    ".xyz": _read_text,
    ".txt": _read_text,
    ".csv": _read_text,
}
"""Readers of bytes, by suffix."""
