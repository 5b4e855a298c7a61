"""Uncertainty of pixels caused by that of the camera's pose, and the spreading of their ink. No checks."""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Floats, Singles

NEAREST_M = 0.01
"""Least range, metres; nearer surfaces count as this near."""
PARALLEL = 1e-18
"""Square of the solid angle of a pixel, rad^4, below which its rays are parallel and give no direction."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def motions_into(out: Floats, rays: Floats, range_m: Singles) -> None:
    """Write (H, W, 2, 6) Jacobians of each pixel's image: pixels by [rotation w (rad), translation v (m)].

    The camera truly is at T exp(motion), so that a point p of its frame is truly at p - w x p - v; along its ray u, at
    the range r, that turns the ray by du = u x w - (v - u (u . v)) / r. Neighbouring rays give the step in pixels.

    Args:
        out: filled; NaN where there is no ray or range.
        rays: (H, W, 3) unit rays, camera frame.
        range_m: (H, W) metres along them.
    """
    height, width = range_m.shape
    a, b = np.empty(3), np.empty(3)
    for y in range(height):
        for x in range(width):
            left, right, up, down = max(x - 1, 0), min(x + 1, width - 1), max(y - 1, 0), min(y + 1, height - 1)
            # a, b: change of the ray per pixel along x and y; det [[aa, ab], [ab, bb]] is the pixel's area squared.
            aa, ab, bb = 0.0, 0.0, 0.0
            for c in range(3):
                a[c] = (rays[y, right, c] - rays[y, left, c]) / (right - left)
                b[c] = (rays[down, x, c] - rays[up, x, c]) / (down - up)
                aa, ab, bb = aa + a[c] * a[c], ab + a[c] * b[c], bb + b[c] * b[c]
            area = aa * bb - ab * ab
            if not (area > PARALLEL and range_m[y, x] >= 0.0):  # nor NaN
                for j in range(6):
                    out[y, x, 0, j] = out[y, x, 1, j] = np.nan
                continue
            nearness = 1.0 / max(np.float64(range_m[y, x]), NEAREST_M)
            u0, u1, u2 = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            for k in range(2):
                # The row of the pseudo-inverse of (a b): how many pixels along x, or y, a change of the ray is.
                s, t = (bb / area, -ab / area) if k == 0 else (-ab / area, aa / area)
                p0, p1, p2 = s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]
                out[y, x, k, 0] = p1 * u2 - p2 * u1  # p . (u x w) = w . (p x u)
                out[y, x, k, 1] = p2 * u0 - p0 * u2
                out[y, x, k, 2] = p0 * u1 - p1 * u0
                # p . -(v - u (u . v)) / r = v . -(p - u (u . p)) / r
                along = p0 * u0 + p1 * u1 + p2 * u2
                out[y, x, k, 3] = -nearness * (p0 - along * u0)
                out[y, x, k, 4] = -nearness * (p1 - along * u1)
                out[y, x, k, 5] = -nearness * (p2 - along * u2)


@nb.njit(cache=True, nogil=True)
def covariances_into(out: Singles, motions: Floats, covariance: Floats) -> None:
    """Write (H, W, 3) covariances J C J^T, xx, xy, yy, px^2, of (H, W, 2, 6) motions J and a (6, 6) covariance C."""
    height, width = out.shape[:2]
    for y in range(height):
        for x in range(width):
            for n in range(3):
                first, second = (0, 0) if n == 0 else ((0, 1) if n == 1 else (1, 1))
                total = 0.0
                for i in range(6):
                    for j in range(6):
                        total += motions[y, x, first, i] * covariance[i, j] * motions[y, x, second, j]
                out[y, x, n] = total


@nb.njit(cache=True, nogil=True)
def scatter_into(
    total: Singles, ink: Bytes, covariance: Singles, points: Singles, counts: npt.NDArray[np.int64]
) -> None:
    """Add each pixel's ink, spread by its own covariance, to a sum.

    Each gives an even share to every one of N places, which are distributed as its covariance says; so many that they
    lie a few pixels apart. They are the same for all pixels: where all spread alike, what is even stays even.

    Args:
        total: (H, W, 4) sum of ink; what falls beyond it is lost.
        ink: (H, W, 4) colours multiplied by their cover, and the cover.
        covariance: (H, W, 3) xx, xy, yy, px^2; not positive or NaN: sharp.
        points: (S, N, 2) standard normal points for S sizes of spread.
        counts: (S,) how many of the N count.
    """
    height, width = covariance.shape[:2]
    sizes = points.shape[0]
    for y in range(height):
        for x in range(width):
            if ink[y, x, 3] == 0:
                continue
            xx, xy, yy = covariance[y, x, 0], covariance[y, x, 1], covariance[y, x, 2]
            if not xx + yy > 0.0:
                for c in range(4):
                    total[y, x, c] += ink[y, x, c]
                continue
            # The Cholesky factor L of the covariance: L z has it, for standard normal z.
            l11 = math.sqrt(max(xx, np.float32(1e-12)))
            l21 = xy / l11
            l22 = math.sqrt(max(yy - l21 * l21, 0.0))
            # As many places as keep neighbouring ones a few pixels apart.
            size = 0
            while size + 1 < sizes and counts[size] < 3.0 * (l11 + 1.0) * (l22 + abs(l21) + 1.0):
                size += 1
            share = np.float32(1.0 / counts[size])
            for n in range(counts[size]):
                p, q = points[size, n, 0], points[size, n, 1]
                i, j = math.floor(x + l11 * p + 0.5), math.floor(y + l21 * p + l22 * q + 0.5)
                if 0 <= i < width and 0 <= j < height:
                    for c in range(4):
                        total[j, i, c] += share * ink[y, x, c]
