"""Hot spots: connected warm voxels, each one thing that a person may have to look at.

    cell             -->  pieces: its connected warm voxels, and those of them that lie at its border
    pieces of cells  -->  spots: pieces whose border voxels touch are parts of one

Voxels touch by a face, an edge or a corner. The pieces of a cell depend on its evidence and the threshold alone: who
keeps them makes those of changed cells again, and joins all of them, which takes some milliseconds.

The height over the floor is that over the surfaces below the hottest voxel: among the layers of the cells around,
the lowest with at least half as many surfaces as the fullest. So it needs no storeys, and no level floor elsewhere.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np

from cairn_map.arrays import Flags, Floats, Int32s, Ints, Words32
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import (
    CELL_LIMIT,
    Cell,
    CellKey,
    Geometry,
    cell_of_key,
    centres_of_voxels,
    check_cubes,
    voxels_in_cell,
)
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds
from cairn_map.evidence.voxels import reading_of_sums
from cairn_map.queries.frozen_map import Box, FrozenMap
from cairn_map.queries.point_queries import first_of_kind, measured_at

WARM_K = 303.15
"""Threshold by default: 30 degrees Celsius, above what walls and furniture of a heated building have."""
VOXELS_MIN = 3
"""Least number of voxels of a spot by default: of fewer, most are single beams that met an edge."""
SURE_VOXELS = 4
"""Number of voxels from which on a spot is confirmed though none of them was hit twice: each then touches a surface."""
BORDER_MAX = 1 << 19
"""Most voxels at the borders of cells that are joined; twice as many would not fit the keys of `_touching`."""
STOREY_M = 3.5
"""Greatest height over a floor at which it is looked for."""
ROOM_M = 1.5
"""Least free height over a surface that may be a floor."""
FLOOR_M2 = 0.25
"""Least area of a floor in the cells that are looked at."""
AROUND_M = 1.0
"""Distance from the voxel within which the cells' surfaces count: what hangs on a wall has its floor next to it."""
HALF = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
"""Steps to 13 of the 26 neighbours, one of each two opposite ones."""
Surfaces = Mapping[Cell, Int32s]
"""`CellPieces.surfaces` of cells."""
Voxel = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """P connected sets of warm voxels: of one cell its pieces, of a map its hot spots."""

    peaks: Ints
    """(P, 3) number of the hottest voxel; of several the lowest number."""
    kelvin: Floats
    """(P,) mean of its samples, apparent temperature."""
    sigma: Floats
    """(P,) standard uncertainty of one of its samples: their spread and the camera's own."""
    weight: Ints
    """(P,) its samples."""
    counts: Ints
    """(P, 2) its hits and misses."""
    measured_s: Floats
    """(P,) time of its samples as in `Reading`; NaN: unknown."""
    hits: Ints
    """(P,) most hits of one of the voxels."""
    voxels: Ints
    """(P,) number of the voxels."""
    low: Ints
    """(P, 3) least number of the voxels along each axis."""
    high: Ints
    """(P, 3) greatest number of the voxels along each axis."""

    def __len__(self) -> int:
        return len(self.peaks)

    @property
    def confirmed(self) -> Flags:
        """(P,) True for a spot of which a voxel was hit in two scans, or that is a surface; else it may be a ghost."""
        return np.asarray((self.hits > 1) | (self.voxels >= SURE_VOXELS))

    def rows(self, rows: Ints | Flags) -> "Spots":
        """Spots in these rows alone, in this order."""
        return Spots(*(getattr(self, each.name)[rows] for each in fields(self)))

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return sum(getattr(self, each.name).nbytes for each in fields(self))


@dataclass(frozen=True, slots=True, eq=False)
class CellPieces:
    """Pieces of a cell, and its surfaces."""

    pieces: Spots
    border: Ints
    """(B, 3) numbers of the warm voxels at the cell's faces."""
    owner: Ints
    """(B,) row of the piece of each."""
    surfaces: Int32s
    """(side,) by layer, occupied voxels with a person's height above them that is not occupied."""

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return self.pieces.size_bytes + self.border.nbytes + self.owner.nbytes + self.surfaces.nbytes


def spots_of_map(frozen: FrozenMap, *, over_k: float, voxels_min: int, box_m: Box | None) -> Spots:
    """Hot spots of a frozen map, ranked.

    Raises:
        BadInputError: kind `unknown_channel`: the map has no temperatures; `bad_box`; `too_costly`; `level_layer`.
    """
    check_cubes(frozen.geometry)
    geometry, model = frozen.geometry, frozen.model
    channel = first_of_kind(geometry, ChannelKind.TEMPERATURE)
    frozen.voxels_of_box(box_m)
    cells = zip(frozen.keys, frozen.cells, strict=True)
    spots = joined_spots(pieces_of_cell(key, cell.packed(), geometry, model, over_k) for key, cell in cells)
    found = ranked_spots(spots, geometry, voxels_min=voxels_min, box_m=None if box_m is None else np.asarray(box_m))
    if frozen.times is None or not len(found):
        return found
    measured_s = measured_at(frozen, centres_of_voxels(found.peaks, geometry), channel)
    return replace(found, measured_s=measured_s)


