"""Which voxels of which bricks a range image looks through; projectively, brick by brick.

    bricks in the view's box --sphere against the image's pyramids--> passed: not seen | free: all of it | mixed
    mixed  --512 voxel centres into the image--> a miss where the centre is nearer than what the pixel saw

A brick costs three loops: where each centre falls, what is there, whether it is nearer. The first and the last are
arithmetic alone, and so become vector instructions; together a voxel takes about a nanosecond.
"""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Index = npt.NDArray[np.int32]
Counts = npt.NDArray[np.uint16]
Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]

BRICK_RADIUS = 4 * math.sqrt(3)
"""Of the sphere around a brick, in voxels."""
FREE, MIXED = 1, 2


@nb.njit(cache=True, nogil=True, error_model="numpy")
def clear_ranges(seen_m: Singles, width: int, height: int, margin_m: float) -> Singles:
    """(height + 2, width + 2) how far each pixel is certainly clear; 0 where it saw nothing, and around it.

    A pixel is as clear as the nearest that any of its eight neighbours saw, less a margin: so a slanted surface and a
    thing that ends between two pixels are not looked through. Neighbours that saw nothing do not count.
    """
    clear = np.zeros((height + 2, width + 2), np.float32)
    for y in range(height):
        for x in range(width):
            nearest = seen_m[y * width + x]
            if not nearest > 0.0:
                continue
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    near = seen_m[v * width + u]
                    if 0.0 < near < nearest:
                        nearest = near
            clear[y + 1, x + 1] = max(nearest - margin_m, 0.0)
    return clear


@nb.njit(cache=True, nogil=True, error_model="numpy")
def pyramid(clear: Singles) -> tuple[Singles, Singles, Ints]:
    """Least and largest value below each texel, level by level, each half as wide; and (L, 3) offset, width, height."""
    height, width = clear.shape
    levels = 1
    while max(width, height) - 1 >> (levels - 1) > 0:
        levels += 1
    shapes = np.zeros((levels, 3), np.int64)
    total, w, h = 0, width, height
    for level in range(levels):
        shapes[level, 0], shapes[level, 1], shapes[level, 2] = total, w, h
        total += w * h
        w, h = (w + 1) // 2, (h + 1) // 2
    least, largest = np.empty(total, np.float32), np.empty(total, np.float32)
    for y in range(height):
        for x in range(width):
            least[y * width + x] = largest[y * width + x] = clear[y, x]
    for level in range(1, levels):
        below, bw, bh = shapes[level - 1, 0], shapes[level - 1, 1], shapes[level - 1, 2]
        here, w, h = shapes[level, 0], shapes[level, 1], shapes[level, 2]
        for y in range(h):
            for x in range(w):
                low, high = np.float32(np.inf), np.float32(0.0)
                for v in range(2 * y, min(2 * y + 2, bh)):
                    for u in range(2 * x, min(2 * x + 2, bw)):
                        low = min(low, least[below + v * bw + u])
                        high = max(high, largest[below + v * bw + u])
                least[here + y * w + x], largest[here + y * w + x] = low, high
    return least, largest, shapes


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cull_bricks_into(
    found: Index,
    low: Ints,
    high: Ints,
    dims: Ints,
    corner_view: Floats,
    axes_view: Floats,
    lens: Floats,
    radius_m: float,
    min_range_m: float,
    least: Singles,
    largest: Singles,
    shapes: Ints,
) -> int:
    """Bricks of a box that a view looks through, as rows of number and FREE or MIXED; returns how many there are.

    Writes as many as `found` holds. `low` and `high` are bricks of the tally's box, both included; `corner_view` is the
    box's corner in the camera's frame, `axes_view` (3, 3) the steps to the next brick along each axis; `lens` is fx,
    fy, cx, cy of the padded image.
    """
    count = 0
    width, height = float(shapes[0, 1]), float(shapes[0, 2])
    farthest = largest[shapes[-1, 0]]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for bz in range(low[2], high[2] + 1):
        for by in range(low[1], high[1] + 1):
            x0 = corner_view[0] + (by + 0.5) * axes_view[1, 0] + (bz + 0.5) * axes_view[2, 0]
            y0 = corner_view[1] + (by + 0.5) * axes_view[1, 1] + (bz + 0.5) * axes_view[2, 1]
            z0 = corner_view[2] + (by + 0.5) * axes_view[1, 2] + (bz + 0.5) * axes_view[2, 2]
            for bx in range(low[0], high[0] + 1):
                x = x0 + (bx + 0.5) * axes_view[0, 0]
                y = y0 + (bx + 0.5) * axes_view[0, 1]
                z = z0 + (bx + 0.5) * axes_view[0, 2]
                if z + radius_m <= 0.0:
                    continue
                distance = math.sqrt(x * x + y * y + z * z)
                if distance - radius_m >= farthest:
                    continue
                kind = MIXED
                if z > 1.5 * radius_m:
                    u0, u1 = _span(x, z, radius_m, fx, cx)
                    v0, v1 = _span(y, z, radius_m, fy, cy)
                    if u1 < 0.0 or v1 < 0.0 or u0 >= width or v0 >= height:
                        continue
                    inside = u0 >= 0.0 and v0 >= 0.0 and u1 < width and v1 < height
                    near, far = _extremes(u0, u1, v0, v1, least, largest, shapes)
                    if distance - radius_m >= far:
                        continue
                    if inside and distance + radius_m < near and distance - radius_m > min_range_m:
                        kind = FREE
                if count < len(found):
                    found[count, 0] = (bz * dims[1] + by) * dims[0] + bx
                    found[count, 1] = kind
                count += 1
    return count


