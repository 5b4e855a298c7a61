"""Slow, obvious twin of the hot spots of a map: a flood fill over a dict of voxels."""

from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

Number = tuple[int, int, int]
STEPS = [step for step in product((-1, 0, 1), repeat=3) if any(step)]


class Warm(NamedTuple):
    """An occupied voxel with samples."""

    kelvin: float
    hits: int


class Spot(NamedTuple):
    """A set of connected voxels."""

    peak: Number
    voxels: int
    low: Number
    high: Number
    confirmed: bool


def hot_spots(world: Mapping[Number, Warm], over_k: float, voxels_min: int) -> list[Spot]:
    """Spots in the order in which they are listed."""
    left = {voxel for voxel, warm in world.items() if warm.kelvin >= over_k}
    found = []
    while left:
        spot, edge = set[Number](), [min(left)]
        while edge:
            voxel = edge.pop()
            if voxel in left:
                left.remove(voxel)
                spot.add(voxel)
                edge += [(voxel[0] + x, voxel[1] + y, voxel[2] + z) for x, y, z in STEPS]
        peak = min(spot, key=lambda voxel: (-world[voxel].kelvin, voxel))
        low, high = (tuple(end(voxel[axis] for voxel in spot) for axis in range(3)) for end in (min, max))
        confirmed = len(spot) >= 4 or any(world[voxel].hits > 1 for voxel in spot)
        found.append(Spot(peak, len(spot), low, high, confirmed))
    kept = [spot for spot in found if spot.voxels >= voxels_min]
    return sorted(kept, key=lambda spot: (not spot.confirmed, -world[spot.peak].kelvin, spot.peak))
