"""Certainly clear range of each pixel of a range image.

A pixel sees no farther than the nearest range of its own and its neighbours, less a margin. So free space never leads
through a slanted surface, nor through a thing that ends between two pixels. An edge shields one pixel more, because the
pixel between two surfaces may have mixed them:

    o---o                          near
          x    shielded            mixed: its range is anything between
             o---o    free         far

Neighbours without a range do not count. A gap of one or two pixels to which nothing came back is first bridged by the
nearer of the ranges on both its sides (`bridge_gaps_into`): images that were resampled to another camera's have such
gaps all over, in rows and columns.
"""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_fusion.transfer.transfer_kernels import step_beside
from cairn_map.arrays import Flags, Floats, Int32s, Singles

GAP_PX = 2
BRIDGE_STEP_M = 1.0
"""Pixels of a gap that two ranges bridge, at most, and the largest difference of the two: a wider gap may be a thing
from which nothing comes back, and at a greater step either end would be a guess."""
RINGS = 2
EDGE_STEP_M = 0.1
SLANT_SHARE = 1.5
"""A pixel two away is another surface if it is nearer by 10 cm and 1.5 times the difference that the slant explains."""
EDGE_SHARE = 1.0
"""An edge shields two pixels only where their spacing is at most so many voxels: farther away one is enough."""
GRAZING_SHARE = 0.4
GRAZING_MAX = 3.0
"""A margin is at least 0.4 of itself across the surface, but never more than 3 times as long along the beam."""


@nb.njit(cache=True, nogil=True)
def classify_ranges_into(
    range_m: Singles,
    shield_m: Singles,
    silent: Flags,
    missing: Flags,
    true_m: Singles,
    full: Flags,
    flying: Flags,
    min_range_m: np.float32,
    max_range_m: np.float32,
    is_silence_clear: bool,
) -> tuple[int, int, int, int, int, int]:
    """Sort an image's pixels by what came back; counts: used, no return, saturated, too near, too far, flying.

    Args:
        range_m: (H, W) takes the ranges that count, NaN elsewhere.
        shield_m: the same with flying pixels.
        silent: takes the pixels without a return where that means empty space.
        missing: takes those where it does not.
        true_m: (H, W) measured ranges; NaN where nothing came back.
        full: (H, W) true where too much light came back.
        flying: (H, W) true for flying pixels.
        min_range_m: least range that counts.
        max_range_m: greatest range that counts.
        is_silence_clear: true if no return means empty space.
    """
    used, void, saturated, near, far, flew = 0, 0, 0, 0, 0, 0
    nothing = np.float32(np.nan)
    for y in range(true_m.shape[0]):
        # Row by row without branches, and so in vector instructions.
        for x in range(true_m.shape[1]):
            r, is_full = true_m[y, x], full[y, x]
            is_void, is_near, is_far = (r != r) & (not is_full), (r < min_range_m) & (not is_full), (r > max_range_m)
            within = (r >= min_range_m) & (r <= max_range_m) & (not is_full)
            counts = within & (not flying[y, x])
            shield_m[y, x] = r if within else nothing
            range_m[y, x] = r if counts else nothing
            silent[y, x], missing[y, x] = is_void & is_silence_clear, is_void & (not is_silence_clear)
            used += int(counts)
            void += int(is_void)
            saturated += int(is_full)
            near += int(is_near)
            far += int(is_far & (not is_full))
            flew += int(within & flying[y, x])
    return used, void, saturated, near, far, flew


@nb.njit(cache=True, nogil=True)
def interpolated(values: npt.NDArray[np.floating], nodes: Floats) -> Floats:
    """(N,) values between (2, K) nodes, as `np.interp` gives them, and NaN for NaN."""
    last = nodes.shape[1] - 1
    out = np.empty(len(values))
    for n in range(len(values)):
        out[n] = nodes[1, 0]
    # Node by node without branches, and so in vector instructions: a search in each of few nodes takes far longer.
    for k in range(last):
        first, low = nodes[0, k], nodes[1, k]
        slope = (nodes[1, k + 1] - low) / (nodes[0, k + 1] - first)
        for n in range(len(values)):
            x = np.float64(values[n])
            out[n] = slope * (x - first) + low if x >= first else out[n]
    end, high = nodes[0, last], nodes[1, last]
    for n in range(len(values)):
        x = np.float64(values[n])
        out[n] = high if x >= end else out[n]
        out[n] = out[n] if x == x else x
    return out


@nb.njit(cache=True, nogil=True)
def stay_before_into(nearest_m: Singles, share: Singles, sigma_m: Floats, least_m: float, noise_sigmas: float) -> None:
    """Shorten nearest ranges by their margins, 0 at least: `share` times the larger of `least_m` and some sigmas."""
    nearest, shares, sigmas = nearest_m.ravel(), share.ravel(), sigma_m.ravel()
    for n in range(len(nearest)):
        margin_m = noise_sigmas * sigmas[n]
        margin_m = margin_m if margin_m > least_m else least_m
        left_m = nearest[n] - shares[n] * np.float32(margin_m)
        nearest[n] = left_m if left_m > np.float32(0.0) else np.float32(0.0)


