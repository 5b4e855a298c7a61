"""Ray casting in a scene. A solid is seen from outside only; the nearest that a ray enters is its hit.

Light that meets glass goes on, and light that meets a mirror turns; so each ray has a first hit, which is the geometry,
and a last one, which is what is seen. `rays` is the caller that checks; tests/naive/raycast.py is the slow
twin.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from cairn_map.arrays import Floats, Int32s, Singles
from cairn_sim.scene.solid_kernels import FAR, SIDE, Shapes, enter, grain_at, surface_at, turn_at
from cairn_sim.scene.surfaces import Optics
from cairn_sim.scene.tree_kernels import STACK, candidates_into, first_entry, spread_into

Bytes = npt.NDArray[np.int8]
Marks = npt.NDArray[np.uint8]

GLASS, MIRROR = int(Optics.GLASS), int(Optics.MIRROR)
"""Bits of `Hits.way`, too."""
PASSES_MAX = 8
"""Panes and mirrors on a ray's way; behind so many it sees nothing."""


class Hits(NamedTuple):
    """Hits of N rays."""

    range_m: Floats
    """(N,) metres to the first surface, infinite for none."""
    solid: Int32s
    """(N,) number of the first solid; -1 for none."""
    path_m: Floats
    """(N,) metres of the light's way to what is seen: through glass, round a mirror; infinite for nothing."""
    seen: Int32s
    """(N,) number of the solid that is seen; -1 for none."""
    second: Marks
    """(N,) 1 where the texture shows the second material."""
    grain: Singles
    """(N,) -1 to 1, the texture's irregular pattern."""
    normal: Singles
    """(N, 3) of the surface that is seen, outward, map frame; where a mirror shows it, too."""
    incidence: Singles
    """(N,) cosine between that normal and the way back."""
    way: Marks
    """(N,) bits: 1 through glass, 2 round a mirror."""
    passes: Marks
    """(N,) panes and mirrors on the way."""
    straight_m: Floats
    """(N,) metres to where the light's way ends or turns, for the first time: what is before it is in plain sight."""


def cast_rays(
    origin: Floats, R_map_camera: Floats, rays: Floats, order: Int32s, starts: Int32s, shapes: Shapes, opaque: bool
) -> Hits:
    """First and last hit of each ray from one origin.

    Rays come in bundles of about the same direction. A bundle asks the tree once, for the solids that any of its rays
    might meet, nearest first; a ray then asks these until the rest is farther than what it found. That takes a third
    of the time of asking the tree ray by ray, as what a mirror turns away still does.

    Args:
        origin: (3,) metres.
        R_map_camera: (3, 3) rotation.
        rays: (N, 3) unit vectors, camera frame; a NaN one meets nothing.
        order: (N,) numbers of the rays, bundle by bundle.
        starts: (B + 1,) where in `order` each bundle begins, and the end.
        shapes: of the scene.
        opaque: whether glass and mirrors stop the ray, as they do in the far infrared.
    """
    # Allocated outside of the kernel, which allocates nothing in its loop.
    n = len(rays)
    hits = Hits(
        range_m=np.empty(n),
        solid=np.empty(n, np.int32),
        path_m=np.empty(n),
        seen=np.empty(n, np.int32),
        second=np.empty(n, np.uint8),
        grain=np.empty(n, np.float32),
        normal=np.empty((n, 3), np.float32),
        incidence=np.empty(n, np.float32),
        way=np.empty(n, np.uint8),
        passes=np.empty(n, np.uint8),
        straight_m=np.empty(n),
    )
    _cast_into(hits, origin, R_map_camera, rays, order, starts, shapes, opaque)
    return hits


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_into(
    hits: Hits,
    origin: Floats,
    R_map_camera: Floats,
    rays: Floats,
    order: Int32s,
    starts: Int32s,
    shapes: Shapes,
    opaque: bool,
) -> None:
    """Fill the hits of `cast_rays`.

    A kernel that made the `Hits` itself would crash at ^C: numba calls a class without a look.
    """
    # As plain arrays: each use of a tuple's member in the loop would count references, two thirds of the time.
    range_m, solid, path_m, seen, second, grain, normal, incidence, way, passes, straight_m = hits
    kind, frame, half_m, optics, texture, bounds, endless, nodes, links, leaves = shapes
    stack, nears = np.empty(STACK, np.int32), np.empty(STACK)
    candidates, candidate_nears = np.empty(len(kind), np.int32), np.empty(len(kind))
    spread, directions = np.empty((3, 2)), np.empty((np.diff(starts).max() if len(starts) > 1 else 0, 3))
    for bundle in range(len(starts) - 1):
        # The solids that any ray of the bundle may meet, nearest first.
        spread_into(spread, directions, R_map_camera, rays, order, starts[bundle], starts[bundle + 1])
        count = candidates_into(
            candidates, candidate_nears, origin, spread, bounds, endless, nodes, links, leaves, stack
        )
        for place in range(starts[bundle], starts[bundle + 1]):
            i = order[place]
            ox, oy, oz = origin[0], origin[1], origin[2]
            d = place - starts[bundle]
            dx, dy, dz = directions[d, 0], directions[d, 1], directions[d, 2]
            # First hit. Candidates come by range: those that begin behind the hit cannot be nearer.
            t, k, face = FAR, -1, SIDE
            for c in range(count if dx == dx else 0):  # a NaN ray meets nothing
                if candidate_nears[c] > t:
                    break
                new, new_face = enter(ox, oy, oz, dx, dy, dz, candidates[c], kind, frame, half_m)
                if new > 0.0 and (new < t or (new == t and candidates[c] < k)):
                    t, k, face = new, candidates[c], new_face
            solid[i], range_m[i] = k, t if k >= 0 else np.inf
            # Last hit: through panes and round mirrors. `gone_m` is the way up to the last mirror, `behind` the
            # pane that the ray just crossed.
            gone_m, behind, path, crossed, straight_m[i] = 0.0, 0.0, np.uint8(0), np.uint8(0), np.inf
            nx, ny, nz, u, v, along = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            while k >= 0:
                x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                # The surface at the hit, and the cosine between ray and normal.
                nx, ny, nz, u, v = surface_at(x, y, z, k, face, kind, frame, half_m)
                along = dx * nx + dy * ny + dz * nz
                # Plain sight ends at the first surface that is no pane.
                if gone_m == 0.0 and (opaque or optics[k] != GLASS):
                    straight_m[i] = t
                # Light ends here: this surface is seen.
                if opaque or optics[k] == 0:
                    break
                behind = t
                if optics[k] == MIRROR:
                    # d' = d - 2 (d . n) n
                    gone_m, behind = gone_m + t, 0.0
                    ox, oy, oz = x, y, z
                    dx, dy, dz = dx - 2 * along * nx, dy - 2 * along * ny, dz - 2 * along * nz
                path |= np.uint8(optics[k])
                crossed += np.uint8(1)
                k = -1
                if crossed > PASSES_MAX:
                    # Nothing is seen behind so many panes, nor is it in sight.
                    straight_m[i] = t if gone_m == 0.0 else straight_m[i]
                else:
                    # Behind the pane, or from the mirror on: the tree is asked ray by ray, for the bundle has come
                    # apart.
                    t, k, face = first_entry(
                        ox, oy, oz, dx, dy, dz, behind, kind, frame, half_m, endless, nodes, links, leaves, stack, nears
                    )
            # The surface that is seen: its range along the light's way, material, grain and normal.
            seen[i], way[i], passes[i], path_m[i] = k, path, crossed, gone_m + t if k >= 0 else np.inf
            second[i], grain[i] = turn_at(u, v, k, texture) if k >= 0 else 0, _texture_grain(u, v, k, face, texture)
            _note_normal(normal, incidence, i, k, nx, ny, nz, along)


