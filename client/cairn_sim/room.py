"""A room that is known exactly: solids with a colour, a temperature and a near-infrared reflectivity.

Everything is one of three convex solids, walls too: a wall is a slab, seen on its inner face. So a ray caster
needs three formulas, and every question about the truth has an exact answer: which solid is at a point
(`Room.solid_at`), how far the nearest surface is (`Room.distance_m`), which one a ray meets (`render.cast`).

    y 5 +-----------------------+-----------+
        |  table       boxes    |  cabinet  |       z is up, the floor is z = 0, the ceiling z = 2.6 m
        |        pillar         |           |
        |radiator                 doorway   |       `small_room`: two rooms, one doorway
        |            person     |           |
      0 +-pipe----shelf---------+-cold tank-+
        0                       4           6  x, metres

A texture is two colours that take turns along the surface, every `period_m`: both periods finite is a
checkerboard, one is stripes, none is plain. It depends on the place alone, so all robots see the same colour there.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Rgb = tuple[int, int, int]
Metres3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Surface:
    """What the three spectra see of a solid; temperature is apparent, as of a black body."""

    colour_srgb: Rgb
    temperature_k: float
    reflectivity_nir: float
    """Of 850 nm light, 0 to 1."""
    second_srgb: Rgb | None = None
    period_m: tuple[float, float] = (math.inf, math.inf)

    def __post_init__(self) -> None:
        if not (self.temperature_k > 0 and 0 <= self.reflectivity_nir <= 1 and min(self.period_m) > 0):
            raise BadInputError(
                "bad_surface",
                "a surface needs kelvin above 0, a reflectivity in 0..1 and positive periods, got "
                f"{self.temperature_k}, {self.reflectivity_nir}, {self.period_m}",
            )


@dataclass(frozen=True, slots=True)
class Box:
    """A box that stands upright, turned by `yaw_rad` about the vertical through its centre."""

    name: str
    surface: Surface
    centre_m: Metres3
    size_m: Metres3
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        _check_positive(self.name, *self.size_m)

    def distance_m(self, points: Floats) -> Floats:
        """(...) metres from the surface, negative inside."""
        p = points - np.array(self.centre_m)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        own = np.stack([cos * p[..., 0] + sin * p[..., 1], cos * p[..., 1] - sin * p[..., 0], p[..., 2]], axis=-1)
        return _distance_outside(np.abs(own) - np.array(self.size_m) / 2)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """An upright cylinder; `foot_m` is the middle of its lower end."""

    name: str
    surface: Surface
    foot_m: Metres3
    radius_m: float
    height_m: float

    def __post_init__(self) -> None:
        _check_positive(self.name, self.radius_m, self.height_m)

    def distance_m(self, points: Floats) -> Floats:
        """(...) metres from the surface, negative inside."""
        p = points - np.array(self.foot_m)
        across = np.hypot(p[..., 0], p[..., 1]) - self.radius_m
        along = np.abs(p[..., 2] - self.height_m / 2) - self.height_m / 2
        return _distance_outside(np.stack([across, along], axis=-1))


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball."""

    name: str
    surface: Surface
    centre_m: Metres3
    radius_m: float

    def __post_init__(self) -> None:
        _check_positive(self.name, self.radius_m)

    def distance_m(self, points: Floats) -> Floats:
        """(...) metres from the surface, negative inside."""
        return np.asarray(np.linalg.norm(points - np.array(self.centre_m), axis=-1) - self.radius_m)