@nb.njit(cache=True, nogil=True)
def shown_in_window(clear_m: Singles, pixel_of: Int32s, height: int, width: int) -> Singles:
    """(height + 2, width + 2) clear range of each pixel of a window (`free_space.Window.shown`); 0 around it."""
    padded, flat = np.zeros((height + 2, width + 2), np.float32), clear_m.ravel()
    for y in range(height):
        row, pixels = padded[y + 1, 1:], pixel_of[y * width :]
        for x in range(width):
            # One past the last pixel: outside the camera's image, and never clear.
            pixel = pixels[x]
            row[x] = flat[pixel] if pixel < len(flat) else np.float32(0.0)
    return padded


@nb.njit(cache=True, nogil=True)
def bridge_gaps_into(seen_m: Singles, shield_m: Singles, missing: Flags) -> None:
    """Give pixels of narrow gaps the nearer of the two ranges at its ends: along rows, and then along columns.

    A gap is at most `GAP_PX` pixels of `missing` in a row, with ranges at both ends that differ by at most
    `BRIDGE_STEP_M`. Between rows that were bridged
    the second pass finds ranges where whole rows are missing.

    Args:
        seen_m: (H, W) ranges of pixels that may clear, NaN for none; changed.
        shield_m: (H, W) nearest range in a pixel, NaN for none; changed where `seen_m` is.
        missing: (H, W) true where nothing came back.
    """
    height, width = seen_m.shape
    # Stage 1: what each pixel says, with a border that says nothing: a range, infinite where missing, else nothing.
    # Nothing is -1, so that the lesser of two ends is known only if both are, and a missing pixel never is an end.
    ends = np.full((height + 2 * GAP_PX, width + 2 * GAP_PX), np.float32(-1.0))
    for y in range(height):
        _ends_of_row_into(ends[y + GAP_PX, GAP_PX:], seen_m[y], missing[y])
    # Stage 2: along rows.
    for y in range(height):
        row = ends[y + GAP_PX]
        _bridge_row_into(seen_m[y], shield_m[y], row, row[1:], row[2:], row[3:], row[4:])
    # Stage 3: along columns, all of a row at once. Only what the rows gave counts: `ends` is not written meanwhile.
    for y in range(height):
        _ends_of_row_into(ends[y + GAP_PX, GAP_PX:], seen_m[y], missing[y])
    for y in range(height):
        far, near, here, next1, next2 = ends[y], ends[y + 1], ends[y + 2], ends[y + 3], ends[y + 4]
        _bridge_row_into(seen_m[y], shield_m[y], far[2:], near[2:], here[2:], next1[2:], next2[2:])


@nb.njit(cache=True, nogil=True)
def _ends_of_row_into(ends: Singles, seen_m: Singles, missing: Flags) -> None:
    """Ranges of a row, infinite where a pixel is missing and -1 where it has no range for another reason."""
    for x in range(len(seen_m)):
        other = np.float32(np.inf) if missing[x] else np.float32(-1.0)
        ends[x] = seen_m[x] if seen_m[x] > np.float32(0.0) else other


@nb.njit(cache=True, nogil=True)
def _bridge_row_into(
    seen_m: Singles,
    shield_m: Singles,
    before2: Singles,
    before: Singles,
    here: Singles,
    after: Singles,
    after2: Singles,
) -> None:
    """Bridge the gaps of one pixel, and of two, that the pixels of a row lie in; `GAP_PX` is 2."""
    none, endless, step = np.float32(0.0), np.float32(np.inf), np.float32(BRIDGE_STEP_M)
    for x in range(len(seen_m)):
        # The end on each side: the next pixel, or behind one that is missing the second.
        short0, short1 = before[x] < endless, after[x] < endless
        low = before[x] if short0 else before2[x]
        high = after[x] if short1 else after2[x]
        nearer = low if low < high else high
        # Not both ends two pixels away, which is a gap of three. Two endless ends have no difference: NaN.
        is_narrow = (here[x] == endless) & (short0 | short1)
        bridged = is_narrow & (nearer > none) & (abs(high - low) <= step)
        seen_m[x] = nearer if bridged else seen_m[x]
        shield_m[x] = nearer if bridged else shield_m[x]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def nearest_around(
    seen_m: Singles, shield_m: Singles, silent_m: float, focal_px: float, voxel_edge_m: float
) -> tuple[Singles, Singles]:
    """(H, W) the nearest range that counts for each pixel, metres, and by how many margins to stay before it.

    Both are 0 where the pixel has no information, the second also where it is silent and no neighbour is nearer. Row by
    row without branches, and so in vector instructions.

    Args:
        seen_m: (H, W) ranges of pixels that may clear; infinite where no return means empty space; else NaN.
        shield_m: (H, W) nearest range in a pixel, at most `seen_m`; NaN for none.
        silent_m: clear range of an infinite one.
        focal_px: pixels per radian.
        voxel_edge_m: of the map.
    """
    height, width = seen_m.shape
    wide = width + 2 * RINGS
    # Stage 1: known ranges, infinite where unknown, with a border so that no neighbour is missing.
    known = np.full((height + 2 * RINGS, wide), np.float32(np.inf))
    for y in range(height):
        row, given = known[y + RINGS, RINGS : RINGS + width], shield_m[y]
        for x in range(width):
            row[x] = given[x] if given[x] > np.float32(0.0) else np.float32(np.inf)
    # Stage 2: the least of each row within one and within two pixels; stage 3 combines rows.
    near, far = np.empty((height + 2 * RINGS, wide), np.float32), np.empty((height + 2 * RINGS, wide), np.float32)
    near[:], far[:] = np.inf, np.inf
    for y in range(RINGS, height + RINGS):
        _least_of_row_into(near[y, RINGS : RINGS + width], far[y, RINGS : RINGS + width], known[y], width)
    nearest, share = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    edge_at_most = EDGE_SHARE * voxel_edge_m * focal_px
    for y in range(height):
        _nearest_of_row_into(nearest[y], share[y], seen_m[y], known, near, far, y, silent_m, focal_px, edge_at_most)
    return nearest, share


