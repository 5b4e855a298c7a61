"""A scene that is known exactly: solids, the light around them, and the same as arrays for the kernels.

Three questions about the truth have exact answers: which solid is at a point (`Scene.solid_at`), how far the nearest
surface is and how warm (`Scene.distance_m`, `Scene.temperature_k_at`), which one a ray meets (`rays.cast`). What moves
stands where it is at one time; `Scene.at` gives the scene of any other.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Int32s, Singles
from cairn_map.errors import BadInputError
from cairn_sim.scene.distance_kernels import nearest_solids
from cairn_sim.scene.movements import CLOCK_START_S, MovingObject
from cairn_sim.scene.solid_kernels import Shapes, second_at
from cairn_sim.scene.solids import Box, Cylinder, Plane, Solid, Sphere
from cairn_sim.scene.surfaces import TEMPERATURE_K, Material, Rgb

LEAF_MAX = 2
"""Solids of a leaf. 1, 2 and 4 differ by less than 5 % in the building; 2 has half the nodes of 1."""
NOWHERE_M = 1e300
"""Corner of an empty tree's node: farther than the kernels' FAR, so that no ray reaches it."""
DEPTH_MAX = 48
"""Branches from the root at most; a node at this depth is a leaf of any size, so that the kernel's stack is bounded."""

AMBIENT_K = 293.15
SOLIDS_MAX = 20_000
"""A solid's number fits 16 bits; and a scene file of a few lines may ask for millions."""
BOUNDS_MARGIN_M = 1e-9 * np.array([-1, -1, -1, 1, 1, 1])
"""So that rounding never lets a ray slip past a box around a solid whose face is the box's own."""
EMPTY_BOUNDS_M = np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf])
"""Bounds of a solid that is gone: as far away as can be."""
TIMES_KEPT = 16
"""Scenes of one time that are kept, 0.2 MB each in the building; threads that render ask for neighbouring times."""
Tree = tuple[Floats, Int32s, Int32s]
"""Nodes, links and leaves of `Shapes`."""
KINDS: tuple[type, ...] = (Box, Cylinder, Sphere, Plane)
"""In the order of the kernels' kind codes."""


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Appearance of P solids, by number; the second axis of materials is a texture's first and second."""

    colours_srgb: Singles
    """(P, 2, 3) 0 to 255."""
    temperature_k: Singles
    """(P, 2)"""
    emissivity: Singles
    """(P, 2)"""
    reflectivity_nir: Singles
    """(P, 2) diffuse."""
    gloss_nir: Singles
    """(P, 2)"""
    retroreflection: Singles
    """(P, 2)"""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Solids and what is around them; made by `scene_of`. What moves is where it is at the scene's start."""

    name: str
    solids: tuple[Solid, ...]
    """Those that stand still, then those of `moving`: a solid has the same number at all times."""
    shapes: Shapes
    surfaces: Surfaces
    ambient_k: float
    """Temperature of the surroundings that bare metal mirrors in the far infrared, kelvin."""
    sky_k: float
    """Apparent temperature where nothing is met."""
    sky_srgb: Rgb
    moving: tuple[MovingObject, ...] = ()
    gone: frozenset[int] = frozenset()
    """Numbers of the solids of moving objects that are not there at this time; they stand in `solids` all the same."""

    def at(self, time_s: float) -> "Scene":
        """The scene as it is at a time, in which nothing moves; itself if nothing ever does.

        Equal for all times between which nothing changed: the same object for the times asked for last.

        Args:
            time_s: UTC, seconds since 1970, as of scans: `CLOCK_START_S` is time 0 of a scene file. Before it all is
                as it is then.
        """
        if not self.moving:
            return self
        after_s = max(time_s - CLOCK_START_S, 0.0)
        poses = [each.movement.pose_at(after_s) for each in self.moving]
        return _placed_scene(self, tuple(None if T is None else T.tobytes() for T in poses))

    def solid_at(self, points: npt.NDArray[np.floating]) -> Int32s:
        """(...) int32, number of the solid at each (..., 3) point; -1 in free space, and for NaN."""
        distance, nearest = self._nearest(points)
        return np.where(distance <= 0, nearest, np.int32(-1)).astype(np.int32)

    def distance_m(self, points: npt.NDArray[np.floating]) -> Floats:
        """(...) metres from each (..., 3) point to the nearest solid, negative inside; NaN for NaN."""
        return self._nearest(points)[0]

    def nearest_solid(self, points: npt.NDArray[np.floating]) -> Int32s:
        """(...) int32, number of the solid nearest to each (..., 3) point, or that it lies deepest in; -1 for NaN."""
        return self._nearest(points)[1]

    def temperature_k_at(self, points: npt.NDArray[np.floating], solids: Int32s | None = None) -> Floats:
        """(...) kelvin of the surface nearest to each (..., 3) point: true, not apparent; NaN for NaN.

        Args:
            points: map frame, metres.
            solids: (...) whose surface is meant; None for the nearest's. NaN for -1.
        """
        p = np.asarray(points, dtype=np.float64)
        nearest = (self._nearest(p)[1] if solids is None else solids).reshape(-1)
        second = second_at(np.ascontiguousarray(p.reshape(-1, 3)), nearest, self.shapes)
        kelvin = self.surfaces.temperature_k[nearest, second].astype(np.float64)
        return np.where(nearest < 0, np.nan, kelvin).reshape(p.shape[:-1])

    def number_of(self, name: str) -> int:
        """The number of the first solid of a name.

        Raises:
            BadInputError: none has it.
        """
        for number, solid in enumerate(self.solids):
            if solid.name == name:
                return number
        raise BadInputError("unknown_solid", f"scene {self.name} has no solid named {name!r}")

    def _nearest(self, points: npt.NDArray[np.floating]) -> tuple[Floats, Int32s]:
        p = np.asarray(points, dtype=np.float64)
        distance, nearest = nearest_solids(np.ascontiguousarray(p.reshape(-1, 3)), self.shapes)
        return distance.reshape(p.shape[:-1]), nearest.reshape(p.shape[:-1])


