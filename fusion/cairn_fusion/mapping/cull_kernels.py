"""Which bricks of a box a range image looks through, and which octants of them voxel by voxel.

    cubes of 16 bricks --against the image--> not seen | free: all of it | mixed: its eight parts, down to octants

A cube is compared with the pixels that it covers: what lies behind the farthest of them is not seen, what lies before
the nearest is free. Both are found by four look-ups, whatever the rectangle, in tables of square windows (Bender and
Farach-Colton 2000). An answer is certain or mixed, so where cubes begin changes how long it takes, never the evidence.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Floats, Int32s, Ints, Singles

NOT_SEEN, FREE, MIXED = 0.0, 1.0, 2.0
BRICK_VOXELS = 8
ROOT_LEVEL = 4
"""Cubes of 2^4 bricks are looked at first."""
LEVELS_MAX = 6
"""Windows of up to 32 pixels: twice as many are nearer than a cube that can be decided on."""
ALL_FREE = 0xFF
"""Of the masks: bit n is a brick's octant n in Morton order, free; bit 8 + n: octant n must be looked at."""
MASKS = np.array([0, 1, 256], np.int64)
"""By what is seen of an octant."""
NEAREST, FARTHEST, LEFT, RIGHT, TOP, BOTTOM, NEAR, FAR, SIGHT = range(0, 72, 8)
"""Where what is known of a cube's eight parts begins, in one array: LLVM makes no vectors of so few numbers if it would
first have to ask whether two arrays overlap."""
SLACK_VOXELS = 0.01
SLACK_SHARE = 1e-5
SLACK_PX = 0.02
"""How much single precision may move a voxel's centre, its squared distance and its pixel; ten times that and more."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def window_extremes_into(extremes: Singles, clear: Singles) -> None:
    """Fill (L, H, 2 W): least value and minus the largest of the square of 2^l pixels that begins at each pixel.

    So both are minima, and lie side by side. Where a square does not fit, nothing is written.
    """
    height, width = clear.shape
    for y in range(height):
        for x in range(width):
            extremes[0, y, 2 * x] = clear[y, x]
            extremes[0, y, 2 * x + 1] = -clear[y, x]
    pairs = np.empty(2 * width, np.float32)
    for level in range(1, len(extremes)):
        half = 1 << (level - 1)
        beside = pairs[2 * half :]
        for y in range(height - 2 * half + 1):
            above, below, out = extremes[level - 1, y], extremes[level - 1, y + half], extremes[level, y]
            for i in range(2 * width):
                pairs[i] = above[i] if above[i] < below[i] else below[i]
            for i in range(len(beside)):
                out[i] = pairs[i] if pairs[i] < beside[i] else beside[i]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cull_bricks_into(
    found: Int32s,
    low: Ints,
    high: Ints,
    dims: Ints,
    corner_eye: Floats,
    edge_m: float,
    R: Floats,
    lens: Floats,
    min_range_m: float,
    farthest_m: float,
    extremes: Singles,
) -> int:
    """Bricks of a box that a view looks through, as rows of number and mask, ALL_FREE or 0; returns how many there are.

    Args:
        found: takes as many as it has rows for.
        low: first brick of the box to look at, along each axis.
        high: last one.
        dims: bricks of the box.
        corner_eye: the box's corner from the eye, map frame.
        edge_m: of a voxel.
        R: the camera's axes in the map, as columns.
        lens: fx, fy, cx, cy of the padded image, with half a pixel added to the centre.
        min_range_m: nothing nearer is free.
        farthest_m: nothing farther is seen.
        extremes: of `window_extremes_into`, of the padded image.
    """
    brick_m = BRICK_VOXELS * edge_m
    stack = np.empty((8 * ROOT_LEVEL, 4), np.int64)
    parts, levels = np.empty(9 * 8), _levels(max(extremes.shape[1], extremes.shape[2]), len(extremes))
    count = 0
    root = 1 << ROOT_LEVEL
    for rz in range(low[2], high[2] + 1, root):
        for ry in range(low[1], high[1] + 1, root):
            for rx in range(low[0], high[0] + 1, root):
                stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = rx, ry, rz, root
                top = 1
                while top > 0:
                    top -= 1
                    bx, by, bz, side = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
                    x = corner_eye[0] + (bx + 0.5 * side) * brick_m
                    y = corner_eye[1] + (by + 0.5 * side) * brick_m
                    z = corner_eye[2] + (bz + 0.5 * side) * brick_m
                    _rects_into(parts, x, y, z, 0.25 * side * brick_m, edge_m, R, lens, farthest_m, extremes)
                    _sights_into(parts, min_range_m, levels, extremes)
                    part = side >> 1
                    for n in range(7, -1, -1):
                        px, py, pz = bx + (n & 1) * part, by + (n >> 1 & 1) * part, bz + (n >> 2) * part
                        if parts[SIGHT + n] == NOT_SEEN or px > high[0] or py > high[1] or pz > high[2]:
                            continue
                        if parts[SIGHT + n] == MIXED and part > 1:
                            stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = px, py, pz, part
                            top += 1
                            continue
                        mask = ALL_FREE if parts[SIGHT + n] == FREE else 0
                        for z1 in range(pz, min(pz + part, high[2] + 1)):
                            for y1 in range(py, min(py + part, high[1] + 1)):
                                for x1 in range(px, min(px + part, high[0] + 1)):
                                    if count < len(found):
                                        found[count, 0] = (z1 * dims[1] + y1) * dims[0] + x1
                                        found[count, 1] = mask
                                    count += 1
    return count


@nb.njit(cache=True, nogil=True, error_model="numpy")
def split_bricks_into(
    found: Int32s,
    corners_view: Singles,
    dims: Ints,
    corner: Ints,
    eye_m: Floats,
    corner_eye: Floats,
    edge_m: float,
    R: Floats,
    lens: Floats,
    min_range_m: float,
    farthest_m: float,
    extremes: Singles,
) -> int:
    """Look at the octants of the bricks that `cull_bricks_into` found with mask 0; returns how many bricks are left.

    Not done there: so one brick need not wait for the one before. `corners_view` (3, N) takes the centre of each
    brick's first voxel, camera frame. `corner` is the box's first voxel, `eye_m` the eye.
    """
    brick_m = BRICK_VOXELS * edge_m
    parts, levels = np.empty(9 * 8), _levels(max(extremes.shape[1], extremes.shape[2]), len(extremes))
    count = 0
    for k in range(len(found)):
        brick, mask = np.int64(found[k, 0]), np.int64(found[k, 1])
        row = brick // dims[0]
        bx, by, bz = brick - row * dims[0], row % dims[1], row // dims[1]
        if mask == 0:
            x = corner_eye[0] + (bx + 0.5) * brick_m
            y = corner_eye[1] + (by + 0.5) * brick_m
            z = corner_eye[2] + (bz + 0.5) * brick_m
            _rects_into(parts, x, y, z, 0.25 * brick_m, edge_m, R, lens, farthest_m, extremes)
            _sights_into(parts, min_range_m, levels, extremes)
            for n in range(8):
                mask |= MASKS[np.uint64(parts[SIGHT + n])] << n
        x = (np.float64(corner[0] + BRICK_VOXELS * bx) + 0.5) * edge_m - eye_m[0]
        y = (np.float64(corner[1] + BRICK_VOXELS * by) + 0.5) * edge_m - eye_m[1]
        z = (np.float64(corner[2] + BRICK_VOXELS * bz) + 0.5) * edge_m - eye_m[2]
        for a in range(3):
            corners_view[a, count] = x * R[0, a] + y * R[1, a] + z * R[2, a]
        found[count, 0], found[count, 1] = brick, mask
        count += 1 if mask != 0 else 0
    return count


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _rects_into(
    parts: Floats,
    x0: float,
    y0: float,
    z0: float,
    step: float,
    edge_m: float,
    R: Floats,
    lens: Floats,
    farthest_m: float,
    extremes: Singles,
) -> None:
    """Of a cube's eight parts: which pixels each covers, and the squares of its least and largest distance.

    The cube's centre is given from the eye, map frame; `step` is from there to the parts' centres along each axis.
    A part's sight becomes MIXED or NOT_SEEN where that is plain already, else FREE.
    """
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    half = step + (SLACK_VOXELS - 0.5) * edge_m
    span = half * (abs(r02) + abs(r12) + abs(r22))
    right, bottom = (extremes.shape[2] >> 1) - 1.0, extremes.shape[1] - 1.0
    widest = (1 << len(extremes)) - 1.0
    limit = farthest_m * farthest_m
    # The planes through the eye and the image's edges, as x / z and y / z, and how far a part reaches across them.
    u0, u1 = (1.0 - SLACK_PX - cx) / fx, (right + SLACK_PX - cx) / fx
    v0, v1 = (1.0 - SLACK_PX - cy) / fy, (bottom + SLACK_PX - cy) / fy
    past_u0 = half * (abs(r00 - u0 * r02) + abs(r10 - u0 * r12) + abs(r20 - u0 * r22))
    past_u1 = half * (abs(r00 - u1 * r02) + abs(r10 - u1 * r12) + abs(r20 - u1 * r22))
    past_v0 = half * (abs(r01 - v0 * r02) + abs(r11 - v0 * r12) + abs(r21 - v0 * r22))
    past_v1 = half * (abs(r01 - v1 * r02) + abs(r11 - v1 * r12) + abs(r21 - v1 * r22))
    for n in range(8):
        x, y, z = x0 + (2 * (n & 1) - 1) * step, y0 + ((n & 2) - 1) * step, z0 + ((n >> 1 & 2) - 1) * step
        ax, ay, az = abs(x), abs(y), abs(z)
        dx, dy, dz = max(ax - half, 0.0), max(ay - half, 0.0), max(az - half, 0.0)
        nearest = (dx * dx + dy * dy + dz * dz) * (1.0 - SLACK_SHARE)
        dx, dy, dz = ax + half, ay + half, az + half
        depth = x * r02 + y * r12 + z * r22
        ahead = depth - span > 0.01 * span
        # Of the cube's points none is farther from the centre's pixel: |x - u z| there, over the least depth.
        across, down = x * r00 + y * r10 + z * r20, x * r01 + y * r11 + z * r21
        beside = (across - u0 * depth <= -past_u0) | (across - u1 * depth >= past_u1)
        beside |= (down - v0 * depth <= -past_v0) | (down - v1 * depth >= past_v1)
        inverse = 1.0 / (depth if ahead else 1.0)
        nearby = half / (depth - span if ahead else 1.0)
        u, v = across * inverse, down * inverse
        du = fx * nearby * (abs(r00 - u * r02) + abs(r10 - u * r12) + abs(r20 - u * r22)) + SLACK_PX
        dv = fy * nearby * (abs(r01 - v * r02) + abs(r11 - v * r12) + abs(r21 - v * r22)) + SLACK_PX
        u, v = fx * u + cx, fy * v + cy
        left_px, right_px = min(max(u - du, 0.0), right), min(max(u + du, 0.0), right)
        top_px, bottom_px = min(max(v - dv, 0.0), bottom), min(max(v + dv, 0.0), bottom)
        unseen = (nearest >= limit) | (depth + span <= 0.0) | beside
        # What is wider than the windows is too near to be decided on as a whole.
        whole = ahead & (right_px - left_px < widest) & (bottom_px - top_px < widest)
        parts[NEAREST + n] = nearest
        parts[FARTHEST + n] = (dx * dx + dy * dy + dz * dz) * (1.0 + SLACK_SHARE)
        parts[LEFT + n], parts[RIGHT + n], parts[TOP + n], parts[BOTTOM + n] = left_px, right_px, top_px, bottom_px
        parts[SIGHT + n] = NOT_SEEN if unseen else (FREE if whole else MIXED)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _sights_into(parts: Floats, min_range_m: float, levels: Int32s, extremes: Singles) -> None:
    """Decide on the parts that `_rects_into` left FREE: none of their pixels sees as far, all see farther, or neither.

    Four windows cover a rectangle and, if it is long and narrow, what is around it. No branches: of eight parts each
    is something else, and a wrong guess costs more than the look-ups.
    """
    height, width, one = extremes.shape[1], extremes.shape[2] >> 1, np.uint64(1)
    for n in range(8):
        x0, x1, y0, y1 = int(parts[LEFT + n]), int(parts[RIGHT + n]), int(parts[TOP + n]), int(parts[BOTTOM + n])
        shift = levels[max(x1 - x0, y1 - y0)]
        side = 1 << shift
        x0, y0 = min(x0, width - side), min(y0, height - side)
        x1, y1 = max(x1 - side + 1, x0), max(y1 - side + 1, y0)
        # Unsigned: Numba counts signed numbers from the end if they are negative, and asks each time.
        level, top, bottom = np.uint64(shift), np.uint64(y0), np.uint64(y1)
        left, right = np.uint64(2 * x0), np.uint64(2 * x1)
        a, b = extremes[level, top, left], extremes[level, top, right]
        c, d = extremes[level, bottom, left], extremes[level, bottom, right]
        a, c = a if a < b else b, c if c < d else d
        parts[NEAR + n] = a if a < c else c
        left, right = left + one, right + one
        a, b = extremes[level, top, left], extremes[level, top, right]
        c, d = extremes[level, bottom, left], extremes[level, bottom, right]
        a, c = a if a < b else b, c if c < d else d
        parts[FAR + n] = a if a < c else c
    min_square = min_range_m * min_range_m
    for n in range(8):
        near, far, nearest = parts[NEAR + n], parts[FAR + n], parts[NEAREST + n]
        # The padded border is never clear: what reaches over it is not all free.
        free = (parts[FARTHEST + n] < near * near) & (nearest > min_square)
        sight = NOT_SEEN if nearest >= far * far else (FREE if free else MIXED)
        parts[SIGHT + n] = sight if parts[SIGHT + n] == FREE else parts[SIGHT + n]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _levels(side_max: int, count: int) -> Int32s:
    """(side_max,) by a rectangle's longer side, less one, the level of the windows to cover it with."""
    levels = np.empty(side_max, np.int32)
    level = 0
    for n in range(side_max):
        if 2 << level <= n + 1 and level + 1 < count:
            level += 1
        levels[n] = level
    return levels
