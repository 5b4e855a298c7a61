"""Covariances between the nodes of a grid: the loop of `covariance_grid`."""

import numba as nb
import numpy as np

from cairn_map.arrays import Floats, Singles

PLANES = 8
"""Numbers of a node: xx, xy, yy by calibration; x, y by range; xx, xy, yy by the pixel itself."""


@nb.njit(cache=True, nogil=True)
def covariances_into(
    out: Singles,
    xs: Singles,
    ys: Singles,
    range_m: Singles,
    sigma_m: Singles,
    grid: Floats,
    nodes: Floats,
    step_x: float,
    step_y: float,
    pixel_sigma_px: float,
) -> None:
    """(N, 3) xx, xy, yy, px^2, interpolated; NaN where a node is NaN or the range is.

    Args:
        out: (N, 3)
        xs: (N,) pixels of the source camera.
        ys: (N,)
        range_m: (N,)
        sigma_m: (N,)
        grid: (K, R, C, 8) by 1 / range, row and column.
        nodes: (K,) rising, 1 / metres.
        step_x: pixels from column to column.
        step_y: pixels from row to row.
        pixel_sigma_px: standard deviation of the pixels themselves.
    """
    last_k, last_r, last_c = grid.shape[0] - 1, grid.shape[1] - 1, grid.shape[2] - 1
    mean = np.empty(PLANES)
    for n in range(len(xs)):
        # Written so that NaN is left out too.
        if not range_m[n] > 0.0:
            out[n, :] = np.nan
            continue
        # The cell of the grid: node k by 1 / range, row r and column c, and the place in it, 0 to 1.
        q = min(max(1.0 / np.float64(range_m[n]), nodes[0]), nodes[last_k])
        k = min(max(np.searchsorted(nodes, q, side="right") - 1, 0), last_k - 1)
        x, y = np.float64(xs[n]) / step_x, np.float64(ys[n]) / step_y
        c, r = min(max(int(x), 0), last_c - 1), min(max(int(y), 0), last_r - 1)
        a, b, t = x - c, y - r, (q - nodes[k]) / (nodes[k + 1] - nodes[k])
        # Linear along each axis: bilinear in the image, then between the two nodes of 1 / range.
        for p in range(PLANES):
            near = (1 - b) * ((1 - a) * grid[k, r, c, p] + a * grid[k, r, c + 1, p])
            near += b * ((1 - a) * grid[k, r + 1, c, p] + a * grid[k, r + 1, c + 1, p])
            far = (1 - b) * ((1 - a) * grid[k + 1, r, c, p] + a * grid[k + 1, r, c + 1, p])
            far += b * ((1 - a) * grid[k + 1, r + 1, c, p] + a * grid[k + 1, r + 1, c + 1, p])
            mean[p] = near + t * (far - near)
        # S = C + sigma_d^2 m m^T + sigma_u^2 D D^T (`pixel_covariance`).
        own, s = pixel_sigma_px * pixel_sigma_px, np.float64(sigma_m[n])
        out[n, 0] = mean[0] + s * s * mean[3] * mean[3] + own * mean[5]
        out[n, 1] = mean[1] + s * s * mean[3] * mean[4] + own * mean[6]
        out[n, 2] = mean[2] + s * s * mean[4] * mean[4] + own * mean[7]