def scene_of(
    solids: Iterable[Solid],
    *,
    moving: Sequence[MovingObject] = (),
    name: str = "scene",
    ambient_k: float = AMBIENT_K,
    sky_k: float = AMBIENT_K,
    sky_srgb: Rgb = (0, 0, 0),
) -> Scene:
    """A scene of these solids, at least one, which may touch and overlap; numbered as given, what moves last.

    Raises:
        BadInputError: no solids, or too many.
    """
    given = (*solids, *(solid for each in moving for solid in each.solids))
    if not 1 <= len(given) <= SOLIDS_MAX:
        raise BadInputError("bad_scene", f"a scene needs 1 to {SOLIDS_MAX} solids, got {len(given)}")
    if not all(TEMPERATURE_K[0] <= kelvin <= TEMPERATURE_K[1] for kelvin in (ambient_k, sky_k)):
        raise BadInputError(
            "bad_scene",
            f"surroundings and sky need {TEMPERATURE_K[0]} to {TEMPERATURE_K[1]} K, got {ambient_k:g} and {sky_k:g}",
        )
    pairs = [solid.surface.materials for solid in given]
    scene = Scene(
        name=name,
        solids=given,
        shapes=_shapes(given),
        surfaces=Surfaces(
            colours_srgb=np.array([[m.colour_srgb for m in pair] for pair in pairs], dtype=np.float32),
            temperature_k=_of(pairs, "temperature_k"),
            emissivity=_of(pairs, "emissivity"),
            reflectivity_nir=_of(pairs, "reflectivity_nir"),
            gloss_nir=_of(pairs, "gloss_nir"),
            retroreflection=_of(pairs, "retroreflection"),
        ),
        ambient_k=ambient_k,
        sky_k=sky_k,
        sky_srgb=sky_srgb,
        moving=tuple(moving),
    )
    return scene if not moving else replace(scene.at(CLOCK_START_S), moving=scene.moving)


@lru_cache(maxsize=TIMES_KEPT)
def _placed_scene(scene: Scene, poses: tuple[bytes | None, ...]) -> Scene:
    """A scene of one time; `poses` are the bytes of each moving object's `T_map_object`, None for one that is gone.

    What stands still keeps its arrays and its tree: a time of the moving building takes 2 ms, making it again 35.
    """
    still_count = len(scene.solids) - sum(len(each.solids) for each in scene.moving)
    solids, gone = list(scene.solids), set[int]()
    first = still_count
    for each, pose in zip(scene.moving, poses, strict=True):
        numbers = range(first, first + len(each.solids))
        if pose is None:
            solids[numbers.start : numbers.stop], gone = each.solids, gone.union(numbers)
        else:
            solids[numbers.start : numbers.stop] = each.placed_solids(np.frombuffer(pose).reshape(4, 4))
        first = numbers.stop
    frame, bounds = scene.shapes.frame.copy(), scene.shapes.bounds.copy()
    frame[still_count:], bounds[still_count:] = _frames(solids[still_count:]), _bounds(solids[still_count:])
    there = [k for k in range(still_count, len(solids)) if k not in gone]
    bounds[list(gone)] = EMPTY_BOUNDS_M
    nodes, links, leaves = _joined_trees(_still_tree(scene, still_count), _tree(bounds, there))
    shapes = scene.shapes._replace(frame=frame, bounds=bounds, nodes=nodes, links=links, leaves=leaves)
    return replace(scene, solids=tuple(solids), shapes=shapes, moving=(), gone=frozenset(gone))


@lru_cache(maxsize=TIMES_KEPT)
def _still_tree(scene: Scene, still_count: int) -> Tree:
    """Tree of the solids of a scene that stand still."""
    endless = set(scene.shapes.endless.tolist())
    return _tree(scene.shapes.bounds, [k for k in range(still_count) if k not in endless])


def _of(pairs: Iterable[tuple[Material, Material]], field: str) -> Singles:
    return np.array([[getattr(m, field) for m in pair] for pair in pairs], dtype=np.float32)


