"""Maps of several cells for the tests of queries, and the same as dicts for their slow twins."""

import numpy as np
import numpy.typing as npt
from tests import naive, naive_queries
from tests.cairn_map.made import as_dict, random_evidence

from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, cell_key, cell_of_key
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of

CELLS = ((0, 0, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (-1, -1, -1), (3, 0, 0))
"""Around the origin, with gaps, and one apart."""


def random_map(seed: int, geometry: Geometry) -> EvidenceMap:
    """Air with holes of unknown in it, whole bricks and single voxels, and a few obstacles."""
    whole, rng = EvidenceMap(geometry), np.random.default_rng(seed)
    top = 8**geometry.depth
    for n, cell in enumerate(CELLS if geometry.depth < 5 else CELLS[:2]):
        has_air = (rng.random(top // 512) < 0.8).repeat(512) & (rng.random(top) < 0.985)
        places = np.nonzero(has_air if top > 512 else rng.random(top) < 0.985)[0].astype(np.uint32)
        counts = np.tile([0, 1], (len(places), 1))
        air = packed_evidence(places, counts, np.zeros((len(places), geometry.plane_count), np.int64), geometry)
        obstacles = random_evidence(100 * seed + n, geometry, voxels=40 * top // 512, air=0)
        whole.merge({cell_key(cell): air})
        whole.merge({cell_key(cell): obstacles})
    return whole


def map_of(geometry: Geometry, voxels: dict[tuple[int, int, int], tuple[int, int]]) -> EvidenceMap:
    """A map with exactly these voxels: hits and misses by number."""
    rows: dict[CellKey, list[tuple[int, int, int]]] = {}
    for (x, y, z), counts in voxels.items():
        cell, side = cell_key((x >> geometry.depth, y >> geometry.depth, z >> geometry.depth)), geometry.side
        rows.setdefault(cell, []).append((naive.interleave(x % side, y % side, z % side), *counts))
    whole = EvidenceMap(geometry)
    for key, listed in rows.items():
        table = np.array(listed, np.int64)
        samples = np.zeros((len(table), geometry.plane_count), np.int64)
        whole.replace(key, packed_evidence(table[:, 0].astype(np.uint32), table[:, 1:], samples, geometry))
    return whole


def snapshot_with(geometry: Geometry, voxels: dict[tuple[int, int, int], tuple[int, int]]) -> MapSnapshot:
    """A snapshot of such a map."""
    return snapshot_of(map_of(geometry, voxels))


def world_of(whole: EvidenceMap) -> naive_queries.World:
    """The map as the slow twins have it."""
    world: naive_queries.World = {}
    for key, evidence in whole.packed().items():
        i, j, k = (index * whole.geometry.side for index in cell_of_key(key))
        for place, voxel in as_dict(evidence).items():
            x, y, z = naive.deinterleave(place)
            world[i + x, j + y, k + z] = voxel
    return world


def random_points(seed: int, whole: EvidenceMap, count: int) -> npt.NDArray[np.float64]:
    """(N, 3) points in and around a map, a third of them exactly on borders of voxels."""
    rng = np.random.default_rng(seed)
    cells = np.array([cell_of_key(key) for key in whole] or [(0, 0, 0)])
    edge_m = whole.geometry.cell_edge_m
    points = (rng.choice(cells, count) + rng.uniform(-0.15, 1.15, (count, 3))) * edge_m
    voxel_m = whole.geometry.voxel_edge_m
    points[::3] = np.rint(points[::3] / voxel_m) * voxel_m
    return points
