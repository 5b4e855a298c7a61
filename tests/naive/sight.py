"""Slow, obvious twins of what a camera sees of a map: each ray is cut with every voxel. Lengths are in voxel edges."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def cuts(origin: Floats, direction: Floats, lows: Ints, edge: int = 1) -> tuple[Floats, Floats]:
    """(V,) where a ray enters and leaves each of (V, 3) cubes; it misses those that it leaves before it enters."""
    with np.errstate(divide="ignore"):
        a, b = (lows - origin) / direction, (lows + edge - origin) / direction
    return np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)


def first_cut(origin: Floats, direction: Floats, lows: Ints, start: float, end: float) -> tuple[float, int]:
    """Range and row of the first voxel that a ray is in from `start` on; (NaN, -1) if there is none up to `end`."""
    enters, leaves = cuts(origin, direction, lows)
    ranges = np.where((leaves > enters) & (leaves > start), np.maximum(enters, start), np.inf)
    row = int(ranges.argmin()) if len(ranges) else -1
    return (float(ranges[row]), row) if row >= 0 and ranges[row] <= end else (np.nan, -1)


def first_beyond(
    origin: Floats, direction: Floats, occupied: Ints, free: Ints, start: float, end: float
) -> tuple[float, int]:
    """The first occupied voxel after the first free one."""
    out, _ = first_cut(origin, direction, free, start, end)
    return first_cut(origin, direction, occupied, out, end) if not np.isnan(out) else (np.nan, -1)
