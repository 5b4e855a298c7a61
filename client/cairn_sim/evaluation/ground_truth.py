"""Truth of the ground from above: the mean height of each column of ground, and a level's errors against it.

    ground_errors          columns of which, from above, nothing but ground is seen
    ground_errors_below    columns below a thing: a bridge, high grass, a person who stood there

Truth is the ground alone, whatever stands on it or hangs over it.
"""

from typing import NamedTuple

import numpy as np

from cairn_map.arrays import Flags, Floats, Ints
from cairn_map.queries.level.elevation import Elevation
from cairn_sim.render.raycast_kernels import cast_each
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Solid

GROUND = ("meadow", "bank", "plateau", "path")
"""Words in the names of the yard's solids on which one walks."""
ABOVE_M = 30.0
SAMPLES = (np.arange(4) + 0.5) / 4 - 0.5
"""Places in a column along an edge, in parts of it."""
SAME_M = 1e-9


class GroundErrors(NamedTuple):
    """Errors of N known columns of ground, metres, and the sigma that was stated for each."""

    error_m: Floats
    sigma_m: Floats

    @property
    def within_three(self) -> float:
        """Share of the errors within three sigma."""
        return float(np.mean(np.abs(self.error_m) <= 3 * self.sigma_m))

    @property
    def median_m(self) -> float:
        """Median of the magnitudes."""
        return float(np.median(np.abs(self.error_m)))

    @property
    def largest_m(self) -> float:
        """Largest magnitude."""
        return float(np.abs(self.error_m).max())


def ground_errors(scene: Scene, ground: Elevation, *, without: tuple[str, ...] = ()) -> GroundErrors:
    """Errors of the known columns of which, from above, nothing but ground is seen.

    Args:
        scene: as it is when the ground is free.
        ground: as the level is read.
        without: things, by name, whose columns are left out: such as grass, of which 16 rays may miss all blades.
    """
    y, x = np.nonzero(np.isfinite(ground.height_m))
    height_m, is_open = _heights(scene, ground, y, x)
    for name in without:
        is_open &= ~_is_below(scene, name, ground, y, x)
    return _errors(ground, y[is_open], x[is_open], height_m[is_open])


def ground_errors_below(scene: Scene, ground: Elevation, name: str) -> GroundErrors:
    """Errors of the known columns with their middle below a thing.

    Args:
        scene: as it is when the thing is there.
        ground: as the level is read.
        name: the thing: a solid's name, or how the names of its solids begin.

    Raises:
        BadInputError: there is no such thing.
    """
    y, x = np.nonzero(np.isfinite(ground.height_m))
    below = _is_below(scene, name, ground, y, x)
    height_m, _ = _heights(scene, ground, y[below], x[below])
    return _errors(ground, y[below], x[below], height_m)


def _errors(ground: Elevation, y: Ints, x: Ints, height_m: Floats) -> GroundErrors:
    return GroundErrors(ground.height_m[y, x] - height_m, ground.sigma_m[y, x])


def _middles(ground: Elevation, y: Ints, x: Ints) -> Floats:
    return np.asarray(ground.origin_m, np.float64) + ground.edge_m * np.stack([x, y], axis=1).astype(np.float64)


def _heights(scene: Scene, ground: Elevation, y: Ints, x: Ints) -> tuple[Floats, Flags]:
    """Mean height of the ground in each column, NaN beyond the ground's edge, and whether it is open to the sky."""
    middle = _middles(ground, y, x)
    bare = scene_of(solid for solid in scene.solids if _is_ground(solid))
    total_m, is_open = np.zeros(len(x)), np.ones(len(x), np.bool_)
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    for dx in SAMPLES:
        for dy in SAMPLES:
            above = np.column_stack([middle + ground.edge_m * np.array([dx, dy]), np.full(len(x), ABOVE_M)])
            range_m, solid, _ = cast_each(above, down, bare.shapes)
            first_m, _, _ = cast_each(above, down, scene.shapes)
            is_open &= (solid >= 0) & (np.abs(first_m - range_m) < SAME_M)
            total_m += np.where(solid >= 0, ABOVE_M - range_m, np.nan)
    return total_m / len(SAMPLES) ** 2, is_open


def _is_ground(solid: Solid) -> bool:
    return any(word in solid.name.lower() for word in GROUND)


def _is_below(scene: Scene, name: str, ground: Elevation, y: Ints, x: Ints) -> Flags:
    """Columns with their middle in the box around each solid of a thing, or of things in a row, seen from above."""
    if not any(solid.name.startswith(name) for solid in scene.solids):
        scene.number_of(name)
    bounds = [solid.bounds_m() for solid in scene.solids if solid.name.startswith(name)]
    low, high = np.min([b[0] for b in bounds], axis=0)[:2], np.max([b[1] for b in bounds], axis=0)[:2]
    middle = _middles(ground, y, x)
    return np.asarray(((middle >= low) & (middle <= high)).all(axis=1))
