"""A closed room of voxels with warm things in it, of which all is known: what a page must list, and fly to."""

import itertools

import numpy as np
from tests.fixtures.server.pushes import MOLE

from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels

GEOMETRY = Geometry(voxel_edge_um=80_000, depth=5)
WIDE, HIGH = 40, 30
"""Voxels of the room inside: 3.2 m by 3.2 m, 2.4 m high."""
MIDDLE_M = (1.6, 1.6, 1.2)
"""From where a robot saw it all."""
TIME_S = 1.76e9
COLD_K = 293.0
HITS = 2
Number = tuple[int, int, int]
SPOTS: dict[str, tuple[list[Number], float]] = {
    "plate": ([(-1, y, z) for y in (18, 19, 20) for z in (10, 11, 12)], 350.0),
    "lamp": ([(x, y, HIGH) for x in (19, 20, 21) for y in (19, 20, 21)], 336.0),
    "machine": ([(x, y, 5) for x in range(30, 34) for y in range(5, 9)], 325.0),
    "nook": ([(WIDE, y, 8) for y in (33, 34, 35)], 315.0),
}
"""On a wall, under the ceiling, on the floor, and behind a cupboard; voxels and kelvin, the hottest first."""


def room() -> dict[Number, float]:
    """Occupied voxels and their temperatures."""
    across, up = range(-1, WIDE + 1), range(-1, HIGH + 1)
    world: dict[Number, float] = {}
    for x, y, z in itertools.product(across, across, up):
        if -1 in (x, y, z) or x == WIDE or y == WIDE or z == HIGH:
            world[x, y, z] = COLD_K
    # The machine, and a cupboard that hides the nook from all sides but one.
    world |= dict.fromkeys(itertools.product(range(30, 34), range(5, 9), range(6)), COLD_K)
    world |= dict.fromkeys(itertools.product([32], range(30, 39), range(20)), COLD_K)
    for voxels, kelvin in SPOTS.values():
        world |= dict.fromkeys(voxels, kelvin)
    return world


def commit_of(world: dict[Number, float], n: int) -> Commit:
    """The n-th commit of mole, which saw these voxels twice."""
    keys, places = split_voxels(np.array(list(world)), GEOMETRY)
    heat = next(channel for channel in GEOMETRY.channels if channel.kind is ChannelKind.TEMPERATURE)
    values = np.rint((np.array(list(world.values())) - heat.zero) / heat.step).astype(np.int64)
    samples = np.zeros((len(world), GEOMETRY.plane_count), np.int64)
    samples[:, GEOMETRY.planes_of(heat.name)] = np.stack(
        [values * HITS, values**2 * HITS, np.full_like(values, HITS)], axis=1
    )
    counts = np.tile([HITS, 0], (len(world), 1))
    cells = {
        CellKey(int(key)): packed_evidence(places[keys == key], counts[keys == key], samples[keys == key], GEOMETRY)
        for key in np.unique(keys)
    }
    pose = ScanPose(time_s=TIME_S, t_map_rig=MIDDLE_M, q_map_rig=(0.0, 0.0, 0.0, 1.0))
    meta = CommitMeta(
        id=str(CommitId(MOLE, n)),
        geometry=GEOMETRY.digest().hex(),
        scans=(pose,) * HITS,
        captured_s=(TIME_S, TIME_S + 1),
    )
    return make_commit(meta, cells, GEOMETRY)


def centre_m(voxel: Number) -> list[float]:
    return [(each + 0.5) * GEOMETRY.voxel_edge_m for each in voxel]
