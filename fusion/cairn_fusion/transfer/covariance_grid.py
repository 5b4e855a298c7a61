"""Covariance of every transferred pixel of an image, computed on a coarse grid and interpolated.

    12 x 9 pixels x 12 ranges    C + sigma_d^2 m m^T + sigma_u^2 D D^T     (`pixel_covariance`), each part by itself
    any pixel, range, noise      linear in the pixel and in 1 / range

All parts change slowly over the image, and at most with the square of 1 / range: between nodes half as far again from
each other that makes 4 % too much, never too little.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.calibration import Calibration
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import MountedCamera, Rig
from cairn_fusion.transfer.calibration_covariance import calibration_covariance, lens_of, pixel_gradients
from cairn_fusion.transfer.covariance_grid_kernels import covariances_into
from cairn_map.arrays import Floats, Singles

COLUMNS, ROWS = 12, 9
"""Nodes along the image's rows and columns."""
NODES = np.geomspace(1 / 20.0, 1 / 0.2, 12)
"""1 / range of the nodes: 0.2 to 20 m; nearer and farther points count as these."""


@dataclass(frozen=True, slots=True, eq=False)
class CovarianceGrid:
    """Covariance of the pixels in one camera's image that show the points of another camera's pixels."""

    grid: Floats
    """(12, 9, 12, 8) by 1 / range, row, column, and number of `covariance_grid_kernels`."""
    step_px: tuple[float, float]
    """Pixels from column to column and from row to row."""

    @classmethod
    def of(cls, rig: Rig, *, src: str, dst: str) -> Self:
        """Grid of a pair of cameras; cached, because it takes some milliseconds.

        Raises:
            BadInputError: one of them is a lidar.
        """
        for name in (src, dst):
            lens_of(rig, name)
        return cls(*_grid_of(rig.calibration, src, rig[src], dst, rig[dst]))

    def at(
        self,
        pixels: npt.NDArray[np.floating | np.integer],
        range_m: Singles,
        sigma_m: Singles,
        *,
        pixel_sigma_px: float = 0.0,
    ) -> Singles:
        """(N, 3) float32 xx, xy, yy, px^2 of `dst`; NaN where the range is NaN, or the other camera cannot see.

        Args:
            pixels: (N, 2) x, y in `src`.
            range_m: (N,) metres along their rays.
            sigma_m: (N,) standard deviation of the range.
            pixel_sigma_px: standard deviation of the pixels themselves.
        """
        out = np.empty((len(pixels), 3), np.float32)
        xs, ys = (np.ascontiguousarray(pixels[:, n], dtype=np.float32) for n in (0, 1))
        ranges, sigmas = (np.ascontiguousarray(each, dtype=np.float32) for each in (range_m, sigma_m))
        covariances_into(out, xs, ys, ranges, sigmas, self.grid, NODES, *self.step_px, pixel_sigma_px)
        return out


def calibration_bound_px(rig: Rig, *, src: str, dst: str) -> float:
    """Largest standard deviation by calibration anywhere on the grid and in any direction, px."""
    if rig.calibration is None or rig.calibration.covariance is None:
        return rig[dst].calibration_sigma_px or 0.0
    if not isinstance(rig[src].camera, Lens):
        return np.inf
    a, b, c = (CovarianceGrid.of(rig, src=src, dst=dst).grid[..., n] for n in range(3))
    return float(np.sqrt(np.nanmax((a + c) / 2 + np.hypot((a - c) / 2, b))))


@lru_cache(maxsize=64)
def _grid_of(
    calibration: Calibration | None, src: str, seen_in: MountedCamera, dst: str, seen_by: MountedCamera
) -> tuple[Floats, tuple[float, float]]:
    rig = Rig.model_construct(name="pair", cameras={src: seen_in, dst: seen_by}, calibration=calibration)
    x, y = np.linspace(0, seen_in.camera.width - 1, COLUMNS), np.linspace(0, seen_in.camera.height - 1, ROWS)
    rays = seen_in.camera.unproject(np.stack(np.meshgrid(x, y), axis=-1)).reshape(-1, 3)
    points = (rays[None] / NODES[:, None, None]).reshape(-1, 3)
    # The three parts of a node: C by calibration, m = J t / d by range, D D^T by the pixel itself.
    grid = np.empty((len(points), 8))
    grid[:, :3] = _three(calibration_covariance(points, rig, src=src, dst=dst))
    T_dst_src = inverse(seen_by.transform) @ seen_in.transform
    by_point = lens_of(rig, dst).pixel_gradients(transform_points(T_dst_src, points))
    grid[:, 3:5] = by_point @ T_dst_src[:3, 3] / np.linalg.norm(points, axis=1)[:, None]
    D = pixel_gradients(points, rig, src=src, dst=dst)
    grid[:, 5:] = _three(D @ np.swapaxes(D, -1, -2))
    whole = grid.reshape(len(NODES), ROWS, COLUMNS, 8)
    whole.setflags(write=False)
    return whole, (float(x[1] - x[0]) or 1.0, float(y[1] - y[0]) or 1.0)


def _three(matrices: Floats) -> Floats:
    """(N, 3) xx, xy, yy of (N, 2, 2)."""
    return np.stack([matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]], axis=1)
