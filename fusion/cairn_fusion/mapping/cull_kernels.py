"""Bricks of a box that a range image looks through, and the octants of them that need a test voxel by voxel.

    cubes of 16 bricks --against the image--> not seen | free: all of it | mixed: its eight parts, down to octants

A cube is compared with the pixels that it covers: behind the farthest of them it is not seen, before the nearest it is
free. Both are found by four look-ups, whatever the rectangle, in tables of square windows (Bender and Farach-Colton
2000). An answer is certain or mixed, so the places where cubes begin change the time taken, never the evidence.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Floats, Int32s, Ints, Singles

NOT_SEEN, FREE, MIXED = 0.0, 1.0, 2.0
BRICK_VOXELS = 8
ROOT_LEVEL = 4
"""The search begins with cubes of 2^4 bricks along each edge."""
LEVELS_MAX = 6
"""Windows of up to 32 pixels: a cube that covers more is too near to be decided on as a whole."""
ALL_FREE = 0xFF
"""Mask of a free brick. Bit n: octant n in Morton order is free; bit 8 + n: octant n needs a test by voxel."""
MASKS = np.array([0, 1, 256], np.int64)
"""Bits of a mask for an octant, by its sight: NOT_SEEN, FREE, MIXED."""
NEAREST, FARTHEST, LEFT, RIGHT, TOP, BOTTOM, NEAR, FAR, SIGHT = range(0, 72, 8)
"""Offsets of the quantities of a cube's eight parts, in one array: LLVM makes no vectors of so few numbers if it first
has to test whether two arrays overlap."""
SLACK_VOXELS = 0.01
SLACK_SHARE = 1e-5
SLACK_PX = 0.02
"""Allowance for single precision in a voxel's centre, squared distance and pixel: ten times its error, or more."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def window_extremes_into(extremes: Singles, clear: Singles) -> None:
    """Fill (L, H, 2 W): least value and minus the largest of the square of 2^l pixels that begins at each pixel.

    So both are minima, and lie side by side. Where a square does not fit, nothing is written.
    """
    # Level 0: the pixels themselves.
    height, width = clear.shape
    for y in range(height):
        for x in range(width):
            extremes[0, y, 2 * x] = clear[y, x]
            extremes[0, y, 2 * x + 1] = -clear[y, x]
    pairs = np.empty(2 * width, np.float32)
    for level in range(1, len(extremes)):
        # A square is the least of four of half its edge: first of two rows, then of two columns.
        half = 1 << (level - 1)
        shifted = pairs[2 * half :]
        for y in range(height - 2 * half + 1):
            above, below, out = extremes[level - 1, y], extremes[level - 1, y + half], extremes[level, y]
            for i in range(2 * width):
                pairs[i] = above[i] if above[i] < below[i] else below[i]
            for i in range(len(shifted)):
                out[i] = pairs[i] if pairs[i] < shifted[i] else shifted[i]


