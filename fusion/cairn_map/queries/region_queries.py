"""Queries of whole regions: layers, height maps, the frontier to the unknown, the hottest voxels, voxels of a box."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Cell, CellKey, centres_of_voxels, check_cubes, voxels_in_cell
from cairn_map.evidence.voxels import Voxels, joined_voxels, voxels_of_evidence
from cairn_map.queries import layer_kernels, point_queries
from cairn_map.queries import layer_kernels as kernels
from cairn_map.queries.frozen_map import Box, FrozenMap
from cairn_map.queries.level.elevation import PIXELS_MAX as ELEVATION_PIXELS_MAX
from cairn_map.queries.level.elevation import Elevation, elevation_of
from cairn_map.queries.occupancy_kernels import list_bits_into
from cairn_map.queries.occupancy_states import State
from cairn_map.queries.point_queries import first_of_kind

PIXELS_MAX = 1 << 26
"""Pixels of an image, at most: cells may lie anywhere, and the box of all of them may be as large as a country."""
NO_TOP = np.iinfo(np.int64).min
"""Height of a column without an occupied voxel."""
AROUND = np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)])
"""(26, 3) steps from a voxel to its neighbours."""
SURFACE_NEIGHBOURS = 3
"""Occupied neighbours of a voxel on a surface, at least: a plane gives 8, its corner 3, a streak of ghosts 2."""
CONFIRMED_AT_ONCE = 1024
"""Voxels whose neighbours are looked up at the same time."""
Values = npt.NDArray[np.number]


@dataclass(frozen=True, slots=True, eq=False)
class MapImage:
    """A map from above: a pixel is a voxel wide, rows go along y and columns along x."""

    values: Values
    """(H, W), or (H, W, 3) for colours."""
    origin_m: tuple[float, float]
    """x, y of the centre of the pixel [0, 0], metres, map frame."""
    edge_m: float
    """Edge of a pixel, metres."""


def layer(frozen: FrozenMap, z_m: float, what: str, box_m: Box | None) -> MapImage:
    """One horizontal layer: `state`, `probability`, `log_odds` or the mean of a channel."""
    if not abs(z_m) < frozen.reach_m:
        raise BadInputError("point_range", f"the height must be finite and within {frozen.reach_m:.0f} m, got {z_m}")
    ask = _question(frozen, what)
    low, high = frozen.voxels_of_box(box_m)
    check_pixels(low, high)
    x, y = (pixel_centres(low[axis], high[axis], frozen.geometry.voxel_edge_um) for axis in (0, 1))
    return _image(frozen, plane_values(x, y, z_m, ask), low)


def plane_values(x: Floats, y: Floats, z_m: float, ask: Callable[[Floats], Values]) -> Values:
    """(H, W) answers, or (H, W, 3), at a height over W places along x and H along y, some rows of them at a time."""
    rows_at_once = max(1, point_queries.CHUNK // max(len(x), 1))
    parts: list[Values] = []
    for start in range(0, max(len(y), 1), rows_at_once):
        at_y, at_x = np.meshgrid(y[start : start + rows_at_once], x, indexing="ij")
        values = ask(np.stack([at_x.ravel(), at_y.ravel(), np.full(at_x.size, z_m)], axis=1))
        parts.append(values.reshape(*at_x.shape, *values.shape[1:]))
    return np.concatenate(parts)


def height_map(frozen: FrozenMap, box_m: Box | None) -> MapImage:
    """The height of each column's highest occupied voxel's upper face; NaN where there is none."""
    low, high = frozen.voxels_of_box(box_m)
    check_pixels(low, high)
    tops = np.full((high[1] - low[1], high[0] - low[0]), NO_TOP)
    kernels.tops_into(frozen.grid, frozen.brick_corners(), low, high, tops)
    heights = np.where(tops == NO_TOP, np.nan, (tops + 1) * frozen.geometry.voxel_height_m)
    return _image(frozen, heights, low)


def elevation(frozen: FrozenMap, box_m: Box | None, clearance_m: float) -> Elevation:
    """The surface of a level layer, over the columns of a box."""
    low, high = frozen.voxels_of_box(box_m)
    check_pixels(low, high, most=ELEVATION_PIXELS_MAX)
    side = frozen.geometry.side
    cells = (
        (frozen.keys[slot], frozen.cells[slot].packed())
        for slot, first in enumerate(frozen.grid.cells * side)
        if (first < high).all() and (first + side > low).all()
    )
    return elevation_of(cells, frozen.geometry, frozen.model, low=low, high=high, clearance_m=clearance_m)


def _question(frozen: FrozenMap, what: str) -> Callable[[Floats], Values]:
    match what:
        case "state":
            return lambda points: point_queries.states_at(frozen, points)
        case "probability":
            return lambda points: point_queries.probability_at(frozen, points)
        case "log_odds":
            return lambda points: point_queries.log_odds_at(frozen, points)
    channel = point_queries.channel_named(frozen, what)
    return lambda points: point_queries.reading_at(frozen, points, channel).mean


def check_pixels(low: Ints, high: Ints, *, most: int = PIXELS_MAX) -> None:
    """Refuse images, of voxels from `low` up to `high`, that are larger than an image may be.

    Raises:
        BadInputError: kind `too_large`.
    """
    pixels = int(high[0] - low[0]) * int(high[1] - low[1])
    if pixels > most:
        raise BadInputError("too_large", f"an image has at most {most} pixels, not {pixels}; give a smaller box")


def pixel_centres(first: int, end: int, edge_um: int) -> Floats:
    """Centres along one axis of the pixels from `first` up to `end`, metres."""
    return np.asarray((2 * np.arange(first, end) + 1) * (edge_um / 2e6), dtype=np.float64)


def _image(frozen: FrozenMap, values: Values, low: npt.NDArray[np.int64]) -> MapImage:
    x, y, _ = centres_of_voxels(low, frozen.geometry)
    return MapImage(values, (float(x), float(y)), frozen.geometry.voxel_edge_m)


def frontier(frozen: FrozenMap, box_m: Box | None) -> Ints:
    """(M, 3) numbers of the free voxels of which a face borders on an unknown one.

    Raises:
        BadInputError: kind `level_layer`.
    """
    check_cubes(frozen.geometry)
    low, high = frozen.voxels_of_box(box_m)
    corners = frozen.brick_corners()
    bits = np.empty((len(corners), 8), np.uint64)
    found = np.empty((layer_kernels.frontier_into(frozen.grid, corners, bits), 3), np.int64)
    list_bits_into(bits, corners, found)
    return found if box_m is None else found[_are_within(found, low, high)]


def frontier_cells(frozen: FrozenMap, box_m: Box | None) -> dict[Cell, int]:
    """Cells with frontier voxels, and how many each has.

    Raises:
        BadInputError: kind `level_layer`.
    """
    cells, counts = np.unique(frontier(frozen, box_m) >> frozen.geometry.depth, axis=0, return_counts=True)
    return {Cell(*cell): count for cell, count in zip(cells.tolist(), counts.tolist(), strict=True)}


def voxels_in_box(frozen: FrozenMap, box_m: Box | None, *, occupied_only: bool) -> Voxels:
    """The voxels with evidence whose centres lie in a box."""
    low, high = frozen.voxels_of_box(box_m)
    side = frozen.geometry.side
    parts = []
    for slot, first in enumerate(frozen.grid.cells * side):
        if (first < high).all() and (first + side > low).all():
            key = frozen.keys[slot]
            evidence = frozen.cells[slot].packed()
            numbers = voxels_in_cell(evidence.voxels, key, frozen.geometry)
            part = evidence.where(_are_within(numbers, low, high))
            parts.append(_voxels(frozen, key, part, occupied_only=occupied_only))
    return joined_voxels(parts or [_voxels(frozen, CellKey(0), empty_evidence(frozen.geometry), occupied_only=False)])


def hottest(frozen: FrozenMap, n: int, *, min_probability: float, box_m: Box | None) -> Voxels:
    """The n known voxels of the highest mean temperature: first those that are confirmed, each group hottest first."""
    return ranked_hottest(frozen, n, min_probability=min_probability, box_m=box_m)[0]


def ranked_hottest(
    frozen: FrozenMap, n: int, *, min_probability: float, box_m: Box | None, only: CellKey | None = None
) -> tuple[Voxels, npt.NDArray[np.bool_]]:
    """`hottest`, of one cell where it is named, and (N,) True for those that are confirmed."""
    if n < 0 or not 0 <= min_probability <= 1:
        raise BadInputError("bad_range", f"n must be 0 or more, a probability 0 to 1; got {n}, {min_probability}")
    channel = first_of_kind(frozen.geometry, ChannelKind.TEMPERATURE)
    planes = frozen.geometry.planes_of(channel.name)
    low, high = frozen.voxels_of_box(box_m)
    parts, confirmed = [], [np.empty(0, np.bool_)]
    for key, cell in zip(frozen.keys, frozen.cells, strict=True):
        if only not in (None, key):
            continue
        # Rows of samples that are asked for, hottest first.
        evidence = cell.packed()
        sums, counts = evidence.samples[:, planes], evidence.counts[evidence.sampled]
        numbers = voxels_in_cell(evidence.voxels[evidence.sampled], key, frozen.geometry)
        # An unknown voxel's probability is NaN, and NaN is not above any number.
        likely = evidence.probability(frozen.model, rows=evidence.sampled) >= min_probability
        (rows,) = np.nonzero((sums[:, -1] > 0) & likely & _are_within(numbers, low, high))
        rows = rows[np.argsort(-sums[rows, 0] / sums[rows, -1], kind="stable")]
        # The first n of both groups, in the order of the cell's voxels.
        sure, doubtful = _first_confirmed(frozen, numbers[rows], counts[rows, 0], n)
        is_sure, chosen = np.zeros((2, len(evidence)), np.bool_)
        is_sure[evidence.sampled[rows[sure]]] = True
        chosen[evidence.sampled[rows[np.concatenate([sure, doubtful])]]] = True
        parts.append(_voxels(frozen, key, evidence.where(chosen), occupied_only=False))
        confirmed.append(is_sure[chosen])
    voxels = joined_voxels(parts or [_voxels(frozen, CellKey(0), empty_evidence(frozen.geometry), occupied_only=False)])
    kelvin, are_sure = voxels.readings[channel.name].mean, np.concatenate(confirmed)
    first = np.lexsort((-kelvin, ~are_sure))[:n]
    return voxels.rows(first), are_sure[first]


def _first_confirmed(frozen: FrozenMap, numbers: Ints, hits: Values, n: int) -> tuple[Ints, Ints]:
    """Rows of the first n voxels that are confirmed, and of the first n that are not, among at least as many rows.

    A voxel is confirmed that was hit in two scans, or that touches a surface. A beam that ends on an edge leaves a
    ghost behind it: one hit, and no surface around.
    """
    sure, doubtful = np.empty(0, np.int64), np.empty(0, np.int64)
    for start in range(0, len(numbers), CONFIRMED_AT_ONCE):
        if len(sure) >= n:
            break
        some = numbers[start : start + CONFIRMED_AT_ONCE]
        is_sure = hits[start : start + CONFIRMED_AT_ONCE] > 1
        is_sure[~is_sure] = _touch_surface(frozen, some[~is_sure])
        sure = np.concatenate([sure, start + np.nonzero(is_sure)[0]])
        doubtful = np.concatenate([doubtful, start + np.nonzero(~is_sure)[0]])[:n]
    return sure[:n], doubtful


def _touch_surface(frozen: FrozenMap, numbers: Ints) -> npt.NDArray[np.bool_]:
    """(N,) True for voxels with at least three occupied ones among their 26 neighbours."""
    neighbours = (numbers[:, None] + AROUND).reshape(-1, 3)
    reach_m = frozen.reach_m - frozen.geometry.voxel_edge_m
    points = np.clip(centres_of_voxels(neighbours, frozen.geometry), -reach_m, reach_m)
    occupied = point_queries.states_at(frozen, points) == State.OCCUPIED
    return np.asarray(occupied.reshape(-1, len(AROUND)).sum(axis=1) >= SURFACE_NEIGHBOURS)


def _voxels(frozen: FrozenMap, key: CellKey, evidence: Evidence, *, occupied_only: bool) -> Voxels:
    return voxels_of_evidence(key, evidence, frozen.geometry, frozen.model, occupied_only=occupied_only)


def _are_within(numbers: Ints, low: Ints, high: Ints) -> npt.NDArray[np.bool_]:
    return np.asarray(((numbers >= low) & (numbers < high)).all(axis=1))