@njit(nogil=True, error_model="numpy", forceinline=True)
def _note_normal(
    normal: Singles, incidence: Singles, i: int, k: int, nx: float, ny: float, nz: float, along: float
) -> None:
    """Note of ray i the normal of the surface that it shows, and the cosine on it; zeros without a surface."""
    if k < 0:
        nx, ny, nz, along = 0.0, 0.0, 0.0, 0.0
    normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
    incidence[i] = -along


@njit(nogil=True, error_model="numpy", forceinline=True)
def _texture_grain(u: float, v: float, k: int, face: int, texture: Floats) -> float:
    """Irregular pattern of solid k at (u, v) metres on a face, -1 to 1; 0 without texture or solid."""
    if k < 0 or not texture[k, 4] > 0.0:
        return 0.0
    return grain_at(u * texture[k, 5], v * texture[k, 5], face + 7 * k)


@njit(cache=True, nogil=True, error_model="numpy")
def cast_each(origins: Floats, directions: Floats, shapes: Shapes) -> tuple[Floats, Int32s, Floats]:
    """The first surface that each of N rays meets, every ray from an origin of its own.

    Returns:
        (N,) metres, infinite for none; (N,) numbers of the solids, -1 for none; (N, 3) outward normals, map frame.
    """
    kind, frame, half_m, _, _, _, endless, nodes, links, leaves = shapes
    stack, nears = np.empty(STACK, np.int32), np.empty(STACK)
    range_m, solid, normal = (
        np.full(len(origins), np.inf),
        np.full(len(origins), -1, np.int32),
        np.zeros((len(origins), 3)),
    )
    for i in range(len(origins)):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        # A NaN ray meets nothing.
        if dx != dx:
            continue
        t, k, face = first_entry(
            ox, oy, oz, dx, dy, dz, 0.0, kind, frame, half_m, endless, nodes, links, leaves, stack, nears
        )
        if k >= 0:
            range_m[i], solid[i] = t, k
            nx, ny, nz, _, _ = surface_at(ox + t * dx, oy + t * dy, oz + t * dz, k, face, kind, frame, half_m)
            normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
    return range_m, solid, normal
