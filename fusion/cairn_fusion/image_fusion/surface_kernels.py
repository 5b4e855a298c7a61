"""Surface of a range image as triangles between its pixels, drawn into other cameras: the loops of `surface`.

o---o---o      neighbours on one surface are joined; across a step in depth they are not
| / | / |
o---o   o  o   a pixel with no triangle is drawn as a small square
"""

import math

import numba as nb
import numpy as np

from cairn_map.arrays import Flags, Floats, Labels, Singles

SLANT_SHARE = 2.0
"""Largest step between two pixels of one surface, over the steps next to it that have the same sign."""
OK = 0
"""Value of `transfer.Label`."""
AREA_MIN = 1e-9
"""Square pixels; a triangle with less is seen edge-on."""
GAP_MAX = 3
"""Largest gap of untrusted pixels in a line over which a step in depth is searched."""
GAP_SHARE = 0.04
"""Relative growth of range from pixel to pixel on a surface seen at 80 degrees of slant, 130 pixels of focal length."""


@nb.njit(cache=True, nogil=True)
def joints(range_m: Singles, labels: Labels, noise_m: Singles, dx: int, dy: int) -> Flags:
    """(H, W) true if a pixel and its next, (dx, dy) away, are of one surface.

    Args:
        range_m: (H, W) metres along the beam.
        labels: (H, W) only what is OK is joints.
        noise_m: (H, W) largest step from noise alone.
        dx: 1 for the next in the row, else 0.
        dy: 1 for the next in the column, else 0.
    """
    height, width = range_m.shape
    out = np.zeros((height, width), np.bool_)
    for y in range(height - dy):
        for x in range(width - dx):
            if labels[y, x] != OK or labels[y + dy, x + dx] != OK:
                continue
            # On a slanted surface the steps before and after this one have its sign and about its size.
            step = range_m[y + dy, x + dx] - range_m[y, x]
            sign = np.float32(1.0) if step > 0 else np.float32(-1.0)
            slant = np.float32(0.0)
            if x >= dx and y >= dy and labels[y - dy, x - dx] == OK:
                slant = max(slant, sign * (range_m[y, x] - range_m[y - dy, x - dx]))
            if x + 2 * dx < width and y + 2 * dy < height and labels[y + 2 * dy, x + 2 * dx] == OK:
                slant = max(slant, sign * (range_m[y + 2 * dy, x + 2 * dx] - range_m[y + dy, x + dx]))
            out[y, x] = abs(step) <= noise_m[y, x] + np.float32(SLANT_SHARE) * slant
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_triangles_into(
    nearness: Singles, drawn: Flags, u: Floats, v: Floats, q: Floats, across: Flags, down: Flags
) -> None:
    """Draw the triangles between joined pixels; the nearest wins.

    Args:
        nearness: (h, w) 1 / metres; 0 for nothing.
        drawn: (H, W) becomes true for pixels that have a triangle.
        u: (H, W) x of the pixels, in pixels of `nearness`; NaN for those that do not appear.
        v: (H, W)
        q: (H, W) 1 / range from there.
        across: (H, W) true if joined to the next in the row.
        down: (H, W) true if joined to the next in the column.
    """
    height, width = u.shape
    for y in range(height - 1):
        for x in range(width - 1):
            # a b
            # c d
            ab, ac, cd, bd = across[y, x], down[y, x], across[y + 1, x], down[y, x + 1]
            # Two triangles along the diagonal b-c; with one side missing, the one that the other diagonal leaves.
            if ab and ac:
                _triangle_into(nearness, drawn, u, v, q, y, x, y, x + 1, y + 1, x)
            if bd and cd:
                _triangle_into(nearness, drawn, u, v, q, y + 1, x + 1, y, x + 1, y + 1, x)
            if ab and bd and not (ac and cd):
                _triangle_into(nearness, drawn, u, v, q, y, x, y, x + 1, y + 1, x + 1)
            if ac and cd and not (ab and bd):
                _triangle_into(nearness, drawn, u, v, q, y, x, y + 1, x, y + 1, x + 1)


@nb.njit(forceinline=True, error_model="numpy")
def _triangle_into(
    nearness: Singles,
    drawn: Flags,
    u: Floats,
    v: Floats,
    q: Floats,
    y0: int,
    x0: int,
    y1: int,
    x1: int,
    y2: int,
    x2: int,
) -> None:
    au, av, bu, bv, cu, cv = u[y0, x0], v[y0, x0], u[y1, x1], v[y1, x1], u[y2, x2], v[y2, x2]
    area = (bu - au) * (cv - av) - (cu - au) * (bv - av)
    # Written so that NaN, a point that does not appear, draws nothing.
    if not abs(area) > AREA_MIN:
        return
    drawn[y0, x0] = drawn[y1, x1] = drawn[y2, x2] = True
    height, width = nearness.shape
    # Drawn pixels of the triangle's box.
    left, right = max(0, math.ceil(min(au, bu, cu))), min(width - 1, math.floor(max(au, bu, cu)))
    top, bottom = max(0, math.ceil(min(av, bv, cv))), min(height - 1, math.floor(max(av, bv, cv)))
    q0, q1, q2, share = q[y0, x0], q[y1, x1], q[y2, x2], 1.0 / area
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            # Barycentric coordinates; 1 / range is linear over the image of a plane.
            b = ((column - au) * (cv - av) - (cu - au) * (row - av)) * share
            c = ((bu - au) * (row - av) - (column - au) * (bv - av)) * share
            if b >= 0.0 and c >= 0.0 and b + c <= 1.0:
                here = np.float32(q0 + b * (q1 - q0) + c * (q2 - q0))
                if here > nearness[row, column]:
                    nearness[row, column] = here