@nb.njit(cache=True, nogil=True)
def _least_of_row_into(near: Singles, far: Singles, known: Singles, width: int) -> None:
    """The least within one and within two pixels of each pixel of a row; `known` has `RINGS` more at both ends."""
    a, b, c, d, e = (
        known[:width],
        known[1 : 1 + width],
        known[2 : 2 + width],
        known[3 : 3 + width],
        known[4 : 4 + width],
    )
    for x in range(width):
        inner = b[x] if b[x] < c[x] else c[x]
        inner = inner if inner < d[x] else d[x]
        outer = a[x] if a[x] < e[x] else e[x]
        near[x] = inner
        far[x] = inner if inner < outer else outer


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _nearest_of_row_into(
    nearest: Singles,
    share: Singles,
    seen_m: Singles,
    known: Singles,
    near: Singles,
    far: Singles,
    y: int,
    silent_m: float,
    focal_px: float,
    edge_at_most: float,
) -> None:
    """Row y of `nearest_around`; `known`, `near` and `far` have a border of `RINGS`."""
    width = len(seen_m)
    up, own, down = known[y + 1, RINGS:][:width], known[y + 2, RINGS:][:width], known[y + 3, RINGS:][:width]
    left, right = known[y + 2, RINGS - 1 :][:width], known[y + 2, RINGS + 1 :][:width]
    near0, near1, near2 = near[y + 1, RINGS:][:width], near[y + 2, RINGS:][:width], near[y + 3, RINGS:][:width]
    far0, far1, far2 = far[y, RINGS:][:width], far[y + 1, RINGS:][:width], far[y + 2, RINGS:][:width]
    far3, far4 = far[y + 3, RINGS:][:width], far[y + 4, RINGS:][:width]
    for x in range(width):
        # Slant of the surface: steps to the next pixel, along rows and columns.
        middle = np.float64(own[x])
        across = step_beside(np.float64(left[x]), middle, np.float64(right[x]))
        along = step_beside(np.float64(up[x]), middle, np.float64(down[x]))
        seen = np.float64(silent_m) if seen_m[x] == np.float32(np.inf) else np.float64(seen_m[x])
        # The least of the 3 x 3 and of the 5 x 5 pixels around.
        ring1 = near0[x] if near0[x] < near1[x] else near1[x]
        ring1 = ring1 if ring1 < near2[x] else near2[x]
        ring2 = far0[x] if far0[x] < far1[x] else far1[x]
        ring2 = ring2 if ring2 < far2[x] else far2[x]
        ring2 = ring2 if ring2 < far3[x] else far3[x]
        ring2 = ring2 if ring2 < far4[x] else far4[x]
        least, shielded = np.float64(ring1), np.float64(ring2)
        # Of the outer ring only another surface counts: if its nearest pixel is none, no pixel of it is.
        step = EDGE_STEP_M + RINGS * SLANT_SHARE * (across + along)
        is_edge = (shielded < seen - step) & (shielded <= edge_at_most) & (shielded < least)
        least = shielded if is_edge else least
        # Steps a pixel over the width of a pixel, seen / focal_px: the tangent of the slant.
        slope = math.sqrt(across * across + along * along) * focal_px / seen
        grazing = min(max(GRAZING_SHARE * math.sqrt(1.0 + slope * slope), 1.0), GRAZING_MAX)
        says = seen > 0.0
        # A silent pixel with nothing nearer around it is clear as far as the camera sees.
        is_free = not least < seen and not own[x] < np.float32(np.inf)
        least = seen if is_free else least
        nearest[x] = np.float32(least if says else 0.0)
        share[x] = np.float32(grazing if says and not is_free else 0.0)
