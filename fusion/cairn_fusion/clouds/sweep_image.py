"""Points of a sweep as a range image: each in the pixel whose ray is nearest to it, the nearest of several counts.

A direction is then exact to half a pixel only. Lidars whose beams are known have an image that is their own; other
clouds have one to look at, in `virtual_lidar`, and their evidence is of the points themselves.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import SpinningLidar

R_LIDAR_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from a camera's axes (x right, y down, z forward) to a lidar's in ROS (x forward, y left, z up; REP 103)."""
T_LIDAR_CAMERA = np.block([[R_LIDAR_CAMERA, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
VIRTUAL_COLUMNS, VIRTUAL_ROWS, VIRTUAL_TOP_DEG = 1024, 256, 88.0


def sweep_image(xyz: npt.NDArray[np.floating], lidar: SpinningLidar) -> npt.NDArray[np.float32]:
    """(H, W) float32, metres along the beam; NaN where no point is.

    Args:
        xyz: (N, 3) metres, x forward, y left, z up; NaN where nothing came back.
        lidar: the raster.
    """
    own = xyz[np.isfinite(xyz).all(axis=1)] @ R_LIDAR_CAMERA
    range_m = np.linalg.norm(own, axis=1)
    pixels = lidar.project(own)
    kept = np.isfinite(pixels).all(axis=1) & (range_m > 0)
    x = np.rint(pixels[kept, 0]).astype(np.int64) % lidar.width
    y = np.clip(np.rint(pixels[kept, 1]).astype(np.int64), 0, lidar.height - 1)
    nearest = np.full((lidar.height, lidar.width), np.inf)
    np.minimum.at(nearest, (y, x), range_m[kept])
    return np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32)


def virtual_lidar() -> SpinningLidar:
    """The raster of clouds whose lidar is not known: all round, 1024 columns of 256 equally far rows."""
    elevations_deg = np.linspace(VIRTUAL_TOP_DEG, -VIRTUAL_TOP_DEG, VIRTUAL_ROWS)
    return SpinningLidar(
        width=VIRTUAL_COLUMNS, height=VIRTUAL_ROWS, elevations_deg=tuple(round(float(e), 4) for e in elevations_deg)
    )