@nb.njit(cache=True, nogil=True)
def fronts(range_m: Singles, labels: Labels, across: Flags, down: Flags, noise_m: Singles) -> Flags:
    """(H, W) pixels where a surface ends before a farther one: they may hide some of it.

    Args:
        range_m: (H, W) metres.
        labels: (H, W)
        across: (H, W) of `joints`.
        down: (H, W)
        noise_m: (H, W) largest step from noise; over a gap of untrusted pixels twice that and `GAP_SHARE`.
    """
    height, width = range_m.shape
    out = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            if labels[y, x] != OK:
                continue
            for side in range(4):
                dx, dy = (1, 0, -1, 0)[side], (0, 1, 0, -1)[side]
                # The next trusted pixel to this side.
                j, i, gap = y + dy, x + dx, 0
                while gap < GAP_MAX and 0 <= j < height and 0 <= i < width and labels[j, i] != OK:
                    j, i, gap = j + dy, i + dx, gap + 1
                if not (0 <= j < height and 0 <= i < width) or labels[j, i] != OK:
                    continue
                if gap > 0:
                    share = np.float32(1.0 + GAP_SHARE * (gap + 1))
                    ends = range_m[j, i] > range_m[y, x] * share + np.float32(2.0) * noise_m[y, x]
                else:
                    # Links are stored with the first pixel of each pair.
                    first_y, first_x = min(y, j), min(x, i)
                    linked = across[first_y, first_x] if dy == 0 else down[first_y, first_x]
                    ends = not linked and range_m[j, i] > range_m[y, x]
                out[y, x] |= ends
    return out


@nb.njit(cache=True, nogil=True)
def draw_squares_into(nearness: Singles, chosen: Flags, u: Floats, v: Floats, q: Floats, half_px: float) -> None:
    """Draw each chosen pixel as a square around its place; the nearest wins. Arguments as `draw_triangles_into`."""
    height, width = nearness.shape
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            if not chosen[y, x] or math.isnan(u[y, x]):
                continue
            left, right = max(0, math.ceil(u[y, x] - half_px)), min(width - 1, math.floor(u[y, x] + half_px))
            top, bottom = max(0, math.ceil(v[y, x] - half_px)), min(height - 1, math.floor(v[y, x] + half_px))
            # Drawn pixels whose centres lie in the square.
            here = np.float32(q[y, x])
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    if here > nearness[row, column]:
                        nearness[row, column] = here


@nb.njit(cache=True, nogil=True)
def draw_labels_into(marks: Labels, nearness: Singles, labels: Labels, u: Floats, v: Floats, half_px: float) -> None:
    """Mark the places where only pixels without a trusted range may appear; a higher label wins.

    Args:
        marks: (h, w)
        nearness: (h, w) as drawn before.
        labels: (H, W) of the range camera's pixels; OK is not drawn.
        u: (H, W) x of their places; NaN where unknown.
        v: (H, W)
        half_px: half the edge of the squares.
    """
    height, width = nearness.shape
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            if labels[y, x] == OK or math.isnan(u[y, x]):
                continue
            left, right = max(0, math.ceil(u[y, x] - half_px)), min(width - 1, math.floor(u[y, x] + half_px))
            top, bottom = max(0, math.ceil(v[y, x] - half_px)), min(height - 1, math.floor(v[y, x] + half_px))
            # Labels rank by their number: a reason beats the mere absence of a range.
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    if nearness[row, column] == 0.0 and labels[y, x] > marks[row, column]:
                        marks[row, column] = labels[y, x]


@nb.njit(cache=True, nogil=True)
def borrowed_ranges(range_m: Singles, labels: Labels, reach_px: int) -> Singles:
    """(H, W) ranges; a pixel without a trusted one takes that of the nearest with one, or NaN with none in reach."""
    height, width = range_m.shape
    out = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            out[y, x] = range_m[y, x]
            if labels[y, x] == OK:
                continue
            out[y, x] = np.nan
            # Nearest by squared distance, first found of several.
            best = (reach_px + 1) ** 2
            for dy in range(-reach_px, reach_px + 1):
                for dx in range(-reach_px, reach_px + 1):
                    j, i, far = y + dy, x + dx, dx * dx + dy * dy
                    if far < best and 0 <= j < height and 0 <= i < width and labels[j, i] == OK:
                        best = far
                        out[y, x] = range_m[j, i]
    return out


@nb.njit(cache=True, nogil=True)
def nearest_of_nine(nearness: Singles) -> Singles:
    """(h, w) the largest value of each 3 x 3 window."""
    height, width = nearness.shape
    # Of rows first, then of columns.
    rows = np.empty_like(nearness)
    for y in range(height):
        for x in range(width):
            best = nearness[y, x]
            if x > 0 and nearness[y, x - 1] > best:
                best = nearness[y, x - 1]
            if x + 1 < width and nearness[y, x + 1] > best:
                best = nearness[y, x + 1]
            rows[y, x] = best
    out = np.empty_like(nearness)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            out[y, x] = max(rows[above, x], rows[y, x], rows[below, x])
    return out