def _shapes(solids: Sequence[Solid]) -> Shapes:
    surfaces = [solid.surface for solid in solids]
    endless = [k for k, solid in enumerate(solids) if isinstance(solid.shape, Plane)]
    bounded = [k for k, solid in enumerate(solids) if not isinstance(solid.shape, Plane)]
    bounds = _bounds(solids)
    nodes, links, leaves = _tree(bounds, bounded)
    return Shapes(
        kind=np.array([KINDS.index(type(solid.shape)) for solid in solids], dtype=np.int8),
        frame=_frames(solids),
        half_m=np.array([solid.shape.half_m for solid in solids], dtype=np.float64),
        optics=np.array([surface.material.optics for surface in surfaces], dtype=np.int8),
        texture=np.array(
            [[*(1 / p for p in s.period_m), *s.phase_m, s.grain, 1 / s.grain_m] for s in surfaces], dtype=np.float64
        ),
        bounds=bounds,
        endless=np.array(endless, dtype=np.int32),
        nodes=nodes,
        links=links,
        leaves=leaves,
    )


def _frames(solids: Sequence[Solid]) -> Floats:
    """(P, 12) of `Shapes`."""
    return np.array([[*s.T_map_solid[:3, :3].T.ravel(), *s.T_map_solid[:3, 3]] for s in solids], dtype=np.float64)


def _bounds(solids: Sequence[Solid]) -> Floats:
    """(P, 6) of `Shapes`."""
    return np.asarray(np.array([np.concatenate(solid.bounds_m()) for solid in solids]) + BOUNDS_MARGIN_M)


def _tree(bounds_m: Floats, members: Sequence[int]) -> Tree:
    """Tree of some of the solids, by their numbers."""
    nodes, links, order = tree_of(bounds_m[list(members)])
    return nodes, links, np.array(members, dtype=np.int32)[order]


def _joined_trees(one: Tree, other: Tree) -> Tree:
    """A root above two trees; the other one if a tree holds nothing."""
    if not len(one[2]) or not len(other[2]):
        return one if len(one[2]) else other
    nodes, links = [], []
    # Numbers move up by what stands before a tree: those of nodes in a branch's link, those of leaves in a leaf's.
    for (own_nodes, own_links, _), nodes_before, leaves_before in ((one, 1, 0), (other, 1 + len(one[0]), len(one[2]))):
        moved = own_links.copy()
        moved[:, 0] += np.where(moved[:, 1] > 0, leaves_before, nodes_before).astype(np.int32)
        nodes.append(own_nodes)
        links.append(moved)
    root = np.concatenate([np.minimum(one[0][0, :3], other[0][0, :3]), np.maximum(one[0][0, 3:], other[0][0, 3:])])
    root_links = np.array([[1 + len(one[0]), 0]], dtype=np.int32)
    return np.vstack([root, *nodes]), np.vstack([root_links, *links]), np.concatenate([one[2], other[2]])


def tree_of(bounds_m: Floats) -> Tree:
    """Nodes, links and order of the tree over (N, 6) bounds; with no bounds, one empty leaf that no ray meets."""
    nodes: list[Floats] = []
    links: list[list[int]] = []
    order: list[int] = []
    if not len(bounds_m):
        return np.full((1, 6), NOWHERE_M), np.zeros((1, 2), np.int32), np.zeros(0, np.int32)

    def add(members: npt.NDArray[np.int64], depth: int) -> None:
        node = len(nodes)
        own = bounds_m[members]
        nodes.append(np.concatenate([own[:, :3].min(axis=0), own[:, 3:].max(axis=0)]))
        links.append([0, 0])
        if len(members) <= LEAF_MAX or depth == DEPTH_MAX:
            links[node] = [len(order), len(members)]
            order.extend(members.tolist())
            return
        first, second = _cut(members, own)
        add(first, depth + 1)
        links[node] = [len(nodes), 0]
        add(second, depth + 1)

    add(np.arange(len(bounds_m)), 0)
    return np.array(nodes), np.array(links, dtype=np.int32), np.array(order, dtype=np.int32)


def _cut(members: npt.NDArray[np.int64], own: Floats) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The members in two halves, neither empty."""
    counts = np.arange(1, len(members))
    best = (np.inf, members, 0)
    for axis in range(3):
        sorting = np.argsort(own[:, axis] + own[:, axis + 3], kind="stable")
        low, high = own[sorting, :3], own[sorting, 3:]
        before = _areas(np.minimum.accumulate(low), np.maximum.accumulate(high))[:-1]
        after = _areas(np.minimum.accumulate(low[::-1]), np.maximum.accumulate(high[::-1]))[:-1][::-1]
        cost = before * counts + after * counts[::-1]
        at = int(np.argmin(cost))
        if cost[at] < best[0]:
            best = (float(cost[at]), members[sorting], at + 1)
    _, ordered, at = best
    return ordered[:at], ordered[at:]


def _areas(low: Floats, high: Floats) -> Floats:
    """Half the surface of boxes."""
    size = high - low
    return np.asarray(size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0])
