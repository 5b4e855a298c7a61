"""Slow, obvious twins of the queries of a map, over a dict of voxels: number (x, y, z) -> (hits, misses, sums).

Lengths are in voxel edges and exact wherever they can be: fractions, not floats.
"""

import itertools
import math
from collections.abc import Iterable
from fractions import Fraction

Number = tuple[int, int, int]
World = dict[Number, tuple[int, int, tuple[int, ...]]]
Vector = tuple[float, float, float]
UNKNOWN, FREE, OCCUPIED = range(3)
FACES = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]


def position(point_m: Iterable[float], edge_nm: int) -> tuple[Fraction, ...]:
    """A point, to the nanometre."""
    return tuple(Fraction(round(p * 1e9), edge_nm) for p in point_m)


def voxel_at(point_m: Iterable[float], edge_nm: int) -> Number:
    """The voxel that holds a point."""
    x, y, z = (math.floor(p) for p in position(point_m, edge_nm))
    return x, y, z


def state(world: World, voxel: Number) -> int:
    """Under the standard sensor model."""
    hits, misses, _ = world.get(voxel, (0, 0, ()))
    if hits == misses == 0:
        return UNKNOWN
    return OCCUPIED if hits * math.log(0.7 / 0.3) + misses * math.log(0.4 / 0.6) > 0 else FREE


def cast(
    world: World, origin: tuple[Fraction, ...], direction: Vector, *, range_max: float, ends_in_unknown: bool
) -> tuple[float, int]:
    """Range, finite, at which a ray enters the voxel that ends it, and its state; (inf, FREE) if there is none."""
    towards = [Fraction(d) for d in direction]
    length = math.sqrt(sum(d * d for d in towards))
    voxel = [math.floor(o) for o in origin]
    at = Fraction(0)
    while float(at) * length <= range_max:
        here = state(world, (voxel[0], voxel[1], voxel[2]))
        if here == OCCUPIED or (here == UNKNOWN and ends_in_unknown):
            return float(at) * length, here
        leaves = [
            math.inf if d == 0 else ((v + 1 if d > 0 else v) - o) / d
            for v, o, d in zip(voxel, origin, towards, strict=True)
        ]
        at = max(at, Fraction(min(leaves)))
        for axis in range(3):
            if leaves[axis] == min(leaves):
                voxel[axis] += 1 if towards[axis] > 0 else -1
    return math.inf, FREE


def first_hit(world: World, origin: tuple[Fraction, ...], direction: Vector) -> float:
    """The same without a walk, of occupied voxels alone: each is cut with the ray."""
    towards = [Fraction(d) for d in direction]
    start = tuple(math.floor(o) for o in origin)
    best: Fraction | float = math.inf
    for voxel in world:
        if state(world, voxel) != OCCUPIED:
            continue
        enters: Fraction | float = Fraction(0)
        leaves: Fraction | float = math.inf
        for v, o, d in zip(voxel, origin, towards, strict=True):
            if d == 0:
                leaves = leaves if v <= o < v + 1 else -math.inf
            else:
                near, far = sorted(((v - o) / d, (v + 1 - o) / d))
                enters, leaves = max(enters, near), min(leaves, far)
        if enters < leaves or voxel == start:
            best = min(best, enters)
    return float(best) * math.sqrt(sum(d * d for d in towards))


def gap(point: Iterable[float | Fraction], voxel: Number) -> float:
    """Distance from a point to a voxel's nearest point."""
    gaps = [float(max(v - p, p - (v + 1), 0)) for p, v in zip(point, voxel, strict=True)]
    return math.sqrt(sum(g * g for g in gaps))


def around(point: Iterable[float | Fraction], radius: float) -> Iterable[Number]:
    """All voxels that could be within a radius of a point."""
    spans = [range(math.floor(p - radius) - 1, math.floor(p + radius) + 2) for p in point]
    return itertools.product(*spans)  # type: ignore[return-value]


def nearest(world: World, point: tuple[Fraction, ...], wanted: int, radius: float) -> float:
    """Distance to the nearest voxel in a state; infinite if there is none within the radius."""
    gaps = [gap(point, voxel) for voxel in around(point, radius) if state(world, voxel) == wanted]
    return min((g for g in gaps if g <= radius), default=math.inf)


def sphere_state(world: World, centre: Vector, radius: float) -> int:
    """What a sphere meets."""
    met = {state(world, voxel) for voxel in around(centre, radius) if gap(centre, voxel) < radius}
    return OCCUPIED if OCCUPIED in met else UNKNOWN if UNKNOWN in met else FREE


def box_state(world: World, corners: list[Vector], axes: list[Vector]) -> int:
    """What a box meets: its eight corners, and its three axes."""
    spans = [range(math.floor(min(c)) - 1, math.floor(max(c)) + 2) for c in zip(*corners, strict=True)]
    met = {state(world, voxel) for voxel in itertools.product(*spans) if boxes_overlap(voxel, corners, axes)}
    return OCCUPIED if OCCUPIED in met else UNKNOWN if UNKNOWN in met else FREE


def boxes_overlap(voxel: Number, corners: list[Vector], axes: list[Vector]) -> bool:
    """Whether no line separates the shadows of a voxel's corners and of a box's."""
    unit: list[Vector] = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    cube = [tuple(v + s for v, s in zip(voxel, step, strict=True)) for step in itertools.product((0, 1), repeat=3)]
    lines = [*unit, *axes, *(cross(a, b) for a in unit for b in axes)]
    for line in lines:
        if math.hypot(*line) < 1e-6:
            continue  # the edges are parallel
        mine, other = ([sum(a * b for a, b in zip(line, p, strict=True)) for p in side] for side in (cube, corners))
        if max(mine) - min(other) <= 1e-6 or max(other) - min(mine) <= 1e-6:
            return False
    return True


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def frontier(world: World) -> set[Number]:
    """Free voxels with an unknown one at a face."""
    return {
        (x, y, z)
        for x, y, z in world
        if state(world, (x, y, z)) == FREE and any(state(world, (x + i, y + j, z + k)) == UNKNOWN for i, j, k in FACES)
    }


def tops(world: World) -> dict[tuple[int, int], int]:
    """The highest occupied voxel of each column that has one."""
    found: dict[tuple[int, int], int] = {}
    for x, y, z in sorted(world):
        if state(world, (x, y, z)) == OCCUPIED:
            found[x, y] = z
    return found


def floor_column(world: World, column: tuple[int, int], *, zone_low: int, band_low: int, band_high: int) -> int:
    """A pixel of a floor grid, by the voxels' numbers: 100 occupied, 0 free, -1 unknown."""
    down = [state(world, (*column, z)) for z in range(band_high - 1, zone_low - 1, -1)]
    if OCCUPIED in down[: band_high - band_low]:
        return 100
    for here in down:
        if here != FREE:
            return 0 if here == OCCUPIED else -1
    return -1
