"""Columns of a cloud's file: its fields by name, and which of them are places and times of points."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

POINTS_MAX = 1 << 24
"""Points of one cloud: a sweep of 128 beams has 260 000."""
FILE_BYTES_MAX = 1 << 30
TIME_FIELDS = ("t", "time", "timestamp", "offset_time", "time_stamp", "gps_time", "time_offset", "stamp")
"""Names that drivers give the times of points, in small letters."""
Column = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class PointCloud:
    """N points of one sweep."""

    points: npt.NDArray[np.float32]
    """(N, 3) metres, x forward, y left, z up, seen from the origin; NaN where nothing came back."""
    times: Floats | None
    """(N,) in the unit and from the start of the file's own field."""
    time_field: str = ""
    has_integer_times: bool = False


def cloud_of(columns: Mapping[str, Column], name: str) -> PointCloud:
    """Points and times of a file's columns.

    Raises:
        BadInputError: kind `bad_cloud`: no columns x, y and z.
    """
    small = {key.lower(): column for key, column in columns.items()}
    if missing := [axis for axis in "xyz" if axis not in small]:
        raise bad_cloud(name, f"no field {', '.join(missing)}; it has {', '.join(columns) or 'none'}")
    with np.errstate(over="ignore", invalid="ignore"):  # of any bytes
        points = np.stack([small[axis].astype(np.float32) for axis in "xyz"], axis=-1)
        # What drivers write where nothing came back.
        is_nothing = ~np.isfinite(points).all(axis=1) | (points == 0).all(axis=1)
    points[is_nothing] = np.nan
    field = next((key for key in TIME_FIELDS if key in small), "")
    if not field:
        return PointCloud(points, None)
    is_integer = np.issubdtype(small[field].dtype, np.integer)
    return PointCloud(points, small[field].astype(np.float64), field, is_integer)


def text_columns(
    body: memoryview, dtype: np.dtype[np.void], count: int, name: str, *, skipped: int = 0
) -> dict[str, Column]:
    """The columns of lines of numbers, one line a point; integers of 64 bits, such as times, keep all digits.

    Args:
        body: the lines.
        dtype: types of the fields, in the order of the words.
        count: lines that are announced.
        name: of the file, for messages.
        skipped: lines before the first point.

    Raises:
        BadInputError: kind `bad_cloud`: other words, or fewer lines.
    """
    names = dtype.names or ()
    if not count:
        return {key: np.zeros((0, *dtype[key].shape), dtype[key].base) for key in names}
    wide = np.dtype([(key, f"{dtype[key].base.kind}8", dtype[key].shape) for key in names])
    try:
        points = np.loadtxt(
            io.BytesIO(body), dtype=wide, ndmin=1, skiprows=skipped, max_rows=count, comments=None, encoding="ascii"
        )
    except ValueError as exc:
        raise bad_cloud(name, f"its lines are no points: {exc}") from exc
    if len(points) < count:
        raise bad_cloud(name, f"it is cut off: {count} points are announced, {len(points)} lines are there")
    return {key: points[key].astype(dtype[key].base) for key in names}


def check_count(count: int, name: str) -> None:
    """Refuse a cloud that announces more points than one sweep has.

    Raises:
        BadInputError: kind `bad_cloud`.
    """
    if not 0 <= count <= POINTS_MAX:
        raise bad_cloud(name, f"{count} points are announced, 0 to {POINTS_MAX} are read")


def bad_cloud(name: str, reason: str) -> BadInputError:
    """The error of a cloud's file; for `raise`."""
    return BadInputError("bad_cloud", f"{name}: {reason}")
