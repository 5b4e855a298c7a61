"""Coarse grid of nodes over a range camera's image, linear between them: the part of the bias that varies smoothly.

Every pixel lies between four nodes. Sums over pixels are taken four nodes at a time, never as products of matrices that
are nearly all 0: those take ten times as long as the rest of a range image (and start threads: `normal_equations.py`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.raster import Raster
from cairn_map.arrays import Floats

Indices = npt.NDArray[np.intp]

NODES = (12, 9)
"""Columns and rows: 16 pixels apart on 176 x 144, a fifth of a board's image."""


@dataclass(frozen=True, slots=True)
class PixelNodes:
    """The four of K nodes around each of (V, M) pixels."""

    count: int
    """K"""
    index: Indices
    """(V, M, 4) their numbers, row by row."""
    share: Floats
    """(V, M, 4) how much each counts; 1 together."""

    def values(self, nodes: Floats) -> Floats:
        """(V, M) what (K,) values at the nodes are at the pixels."""
        return np.asarray(np.sum(self.share * nodes[self.index], axis=-1))

    def variances(self, covariance: Floats) -> Floats:
        """(V, M) variances of that, of the values' (K, K) covariance."""
        between = covariance[self.index[..., :, None], self.index[..., None, :]]
        return np.asarray(np.sum(between * self.share[..., :, None] * self.share[..., None, :], axis=(-2, -1)))

    def squares(self, weights: Floats) -> Floats:
        """(V, K, K) sum over an image's pixels of weight times node times node, of (V, M) weights."""
        views, size = len(weights), self.count**2
        pair = self.index[..., :, None] * self.count + self.index[..., None, :]
        pair += np.arange(views)[:, None, None, None] * size
        products = weights[..., None, None] * self.share[..., :, None] * self.share[..., None, :]
        summed = np.bincount(pair.ravel(), weights=products.ravel(), minlength=views * size)
        return np.asarray(summed, np.float64).reshape(views, self.count, self.count)

    def products(self, columns: Floats) -> Floats:
        """(V, J, K) sum over an image's pixels of column times node, of (V, M, J) columns."""
        views = len(columns)
        number = (self.index + np.arange(views)[:, None, None] * self.count).ravel()
        summed = [
            np.bincount(number, weights=(column[..., None] * self.share).ravel(), minlength=views * self.count)
            for column in np.moveaxis(columns, -1, 0)
        ]
        return np.stack([each.reshape(views, self.count) for each in summed], axis=1).astype(np.float64, copy=False)


def pixel_nodes(raster: Raster, pixels: Floats, nodes: tuple[int, int]) -> PixelNodes:
    """The nodes around (V, M, 2) pixels; `nodes` are columns and rows."""
    columns, rows = nodes
    x = np.clip(pixels[..., 0] / max(raster.width - 1, 1), 0, 1) * (columns - 1)
    y = np.clip(pixels[..., 1] / max(raster.height - 1, 1), 0, 1) * (rows - 1)
    left, top = np.minimum(x.astype(np.intp), columns - 2), np.minimum(y.astype(np.intp), rows - 2)
    across, down = np.stack([1 + left - x, x - left], axis=-1), np.stack([1 + top - y, y - top], axis=-1)
    index = (top[..., None] + np.array([0, 0, 1, 1])) * columns + left[..., None] + np.array([0, 1, 0, 1])
    return PixelNodes(columns * rows, index, (down[..., :, None] * across[..., None, :]).reshape(*x.shape, 4))


def image_nodes(raster: Raster, nodes: tuple[int, int]) -> PixelNodes:
    """The nodes around every pixel: (H, W)."""
    y, x = np.mgrid[: raster.height, : raster.width]
    return pixel_nodes(raster, np.stack([x, y], axis=-1).astype(np.float64), nodes)