def pieces_of_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, over_k: float
) -> CellPieces:
    """Connected voxels of a cell that are occupied and at least `over_k` warm (kelvin).

    Of the evidence only voxels with hits or samples matter.

    Raises:
        BadInputError: kind `unknown_channel`: the map has no temperatures.
    """
    channel = first_of_kind(geometry, ChannelKind.TEMPERATURE)
    occupied = _occupied(evidence, model)
    surfaces = _surfaces(key, evidence.voxels[occupied], geometry)
    sums = evidence.samples[:, geometry.planes_of(channel.name)]
    reading = reading_of_sums(channel, sums)
    # A mean without samples is NaN, which is not above any number.
    (rows,) = np.nonzero(occupied[evidence.sampled] & (reading.mean >= over_k))
    numbers = voxels_in_cell(evidence.voxels[evidence.sampled[rows]], key, geometry)
    counts = evidence.counts[evidence.sampled[rows]].astype(np.int64)
    assert reading.sigma is not None  # noqa: S101 - of temperatures it is there
    measured_s = np.full(len(rows), np.nan)
    if evidence.measured_s is not None:
        measured_s = evidence.measured_s[rows, geometry.channels.index(channel)]
    single = Spots(
        numbers,
        reading.mean[rows],
        reading.sigma[rows],
        reading.weight[rows],
        counts,
        measured_s,
        counts[:, 0],
        np.ones(len(rows), np.int64),
        numbers,
        numbers,
    )
    of_row, pieces = _joined(single, _components(len(rows), *_touching(numbers)))
    local = numbers % geometry.side
    at_border = ((local == 0) | (local == geometry.side - 1)).any(axis=1)
    return CellPieces(pieces, numbers[at_border], of_row[at_border], surfaces)


def joined_spots(cells: Iterable[CellPieces]) -> Spots:
    """Hot spots of a map, from the pieces of its cells, which must all be of the same threshold; in no order.

    Raises:
        BadInputError: kind `too_costly`: too many warm voxels lie at borders of cells.
    """
    found = [cell for cell in cells if len(cell.pieces)]
    if not found:
        return NO_SPOTS
    firsts = np.cumsum([0, *(len(cell.pieces) for cell in found)])
    border = np.concatenate([cell.border for cell in found])
    if len(border) > BORDER_MAX:
        raise BadInputError(
            "too_costly",
            f"{len(border)} warm voxels lie at borders of cells, more than {BORDER_MAX}: ask for a higher temperature",
        )
    owner = np.concatenate([cell.owner + first for cell, first in zip(found, firsts[:-1], strict=True)])
    pieces = Spots(*(np.concatenate([getattr(cell.pieces, each.name) for cell in found]) for each in fields(Spots)))
    a, b = _touching(border)
    return _joined(pieces, _components(len(pieces), owner[a], owner[b]))[1]


def ranked_spots(
    spots: Spots, geometry: Geometry, *, voxels_min: int, box_m: Sequence[Floats] | Floats | None
) -> Spots:
    """Spots of so many voxels whose hottest one's centre lies in a box (lowest, highest corner), ends included.

    Confirmed ones come first, then the others, each hottest first.
    """
    keep = spots.voxels >= voxels_min
    if box_m is not None:
        centres_m = centres_of_voxels(spots.peaks, geometry)
        keep &= ((centres_m >= box_m[0]) & (centres_m <= box_m[1])).all(axis=1)
    kept = spots.rows(keep)
    x, y, z = kept.peaks.T
    return kept.rows(np.lexsort((z, y, x, -kept.kelvin, ~kept.confirmed)))


def cells_over_floor(peak: Voxel, geometry: Geometry) -> list[Cell]:
    """Cells in which the floor below a voxel may be: those within a metre around it, and those below that are near."""
    reach = math.ceil(AROUND_M / geometry.voxel_edge_m)
    storey = math.floor(STOREY_M / geometry.voxel_edge_m)
    low = [peak[0] - reach, peak[1] - reach, max(peak[2] - storey, (peak[2] >> geometry.depth) * geometry.side - 1)]
    high = [peak[0] + reach, peak[1] + reach, peak[2]]
    ranges = (range(a >> geometry.depth, (b >> geometry.depth) + 1) for a, b in zip(low, high, strict=True))
    return [Cell(*each) for each in product(*ranges) if all(-CELL_LIMIT <= n < CELL_LIMIT for n in each)]


