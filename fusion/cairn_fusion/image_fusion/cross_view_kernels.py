"""Points of one camera's image in another's, their occlusion, and the value there: the loops of `cross_view`."""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Labels, Singles

OK, OCCLUDED, OUT_OF_VIEW, NO_RANGE, NO_READING = 0, 1, 2, 3, 6
"""Values of `transfer.Label`."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def places_into(
    us: Singles,
    vs: Singles,
    qs: Singles,
    range_m: Singles,
    rays: Singles,
    T_dst_src: Floats,
    lens: Floats,
    coefficients: Floats,
    radius_limit: float,
    first: int,
    last: int,
) -> None:
    """Pixels of an image's points in a pinhole with Brown's distortion, and 1 / range from there.

    Eq. 1-6, for rows `first` to `last` - 1.

    Args:
        us: (H, W) takes x, pixels, also beyond the image; NaN for a point that the camera cannot see.
        vs: (H, W) takes y.
        qs: (H, W) takes 1 / metres.
        range_m: (H, W) along the rays.
        rays: (3, H, W) unit rays.
        T_dst_src: (4, 4)
        lens: fx, fy, cx, cy
        coefficients: k1, k2, p1, p2, k3
        radius_limit: of `cairn_calib.rig.brown`.
        first: first row.
        last: one past the last row.
    """
    f, T = np.float32, T_dst_src
    fx, fy, cx, cy = f(lens[0]), f(lens[1]), f(lens[2]), f(lens[3])
    k1, k2, k3 = f(coefficients[0]), f(coefficients[1]), f(coefficients[4])
    p1, p2 = f(coefficients[2]), f(coefficients[3])
    r00, r01, r02, t0 = f(T[0, 0]), f(T[0, 1]), f(T[0, 2]), f(T[0, 3])
    r10, r11, r12, t1 = f(T[1, 0]), f(T[1, 1]), f(T[1, 2]), f(T[1, 3])
    r20, r21, r22, t2 = f(T[2, 0]), f(T[2, 1]), f(T[2, 2]), f(T[2, 3])
    one, two, none, limit = f(1.0), f(2.0), f(np.nan), f(radius_limit * radius_limit)
    for row in range(first, last):
        d, a, b, c = range_m[row], rays[0, row], rays[1, row], rays[2, row]
        u, v, q = us[row], vs[row], qs[row]
        # Without branches, over numbers that lie side by side: vector instructions.
        for n in range(range_m.shape[1]):
            # Eq. 1 and 4: the point is range times unit ray, (a, b, c) d. Eq. 5: into the other camera's frame.
            X = (r00 * a[n] + r01 * b[n] + r02 * c[n]) * d[n] + t0
            Y = (r10 * a[n] + r11 * b[n] + r12 * c[n]) * d[n] + t1
            Z = (r20 * a[n] + r21 * b[n] + r22 * c[n]) * d[n] + t2
            # Eq. 6, on the plane at distance 1.
            w = one / Z
            x, y = X * w, Y * w
            # Brown's distortion, then Eq. 6's f' and the shift to the calibrated principal point.
            s = x * x + y * y
            radial = one + s * (k1 + s * (k2 + s * k3))
            uu = (x * radial + two * p1 * x * y + p2 * (s + two * x * x)) * fx + cx
            vv = (y * radial + p1 * (s + two * y * y) + two * p2 * x * y) * fy + cy
            # Behind the camera, or where the distortion folds over, there is no pixel.
            seen = (f(0.0) < Z) & (s < limit)
            u[n] = uu if seen else none
            v[n] = vv
            q[n] = one / math.sqrt(X * X + Y * Y + Z * Z)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def label_into(
    labels: Labels,
    us: Singles,
    vs: Singles,
    qs: Singles,
    least: Singles,
    step_px: int,
    width: int,
    height: int,
) -> None:
    """Label points out of another camera's view, or behind the surface that it sees there; others keep their label.

    Args:
        labels: (H, W); only pixels labelled OK are examined.
        us: (H, W) of `places_into`.
        vs: (H, W)
        qs: (H, W)
        least: (h, w) 1 / metres: a point with less lies behind the surface around a place.
        step_px: pixels of the camera along one of `least`.
        width: of the camera's image.
        height: of the camera's image.
    """
    f = np.float32
    # The centre of the top-left pixel is (0, 0), so the image begins half a pixel before it.
    right, bottom, first = f(width - 0.5), f(height - 0.5), f(-0.5)
    share, half = f(1.0 / step_px), f(0.5)
    for row in range(labels.shape[0]):
        for n in range(labels.shape[1]):
            if labels[row, n] != OK:
                continue
            u, v = us[row, n], vs[row, n]
            # Written so that NaN, a point without a pixel, is out of view too.
            if not (u >= first and v >= first and u < right and v < bottom):
                labels[row, n] = OUT_OF_VIEW
                continue
            i, j = int((v + half) * share), int((u + half) * share)
            if qs[row, n] < least[i, j]:
                labels[row, n] = OCCLUDED


@nb.njit(cache=True, nogil=True)
def sample_into(values: Singles, labels: Labels, us: Singles, vs: Singles, image: Singles) -> None:
    """Bilinear values where the label is OK; one that touches a pixel without a value becomes NO_READING.

    Args:
        values: (H, W, C)
        labels: (H, W)
        us: (H, W) pixels of the image.
        vs: (H, W)
        image: (h, w, C); NaN for no value.
    """
    f = np.float32
    bottom, right, channels = image.shape[0] - 1, image.shape[1] - 1, image.shape[2]
    for row in range(labels.shape[0]):
        for n in range(labels.shape[1]):
            if labels[row, n] != OK:
                continue
            # The four pixels around the place; on the border's outer half pixel they are the border's.
            u, v = max(us[row, n], f(0.0)), max(vs[row, n], f(0.0))
            x, y = min(int(u), right), min(int(v), bottom)
            x1, y1 = min(x + 1, right), min(y + 1, bottom)
            a, b = u - f(x), v - f(y)
            for c in range(channels):
                upper = image[y, x, c] * (f(1.0) - a) + image[y, x1, c] * a
                lower = image[y1, x, c] * (f(1.0) - a) + image[y1, x1, c] * a
                value = upper * (f(1.0) - b) + lower * b
                values[row, n, c] = value
                # NaN times a weight of 0 is NaN: a pixel without a value spoils each mean that it is in.
                if math.isnan(value):
                    labels[row, n] = NO_READING


@nb.njit(cache=True, nogil=True)
def fill_into(
    values: Singles,
    labels: Labels,
    source: Labels,
    pixels: npt.NDArray[np.int64],
    others: Singles,
    other_labels: Labels,
    number: int,
) -> None:
    """Take another camera's values at the pixels that it sees and those before it do not.

    Args:
        values: (H, W, C) become the other's where it is OK.
        labels: (H, W) become OK there.
        source: (H, W) becomes its number there.
        pixels: (N,) numbers of the pixels.
        others: (N, C)
        other_labels: (N,)
        number: of the other camera.
    """
    for n in range(len(pixels)):
        if other_labels[n] != OK:
            continue
        row, column = divmod(pixels[n], labels.shape[1])
        labels[row, column] = OK
        source[row, column] = number
        for c in range(values.shape[2]):
            values[row, column, c] = others[n, c]
