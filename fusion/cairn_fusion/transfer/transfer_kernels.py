"""Points in another camera's image (Eq. 5-6), and their occlusion: the loops of `transfer`."""

import numba as nb
import numpy as np

from cairn_map.arrays import Flags, Floats, Int32s, Labels, Singles

OK, OCCLUDED, OUT_OF_VIEW, NO_RANGE, NO_READING, UNCERTAIN = 0, 1, 2, 3, 6, 7
"""Values of `transfer.Label`."""
BLOCK = 1024
"""Points that are projected together."""
STRETCH_MAX = 8.0
"""Largest factor by which a lens stretches its image."""
REACH_MAX_PX = 16
"""Largest reach of `pixel_covariance.PlaceBounds`: a bound on work."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def project_into(
    pixels: Int32s,
    depth_m: Floats,
    labels: Labels,
    points: Floats,
    T_dst_src: Floats,
    lens: Floats,
    coefficients: Floats,
    square_limit: float,
    width: int,
    height: int,
) -> None:
    """Nearest pixels, depths and labels (not OCCLUDED yet) of points in a pinhole with Brown's distortion.

    Eq. 5-6, as `cairn_calib.rig.camera.Camera.project` and `contains`.

    Args:
        pixels: (2, N) takes x and y; 0 where the label is not OK.
        depth_m: (N,) takes the depths.
        labels: (N,) takes the labels.
        points: (3, N) metres, frame of the source.
        T_dst_src: Eq. 5's transform.
        lens: fx, fy, cx, cy.
        coefficients: (5,) of Brown's distortion.
        square_limit: square of the radius on the plane at distance 1 from which on the lens folds.
        width: of the image, pixels.
        height: of the image, pixels.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k1, k2, p1, p2, k3 = coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4]
    r00, r01, r02, t0 = T_dst_src[0, 0], T_dst_src[0, 1], T_dst_src[0, 2], T_dst_src[0, 3]
    r10, r11, r12, t1 = T_dst_src[1, 0], T_dst_src[1, 1], T_dst_src[1, 2], T_dst_src[1, 3]
    r20, r21, r22, t2 = T_dst_src[2, 0], T_dst_src[2, 1], T_dst_src[2, 2], T_dst_src[2, 3]
    right, bottom = width - 0.5, height - 0.5
    us, vs = np.empty(BLOCK), np.empty(BLOCK)
    # Loops without branches, over numbers that lie side by side, become vector instructions: a fifth of the time. In
    # blocks, so that what one loop leaves for the next stays in the nearest cache.
    for start in range(0, points.shape[1], BLOCK):
        count = min(BLOCK, points.shape[1] - start)
        a, b, c = points[0, start:][:count], points[1, start:][:count], points[2, start:][:count]
        depth, label = depth_m[start:][:count], labels[start:][:count]
        column, row = pixels[0, start:][:count], pixels[1, start:][:count]
        for n in range(count):
            # Eq. 5: into the other camera's frame.
            z = r20 * a[n] + r21 * b[n] + r22 * c[n] + t2
            # Eq. 6 on the plane at distance 1; f' and the principal point follow the distortion.
            x, y = (r00 * a[n] + r01 * b[n] + r02 * c[n] + t0) / z, (r10 * a[n] + r11 * b[n] + r12 * c[n] + t1) / z
            s = x * x + y * y
            radial = 1 + s * (k1 + s * (k2 + s * k3))
            # Derivatives of the distorted place by x and y: a symmetric matrix, [xx xy; xy yy].
            slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
            xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
            xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
            yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
            u = (x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)) * fx + cx
            v = (y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y) * fy + cy
            # Its determinant is positive where the lens maps one to one. Beyond, the polynomial folds the image over,
            # and a point from far outside the view would appear in it.
            seen = (z > 0.0) & (s < square_limit) & (xx * yy - xy * xy > 0.0)
            seen &= (u >= -0.5) & (v >= -0.5) & (u < right) & (v < bottom)
            depth[n] = z
            us[n], vs[n] = u if seen else -1.0, v if seen else -1.0
        for n in range(count):
            # Seen pixels begin at -0.5: rounded they are 0 or more.
            column[n] = np.int32(max(np.rint(us[n]), 0.0))
            row[n] = np.int32(max(np.rint(vs[n]), 0.0))
        for n in range(count):
            unseen = np.uint8(OUT_OF_VIEW) if depth[n] == depth[n] else np.uint8(NO_RANGE)
            label[n] = np.uint8(OK) if us[n] >= -0.5 else unseen