@nb.njit(cache=True, nogil=True)
def offsets_in_view(places: Floats, R: Floats, edge_m: float) -> Singles:
    """(3, N) from the first voxel's centre of a brick to that of each place (3, N) x, y, z in voxels, camera frame."""
    # The rotation into the camera's frame: R's columns are the camera's axes.
    offsets = np.empty(places.shape, np.float32)
    for a in range(3):
        for n in range(places.shape[1]):
            x, y, z = places[0, n] * edge_m, places[1, n] * edge_m, places[2, n] * edge_m
            offsets[a, n] = np.float32(x * R[0, a] + y * R[1, a] + z * R[2, a])
    return offsets


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
    """Bricks of a box that a view looks through, as rows of number and mask, ALL_FREE or 0; returns their count.

    Args:
        found: takes as many bricks as it has rows.
        low: (3,) first brick of the box to examine.
        high: (3,) last one.
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
    stack = np.empty((8 * ROOT_LEVEL, 4), np.int64)  # depth first: of each size at most eight cubes wait
    parts, levels = np.empty(9 * 8), _levels(max(extremes.shape[1], extremes.shape[2]), len(extremes))
    count, root = 0, 1 << ROOT_LEVEL
    for rz in range(low[2], high[2] + 1, root):
        for ry in range(low[1], high[1] + 1, root):
            for rx in range(low[0], high[0] + 1, root):
                stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = rx, ry, rz, root
                top = 1
                while top > 0:
                    top -= 1
                    bx, by, bz, side = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
                    # Stage 1: the cube's centre from the eye, and the sight of its eight parts.
                    x = corner_eye[0] + (bx + 0.5 * side) * brick_m
                    y = corner_eye[1] + (by + 0.5 * side) * brick_m
                    z = corner_eye[2] + (bz + 0.5 * side) * brick_m
                    _rects_into(parts, x, y, z, 0.25 * side * brick_m, edge_m, R, lens, farthest_m, extremes)
                    _sights_into(parts, min_range_m, levels, extremes)
                    part = side >> 1
                    # Stage 2: mixed parts wait for their turn, down to bricks; the bricks of decided ones are found.
                    for n in range(7, -1, -1):
                        px, py, pz = bx + (n & 1) * part, by + (n >> 1 & 1) * part, bz + (n >> 2) * part
                        if parts[SIGHT + n] == NOT_SEEN or px > high[0] or py > high[1] or pz > high[2]:
                            continue
                        if parts[SIGHT + n] == MIXED and part > 1:
                            stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = px, py, pz, part
                            top += 1
                            continue
                        mask = ALL_FREE if parts[SIGHT + n] == FREE else 0
                        count = _put_into(found, count, mask, px, py, pz, part, high, dims)
    return count


@nb.njit(forceinline=True)
def _put_into(
    found: Int32s, count: int, mask: int, px: int, py: int, pz: int, part: int, high: Ints, dims: Ints
) -> int:
    """Append the bricks of a cube of `part` bricks along each edge, up to `high`; returns bricks found, room or not."""
    for z in range(pz, min(pz + part, high[2] + 1)):
        for y in range(py, min(py + part, high[1] + 1)):
            for x in range(px, min(px + part, high[0] + 1)):
                if count < len(found):
                    found[count, 0] = (z * dims[1] + y) * dims[0] + x
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
    """Decide on the octants of the bricks that `cull_bricks_into` found with mask 0; returns the number of bricks left.

    A pass of its own: so no brick waits for the one before it. `corners_view` (3, N) takes the centre of each
    brick's first voxel, camera frame. `corner` is the box's first voxel, `eye_m` the eye.
    """
    brick_m = BRICK_VOXELS * edge_m
    parts, levels = np.empty(9 * 8), _levels(max(extremes.shape[1], extremes.shape[2]), len(extremes))
    count = 0
    for k in range(len(found)):
        brick, mask = np.int64(found[k, 0]), np.int64(found[k, 1])
        # Coordinates of the brick, from its number.
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
        # From whole voxel numbers, so that the box does not change a bit of it (`free_space.Carving.corners_view`).
        x = (np.float64(corner[0] + BRICK_VOXELS * bx) + 0.5) * edge_m - eye_m[0]
        y = (np.float64(corner[1] + BRICK_VOXELS * by) + 0.5) * edge_m - eye_m[1]
        z = (np.float64(corner[2] + BRICK_VOXELS * bz) + 0.5) * edge_m - eye_m[2]
        for a in range(3):
            corners_view[a, count] = x * R[0, a] + y * R[1, a] + z * R[2, a]
        # In place: `count` never overtakes `k`. A brick with mask 0 is written over.
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
    """Pixels that each of a cube's eight parts covers, and the squares of its least and largest distance.

    The cube's centre is given from the eye, map frame; `step` leads from there to the parts' centres along each axis.
    A part's sight becomes MIXED or NOT_SEEN where no pixel need be read, else FREE, which `_sights_into` tests.
    """
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    half = step + (SLACK_VOXELS - 0.5) * edge_m
    span = half * (abs(r02) + abs(r12) + abs(r22))
    right, bottom, widest = (extremes.shape[2] >> 1) - 1.0, extremes.shape[1] - 1.0, (1 << len(extremes)) - 1.0
    # Planes through the eye and the image's edges, as x / z and y / z, and a part's reach across them.
    u0, u1 = (1.0 - SLACK_PX - cx) / fx, (right + SLACK_PX - cx) / fx
    v0, v1 = (1.0 - SLACK_PX - cy) / fy, (bottom + SLACK_PX - cy) / fy
    past_u0 = half * (abs(r00 - u0 * r02) + abs(r10 - u0 * r12) + abs(r20 - u0 * r22))
    past_u1 = half * (abs(r00 - u1 * r02) + abs(r10 - u1 * r12) + abs(r20 - u1 * r22))
    past_v0 = half * (abs(r01 - v0 * r02) + abs(r11 - v0 * r12) + abs(r21 - v0 * r22))
    past_v1 = half * (abs(r01 - v1 * r02) + abs(r11 - v1 * r12) + abs(r21 - v1 * r22))
    for n in range(8):
        x, y, z = x0 + (2 * (n & 1) - 1) * step, y0 + ((n & 2) - 1) * step, z0 + ((n >> 1 & 2) - 1) * step
        # Distances: to the nearest and to the farthest voxel centre of the part, a box around (x, y, z).
        ax, ay, az = abs(x), abs(y), abs(z)
        dx, dy, dz = max(ax - half, 0.0), max(ay - half, 0.0), max(az - half, 0.0)
        nearest = (dx * dx + dy * dy + dz * dz) * (1.0 - SLACK_SHARE)
        dx, dy, dz = ax + half, ay + half, az + half
        depth = x * r02 + y * r12 + z * r22
        ahead = depth - span > 0.01 * span
        # Outside the pyramid of the image's edges?
        right_m, down_m = x * r00 + y * r10 + z * r20, x * r01 + y * r11 + z * r21
        outside = (right_m - u0 * depth <= -past_u0) | (right_m - u1 * depth >= past_u1)
        outside |= (down_m - v0 * depth <= -past_v0) | (down_m - v1 * depth >= past_v1)
        # Eq. 6 for the centre; no point of the part is farther from its pixel than |x - u z| over the least depth.
        inverse = 1.0 / (depth if ahead else 1.0)
        nearby = half / (depth - span if ahead else 1.0)
        u, v = right_m * inverse, down_m * inverse
        du = fx * nearby * (abs(r00 - u * r02) + abs(r10 - u * r12) + abs(r20 - u * r22)) + SLACK_PX
        dv = fy * nearby * (abs(r01 - v * r02) + abs(r11 - v * r12) + abs(r21 - v * r22)) + SLACK_PX
        u, v = fx * u + cx, fy * v + cy
        left_px, right_px = min(max(u - du, 0.0), right), min(max(u + du, 0.0), right)
        top_px, bottom_px = min(max(v - dv, 0.0), bottom), min(max(v + dv, 0.0), bottom)
        unseen = (nearest >= farthest_m * farthest_m) | (depth + span <= 0.0) | outside
        # A rectangle wider than the windows belongs to a part too near to be decided on as a whole.
        whole = ahead & (right_px - left_px < widest) & (bottom_px - top_px < widest)
        parts[NEAREST + n] = nearest
        parts[FARTHEST + n] = (dx * dx + dy * dy + dz * dz) * (1.0 + SLACK_SHARE)
        parts[LEFT + n], parts[RIGHT + n], parts[TOP + n], parts[BOTTOM + n] = left_px, right_px, top_px, bottom_px
        parts[SIGHT + n] = NOT_SEEN if unseen else (FREE if whole else MIXED)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _sights_into(parts: Floats, min_range_m: float, levels: Int32s, extremes: Singles) -> None:
    """Decide on the parts that `_rects_into` left FREE: none of their pixels sees as far, all see farther, or neither.

    Four windows cover a rectangle and, if it is long and narrow, more around it. No branches: eight parts differ, and
    a wrong guess of the processor costs more than the look-ups.
    """
    height, width, one = extremes.shape[1], extremes.shape[2] >> 1, np.uint64(1)
    for n in range(8):
        x0, x1, y0, y1 = int(parts[LEFT + n]), int(parts[RIGHT + n]), int(parts[TOP + n]), int(parts[BOTTOM + n])
        # Four windows of this side, one in each corner of the rectangle, inside the image.
        shift = levels[max(x1 - x0, y1 - y0)]
        side = 1 << shift
        x0, y0 = min(x0, width - side), min(y0, height - side)
        x1, y1 = max(x1 - side + 1, x0), max(y1 - side + 1, y0)
        # Unsigned: Numba counts signed numbers from the end if they are negative, and tests for it each time.
        level, top, bottom = np.uint64(shift), np.uint64(y0), np.uint64(y1)
        left, right = np.uint64(2 * x0), np.uint64(2 * x1)
        a, b = extremes[level, top, left], extremes[level, top, right]
        c, d = extremes[level, bottom, left], extremes[level, bottom, right]
        a, c = a if a < b else b, c if c < d else d
        parts[NEAR + n] = a if a < c else c
        # The odd entries hold minus the largest.
        left, right = left + one, right + one
        a, b = extremes[level, top, left], extremes[level, top, right]
        c, d = extremes[level, bottom, left], extremes[level, bottom, right]
        a, c = a if a < b else b, c if c < d else d
        parts[FAR + n] = a if a < c else c
    min_square = min_range_m * min_range_m
    for n in range(8):
        near, far, nearest = parts[NEAR + n], parts[FAR + n], parts[NEAREST + n]
        # The padded border is never clear: a part that reaches over it is not all free.
        free = (parts[FARTHEST + n] < near * near) & (nearest > min_square)
        sight = NOT_SEEN if nearest >= far * far else (FREE if free else MIXED)
        parts[SIGHT + n] = sight if parts[SIGHT + n] == FREE else parts[SIGHT + n]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _levels(side_max: int, count: int) -> Int32s:
    """(side_max,) level of the windows that cover a rectangle, by its longer side less one."""
    levels = np.empty(side_max, np.int32)
    level = 0
    for n in range(side_max):
        if 2 << level <= n + 1 and level + 1 < count:
            level += 1
        levels[n] = level
    return levels
