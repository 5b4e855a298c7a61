"""Floor grids: a storey as a ground robot sees it, free, occupied or unknown, as Nav2 and RViz take it.

    band top     ----------   looked down from here
    . . . . . .               known free all the way ...
    band bottom  ----------
    . . . . . .
    ground +- LOW  ########   ... to an occupied voxel of the ground: free

A column with an obstacle in the band is occupied; all others are unknown. So nothing is free that was not seen free
down to the ground: not the space above a hole, nor that below a table whose floor no camera saw.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.grid import NANOMETRES, check_cubes
from cairn_map.queries import floor_kernels as kernels
from cairn_map.queries.frozen_map import Box, FrozenMap
from cairn_map.queries.region_queries import check_pixels

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of `nav_msgs/OccupancyGrid`."""
STANDARD_BAND_M = (0.1, 1.5)
"""Heights above the ground that a robot takes: above what its wheels climb, and as high as it is."""
Band = tuple[float, float]
"""Lowest and highest height above the ground, metres."""
GROUNDS_MAX = 32
"""Heights that are examined for a ground."""
STOREY_SHARE = 0.1
"""Free area of a storey, as a part of the largest one's, at least: tops of shelves and cupboards are smaller."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """One storey from above: a pixel is a voxel wide, rows go along y and columns along x."""

    values: npt.NDArray[np.int8]
    """(H, W) of UNKNOWN, FREE, OCCUPIED."""
    origin_m: tuple[float, float]
    """x, y of the outer corner of the pixel [0, 0], metres, map frame."""
    edge_m: float
    """Edge of a pixel, metres."""
    ground_m: float
    """Height of the ground, metres, map frame."""

    @property
    def free_m2(self) -> float:
        """Free area, square metres."""
        return int((self.values == FREE).sum()) * self.edge_m**2

    @property
    def occupied_m2(self) -> float:
        """Area with an obstacle in the band, square metres."""
        return int((self.values == OCCUPIED).sum()) * self.edge_m**2


def standard_band(edge_m: float) -> Band:
    """Band of a map with voxels of this edge: the standard one, from a voxel on where voxels are coarser."""
    low_m, high_m = STANDARD_BAND_M
    return max(low_m, edge_m), max(high_m, 2 * edge_m)


def floor_grid(frozen: FrozenMap, ground_m: float, band_m: Band | None, box_m: Box | None) -> FloorGrid:
    """The storey on a ground, over the columns of a box.

    Raises:
        BadInputError: kind `bad_band`; `point_range`: the ground is beyond the numbered space; `bad_box`; `too_large`.
    """
    check_cubes(frozen.geometry)
    edge_m = frozen.geometry.voxel_edge_m
    band_m = _checked_band(band_m, edge_m)
    if not abs(ground_m) + band_m[1] < frozen.reach_m:
        raise BadInputError(
            "point_range", f"the ground must be finite and within {frozen.reach_m:.0f} m, got {ground_m} m"
        )
    low, high = frozen.voxels_of_box(box_m)
    check_pixels(low, high)
    columns = np.full((high[1] - low[1], high[0] - low[0]), UNKNOWN, np.int8)
    heights = (ground_m - band_m[0], ground_m + band_m[0], ground_m + band_m[1])
    zone_low, band_low, band_high = (_first_centre_at(height_m, frozen.grid.edge_nm) for height_m in heights)
    kernels.columns_into(frozen.grid, low, high, zone_low, band_low, band_high, columns)
    x_m, y_m = (int(number) * frozen.geometry.voxel_edge_um / 1e6 for number in low[:2])
    return FloorGrid(columns, (x_m, y_m), edge_m, ground_m)


def grounds(frozen: FrozenMap, band_m: Band | None) -> list[tuple[float, float]]:
    """Height in metres and free area in square metres of each storey's ground, the largest area first.

    A ground is a height with many surfaces, on which a robot of the band finds free columns; of heights that a robot
    would fill together the one with the most surfaces stands for all. Ramps and stairs are no grounds.

    Raises:
        BadInputError: kind `bad_band`.
        NotFoundError: kind `no_ground`: no column is free at any height.
    """
    check_cubes(frozen.geometry)
    edge_m = frozen.geometry.voxel_edge_m
    band_m = _checked_band(band_m, edge_m)
    bottom = int(frozen.grid.low[2])
    counts = np.zeros(int(frozen.grid.high[2]) - bottom, np.int64)
    kernels.surfaces_into(frozen.grid, frozen.brick_corners(), counts)
    # Heights by falling number of surfaces, each at least the band apart from all before.
    apart, peaks = math.ceil(band_m[1] / edge_m), list[int]()
    for height in np.argsort(-counts, kind="stable").tolist():
        if counts[height] == 0 or len(peaks) == GROUNDS_MAX:
            break
        if all(abs(height - peak) >= apart for peak in peaks):
            peaks.append(height)
    # On the voxels' upper faces.
    heights_m = [(bottom + peak + 1) * frozen.geometry.voxel_edge_um / 1e6 for peak in peaks]
    found = [(ground_m, floor_grid(frozen, ground_m, band_m, None).free_m2) for ground_m in heights_m]
    found.sort(key=lambda storey: -storey[1])
    if not found or found[0][1] == 0:
        raise NotFoundError(
            "no_ground",
            f"at no height is a column known free from {band_m[1]:g} m above the ground down to the ground: map the "
            "floor, too, or give a lower band",
        )
    return [storey for storey in found if storey[1] >= STOREY_SHARE * found[0][1]]


def _checked_band(band_m: Band | None, edge_m: float) -> Band:
    low_m, high_m = band_m or standard_band(edge_m)
    if not edge_m <= low_m < high_m < math.inf:
        raise BadInputError(
            "bad_band",
            f"a band is its lowest and its highest height above the ground, metres, the lowest at least a voxel "
            f"({edge_m:g} m); got {low_m:g} to {high_m:g}",
        )
    return low_m, high_m


def _first_centre_at(height_m: float, edge_nm: int) -> int:
    """The lowest voxel whose centre is not below a height, in integers."""
    return -((edge_nm - 2 * round(height_m * NANOMETRES)) // (2 * edge_nm))
