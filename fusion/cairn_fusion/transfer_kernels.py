"""Points into another camera's image, and which of them something else hides: the loops of `transfer`."""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.int64]
Labels = npt.NDArray[np.uint8]

OK, OCCLUDED, OUT_OF_VIEW, NO_RANGE = 0, 1, 2, 3
"""`transfer.Label`."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def project_into(
    pixels: Pixels,
    depth_m: Floats,
    labels: Labels,
    points: Floats,
    T_dst_src: Floats,
    lens: Floats,
    coefficients: Floats,
    radius_limit: float,
    width: int,
    height: int,
) -> None:
    """Nearest pixels, depths and labels (not OCCLUDED yet) of (N, 3) points in a pinhole with Brown's distortion.

    Eq. 5-6; what `cairn_calib.camera.Camera.project` and `contains` say. `lens` is fx, fy, cx, cy.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k1, k2, p1, p2, k3 = coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4]
    is_bent = k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0
    for n in range(points.shape[0]):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        z = T_dst_src[2, 0] * a + T_dst_src[2, 1] * b + T_dst_src[2, 2] * c + T_dst_src[2, 3]
        pixels[n, 0] = pixels[n, 1] = 0
        depth_m[n] = z
        if math.isnan(z):
            labels[n] = NO_RANGE
            continue
        labels[n] = OUT_OF_VIEW
        if not z > 0.0:
            continue
        x = (T_dst_src[0, 0] * a + T_dst_src[0, 1] * b + T_dst_src[0, 2] * c + T_dst_src[0, 3]) / z
        y = (T_dst_src[1, 0] * a + T_dst_src[1, 1] * b + T_dst_src[1, 2] * c + T_dst_src[1, 3]) / z
        if is_bent:
            s = x * x + y * y
            if not math.sqrt(s) < radius_limit:
                continue
            radial = 1 + s * (k1 + s * (k2 + s * k3))
            slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
            xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
            xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
            yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
            if not xx * yy - xy * xy > 0.0:
                continue
            x, y = (
                x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
                y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
            )
        u, v = x * fx + cx, y * fy + cy
        if u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5:
            pixels[n, 0], pixels[n, 1] = np.int64(np.rint(u)), np.int64(np.rint(v))
            labels[n] = OK


@nb.njit(cache=True, nogil=True, error_model="numpy")
def hide_into(
    labels: Labels,
    pixels: Pixels,
    depth_m: Floats,
    slant_m: Floats,
    bin_px: int,
    columns: int,
    rows: int,
    tolerance: float,
    tolerance_m: float,
) -> None:
    """Label what something nearer hides: deeper than the nearest point of its bin by more than is tolerated."""
    nearest_m = np.full(rows * columns, np.inf)
    for n in range(labels.shape[0]):
        if labels[n] == OK:
            place = (pixels[n, 1] // bin_px) * columns + pixels[n, 0] // bin_px
            if depth_m[n] < nearest_m[place]:
                nearest_m[place] = depth_m[n]
    for n in range(labels.shape[0]):
        if labels[n] == OK:
            place = (pixels[n, 1] // bin_px) * columns + pixels[n, 0] // bin_px
            if depth_m[n] > nearest_m[place] * (1 + tolerance) + tolerance_m + slant_m[n]:
                labels[n] = OCCLUDED
