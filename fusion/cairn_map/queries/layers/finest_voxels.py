"""Finest voxels: sets of voxels of several layers in which no place is shown twice, and no obstacle vanishes.

    voxel of a coarser layer    gives way where a finer layer knows all of it
    one that is occupied        gives way, too, where a finer layer has an occupied voxel in it

A finer layer that saw a part of an occupied voxel as free says nothing of the rest, so the voxel stays. A voxel lies in
that coarser one which holds its centre.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cairn_map.arrays import Ints
from cairn_map.evidence.channels import Channel
from cairn_map.evidence.grid import BRICK_DEPTH
from cairn_map.evidence.voxels import Reading, Voxels, joined_voxels
from cairn_map.queries import point_queries, region_queries
from cairn_map.queries.frozen_map import Box, FrozenMap
from cairn_map.queries.layers.finest_kernels import clear_met_into, clear_whole_into
from cairn_map.queries.occupancy_states import State

BRICK_SIDE = 1 << BRICK_DEPTH


def finest_states(layers: Mapping[str, FrozenMap], box_m: Box | None) -> dict[str, FrozenMap]:
    """The layers, each without the voxels that give way to finer ones: these are unknown in its grid.

    Args:
        layers: by name, the finest first.
        box_m: where they give way, at least; None: everywhere.

    Returns:
        The same, of which `grid` alone may differ: cells, and so counts and readings, are those of the layer.

    Raises:
        BadInputError: as `FrozenMap.voxels_of_box`.
    """
    found: dict[str, FrozenMap] = {}
    finer: list[FrozenMap] = []
    for name, frozen in layers.items():
        found[name] = _without_shown(frozen, finer, box_m) if finer else frozen
        finer.append(frozen)
    return found


def voxels_by_layer(finest: Mapping[str, FrozenMap], box_m: Box | None, *, occupied_only: bool) -> dict[str, Voxels]:
    """The voxels of `finest_states` whose centres lie in a box, by layer."""
    found = {}
    for name, frozen in finest.items():
        voxels = region_queries.voxels_in_box(frozen, box_m, occupied_only=occupied_only)
        states = point_queries.states_at(frozen, voxels.centres_m)
        found[name] = voxels.rows(np.nonzero(states != State.UNKNOWN)[0])
    return found


def joined_layers(parts: Sequence[Voxels]) -> Voxels:
    """Voxels of several layers as one table: a layer has no samples of a channel that it lacks.

    A channel of the same name is left out of a layer where it has another kind, unit or list of classes than in the
    first layer that has one. `numbers` are each of their layer's own grid.

    Args:
        parts: one for each layer, at least one.
    """
    known: dict[str, Reading] = {}
    for part in parts:
        for name, reading in part.readings.items():
            known.setdefault(name, reading)
    has_times = any(reading.measured_s is not None for part in parts for reading in part.readings.values())
    return joined_voxels([_with_readings(part, known, has_times=has_times) for part in parts])


def are_alike(one: Channel, other: Channel) -> bool:
    """True if two layers' readings of these channels can stand in one column."""
    return (one.kind, one.unit, one.classes) == (other.kind, other.unit, other.classes)


def _with_readings(part: Voxels, known: Mapping[str, Reading], *, has_times: bool) -> Voxels:
    readings = {}
    for name, pattern in known.items():
        found = part.readings.get(name)
        if found is None or not are_alike(found.channel, pattern.channel):
            found = _no_samples(pattern, len(part))
        # Of a map some layers have epochs and some have none: a time that is unknown is NaN, so columns are as long.
        if found.measured_s is None and has_times:
            found = replace(found, measured_s=np.full(len(part), np.nan))
        readings[name] = found
    return replace(part, readings=readings)


def _no_samples(pattern: Reading, N: int) -> Reading:
    """Reading of N voxels that have no samples, in the columns of another one."""
    mean = np.full((N, *pattern.mean.shape[1:]), np.nan)
    spread = None if pattern.spread is None else np.full(N, np.nan)
    unsure = None if pattern.unsure is None else np.zeros(N, np.bool_)
    return Reading(pattern.channel, mean, np.zeros(N, np.int64), spread, None, unsure)


def _without_shown(frozen: FrozenMap, finer: Sequence[FrozenMap], box_m: Box | None) -> FrozenMap:
    words, edges_um = frozen.grid.words.copy(), frozen.geometry.voxel_size_um()
    low, high = frozen.voxels_of_box(box_m)
    corners = frozen.brick_corners()
    bricks = _bricks_within(corners, low, high)
    for fine in finer:
        fine_edges_um, fine_corners = fine.geometry.voxel_size_um(), fine.brick_corners()
        # Finer voxels k with their centres in the voxels from K up to L: K E <= (k + 1/2) e < L E, in integers.
        first, end = (-((fine_edges_um - 2 * side * edges_um) // (2 * fine_edges_um)) for side in (low, high))
        fine_bricks = _bricks_within(fine_corners, first, end)
        clear_met_into(words, frozen.grid, edges_um, fine.grid, fine_edges_um, fine_corners, fine_bricks)
        clear_whole_into(words, corners, bricks, edges_um, fine.grid, fine_edges_um)
    return replace(frozen, grid=frozen.grid._replace(words=words))


def _bricks_within(corners: Ints, low: Ints, high: Ints) -> Ints:
    """(M,) rows of the bricks, by their first voxels (B, 3), that have voxels from `low` up to `high`."""
    return np.nonzero(((corners < high) & (corners + BRICK_SIDE > low)).all(axis=1))[0]
