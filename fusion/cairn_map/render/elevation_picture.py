"""Pictures and files of a level layer's elevation: the ground as it hinders a vehicle, in colours, and all numbers.

    green -> yellow -> red     difficulty 0 to 1, `Elevation.difficulty`
    dark red                   beyond the vehicle's limits
    black                      no surface is known

Shades by the slope towards the upper left make shapes visible. The row of the highest y comes first, as on a map.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.queries.level.elevation import STANDARD_VEHICLE, Elevation, Vehicle
from cairn_map.render.map_picture import npz_of
from cairn_map.render.render_picture import BLOCKED, EASY, LIMIT, MIDDLE, png_of

SHADE = 0.5
"""Change of brightness where the ground falls by its own width."""


def elevation_png(elevation: Elevation, vehicle: Vehicle = STANDARD_VEHICLE) -> bytes:
    """The difficulty of the ground for a vehicle, as a PNG; a pixel is a column.

    Args:
        elevation: the ground.
        vehicle: whose limits are drawn in red.
    """
    values = elevation.difficulty(vehicle)
    known = np.isfinite(values)
    level = np.where(known, values, 0.0)
    rgb: npt.NDArray[np.float64] = np.stack(
        [np.interp(level, (0.0, 0.5, 1.0), tones) for tones in zip(EASY, MIDDLE, LIMIT, strict=True)], axis=-1
    )
    rgb[level > 1.0] = BLOCKED
    shaded = np.clip(rgb * (1.0 + SHADE * _falls(elevation))[..., None], 0, 255)
    shaded[~known] = 0
    return png_of(np.ascontiguousarray(np.rint(shaded).astype(np.uint8)[::-1]))


def elevation_npz(elevation: Elevation, vehicle: Vehicle = STANDARD_VEHICLE) -> bytes:
    """All arrays of an elevation as an `.npz` file, `difficulty` among them; rows rise with y."""
    return npz_of({**elevation.arrays(), "difficulty": elevation.difficulty(vehicle)})


def _falls(elevation: Elevation) -> Floats:
    """(H, W) fall of the ground towards the lower right, -1 to 1; 0 where a neighbour is unknown."""
    height, falls = elevation.height_m, np.zeros_like(elevation.height_m)
    falls[1:, :-1] = (height[:-1, 1:] - height[1:, :-1]) / (2 * elevation.edge_m)
    return np.clip(np.nan_to_num(-falls), -1.0, 1.0)