def over_floor_m(peak: Voxel, surfaces: Surfaces, geometry: Geometry) -> float | None:
    """Height of a voxel's centre over the floor below it, metres; None: no floor is known there.

    Args:
        peak: its number.
        surfaces: of `cells_over_floor`, as far as they are known; others do no harm.
        geometry: the map's.
    """
    k = peak[2] >> geometry.depth
    layers = np.zeros(2 * geometry.side, np.int64)
    for cell in cells_over_floor(peak, geometry):
        if cell in surfaces:
            first = (cell.k - k + 1) * geometry.side
            layers[first : first + geometry.side] += surfaces[cell]
    last = peak[2] - (k - 1) * geometry.side
    first = max(0, last - math.floor(STOREY_M / geometry.voxel_edge_m))
    near = layers[first : last + 1]
    if near.max() * geometry.voxel_edge_m**2 < FLOOR_M2:
        return None
    floor = first + int(np.argmax(2 * near >= near.max()))
    return max(0.0, round((last - floor - 0.5) * geometry.voxel_edge_m, 6))


def _occupied(evidence: Evidence, model: SensorModel) -> Flags:
    """`Evidence.occupied`, of which the many voxels that were only seen through are left out first."""
    if model.p_occupied < 0.5:
        return evidence.occupied(model)
    # Only hits raise the log-odds, and those of an occupied voxel are above 0.
    (rows,) = np.nonzero(evidence.counts[:, 0])
    found = np.zeros(len(evidence), np.bool_)
    found[rows] = evidence.log_odds(model, rows=rows) > log_odds(model.p_occupied)
    return found


def _surfaces(key: CellKey, places: Words32, geometry: Geometry) -> Int32s:
    """(side,) occupied voxels by layer over which no other one is within a person's height."""
    x, y, z = (voxels_in_cell(places, key, geometry) - np.array(cell_of_key(key)) * geometry.side).T
    order = np.lexsort((z, y, x))
    column, height = (x * geometry.side + y)[order], z[order]
    is_top = np.ones(len(order), np.bool_)
    is_top[:-1] = (column[1:] != column[:-1]) | ((height[1:] - height[:-1]) * geometry.voxel_edge_m > ROOM_M)
    return np.bincount(height[is_top], minlength=geometry.side).astype(np.int32)


def _touching(numbers: Ints) -> tuple[Ints, Ints]:
    """Rows of all pairs of (N, 3) distinct voxels that touch, each pair once."""
    # Along each axis gaps are closed to two, so that three numbers fit one of 63 bits, however far apart voxels are.
    x, y, z = (_without_gaps(numbers[:, axis]) for axis in range(3))
    keys = (x << 42) | (y << 21) | z
    order = np.argsort(keys)
    rising = keys[order]
    pairs: list[tuple[Ints, Ints]] = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for dx, dy, dz in HALF:
        wanted = rising + (dx * (1 << 42) + dy * (1 << 21) + dz)
        at = np.minimum(np.searchsorted(rising, wanted), max(len(rising) - 1, 0))
        (there,) = np.nonzero(rising[at] == wanted) if len(rising) else (np.empty(0, np.int64),)
        pairs.append((order[there], order[at[there]]))
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return a, b


def _without_gaps(values: Ints) -> Ints:
    """(N,) numbers from 1 on of which two differ by one exactly if the values do, and rise as they do."""
    there, of_row = np.unique(values, return_inverse=True)
    return np.concatenate([[1], 1 + np.cumsum(np.minimum(np.diff(there), 2))]).astype(np.int64)[of_row]


def _components(count: int, a: Ints, b: Ints) -> Ints:
    """(count,) least row that each row is connected with, by pairs of rows."""
    root = np.arange(count)
    while True:
        # Of two roots that touch, the higher one is hung under the lower; then all rows are put under their roots.
        low, high = np.minimum(root[a], root[b]), np.maximum(root[a], root[b])
        apart = low != high
        if not apart.any():
            return root
        np.minimum.at(root, high[apart], low[apart])
        while (root[root] != root).any():
            root = root[root]


def _joined(parts: Spots, root: Ints) -> tuple[Ints, Spots]:
    """Sets that are connected as one, and the row in them of each of the parts; `root` as `_components`."""
    _, of_row = np.unique(root, return_inverse=True)
    x, y, z = parts.peaks.T
    order = np.lexsort((z, y, x, -parts.kelvin, of_row))
    starts = np.nonzero(np.diff(of_row[order], prepend=-1))[0]
    sorted_parts = parts.rows(order)
    if not len(order):
        return of_row, parts
    peak = sorted_parts.rows(starts)
    return of_row, Spots(
        peak.peaks,
        peak.kelvin,
        peak.sigma,
        peak.weight,
        peak.counts,
        peak.measured_s,
        np.maximum.reduceat(sorted_parts.hits, starts),
        np.add.reduceat(sorted_parts.voxels, starts),
        np.minimum.reduceat(sorted_parts.low, starts),
        np.maximum.reduceat(sorted_parts.high, starts),
    )


_NONE = np.empty(0, np.int64)
NO_SPOTS = Spots(
    np.empty((0, 3), np.int64),
    np.empty(0),
    np.empty(0),
    _NONE,
    np.empty((0, 2), np.int64),
    np.empty(0),
    _NONE,
    _NONE,
    np.empty((0, 3), np.int64),
    np.empty((0, 3), np.int64),
)
"""Spots of a map without warm voxels."""
