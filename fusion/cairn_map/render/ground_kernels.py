"""Kernels of a level that is drawn: what the columns around each surface say, and the surface that each ray meets.

A column has spans, from below: a surface is solid from its height down to the lowest surface next to it, so that no ray
slips through where the ground steps; an obstacle is solid over the height of its voxel. A ray walks through columns of
cells that its height may meet, and in them column by column. These kernels check nothing.
tests/naive/ground.py has the slow twins.
"""

from typing import NamedTuple

import numba as nb
import numpy as np

from cairn_map.arrays import Flags, Floats, Int32s, Ints, Singles
from cairn_map.kernels.integer_kernels import signed

NO_ROW = -1
"""Row of what sees nothing."""


class Columns(NamedTuple):
    """Spans by column, for kernels; lengths in metres, map frame."""

    tables: Int32s
    """(I, J) one more than the table of each column of cells, 0 for none."""
    first: Ints
    """(2,) indices of the cell at [0, 0]."""
    depth: int
    edge_m: float
    """Edge of a column."""
    starts: Int32s
    """(T, 4^depth + 1) first row of each column of a table, row by row along x; the next one's first row ends it."""
    lows: Floats
    """(T,) the lowest end of a table's spans, and `highs` the highest."""
    highs: Floats
    bottoms: Floats
    """(R,) lower end of each span."""
    tops: Floats
    """(R,) upper end of each span; of a surface its height. They rise in a column."""
    is_ground: Flags
    """(R,) True for surfaces, False for obstacles."""


@nb.njit(cache=True, nogil=True)
def surroundings_into(
    columns: Columns, plane_min: int, fall_max_m: float, clearance_m: float, around: Floats, fall_x: Floats
) -> None:
    """Write (R, 5) slope (radians), roughness, step, fall and obstacle (metres) of each surface, and its fall along x.

    Of eight columns around the surface nearest in height counts. NaN for obstacles; slope, roughness and `fall_x`, the
    part of its own width by which the plane falls towards the lower right, also where fewer than `plane_min` of nine
    are known, or all lie in a line. A fall is the largest one to a surface around that is no farther below than
    `fall_max_m`.
    """
    side = 1 << columns.depth
    # All columns of all tables; those counted from the first cell are found again across borders of cells.
    for i in range(columns.tables.shape[0]):
        for j in range(columns.tables.shape[1]):
            table = signed(columns.tables[i, j]) - 1
            if table < 0:
                continue
            for column in range(side * side):
                begin, end = columns.starts[table, column], columns.starts[table, column + 1]
                x, y = i * side + column % side, j * side + column // side
                for row in range(begin, end):
                    around[row] = np.nan
                    fall_x[row] = np.nan
                    if columns.is_ground[row]:
                        _around_into(columns, x, y, row, plane_min, fall_max_m, around[row], fall_x)
                        # The highest thing over the surface that would hinder a vehicle.
                        height, highest = columns.tops[row], 0.0
                        for other in range(begin, end):
                            over = columns.tops[other] - height
                            if over <= clearance_m:
                                highest = max(highest, over)
                        around[row, 4] = highest


