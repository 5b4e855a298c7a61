"""Point queries: states, counts, probabilities and the readings of channels at given points.

Points are worked on in chunks, so that the memory needed besides the result is bounded.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, known, log_odds
from cairn_map.evidence.voxels import Reading, joined_readings, reading_of_sums
from cairn_map.queries import point_kernels as kernels
from cairn_map.queries.frozen_map import FrozenMap, as_points, check_within
from cairn_map.queries.occupancy_states import odds_of_counts

CHUNK = 1 << 17
"""Points of a chunk."""
Located = tuple[slice, int, npt.NDArray[np.int32], npt.NDArray[np.uint32]]


def states_at(frozen: FrozenMap, points_m: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """(N,) `State` of the voxels that hold (N, 3) points."""
    points = frozen.on_lattice(as_points(points_m, "points"))
    states = np.empty(len(points), np.uint8)
    check_within(kernels.states_into(frozen.grid, points, frozen.reach_m, states), frozen)
    return states


def counts_at(frozen: FrozenMap, points_m: npt.ArrayLike) -> npt.NDArray[np.int32]:
    """(N, 2) hits and misses of the voxels that hold (N, 3) points; zeros where unknown."""
    points = frozen.on_lattice(as_points(points_m, "points"))
    counts = np.zeros((len(points), 2), np.int32)
    for part, slot, rows, places in _located(frozen, points):
        sums = frozen.bricks(slot).counts
        kernels.counts_into(rows, places, sums.brick_of, sums.pool, counts[part])
    return counts


def log_odds_at(frozen: FrozenMap, points_m: npt.ArrayLike) -> Floats:
    """(N,) clamped log-odds of the voxels that hold (N, 3) points; NaN where unknown."""
    points, model = frozen.on_lattice(as_points(points_m, "points")), frozen.model
    odds = np.full(len(points), np.nan)
    clamps = log_odds(model.p_min), log_odds(model.p_max)
    bounds = log_odds(model.p_occupied), *clamps
    for part, slot, rows, places in _located(frozen, points):
        cell = frozen.bricks(slot)
        bricks, pool = cell.counts.brick_of, cell.counts.pool
        if cell.odds is not None:
            cell.odds.check_model(model)
            kernels.read_odds_into(rows, places, bricks, pool, cell.odds.steps, LOG_ODDS_STEP, *bounds, odds[part])
        elif pool.dtype == np.int16:
            tables = odds_of_counts(model)  # pyright: ignore[reportArgumentType]
            kernels.log_odds_into(rows, places, bricks, pool, *tables, *clamps, odds[part])
        else:
            counts = pool[bricks[places[rows] >> 9], places[rows] & 511].astype(np.int32)
            odds[part][rows] = np.where(known(counts), model.log_odds(counts), np.nan)
    return odds


def probability_at(frozen: FrozenMap, points_m: npt.ArrayLike) -> Floats:
    """(N,) probability of occupancy of the voxels that hold (N, 3) points; NaN where unknown."""
    # P = 1 / (1 + exp(-L)), in place.
    probability = log_odds_at(frozen, points_m)
    np.negative(probability, out=probability)
    np.exp(probability, out=probability)
    probability += 1
    np.divide(1, probability, out=probability)
    return probability


def reading_at(frozen: FrozenMap, points_m: npt.ArrayLike, channel: Channel) -> Reading:
    """Reading of one channel at (N, 3) points."""
    points = as_points(points_m, "points")
    if channel.kind is ChannelKind.CLASSES and len(points) > CHUNK:
        # Up to 64 sums a point: chunk by chunk, lest they take more memory than the map.
        starts = range(0, len(points), CHUNK)
        return joined_readings([reading_at(frozen, points[start : start + CHUNK], channel) for start in starts])
    points = frozen.on_lattice(points)
    planes = frozen.geometry.planes_of(channel.name)
    sums = np.zeros((len(points), planes.stop - planes.start), np.int64)
    for part, slot, rows, places in _located(frozen, points):
        kernels.samples_into(rows, places, *frozen.bricks(slot).samples.rows, planes.start, sums[part])
    return reading_of_sums(channel, sums)


def seen_at(frozen: FrozenMap, points_m: npt.ArrayLike) -> Floats:
    """(N,) times, UTC seconds since 1970, at which the voxels that hold (N, 3) points were seen last; NaN if never."""
    points = frozen.on_lattice(as_points(points_m, "points"))
    seen_s = np.full(len(points), np.nan)
    for part, slot, rows, places in _located(frozen, points):
        if frozen.times is not None:
            seen_s[part][rows] = frozen.times.seen(frozen.keys[slot], places[rows])
    return seen_s


def measured_at(frozen: FrozenMap, points_m: npt.ArrayLike, channel: Channel) -> Floats:
    """(N,) times, UTC seconds since 1970, of the newest samples of which `reading_at` is made; NaN where unknown."""
    points = frozen.on_lattice(as_points(points_m, "points"))
    column = frozen.geometry.channels.index(channel)
    measured_s = np.full(len(points), np.nan)
    for part, slot, rows, places in _located(frozen, points):
        if frozen.times is not None:
            times = frozen.times.measured(frozen.keys[slot], places[rows], frozen.model)
            measured_s[part][rows] = times[:, column]
    return measured_s


def channel_named(frozen: FrozenMap, name: str) -> Channel:
    """The map's channel of a name.

    Raises:
        BadInputError: kind `unknown_channel`: the map has none of that name.
    """
    channel = frozen.geometry.channel(name)
    if channel is None:
        names = [channel.name for channel in frozen.geometry.channels]
        raise BadInputError("unknown_channel", f"map has no channel {name!r}; it has {names}")
    return channel


def first_of_kind(geometry: Geometry, kind: ChannelKind) -> Channel:
    """The map's first channel of a kind.

    Raises:
        BadInputError: kind `unknown_channel`: the map has none.
    """
    found = next((channel for channel in geometry.channels if channel.kind is kind), None)
    if found is None:
        raise BadInputError("unknown_channel", f"this map has no channel of kind {kind}")
    return found


def _located(frozen: FrozenMap, points: Floats) -> Iterator[Located]:
    """For each chunk and each cell with points in its bricks: the chunk, the slot, rows in the chunk, and places."""
    starts = np.empty(len(frozen.cells) + 1, np.int64)
    for start in range(0, len(points), CHUNK):
        part = slice(start, min(start + CHUNK, len(points)))
        N = part.stop - start
        slots, places, order = np.empty(N, np.int32), np.empty(N, np.uint32), np.empty(N, np.int32)
        check_within(kernels.locate_into(frozen.grid, points[part], frozen.reach_m, slots, places), frozen)
        kernels.group_into(slots, starts, order)
        for slot in np.nonzero(starts[1:] != starts[:-1])[0].tolist():
            yield part, slot, order[starts[slot] : starts[slot + 1]], places
