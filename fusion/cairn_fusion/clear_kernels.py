"""How far each pixel of a range image is certainly clear.

A pixel sees no farther than the nearest that it or one of its neighbours saw, less a margin. So a slanted surface is
not looked through, nor a thing that ends between two pixels. An edge shields one pixel more, because the pixel between
two surfaces may have mixed them:

    o---o                          near
          x    shielded            mixed: its range is anything between
             o---o    free         far

Neighbours that saw nothing do not count.
"""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

Singles = npt.NDArray[np.float32]

RINGS = 2
EDGE_STEP_M = 0.1
SLANT_SHARE = 1.5
"""What a pixel two away must be nearer by to be another surface: 10 cm, and 1.5 times what the slant explains."""
EDGE_SHARE = 1.0
"""An edge shields two pixels only where their spacing is at most so many voxels: farther away one is enough."""
GRAZING_SHARE = 0.4
GRAZING_MAX = 3.0
"""A margin is at least 0.4 of itself across the surface, but never more than 3 times as long along the beam."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def clear_distances(
    seen_m: Singles, shield_m: Singles, margins_m: Singles, silent_m: float, focal_px: float, voxel_edge_m: float
) -> Singles:
    """(H, W) metres that each pixel's beam is clear; 0 where it says nothing.

    Args:
        seen_m: (H, W) ranges of pixels that may clear; infinite where nothing came back and that means empty; else NaN.
        shield_m: (H, W) the nearest that a pixel saw, at most `seen_m`; NaN for nothing.
        margins_m: (H, W) what to keep before what `shield_m` says.
        silent_m: how far an infinite one is clear.
        focal_px: pixels per radian.
        voxel_edge_m: of the map.
    """
    height, width = seen_m.shape
    clear = np.zeros((height, width), np.float32)
    least = _least_around(shield_m)
    # With a border of nothing, so that the loop over neighbours has one length: a quarter off the time.
    padded, wide = _padded(shield_m), width + 2
    for y in range(height):
        for x in range(width):
            seen = min(np.float64(seen_m[y, x]), silent_m) if math.isinf(seen_m[y, x]) else np.float64(seen_m[y, x])
            if not seen > 0.0:
                continue
            across, down = _step(shield_m, y, x, 0, 1), _step(shield_m, y, x, 1, 0)
            edge = EDGE_STEP_M + RINGS * SLANT_SHARE * (across + down)
            nearest, margin = seen, 0.0
            if shield_m[y, x] > 0.0:
                margin = np.float64(margins_m[y, x])
            best = np.uint64(y * wide + x)
            least_m = padded[best]
            for k in range(1, 9):
                place = np.uint64(y * wide + x + k // 3 * wide + k % 3)
                if padded[place] < least_m:
                    least_m, best = padded[place], place
            if np.float64(least_m) < nearest:
                nearest = np.float64(least_m)
                margin = np.float64(margins_m[np.int64(best) // wide - 1, np.int64(best) % wide - 1])
            # Beyond these no pixel of the outer ring counts: on most of an image none is looked at.
            limit = min(nearest, min(seen - edge, EDGE_SHARE * voxel_edge_m * focal_px))
            if least[y, x] <= limit:
                for v in range(max(y - RINGS, 0), min(y + RINGS + 1, height)):
                    for u in range(max(x - RINGS, 0), min(x + RINGS + 1, width)):
                        near = np.float64(shield_m[v, u])
                        if near < nearest and near < seen - edge and near <= EDGE_SHARE * voxel_edge_m * focal_px:
                            nearest, margin = near, np.float64(margins_m[v, u])
            slope = math.sqrt(across * across + down * down) * focal_px / seen
            grazing = min(max(GRAZING_SHARE * math.sqrt(1.0 + slope * slope), 1.0), GRAZING_MAX)
            clear[y, x] = max(nearest - grazing * margin, 0.0)
    return clear


@nb.njit(cache=True, nogil=True)
def _padded(shield_m: Singles) -> Singles:
    """((H + 2) (W + 2),) row by row, a pixel of nothing around it; infinite for nothing."""
    height, width = shield_m.shape
    padded = np.full((height + 2, width + 2), np.float32(np.inf))
    for y in range(height):
        for x in range(width):
            if shield_m[y, x] > 0.0:
                padded[y + 1, x + 1] = shield_m[y, x]
    return padded.ravel()


@nb.njit(cache=True, nogil=True)
def _least_around(shield_m: Singles) -> Singles:
    """(H, W) the nearest of each pixel and the two rings around it; infinite for none."""
    height, width = shield_m.shape
    rows, least = np.full((height, width), np.inf, np.float32), np.full((height, width), np.inf, np.float32)
    for y in range(height):
        for x in range(width):
            for u in range(max(x - RINGS, 0), min(x + RINGS + 1, width)):
                if shield_m[y, u] < rows[y, x]:
                    rows[y, x] = shield_m[y, u]
    for y in range(height):
        for v in range(max(y - RINGS, 0), min(y + RINGS + 1, height)):
            for x in range(width):
                if rows[v, x] < least[y, x]:
                    least[y, x] = rows[v, x]
    return least


@nb.njit(inline="always")
def _step(shield_m: Singles, y: int, x: int, dy: int, dx: int) -> float:
    """How much farther the surface is from one pixel of a line to the next; beside an edge, on this side of it."""
    least = np.inf
    here = np.float64(shield_m[y, x])
    if y >= dy and x >= dx:
        step = abs(np.float64(shield_m[y - dy, x - dx]) - here)
        if step < least:
            least = step
    if y + dy < shield_m.shape[0] and x + dx < shield_m.shape[1]:
        step = abs(np.float64(shield_m[y + dy, x + dx]) - here)
        if step < least:
            least = step
    return least if least < np.inf else 0.0
