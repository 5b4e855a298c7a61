"""A level of which all is known: flat ground, a ramp, a kerb, a bridge over it all, a post, and what too few saw."""

from itertools import product
from math import floor

import numpy as np
from tests.fixtures.server.pushes import MOLE

from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels

GEOMETRY = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=5, channels=(HEIGHT_OFFSET,))
BIN_M = 0.05
VOTES = 10
WIDE, FAR = 40, 12
"""Columns along x and y: two cells along x."""
RAMP, KERB = 12, 34
"""Columns along x at which a ramp of 0.2 begins, and the kerb of 0.3 m that is its upper end."""
BRIDGE = range(4, 7)
"""Columns along x over which a deck lies, 1.2 m above the ground: in the cell above it and in the ground's own."""
POST = (3, 9)
"""Column with something that stands on it."""
Number = tuple[int, int, int]


def height_m(x: int) -> float:
    """Height of the ground in a column."""
    return 0.52 + (0.04 * min(max(x - RAMP, 0), KERB - RAMP)) + (0.3 if x >= KERB else 0.0)


def votes() -> dict[Number, tuple[int, int]]:
    """Votes by voxel, and the sum of their heights over its lower face in steps of 5 mm."""
    found: dict[Number, tuple[int, int]] = {}
    for x, y in product(range(WIDE), range(FAR)):
        heights = [(height_m(x), VOTES)]
        # A tenth of the votes is wrong: no surface.
        heights += [(height_m(x) + 0.7, 1)] if (x + y) % 3 == 0 else []
        heights += [(height_m(x) + 1.2, VOTES)] if x in BRIDGE and y < 6 else []
        for height, count in heights:
            number = (x, y, floor(height / BIN_M + 1e-9))
            found[number] = count, count * round((height - number[2] * BIN_M) * 200)
    return found


def ground_commit(n: int) -> Commit:
    """The n-th commit of mole, which saw it all."""
    surfaces = votes()
    own = floor(height_m(POST[0]) / BIN_M)
    post = [(*POST, own + up) for up in range(4, 12)]
    numbers = np.array([*surfaces, *post])
    hits = np.array([count for count, _ in surfaces.values()] + [VOTES] * len(post))
    sums = np.array([(total, count) for count, total in surfaces.values()] + [(0, 0)] * len(post))
    keys, places = split_voxels(numbers, GEOMETRY)
    counts = np.stack([hits, np.zeros_like(hits)], axis=1)
    cells = {
        CellKey(int(key)): packed_evidence(places[keys == key], counts[keys == key], sums[keys == key], GEOMETRY)
        for key in np.unique(keys)
    }
    pose = ScanPose(time_s=1.76e9, t_map_rig=(1.0, 1.0, 1.5), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    meta = CommitMeta(
        id=str(CommitId(MOLE, n)),
        geometry=GEOMETRY.digest().hex(),
        scans=(pose,) * (3 * VOTES),
        captured_s=(1.76e9, 1.76e9 + 1),
    )
    return make_commit(meta, cells, GEOMETRY)
