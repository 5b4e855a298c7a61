"""Scores of a map against `truth_grid`: counts of voxels that add up over cells, and their ratios.

    recall             surface voxels that the map calls occupied; the rest was carved away, or is unknown
    recall of free     free voxels that the map calls free
    false free         voxels that the map calls free and that hold some solid: any at all, or half of them
    precision          voxels that the map calls occupied and that have a solid or a surface at most one voxel away

Occupied is log-odds above 0, free is below. Occupied voxels without solid are no fault in themselves: noise of 5 mm
puts one in three hits of a 4 cm grid into the voxel in front of the wall.
"""

import math
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import Diff
from cairn_map.evidence.grid import Geometry, cell_key, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.truth_grid import HALF_SOLID, Truth, TruthClass, VoxelBox

States = npt.NDArray[np.int8]

FREE, UNKNOWN, OCCUPIED = -1, 0, 1
"""State of a map's voxel: the sign of its log-odds."""
VOXELS_AT_ONCE = 1 << 20
"""Voxels of a cell's evidence scored at once; bounds the memory to some 50 MB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Voxels of one box or, added, of several."""

    surface: int = 0
    """Surface voxels of the truth."""
    surface_occupied: int = 0
    """Surface voxels that the map calls occupied."""
    surface_free: int = 0
    """And free: carved away."""
    free: int = 0
    """Free voxels of the truth."""
    free_free: int = 0
    free_occupied: int = 0
    map_free: int = 0
    map_free_touching: int = 0
    """Free voxels of the map with any of the 64 samples in a solid."""
    map_free_half_solid: int = 0
    """With at least half of them."""
    map_occupied: int = 0
    map_occupied_empty: int = 0
    """Occupied voxels of the map without a sample in a solid."""
    map_occupied_near: int = 0
    """Those that are, or have as one of 26 neighbours, a voxel that touches a solid or is surface."""

    def __add__(self, other: "Scores") -> "Scores":
        return Scores(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    @property
    def surface_unknown(self) -> int:
        """Surface voxels of which the map knows nothing."""
        return self.surface - self.surface_occupied - self.surface_free

    @property
    def free_unknown(self) -> int:
        """Free voxels of which the map knows nothing."""
        return self.free - self.free_free - self.free_occupied

    @property
    def recall(self) -> float:
        """Share of the surface that the map calls occupied; this and all ratios 0 to 1, NaN for 0 of 0."""
        return _ratio(self.surface_occupied, self.surface)

    @property
    def carved(self) -> float:
        """Share of the surface that the map calls free."""
        return _ratio(self.surface_free, self.surface)

    @property
    def unknown(self) -> float:
        """Share of the surface that is unknown in the map."""
        return _ratio(self.surface_unknown, self.surface)

    @property
    def recall_free(self) -> float:
        """Share of the free voxels that the map calls free."""
        return _ratio(self.free_free, self.free)

    @property
    def false_free(self) -> float:
        """Share of the map's free voxels that touch a solid."""
        return _ratio(self.map_free_touching, self.map_free)

    @property
    def false_free_half(self) -> float:
        """Share of the map's free voxels that are at least half solid."""
        return _ratio(self.map_free_half_solid, self.map_free)

    @property
    def occupied_empty(self) -> float:
        """Share of the map's occupied voxels without solid."""
        return _ratio(self.map_occupied_empty, self.map_occupied)

    @property
    def precision(self) -> float:
        """Share of the map's occupied voxels at most one voxel from a solid or a surface."""
        return _ratio(self.map_occupied_near, self.map_occupied)

    def __str__(self) -> str:
        return (
            f"recall {self.recall:.1%}, carved {self.carved:.1%}, unknown {self.unknown:.1%} of {self.surface}; "
            f"recall of free {self.recall_free:.1%} of {self.free}; "
            f"false free {self.false_free:.2%} (half solid {self.false_free_half:.2%}) of {self.map_free}; "
            f"precision {self.precision:.1%} (without solid {self.occupied_empty:.1%}) of {self.map_occupied}"
        )


def scores_of(truth: Truth, diff: Diff, geometry: Geometry, *, model: SensorModel | None = None) -> Scores:
    """Scores of a map's evidence in one box against the truth.

    Args:
        truth: of a box on the map's grid.
        diff: the map's evidence by cell, `EvidenceMap.packed()`; cells that are not there are unknown.
        geometry: of the map.
        model: what its counts mean; the default where none is given.

    Raises:
        BadInputError: kind `bad_geometry`: the voxels differ in size.
    """
    return scores_from(truth, map_states(truth.box, diff, geometry, model=model or SensorModel()))


def scores_from(truth: Truth, states: States) -> Scores:
    """Scores of (X, Y, Z) states of a box's voxels, FREE, UNKNOWN or OCCUPIED, against the truth."""
    occupied, free = states == OCCUPIED, states == FREE
    surface, open_space = truth.classes == TruthClass.SURFACE, truth.classes == TruthClass.FREE
    return Scores(
        surface=_count(surface),
        surface_occupied=_count(surface & occupied),
        surface_free=_count(surface & free),
        free=_count(open_space),
        free_free=_count(open_space & free),
        free_occupied=_count(open_space & occupied),
        map_free=_count(free),
        map_free_touching=_count(free & (truth.solid_samples > 0)),
        map_free_half_solid=_count(free & (truth.solid_samples >= HALF_SOLID)),
        map_occupied=_count(occupied),
        map_occupied_empty=_count(occupied & (truth.solid_samples == 0)),
        map_occupied_near=_count(occupied & truth.near_solid),
    )


def map_states(box: VoxelBox, diff: Diff, geometry: Geometry, *, model: SensorModel) -> States:
    """(X, Y, Z) FREE, UNKNOWN or OCCUPIED: what a map says of each voxel of a box.

    Raises:
        BadInputError: kind `bad_geometry`: the voxels differ in size.
    """
    if box.voxel_edge_um != geometry.voxel_edge_um:
        raise BadInputError(
            "bad_geometry",
            f"the map's voxels are {geometry.voxel_edge_um} um, those of the box {box.voxel_edge_um} um",
        )
    states = np.full(box.shape, UNKNOWN, np.int8)
    low, shape = np.array(box.low, dtype=np.int64), np.array(box.shape, dtype=np.int64)
    first, last = low >> geometry.depth, (low + shape - 1) >> geometry.depth
    for i, j, k in product(*(range(a, b + 1) for a, b in zip(first.tolist(), last.tolist(), strict=True))):
        key = cell_key((i, j, k))
        if key not in diff:
            continue
        evidence = diff[key]
        for start in range(0, len(evidence), VOXELS_AT_ONCE):
            part = slice(start, start + VOXELS_AT_ONCE)
            at = voxels_in_cell(evidence.voxels[part], key, geometry) - low
            inside = ((at >= 0) & (at < shape)).all(axis=1)
            x, y, z = at[inside].T
            states[x, y, z] = np.sign(model.log_odds(evidence.counts[part][inside]))
    return states


def _count(flags: npt.NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(flags))


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
