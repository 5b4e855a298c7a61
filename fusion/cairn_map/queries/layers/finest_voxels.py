"""Finest voxels: sets of voxels of several layers in which no place is shown twice, and no obstacle vanishes.

    voxel of a coarser layer    gives way where a finer layer knows all of it
    one that is occupied        gives way, too, where a finer layer has an occupied voxel in it

A finer layer that saw a part of an occupied voxel as free says nothing of the rest, so the voxel stays. A voxel lies in
that coarser one which holds its centre.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints, Words
from cairn_map.evidence.grid import Geometry, split_voxels
from cairn_map.evidence.voxels import Reading, Voxels, joined_voxels
from cairn_map.queries import point_queries, region_queries
from cairn_map.queries.frozen_map import Box, FrozenMap
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, OCCUPIED_BITS, list_bits_into
from cairn_map.queries.occupancy_states import State

Bools = npt.NDArray[np.bool_]


def finest_states(layers: Mapping[str, FrozenMap]) -> dict[str, FrozenMap]:
    """The layers, each without the voxels that give way to finer ones: these are unknown in its grid.

    Args:
        layers: by name, the finest first.

    Returns:
        The same, of which `grid` alone may differ: cells, and so counts and readings, are those of the layer.
    """
    found: dict[str, FrozenMap] = {}
    finer: list[FrozenMap] = []
    for name, frozen in layers.items():
        found[name] = _without_shown(frozen, finer) if finer else frozen
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
    return joined_voxels([_with_readings(part, known) for part in parts])


def are_alike(one: Reading, other: Reading) -> bool:
    """True if two layers' readings of a channel can stand in one column."""
    a, b = one.channel, other.channel
    return (a.kind, a.unit, a.classes) == (b.kind, b.unit, b.classes)


def _with_readings(part: Voxels, known: Mapping[str, Reading]) -> Voxels:
    readings = {}
    for name, pattern in known.items():
        own = part.readings.get(name)
        found = own if own is not None and are_alike(own, pattern) else _no_samples(pattern, len(part))
        # Of a map some layers have epochs and some have none: a time that is unknown is NaN, so columns are as long.
        if found.measured_s is None and any(reading.measured_s is not None for reading in known.values()):
            found = replace(found, measured_s=np.full(len(part), np.nan))
        readings[name] = found
    return replace(part, readings=readings)


def _no_samples(pattern: Reading, N: int) -> Reading:
    """Reading of N voxels that have no samples, in the columns of another one."""
    mean = np.full((N, *pattern.mean.shape[1:]), np.nan)
    spread = None if pattern.spread is None else np.full(N, np.nan)
    unsure = None if pattern.unsure is None else np.zeros(N, np.bool_)
    return Reading(pattern.channel, mean, np.zeros(N, np.int64), spread, None, unsure)


def _without_shown(frozen: FrozenMap, finer: Sequence[FrozenMap]) -> FrozenMap:
    occupied, known = (_listed(frozen, bits) for bits in (OCCUPIED_BITS, KNOWN_BITS))
    gone_known, gone_occupied = np.zeros(len(known), np.bool_), np.zeros(len(occupied), np.bool_)
    for fine in finer:
        gone_known |= _are_known_whole(known, frozen, fine)
        gone_occupied |= _counts_in(occupied, frozen.geometry, _listed(fine, OCCUPIED_BITS), fine.geometry) > 0
    words = frozen.grid.words.copy()
    for numbers in (known[gone_known], occupied[gone_occupied]):
        _clear_into(words, frozen, numbers)
    return replace(frozen, grid=frozen.grid._replace(words=words))


def _listed(frozen: FrozenMap, which: np.uint64) -> Ints:
    """(M, 3) numbers of the occupied, or the known, voxels."""
    bits = np.ascontiguousarray(frozen.grid.words[..., int(which)])
    found = np.empty((int(np.bitwise_count(bits).sum()), 3), np.int64)
    list_bits_into(bits, frozen.brick_corners(), found)
    return found


def _are_known_whole(coarse: Ints, frozen: FrozenMap, fine: FrozenMap) -> Bools:
    """(N,) True for the voxels of a layer of which a finer layer knows every voxel."""
    edges, own = frozen.geometry.voxel_size_um(), fine.geometry.voxel_size_um()
    # Finer voxels k with the centre in a voxel K: K E <= (k + 1/2) e < (K + 1) E, in integers.
    first, end = (-((own - 2 * side * edges) // (2 * own)) for side in (coarse, coarse + 1))
    inside = np.maximum(end - first, 0).prod(axis=1)
    counts = _counts_in(coarse, frozen.geometry, _listed(fine, KNOWN_BITS), fine.geometry)
    return np.asarray((inside > 0) & (counts == inside))


def _counts_in(coarse: Ints, geometry: Geometry, fine: Ints, fine_geometry: Geometry) -> Ints:
    """(N,) numbers of a finer layer's voxels (M, 3) in each of a coarser layer's (N, 3)."""
    if not len(coarse) or not len(fine):
        return np.zeros(len(coarse), np.int64)
    holders = (2 * fine + 1) * fine_geometry.voxel_size_um() // (2 * geometry.voxel_size_um())
    # Cells by rank, because a cell's number and a place in it do not fit one word.
    cells, places = split_voxels(coarse, geometry)
    known_cells = np.unique(cells)
    codes = _codes(known_cells, cells, places, geometry)
    order = np.argsort(codes)
    cells, places = split_voxels(holders, geometry)
    rank = np.minimum(np.searchsorted(known_cells, cells), len(known_cells) - 1)
    there = known_cells[rank] == cells
    asked = _codes(known_cells, cells[there], places[there], geometry)
    at = np.minimum(np.searchsorted(codes[order], asked), len(codes) - 1)
    at = at[codes[order][at] == asked]
    counts = np.empty(len(coarse), np.int64)
    counts[order] = np.bincount(at, minlength=len(coarse))
    return counts


def _codes(
    known: npt.NDArray[np.uint64], cells: npt.NDArray[np.uint64], places: npt.NDArray[np.uint32], geometry: Geometry
) -> npt.NDArray[np.uint64]:
    rank = np.searchsorted(known, cells).astype(np.uint64)
    return np.asarray((rank << np.uint64(3 * geometry.depth)) | places)


def _clear_into(words: Words, frozen: FrozenMap, numbers: Ints) -> None:
    """Make voxels unknown in the words of a grid, which are changed in place."""
    cells, places = split_voxels(numbers, frozen.geometry)
    slots = np.searchsorted(np.array(frozen.keys, np.uint64), cells)
    bricks = frozen.grid.bricks[slots, places >> np.uint32(9)]
    masks = ~(np.uint64(1) << (places & np.uint32(63)).astype(np.uint64))
    blocks = bricks.astype(np.int64) * 8 + ((places >> np.uint32(6)) & np.uint32(7))
    for which in (OCCUPIED_BITS, KNOWN_BITS):
        np.bitwise_and.at(words.reshape(-1, 2)[:, int(which)], blocks, masks)


def centres(first: int, end: int, edge_um: int) -> Floats:
    """Centres along one axis of the voxels from `first` up to `end`, metres."""
    return np.asarray((2 * np.arange(first, end) + 1) * (edge_um / 2e6), dtype=np.float64)
