"""Images in other conventions, turned into a scan's: the only place where a convention is guessed at.

A depth camera usually reports the distance along the optical axis (z), in integer millimetres or tenths;
a time-of-flight camera the distance along the beam. Mixing them up bends every wall by up to 20 % at the
image's corners, so the caller must say which one it has by choosing the function.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import AnyCamera
from cairn_map.errors import BadInputError

Image = npt.NDArray[np.generic]
Ranges = npt.NDArray[np.float32]


def range_from_z_depth(depth: Image, camera: AnyCamera, *, units_per_m: float) -> Ranges:
    """Ranges along the beam from a z-depth image.

    Eq. 4 of Kocmanova et al. backwards: d = z / (z component of the pixel's unit ray).

    Args:
        depth: (H, W) any number type, distance along the optical axis; 0 or NaN where nothing came back.
        camera: the depth camera.
        units_per_m: depth units in one metre: 1000 for millimetres, 1 for metres.

    Returns:
        (H, W) float32, metres along each beam; NaN where nothing came back.

    Raises:
        BadInputError: wrong image size, or `units_per_m` not positive.
    """
    z_m = _metres(depth, camera, units_per_m)
    return (z_m / camera.rays()[..., 2]).astype(np.float32)


def range_from_radial(radial: Image, camera: AnyCamera, *, units_per_m: float) -> Ranges:
    """Ranges from an image that already holds distance along the beam; arguments as `range_from_z_depth`."""
    return _metres(radial, camera, units_per_m).astype(np.float32)


def kelvin_from_counts(counts: Image, *, kelvin_per_count: float, kelvin_at_zero: float = 0.0) -> Ranges:
    """Apparent temperature from linear radiometric counts: (H, W) float32 kelvin; count 0 means no reading (NaN)."""
    values = counts.astype(np.float64)
    return np.where(values > 0, values * kelvin_per_count + kelvin_at_zero, np.nan).astype(np.float32)


def _metres(image: Image, camera: AnyCamera, units_per_m: float) -> npt.NDArray[np.float64]:
    if not units_per_m > 0:
        raise BadInputError("bad_scale", f"units_per_m must be positive, got {units_per_m}")
    camera.check_image(image, name="depth image")
    metres = image.astype(np.float64) / units_per_m
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.nan)
