"""A map with epochs in which all that changes is known: what robots saw when, what went, came and got warm."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from tests.console.hot_room import GEOMETRY, Number
from tests.fixtures.server.pushes import MOLE, WREN

from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.epochs.epoch import epoch_of
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import CellKey, split_voxels

EPOCH_S = 120
LAYER = MapLayer(geometry=GEOMETRY, epoch_s=EPOCH_S)
START_S = 1_760_000_040.0
"""In the middle of an epoch."""
SCANS = 40
"""Enough for a change to be one."""
COLD_K, HOT_K = 293.0, 350.0
FLOOR = list(product(range(16), range(16), (0,)))
CRATE = list(product(range(2, 6), range(2, 6), range(1, 5)))
"""Voxels that come."""
DOOR = list(product((12,), range(4, 9), range(1, 9)))
"""Voxels that go."""
PLATE = list(product(range(9, 14), range(10, 14), (0,)))
"""Part of the floor that gets warm."""
GHOST = list(product(range(1, 5), range(9, 13), range(6, 9)))
"""Never was there: the commit is taken out."""


@dataclass(frozen=True)
class Sight:
    """Evidence of one commit."""

    author: Author
    n: int
    after_s: float
    """Time since the map's begin."""
    there: Mapping[Number, float]
    free: Sequence[Number] = ()

    @property
    def time_s(self) -> float:
        return START_S + self.after_s

    @property
    def commit(self) -> Commit:
        voxels = [*self.there, *self.free]
        is_there = np.arange(len(voxels)) < len(self.there)
        hits = np.where(is_there, SCANS, 0)
        heat = next(channel for channel in GEOMETRY.channels if channel.kind is ChannelKind.TEMPERATURE)
        kelvin = np.array([*self.there.values(), *[heat.zero] * len(self.free)])
        values = np.rint((kelvin - heat.zero) / heat.step).astype(np.int64)
        samples = np.zeros((len(voxels), GEOMETRY.plane_count), np.int64)
        samples[:, GEOMETRY.planes_of(heat.name)] = np.stack([values * hits, values**2 * hits, hits], axis=1)
        counts = np.stack([hits, SCANS - hits], axis=1)
        keys, places = split_voxels(np.array(voxels), GEOMETRY)
        cells = {
            CellKey(int(key)): packed_evidence(places[keys == key], counts[keys == key], samples[keys == key], GEOMETRY)
            for key in np.unique(keys)
        }
        pose = ScanPose(time_s=self.time_s, t_map_rig=(0.8, 0.8, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
        meta = CommitMeta(
            id=str(CommitId(self.author, self.n)),
            layers=LAYER.identities,
            epoch=epoch_of(self.time_s, EPOCH_S),
            scans=(pose,) * SCANS,
            captured_s=(self.time_s - 5, self.time_s),
        )
        return make_commit(meta, cells, LAYER)


def at(voxels: Sequence[Number], kelvin: float = COLD_K) -> dict[Number, float]:
    """Voxels that are there, at a temperature."""
    return dict.fromkeys(voxels, kelvin)


SIGHTS = [
    Sight(MOLE, 0, 0, at(FLOOR[:128])),
    Sight(WREN, 0, 150, at(FLOOR[128:])),
    Sight(MOLE, 1, 300, at(DOOR), free=CRATE),
    Sight(WREN, 1, 450, at(FLOOR[:64])),
    Sight(WREN, 2, 700, at(GHOST)),
    Sight(MOLE, 2, 9 * 3600, at(CRATE)),
    Sight(MOLE, 3, 9 * 3600 + 150, at(PLATE, HOT_K), free=DOOR),
    Sight(WREN, 3, 9 * 3600 + 300, at(FLOOR[64:128])),
]
OUT = SIGHTS[4]
"""Commit that is taken out."""
CHANGED = {"appeared": CRATE, "gone": DOOR, "warmer": PLATE}
BEFORE_S = START_S + 700
"""Time before all these changes."""