@nb.njit(nogil=True)
def _around_into(
    columns: Columns, x: int, y: int, row: int, plane_min: int, fall_max_m: float, found: Floats, fall_x: Floats
) -> None:
    """The plane through a surface and those around it, by least squares about their means; the largest step, fall."""
    # Stage 1: sums of the normal equations, lengths in columns, heights relative to the surface, which is known.
    height, edge = columns.tops[row], columns.edge_m
    n, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    step, fall = 0.0, 0.0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if dx == 0 and dy == 0:
                continue
            # Of several surfaces of a column the nearest in height goes on from this one.
            z = _surface_at(columns, x + dx, y + dy, height) - height
            if np.isnan(z):
                continue
            n += 1.0
            sx, sy, sz = sx + dx, sy + dy, sz + z
            sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
            sxz, syz, szz = sxz + dx * z, syz + dy * z, szz + z * z
            step = max(step, abs(z))
            # A deeper one is another surface, not this one's edge.
            if -z <= fall_max_m:
                fall = max(fall, -z)
    found[2], found[3] = step, fall
    # Stage 2: the plane. About the means; a determinant of 0 has all columns in a line.
    cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    cxz, cyz, czz = sxz - sx * sz / n, syz - sy * sz / n, szz - sz * sz / n
    area = cxx * cyy - cxy * cxy
    if n >= plane_min and area > 1e-9:
        a, b = (cxz * cyy - cyz * cxy) / area, (cyz * cxx - cxz * cxy) / area
        found[0] = np.arctan(np.hypot(a, b) / edge)
        found[1] = np.sqrt(max(czz - a * cxz - b * cyz, 0.0) / n)
        fall_x[row] = (b - a) / edge


@nb.njit(nogil=True)
def _surface_at(columns: Columns, x: int, y: int, near_m: float) -> float:
    """Height of the surface of a column, counted from the first cell, that is nearest to a height; NaN for none."""
    # The table first: beyond the cells that were read nothing is known.
    i, j = x >> columns.depth, y >> columns.depth
    if (i < 0) | (j < 0) | (i >= columns.tables.shape[0]) | (j >= columns.tables.shape[1]):
        return np.nan
    table = signed(columns.tables[i, j]) - 1
    if table < 0:
        return np.nan
    mask = (1 << columns.depth) - 1
    column = ((y & mask) << columns.depth) + (x & mask)
    # The first of those that are equally near: NaN is farther than any.
    best = np.nan
    for row in range(columns.starts[table, column], columns.starts[table, column + 1]):
        if columns.is_ground[row] and not abs(columns.tops[row] - near_m) >= abs(best - near_m):
            best = columns.tops[row]
    return best


@nb.njit(cache=True, nogil=True)
def see_ground_into(
    columns: Columns, T_map_camera: Floats, rays: Floats, range_max_m: float, ranges: Singles, rows: Int32s
) -> None:
    """Write the range (metres) at which each of (N, 3) unit rays of a camera meets its first span, and the span's row.

    NaN and `NO_ROW` where it meets none within `range_max_m`, or looks nowhere.
    """
    side_m = columns.edge_m * (1 << columns.depth)
    start, ray = np.empty(3), np.empty(3)
    start[:] = T_map_camera[:3, 3]
    # The box of all cells, in x and y.
    low = (columns.first[0] * side_m, columns.first[1] * side_m)
    high = (low[0] + columns.tables.shape[0] * side_m, low[1] + columns.tables.shape[1] * side_m)
    for n in range(rays.shape[0]):
        ranges[n], rows[n] = np.nan, NO_ROW
        # d_map = R_map_camera d_camera
        for axis in range(3):
            ray[axis] = (
                T_map_camera[axis, 0] * rays[n, 0]
                + T_map_camera[axis, 1] * rays[n, 1]
                + T_map_camera[axis, 2] * rays[n, 2]
            )
        if np.isnan(ray[0] + ray[1] + ray[2]):
            continue
        # The part of the ray in the box.
        enter, leave = 0.0, range_max_m
        for axis in range(2):
            if ray[axis] == 0.0:
                if not low[axis] <= start[axis] < high[axis]:
                    leave = -1.0
            else:
                a, b = (low[axis] - start[axis]) / ray[axis], (high[axis] - start[axis]) / ray[axis]
                enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
        if enter <= leave:
            ranges[n], rows[n] = _look(columns, start, ray, enter, leave)


