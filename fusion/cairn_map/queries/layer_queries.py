"""Images of a map from above: one layer of voxels, or the highest of each column."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import centres_of_voxels
from cairn_map.queries import layer_kernels as kernels
from cairn_map.queries import point_queries
from cairn_map.queries.frozen_map import Box, FrozenMap

PIXELS_MAX = 1 << 26
"""Pixels of an image, at most: cells may lie anywhere, and the box of all of them may be as large as a country."""
NO_TOP = np.iinfo(np.int64).min
"""Height of a column without an occupied voxel."""
Values = npt.NDArray[np.number]


@dataclass(frozen=True, slots=True, eq=False)
class MapImage:
    """A map from above: a pixel is a voxel wide, rows go along y and columns along x."""

    values: Values
    """(H, W), or (H, W, 3) for colours."""
    origin_m: tuple[float, float]
    """x, y of the centre of the pixel [0, 0], metres, map frame."""
    edge_m: float
    """Edge of a pixel, metres."""


def layer(frozen: FrozenMap, z_m: float, what: str, box_m: Box | None) -> MapImage:
    """One horizontal layer: `state`, `probability`, `log_odds` or the mean of a channel."""
    if not abs(z_m) < frozen.reach_m:
        raise BadInputError("point_range", f"the height must be finite and within {frozen.reach_m:.0f} m, got {z_m}")
    ask = _question(frozen, what)
    low, high = _checked(*frozen.voxels_of_box(box_m))
    W, H = high[0] - low[0], high[1] - low[1]
    centres_x, centres_y = (_centres(frozen, low[axis], high[axis]) for axis in (0, 1))
    rows_at_once = max(1, point_queries.CHUNK // max(W, 1))
    parts: list[Values] = []
    for start in range(0, max(H, 1), rows_at_once):
        y, x = np.meshgrid(centres_y[start : start + rows_at_once], centres_x, indexing="ij")
        points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], axis=1)
        values = ask(points)
        parts.append(values.reshape(*x.shape, *values.shape[1:]))
    return _image(frozen, np.concatenate(parts), low)


def height_map(frozen: FrozenMap, box_m: Box | None) -> MapImage:
    """The height of each column's highest occupied voxel's upper face; NaN where there is none."""
    low, high = _checked(*frozen.voxels_of_box(box_m))
    tops = np.full((high[1] - low[1], high[0] - low[0]), NO_TOP)
    kernels.tops_into(frozen.grid, frozen.brick_corners(), low, high, tops)
    heights = np.where(tops == NO_TOP, np.nan, (tops + 1) * frozen.geometry.voxel_edge_m)
    return _image(frozen, heights, low)


def _question(frozen: FrozenMap, what: str) -> Callable[[Floats], Values]:
    match what:
        case "state":
            return lambda points: point_queries.states_at(frozen, points)
        case "probability":
            return lambda points: point_queries.probability_at(frozen, points)
        case "log_odds":
            return lambda points: point_queries.log_odds_at(frozen, points)
    channel = point_queries.channel_named(frozen, what)
    return lambda points: point_queries.reading_at(frozen, points, channel).mean


def _checked(low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], ...]:
    pixels = int(high[0] - low[0]) * int(high[1] - low[1])
    if pixels > PIXELS_MAX:
        raise BadInputError("too_large", f"an image has at most {PIXELS_MAX} pixels, not {pixels}; give a smaller box")
    return low, high


def _centres(frozen: FrozenMap, low: int, high: int) -> Floats:
    voxels = np.zeros((high - low, 3), np.int64)
    voxels[:, 0] = np.arange(low, high)
    return centres_of_voxels(voxels, frozen.geometry)[:, 0]


def _image(frozen: FrozenMap, values: Values, low: npt.NDArray[np.int64]) -> MapImage:
    x, y, _ = centres_of_voxels(low, frozen.geometry)
    return MapImage(values, (float(x), float(y)), frozen.geometry.voxel_edge_m)