Solid = Box | Cylinder | Sphere


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Solids, and the same as arrays for `raycast_kernels`; made by `room_of`.

    `solids` and the arrays of P rows are in the kernel's order: B boxes, then C cylinders, then S spheres.
    """

    solids: tuple[Solid, ...]
    boxes: Floats
    """(B, 8) centre x y z, half size x y z, cosine and sine of the yaw."""
    cylinders: Floats
    """(C, 5) axis x y, lowest z, highest z, radius."""
    spheres: Floats
    """(S, 4) centre x y z, radius."""
    colours_srgb: npt.NDArray[np.float32]
    """(P, 2, 3) both colours, 0 to 255; equal where the surface is plain."""
    frequency_per_m: Floats
    """(P, 2) colour changes a metre along u and v; 0 for none."""
    temperature_k: npt.NDArray[np.float32]
    reflectivity_nir: npt.NDArray[np.float32]

    def solid_at(self, points: npt.NDArray[np.floating]) -> Ints:
        """(...) int32, index into `solids` of the one at each (..., 3) point; -1 in free space, and for NaN."""
        distance, nearest = self._nearest(points)
        return np.where(distance <= 0, nearest, np.int32(-1)).astype(np.int32)

    def distance_m(self, points: npt.NDArray[np.floating]) -> Floats:
        """(...) metres from each (..., 3) point to the nearest solid, negative inside; NaN for NaN."""
        return self._nearest(points)[0]

    def _nearest(self, points: npt.NDArray[np.floating]) -> tuple[Floats, Ints]:
        p = np.asarray(points, dtype=np.float64)
        best = np.full(p.shape[:-1], np.inf)
        which = np.full(p.shape[:-1], -1, dtype=np.int32)
        for k, solid in enumerate(self.solids):
            distance = solid.distance_m(p)
            which = np.where(distance < best, np.int32(k), which)
            best = np.minimum(best, distance)
        return best, which


def room_of(solids: Iterable[Solid]) -> Room:
    """A room of these solids, at least one, which may touch and overlap; `Room.solids` has them sorted by kind."""
    given = list(solids)
    if not given:
        raise BadInputError("empty_room", "a room needs at least one solid, got none")
    boxes = [s for s in given if isinstance(s, Box)]
    cylinders = [s for s in given if isinstance(s, Cylinder)]
    spheres = [s for s in given if isinstance(s, Sphere)]
    ordered: tuple[Solid, ...] = (*boxes, *cylinders, *spheres)
    surfaces = [s.surface for s in ordered]
    pairs = [(s.colour_srgb, s.second_srgb if s.second_srgb is not None else s.colour_srgb) for s in surfaces]
    return Room(
        solids=ordered,
        boxes=_rows(
            [(*b.centre_m, *(e / 2 for e in b.size_m), math.cos(b.yaw_rad), math.sin(b.yaw_rad)) for b in boxes], 8
        ),
        cylinders=_rows([(*c.foot_m, c.foot_m[2] + c.height_m, c.radius_m) for c in cylinders], 5),
        spheres=_rows([(*s.centre_m, s.radius_m) for s in spheres], 4),
        colours_srgb=np.array(pairs, dtype=np.float32).reshape(-1, 2, 3),
        frequency_per_m=_rows([(1 / s.period_m[0], 1 / s.period_m[1]) for s in surfaces], 2),
        temperature_k=np.array([s.temperature_k for s in surfaces], dtype=np.float32),
        reflectivity_nir=np.array([s.reflectivity_nir for s in surfaces], dtype=np.float32),
    )


def small_room() -> Room:
    """Two rooms of 4 x 5 and 1.9 x 5 m with a doorway between them: something hot, warm and cold in each view."""
    return room_of([*_shell(), *_partition(), *_table(), *_shelf(), *_things(), *_person(2.9, 1.1)])


def _shell() -> list[Solid]:
    tiles = Surface((150, 140, 125), 291.5, 0.45, (105, 100, 95), (0.5, 0.5))
    return [
        _span("floor", tiles, (0, 6), (0, 5), (-0.2, 0)),
        _span("ceiling", Surface((235, 235, 230), 294.5, 0.8), (0, 6), (0, 5), (2.6, 2.8)),
        _span("wall west", Surface((205, 190, 150), 292.0, 0.6), (-0.2, 0), (-0.2, 5.2), (-0.2, 2.8)),
        _span("wall east", Surface((150, 180, 205), 292.6, 0.6), (6, 6.2), (-0.2, 5.2), (-0.2, 2.8)),
        _span("wall south", Surface((170, 200, 165), 293.2, 0.6), (0, 6), (-0.2, 0), (-0.2, 2.8)),
        _span("wall north", Surface((215, 175, 165), 293.8, 0.6), (0, 6), (5, 5.2), (-0.2, 2.8)),
    ]


def _partition() -> list[Solid]:
    plaster = Surface((190, 185, 210), 293.0, 0.55, (170, 165, 195), (0.6, math.inf))
    return [
        _span("partition south", plaster, (4.0, 4.1), (0, 1.9), (0, 2.6)),
        _span("partition north", plaster, (4.0, 4.1), (3.0, 5), (0, 2.6)),
        _span("lintel", plaster, (4.0, 4.1), (1.9, 3.0), (2.1, 2.6)),
    ]


def _table() -> list[Solid]:
    wood = Surface((150, 95, 50), 293.5, 0.5, (135, 80, 40), (math.inf, 0.1))
    corners = ((0.4, 4.2), (0.4, 4.84), (1.54, 4.2), (1.54, 4.84))
    legs = [_span(f"table leg {x} {y}", wood, (x, x + 0.06), (y, y + 0.06), (0, 0.71)) for x, y in corners]
    mug = Cylinder("mug", Surface((240, 240, 240), 325.0, 0.7), (0.8, 4.5, 0.75), 0.05, 0.11)
    return [_span("table top", wood, (0.4, 1.6), (4.2, 4.9), (0.71, 0.75)), *legs, mug]


def _shelf() -> list[Solid]:
    metal = Surface((90, 110, 130), 292.5, 0.35)
    ends = [_span(f"shelf end {x}", metal, (x, x + 0.03), (0, 0.35), (0, 1.9)) for x in (0.9, 2.07)]
    boards = [_span(f"shelf board {z}", metal, (0.93, 2.07), (0, 0.35), (z, z + 0.03)) for z in (0.1, 0.65, 1.2, 1.75)]
    folders = Surface((40, 70, 160), 293.0, 0.5, (190, 50, 45), (0.08, math.inf))
    return [*ends, *boards, _span("folders", folders, (1.0, 1.7), (0.03, 0.28), (0.68, 0.98))]


def _things() -> list[Solid]:
    fins = Surface((245, 245, 240), 330.0, 0.75, (215, 215, 210), (0.06, math.inf))
    card = Surface((185, 140, 90), 292.8, 0.55)
    bands = Surface((230, 200, 40), 293.4, 0.5, (40, 40, 40), (math.inf, 0.2))
    cold = Surface((70, 130, 190), 278.0, 0.4)
    return [
        _span("radiator", fins, (0.04, 0.14), (1.3, 2.7), (0.15, 0.75)),
        Cylinder("pipe", Surface((170, 85, 60), 328.0, 0.3), (0.15, 0.4, 0), 0.05, 2.6),
        Cylinder("pillar", bands, (1.8, 3.1, 0), 0.15, 2.6),
        Box("box low", card, (3.4, 4.4, 0.25), (0.6, 0.5, 0.5), 0.25),
        Box("box middle", Surface((120, 150, 90), 292.8, 0.55), (3.4, 4.4, 0.7), (0.45, 0.4, 0.4), -0.3),
        Box("box high", Surface((170, 60, 60), 292.8, 0.5), (3.42, 4.38, 1.02), (0.3, 0.3, 0.24), 0.7),
        _span("cabinet", Surface((110, 85, 110), 292.9, 0.4), (5.4, 6), (3.9, 4.8), (0, 1.8)),
        Cylinder("cold tank", cold, (5.5, 0.5, 0), 0.22, 1.0),
        Sphere("cold tank dome", cold, (5.5, 0.5, 1.0), 0.22),
    ]


def _person(x: float, y: float) -> list[Solid]:
    """A standing person who faces north; 1.75 m."""
    trousers, shirt = Surface((45, 50, 75), 305.0, 0.45), Surface((200, 90, 40), 306.0, 0.6)
    skin, arm = Surface((220, 170, 140), 309.0, 0.55), Surface((200, 90, 40), 305.5, 0.6)
    return [
        Cylinder("leg left", trousers, (x - 0.1, y, 0), 0.08, 0.85),
        Cylinder("leg right", trousers, (x + 0.1, y, 0), 0.08, 0.85),
        Cylinder("torso", shirt, (x, y, 0.85), 0.19, 0.6),
        Cylinder("arm left", arm, (x - 0.25, y, 0.8), 0.05, 0.62),
        Cylinder("arm right", arm, (x + 0.25, y, 0.8), 0.05, 0.62),
        Cylinder("neck", skin, (x, y, 1.45), 0.06, 0.12),
        Sphere("head", skin, (x, y, 1.63), 0.12),
    ]


def _span(name: str, surface: Surface, x: Sequence[float], y: Sequence[float], z: Sequence[float]) -> Box:
    """The box between two values on each axis."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    return Box(name, surface, ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2), (x1 - x0, y1 - y0, z1 - z0))


def _distance_outside(excess: Floats) -> Floats:
    """Signed distance to a product of intervals, from (..., K) how far a point is outside each."""
    outside = np.linalg.norm(np.maximum(excess, 0), axis=-1)
    return np.asarray(outside + np.minimum(excess.max(axis=-1), 0))


def _rows(rows: Sequence[Sequence[float]], columns: int) -> Floats:
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _check_positive(name: str, *sizes_m: float) -> None:
    if not all(0 < size < math.inf for size in sizes_m):
        raise BadInputError("bad_solid", f"{name} needs sizes above 0 m, got {sizes_m}")
