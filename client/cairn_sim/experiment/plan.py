"""The map from above, as the paper's Fig. 20 draws it: colour and temperature, cells violet, stops as dots.

Of each column of voxels one sees the highest occupied one below the ceiling, and the hottest. Cells are taken one by
one, so that a map of any size is drawn in the memory of its floor plan.
"""

import base64
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform
from cairn_fusion.recording.images import write_colour
from cairn_map.arrays import Rgb, Singles
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import voxels_of_evidence
from cairn_map.files.cell_files import colours
from cairn_sim.scene.scene import AMBIENT_K

PAPER_WHITE = (255, 255, 255)
NO_TEMPERATURE = (214, 214, 214)
"""Colour of voxels that no thermal camera saw."""
HEAT = np.array(
    [[20, 11, 52], [101, 21, 110], [159, 42, 99], [212, 72, 66], [245, 125, 21], [250, 193, 39], [252, 255, 164]]
)
"""Cold to hot, sRGB, evenly spaced: seven colours of matplotlib's inferno."""
PERCENTILES = (1.0, 99.5)
STRAY = 50
"""Cells with fewer columns than this are not drawn: a few voxels behind a pane would make the building small."""
ROBOT_COLOURS = ("#0b6e4f", "#c2410c", "#1d4ed8", "#7e22ce")
CELL_COLOUR = "#8b2fc9"


@dataclass(slots=True)
class _Tile:
    """One column of cells from above, arrays [x, y]."""

    height: npt.NDArray[np.int64]
    rgb: Rgb
    kelvin: Singles
    occupied: npt.NDArray[np.bool_]


@dataclass(slots=True)
class PlanView:
    """A floor plan that cells are added to."""

    geometry: Geometry
    ceiling_m: float
    tiles: dict[tuple[int, int], _Tile] = field(default_factory=dict)

    def add(self, key: CellKey, evidence: Evidence, model: SensorModel) -> None:
        """Add one cell."""
        voxels = voxels_of_evidence(key, evidence, self.geometry, model, occupied_only=True)
        low = np.flatnonzero(voxels.centres_m[:, 2] <= self.ceiling_m)
        if not len(low):
            return
        cell, side = cell_of_key(key), self.geometry.side
        tile = self.tiles.setdefault((cell.i, cell.j), _empty_tile(side))
        order = low[np.argsort(voxels.numbers[low, 2], kind="stable")]
        x, y = (voxels.numbers[order, axis] - index * side for axis, index in ((0, cell.i), (1, cell.j)))
        # Rising, so that the highest of a column is what stays.
        top = np.full((side, side), -1, np.int64)
        top[x, y] = np.arange(len(order))
        z = np.where(top >= 0, voxels.numbers[order, 2][top], np.iinfo(np.int64).min)
        higher = z > tile.height
        tile.height[higher] = z[higher]
        tile.rgb[higher] = colours(voxels)[order][top][higher]
        tile.occupied |= top >= 0
        thermal = voxels.of_kind(ChannelKind.TEMPERATURE)
        if thermal is not None:
            kelvin = np.nan_to_num(thermal.mean[order], nan=0.0).astype(np.float32)
            np.maximum.at(tile.kelvin, (x, y), kelvin)

    def svg(self, which: str, stops: Sequence[tuple[str, Sequence[Transform]]]) -> str:
        """The plan as an SVG element with the picture in it; its unit is the metre.

        Args:
            which: `colour` or `temperature`.
            stops: of each robot: its name, and `T_map_rig` at its stops.
        """
        edge_m, low, high = self.geometry.cell_edge_m, *self._bounds()
        width_m, height_m = ((b - a) * edge_m for a, b in zip(low, high, strict=True))
        # y goes up on a map and down on a page.
        flip = f"matrix(1 0 0 -1 {-low[0] * edge_m:.6g} {high[1] * edge_m:.6g})"
        return "".join(
            [
                f'<svg class="plan" viewBox="-0.1 -0.1 {width_m + 0.2:.6g} {height_m + 0.2:.6g}" role="img" '
                f'aria-label="The map from above, {escape(which)}">',
                f'<image width="{width_m:.6g}" height="{height_m:.6g}" style="image-rendering:pixelated" '
                f'href="{_png_url(self._image(which))}"/><g transform="{flip}">',
                *(
                    f'<rect x="{i * edge_m:.6g}" y="{j * edge_m:.6g}" width="{edge_m:g}" height="{edge_m:g}" '
                    f'fill="none" stroke="{CELL_COLOUR}" stroke-width="0.06"/>'
                    for i, j in self._drawn()
                ),
                *(
                    f'<circle cx="{T[0, 3]:.2f}" cy="{T[1, 3]:.2f}" r="0.2" stroke="#fff" stroke-width="0.06" '
                    f'fill="{ROBOT_COLOURS[number % len(ROBOT_COLOURS)]}"/>'
                    for number, (_, poses) in enumerate(stops)
                    for T in poses
                ),
                "</g></svg>",
            ]
        )

    def temperature_range_k(self) -> tuple[float, float]:
        """Temperatures at the two ends of the colour scale, kelvin."""
        kelvin = [tile.kelvin[tile.kelvin > 0] for tile in self._drawn().values()]
        values = np.concatenate([*kelvin, np.empty(0, np.float32)])
        low_k, high_k = np.percentile(values, PERCENTILES) if len(values) else (AMBIENT_K, AMBIENT_K)
        return float(low_k), float(max(high_k, low_k + 0.1))

    def _drawn(self) -> dict[tuple[int, int], _Tile]:
        worth = {at: tile for at, tile in self.tiles.items() if np.count_nonzero(tile.occupied) >= STRAY}
        return worth or self.tiles

    def _bounds(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Lowest cell, and the first behind the highest, along x and y."""
        at = np.array([*self._drawn()] or [(0, 0)])
        (i, j), (last_i, last_j) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
        return (i, j), (last_i + 1, last_j + 1)

    def _image(self, which: str) -> Rgb:
        """(H, W, 3) a pixel a voxel; y up on the map is up in the image."""
        side, (low, high) = self.geometry.side, self._bounds()
        image = np.full(((high[0] - low[0]) * side, (high[1] - low[1]) * side, 3), PAPER_WHITE, np.uint8)
        low_k, high_k = self.temperature_range_k()
        for (i, j), tile in self._drawn().items():
            x, y = (i - low[0]) * side, (j - low[1]) * side
            painted = tile.rgb if which == "colour" else _heated(tile.kelvin, low_k, high_k)
            image[x : x + side, y : y + side][tile.occupied] = painted[tile.occupied]
        return np.ascontiguousarray(image.transpose(1, 0, 2)[::-1])


def _empty_tile(side: int) -> _Tile:
    return _Tile(
        np.full((side, side), np.iinfo(np.int64).min, np.int64),
        np.zeros((side, side, 3), np.uint8),
        np.zeros((side, side), np.float32),
        np.zeros((side, side), np.bool_),
    )


def _heated(kelvin: Singles, low_k: float, high_k: float) -> Rgb:
    level = np.clip((kelvin - low_k) / (high_k - low_k), 0, 1) * (len(HEAT) - 1)
    rgb = np.stack([np.interp(level, np.arange(len(HEAT)), HEAT[:, c]) for c in range(3)], axis=-1)
    painted: Rgb = np.rint(rgb).astype(np.uint8)
    painted[kelvin <= 0] = NO_TEMPERATURE
    return painted


def _png_url(image: Rgb) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.png"
        write_colour(path, image)
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