@nb.njit(inline="always")
def _span(x: float, z: float, radius: float, f: float, c: float) -> tuple[float, float]:
    """Lowest and highest pixel of a sphere along one axis of the image, or a little more; half a pixel is added."""
    low, high = x - radius, x + radius
    u0 = f * (low / (z - radius) if low < 0.0 else low / (z + radius)) + c
    u1 = f * (high / (z - radius) if high > 0.0 else high / (z + radius)) + c
    return u0 - 0.5, u1 + 0.5


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _extremes(
    u0: float, u1: float, v0: float, v1: float, least: Singles, largest: Singles, shapes: Ints
) -> tuple[float, float]:
    """Least and largest value in a rectangle of the image, from at most 3 by 3 texels of one level."""
    x0, x1 = max(int(u0), 0), min(int(u1 + 1.0), shapes[0, 1] - 1)
    y0, y1 = max(int(v0), 0), min(int(v1 + 1.0), shapes[0, 2] - 1)
    level = 0
    while (x1 >> level) - (x0 >> level) > 2 or (y1 >> level) - (y0 >> level) > 2:
        level += 1
    base, width = shapes[level, 0], shapes[level, 1]
    near, far = np.inf, 0.0
    for y in range(y0 >> level, (y1 >> level) + 1):
        for x in range(x0 >> level, (x1 >> level) + 1):
            near = min(near, float(least[base + y * width + x]))
            far = max(far, float(largest[base + y * width + x]))
    return near, far


@nb.njit(cache=True, nogil=True, error_model="numpy")
def carve_into(
    misses: Counts,
    slots: Index,
    kinds: Index,
    corners_view: Singles,
    offsets_view: Singles,
    squares: Singles,
    lens: Singles,
    min_square: float,
    table_of: Index,
    local_of: Index,
) -> None:
    """Count a miss in each voxel that is looked through and was not hit.

    Args:
        misses: (B, 512) of the pool, voxels in Morton order.
        slots: (K,) where in the pool the bricks are; all different.
        kinds: (K,) FREE or MIXED.
        corners_view: (3, K) the centre of each brick's first voxel, camera frame.
        offsets_view: (3, 512) from there to each voxel's centre.
        squares: (H, W) padded image of how far each pixel is clear, squared; 0 where it is not.
        lens: fx, fy, cx, cy of that image, with half a pixel added to the centre.
        min_square: nothing nearer than this, squared, is free.
        table_of: (B,) the brick's row in `local_of`; -1 for none.
        local_of: (T, 512) -1 where this scan has no hit.
    """
    where = np.empty(512, np.int32)
    squared = np.empty(512, np.float32)
    limit = np.empty(512, np.float32)
    height, width = squares.shape
    flat = squares.ravel()
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    nearest = np.float32(min_square)
    for k in range(len(slots)):
        row = misses[slots[k]]
        table = table_of[slots[k]]
        if kinds[k] == FREE:
            if table < 0:
                for i in range(512):
                    row[i] += np.uint16(1)
            else:
                local = local_of[table]
                for i in range(512):
                    row[i] += np.uint16(1) if local[i] < 0 else np.uint16(0)
            continue
        bx, by, bz = corners_view[0, k], corners_view[1, k], corners_view[2, k]
        _addresses_into(where, squared, offsets_view, bx, by, bz, fx, fy, cx, cy, width, height)
        for i in range(512):
            limit[i] = flat[where[i]]
        if table < 0:
            for i in range(512):
                row[i] += np.uint16((squared[i] < limit[i]) & (squared[i] > nearest))
        else:
            local = local_of[table]
            for i in range(512):
                row[i] += np.uint16((squared[i] < limit[i]) & (squared[i] > nearest) & (local[i] < 0))


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _addresses_into(
    where: Index,
    squared: Singles,
    offsets: Singles,
    bx: float,
    by: float,
    bz: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
) -> None:
    """For each voxel of a brick the pixel that its centre falls on, 0 for none, and its squared distance."""
    zero, one = np.float32(0.0), np.float32(1.0)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    for i in range(512):
        x, y, z = bx + offsets[0, i], by + offsets[1, i], bz + offsets[2, i]
        squared[i] = x * x + y * y + z * z
        inverse = one / z
        u = min(max(fx * (x * inverse) + cx, zero), right)
        v = min(max(fy * (y * inverse) + cy, zero), bottom)
        # Pixel 0 is on the padded image's border, where nothing is clear; so is what lies behind the camera.
        where[i] = np.int32(v) * np.int32(width) + np.int32(u) if z > zero else np.int32(0)