@nb.njit(nogil=True)
def _look(columns: Columns, start: Floats, ray: Floats, enter: float, leave: float) -> tuple[float, int]:
    """Range and row of the first span between two ranges; the ray is in the box of all cells there."""
    side_m = columns.edge_m * (1 << columns.depth)
    last_i, last_j = columns.tables.shape[0] - 1, columns.tables.shape[1] - 1
    i = _place(start[0] + enter * ray[0], side_m, columns.first[0], last_i)
    j = _place(start[1] + enter * ray[1], side_m, columns.first[1], last_j)
    at = enter
    # Invariant: the ray enters column of cells (i, j) at range `at`; each turn leaves it for the next one.
    while True:
        to_x = _border(columns.first[0] + i, side_m, start[0], ray[0])
        to_y = _border(columns.first[1] + j, side_m, start[1], ray[1])
        end = max(min(to_x, to_y, leave), at)
        # A column of cells is walked only where the ray's heights and those of its spans overlap.
        table = signed(columns.tables[i, j]) - 1
        if table >= 0:
            z0, z1 = start[2] + at * ray[2], start[2] + end * ray[2]
            if max(z0, z1) >= columns.lows[table] and min(z0, z1) <= columns.highs[table]:
                found, row = _look_in(columns, table, i, j, start, ray, at, end)
                if row >= 0:
                    return found, row
        if end >= leave:
            return np.nan, NO_ROW
        # On to the next column of cells.
        if to_x <= to_y:
            i += 1 if ray[0] > 0 else -1
        else:
            j += 1 if ray[1] > 0 else -1
        if (i < 0) | (j < 0) | (i > last_i) | (j > last_j):
            return np.nan, NO_ROW
        at = end


@nb.njit(nogil=True)
def _look_in(
    columns: Columns, table: int, i: int, j: int, start: Floats, ray: Floats, enter: float, leave: float
) -> tuple[float, int]:
    """Range and row of the first span in one column of cells, between the ranges at which the ray enters and leaves."""
    side, edge = 1 << columns.depth, columns.edge_m
    first_x, first_y = (columns.first[0] + i) * side, (columns.first[1] + j) * side
    x = _place(start[0] + enter * ray[0], edge, first_x, side - 1)
    y = _place(start[1] + enter * ray[1], edge, first_y, side - 1)
    at = enter
    # Invariant: the ray enters column (x, y) at range `at`.
    while True:
        to_x = _border(first_x + x, edge, start[0], ray[0])
        to_y = _border(first_y + y, edge, start[1], ray[1])
        end = max(min(to_x, to_y, leave), at)
        z0, z1 = start[2] + at * ray[2], start[2] + end * ray[2]
        # The nearest of the column's few spans.
        best, best_row = np.inf, NO_ROW
        column = y * side + x
        for row in range(columns.starts[table, column], columns.starts[table, column + 1]):
            top, bottom = columns.tops[row], columns.bottoms[row]
            if max(z0, z1) < bottom or min(z0, z1) > top:
                continue
            # Through the side, from above, or from below.
            met = at
            if z0 > top:
                met = (top - start[2]) / ray[2]
            elif z0 < bottom:
                met = (bottom - start[2]) / ray[2]
            if met < best:
                best, best_row = met, row
        if best_row >= 0:
            return best, best_row
        if end >= leave:
            return np.nan, NO_ROW
        if to_x <= to_y:
            x += 1 if ray[0] > 0 else -1
        else:
            y += 1 if ray[1] > 0 else -1
        if (x < 0) | (y < 0) | (x >= side) | (y >= side):
            return np.nan, NO_ROW
        at = end


@nb.njit(nogil=True, forceinline=True)
def _place(at_m: float, edge_m: float, first: int, last: int) -> int:
    """Number, from `first` on, of the interval that holds a length, 0 to `last`: rounding may put it next to them."""
    return min(max(int(np.floor(at_m / edge_m)) - first, 0), last)


@nb.njit(nogil=True, forceinline=True)
def _border(number: int, edge_m: float, start: float, ray: float) -> float:
    """Range at which a ray leaves an interval along one axis."""
    if ray > 0:
        return ((number + 1) * edge_m - start) / ray
    if ray < 0:
        return (number * edge_m - start) / ray
    return np.inf
