"""Probe points of a calibration: over the gauge camera's image, at 1, 2 and 5 m, as they appear in every camera.

Not the sigma of a parameter matters, but that of a point's pixel: a pixel of the range camera carried to the colour
camera. Focal length and distance, principal point and rotation may be uncertain together and yet carry every pixel
well. Of the gauge itself it is where a direction of its frame appears.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.projection_uncertainty import mounted_lens, projection_moves, transfer_moves
from cairn_calib.rig.rig import Rig
from cairn_calib.solve.rig_state import ParameterLayout
from cairn_map.arrays import Floats

RANGES_M = (1.0, 2.0, 5.0)
COLUMNS, ROWS = 9, 7


@dataclass(frozen=True, slots=True)
class Probes:
    """R probe points in one camera."""

    camera: str
    pixels: Floats
    """(R, 2)"""
    range_m: Floats
    """(R,) from the gauge camera."""
    rows: Floats
    """(R, 2, P) pixels a unit of each shared parameter of the layout."""

    def sigmas_px(self, covariance: Floats) -> Floats:
        """(R,) standard deviation of the pixels, one axis, for a (P, P) covariance."""
        variances: Floats = np.einsum("rip,pq,riq->r", self.rows, covariance, self.rows, optimize=True) / 2
        return np.sqrt(variances)


def probes_of(rig: Rig, gauge: str, layout: ParameterLayout) -> list[Probes]:
    """Probe points of each camera that lie in its image."""
    lens = mounted_lens(rig, gauge)
    grid = image_grid(lens.width, lens.height, COLUMNS, ROWS)
    source = np.concatenate([grid] * len(RANGES_M))
    range_m = np.repeat(RANGES_M, len(grid))
    result = []
    for name, mounted in rig.cameras.items():
        if name == gauge:
            pixels, _, moves = projection_moves(rig, name, lens.unproject(grid))
        else:
            pixels, moves = transfer_moves(rig, gauge, name, source, range_m)
        inside = mounted.camera.contains(pixels)
        result.append(_probes(name, pixels, range_m[: len(pixels)], moves, layout, inside))
    return [each for each in result if len(each.pixels)]


def image_grid(width: int, height: int, columns: int, rows: int) -> Floats:
    """(rows * columns, 2) pixels in the middles of a grid of equal parts of an image."""
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _probes(
    name: str,
    pixels: Floats,
    range_m: Floats,
    moves: dict[tuple[str, str], Floats],
    layout: ParameterLayout,
    inside: npt.NDArray[np.bool_],
) -> Probes:
    rows = np.zeros((*pixels.shape, layout.size))
    for n, parameter in enumerate(layout.names):
        if parameter in moves:
            rows[..., n] = moves[parameter]
    good = inside & np.isfinite(rows).all(axis=(1, 2))
    return Probes(name, pixels[good], range_m[good], rows[good])