@nb.njit(cache=True, nogil=True, error_model="numpy")
def hide_into(
    labels: Labels,
    pixels: Int32s,
    depth_m: Floats,
    slant_m: Floats,
    slants: float,
    bin_px: int,
    columns: int,
    rows: int,
    tolerance: float,
    tolerance_m: float,
) -> None:
    """Label points OCCLUDED that lie deeper than the nearest of their bin by more than the tolerances.

    Args:
        labels: (N,)
        pixels: (2, N) x and y.
        depth_m: (N,)
        slant_m: (N,) depth that a slanted surface spans along one range pixel.
        slants: range pixels along a bin.
        bin_px: edge of a bin, pixels.
        columns: of bins.
        rows: of bins.
        tolerance: share of the depth.
        tolerance_m: metres.
    """
    # The z-buffer: the nearest depth of each bin; the last one is that of points that are not seen.
    nearest_m, bins = np.full(rows * columns + 1, np.inf), np.empty(labels.shape[0], np.int32)
    # By multiplication: half a pixel off a bin's edge is never rounded into the next bin.
    share, last, wide = 1.0 / bin_px, np.int32(rows * columns), np.int32(columns)
    for n in range(labels.shape[0]):
        column, row = np.int32((pixels[0, n] + 0.5) * share), np.int32((pixels[1, n] + 0.5) * share)
        bins[n] = row * wide + column if labels[n] == OK else last
    for n in range(labels.shape[0]):
        nearest, depth = nearest_m[bins[n]], depth_m[n]
        nearest_m[bins[n]] = depth if depth < nearest else nearest
    # Hidden: deeper by a share of the depth, a fixed step, and the depth that a slanted surface spans in a bin.
    for n in range(labels.shape[0]):
        farthest = nearest_m[bins[n]] * (1 + tolerance) + tolerance_m + slant_m[n] * slants
        is_hidden = (labels[n] == OK) & (depth_m[n] > farthest)
        labels[n] = np.uint8(OCCLUDED) if is_hidden else labels[n]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def list_doubtful_into(
    labels: Labels,
    doubtful: Int32s,
    voxel_of: Int32s,
    spoken: Flags,
    range_m: Floats,
    sigma_m: Floats,
    baseline_m: float,
    calibration: float,
    limit_m: float,
) -> int:
    """Label points of voxels that have a sample NO_READING, and list those whose place may be too uncertain: how many.

    Args:
        labels: (N,) only points labelled OK are examined.
        doubtful: takes the numbers of those whose covariance is to be looked at: a bound does not clear them.
        voxel_of: (N,) number of each point's voxel.
        spoken: (U,) voxels that have a sample.
        range_m: (N,)
        sigma_m: (N,) standard deviation of the ranges.
        baseline_m: distance of the cameras (`pixel_covariance.PlaceBounds`).
        calibration: standard deviation of a direction by calibration, as a tangent.
        limit_m: largest uncertainty of a place.
    """
    count = 0
    for n in range(labels.shape[0]):
        is_ok = labels[n] == OK
        bound_m = STRETCH_MAX * (baseline_m * (sigma_m[n] / range_m[n]) + calibration * (range_m[n] + baseline_m))
        has_spoken = spoken[voxel_of[n]]
        labels[n] = np.uint8(NO_READING) if is_ok & has_spoken else labels[n]
        # Written so that a bound of NaN is doubtful; the entry is written over if it is not.
        doubtful[count] = n
        count += int(is_ok & (not has_spoken) & (not bound_m <= limit_m))
    return count


@nb.njit(cache=True, nogil=True, error_model="numpy")
def points_of_pixels(range_m: Singles, rays: Floats, pixels: Int32s) -> tuple[Floats, Floats, Floats]:
    """Points (3, N) of an image's pixels, camera frame, their ranges and slants (`transfer.depth_steps`), (N,) each.

    Args:
        range_m: (H, W) metres along the beams.
        rays: (H, W, 3) unit rays.
        pixels: (N,) numbers of pixels, row by row.
    """
    height, width = range_m.shape
    # Of the whole image only the depth (Eq. 4), because a slant takes the pixels around.
    depth_m = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            depth_m[y, x] = rays[y, x, 2] * np.float64(range_m[y, x])
    steps, beams, flat = steps_of(depth_m).ravel(), rays.reshape(-1, 3), range_m.ravel()
    points, ranges, slants = np.empty((3, len(pixels))), np.empty(len(pixels)), np.empty(len(pixels))
    for n in range(len(pixels)):
        pixel = np.uint64(pixels[n])
        r = np.float64(flat[pixel])
        # Eq. 1: a unit ray times the range along it.
        points[0, n], points[1, n], points[2, n] = beams[pixel, 0] * r, beams[pixel, 1] * r, beams[pixel, 2] * r
        ranges[n], slants[n] = r, steps[pixel]
    return points, ranges, slants


@nb.njit(cache=True, nogil=True)
def steps_of(depth_m: Floats) -> Floats:
    """(H, W) of `transfer.depth_steps`."""
    height, width = depth_m.shape
    # With a border of unknown depth, so that no neighbour is missing.
    padded = np.full((height + 2, width + 2), np.inf)
    for y in range(height):
        row, given = padded[y + 1, 1 : 1 + width], depth_m[y]
        for x in range(width):
            row[x] = given[x] if given[x] < np.inf else np.inf
    steps = np.empty((height, width))
    for y in range(height):
        above, here, below, out = padded[y, 1:], padded[y + 1], padded[y + 2, 1:], steps[y]
        left, own, right = here[:width], here[1 : 1 + width], here[2 : 2 + width]
        for x in range(width):
            across, down = step_beside(left[x], own[x], right[x]), step_beside(above[x], own[x], below[x])
            out[x] = across + down
    return steps


@nb.njit(forceinline=True)
def step_beside(before: float, here: float, after: float) -> float:
    """Difference of range from one pixel of a line to the next, on this side of an edge if there is one.

    Infinite ranges are unknown; without a known neighbour the difference is 0.
    """
    one, other = abs(before - here), abs(after - here)
    least = np.inf
    least = one if one < least else least
    least = other if other < least else least
    return least if least < np.inf else 0.0
