"""Tree walks: the solids that a ray, or a bundle of rays, may meet, in the tree of `scene.tree_of`."""

import numpy as np
import numpy.typing as npt
from numba import njit

from cairn_map.arrays import Floats, Int32s
from cairn_sim.scene.solid_kernels import FAR, SIDE, enter, inverse_of

Bytes = npt.NDArray[np.int8]

STACK = 64
"""Above `tree.DEPTH_MAX`."""


@njit(nogil=True, error_model="numpy")
def first_entry(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    behind: float,
    kind: Bytes,
    frame: Floats,
    half_m: Floats,
    endless: Int32s,
    nodes: Floats,
    links: Int32s,
    leaves: Int32s,
    stack: Int32s,
    nears: Floats,
) -> tuple[float, int, int]:
    """Range, solid and face where the ray first enters a solid farther than `behind`; FAR and -1 for none.

    Of two at the same range the one of the lower number, whatever the order in which the tree brings them.
    """
    # Not infinite, or a box that is missed, with `_near` infinite, would look as near as the best.
    best, which, best_face = FAR, -1, SIDE
    # Planes first: no tree holds them.
    for at in range(len(endless)):
        k = int(endless[at])
        t, face = enter(ox, oy, oz, dx, dy, dz, k, kind, frame, half_m)
        if behind < t < best:
            best, which, best_face = t, k, face
    # Then the tree, nearest node first, with the farther ones on a stack.
    ix, iy, iz = inverse_of(dx), inverse_of(dy), inverse_of(dz)
    node, top = 0, 0
    if len(leaves) == 0 or not _near(ox, oy, oz, ix, iy, iz, nodes, 0, best) <= best:
        return best, which, best_face
    while True:
        # A leaf holds `count` solids from leaves[links[node, 0]] on; a branch has count 0.
        count = links[node, 1]
        if count > 0:
            for at in range(links[node, 0], links[node, 0] + count):
                k = int(leaves[at])
                t, face = enter(ox, oy, oz, dx, dy, dz, k, kind, frame, half_m)
                if behind < t and (t < best or (t == best and k < which)):
                    best, which, best_face = t, k, face
        else:
            # The first child follows its parent, the second is linked: the two in order of range.
            one, other = node + 1, int(links[node, 0])
            near_one = _near(ox, oy, oz, ix, iy, iz, nodes, one, best)
            near_other = _near(ox, oy, oz, ix, iy, iz, nodes, other, best)
            if near_other < near_one:
                one, other, near_one, near_other = other, one, near_other, near_one
            if near_other <= best:
                stack[top], nears[top] = other, near_other
                top += 1
            if near_one <= best:
                node = one
                continue
        # Nodes that begin behind the best hit are dropped unopened.
        while top > 0 and nears[top - 1] > best:
            top -= 1
        if top == 0:
            return best, which, best_face
        top -= 1
        node = int(stack[top])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"nnan", "nsz"})
def _near(
    ox: float, oy: float, oz: float, ix: float, iy: float, iz: float, nodes: Floats, n: int, best: float
) -> float:
    """Distance at which the ray enters a node's box, at least 0; infinite when it misses, or enters behind `best`."""
    # Slabs (Kay and Kajiya 1986): the ray is in the box between the last entry and the first exit of three axes.
    x0, x1 = (nodes[n, 0] - ox) * ix, (nodes[n, 3] - ox) * ix
    y0, y1 = (nodes[n, 1] - oy) * iy, (nodes[n, 4] - oy) * iy
    z0, z1 = (nodes[n, 2] - oz) * iz, (nodes[n, 5] - oz) * iz
    near = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
    far = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), best))
    return near if near <= far else np.inf


@njit(nogil=True, error_model="numpy")
def spread_into(
    spread: Floats, directions: Floats, R: Floats, rays: Floats, order: Int32s, start: int, end: int
) -> None:
    """A bundle's rays in the map frame, and (3, 2) their lowest and highest component along each axis but for NaN."""
    for a in range(3):
        low, high = np.inf, -np.inf
        # A NaN compares false, so a ray without direction leaves the bounds alone.
        for place in range(start, end):
            i = order[place]
            d = R[a, 0] * rays[i, 0] + R[a, 1] * rays[i, 1] + R[a, 2] * rays[i, 2]
            directions[place - start, a] = d
            low = d if d < low else low
            high = d if d > high else high
        spread[a, 0], spread[a, 1] = low, high


@njit(nogil=True, error_model="numpy")
def candidates_into(
    candidates: Int32s,
    nears: Floats,
    origin: Floats,
    spread: Floats,
    bounds: Floats,
    endless: Int32s,
    nodes: Floats,
    links: Int32s,
    leaves: Int32s,
    stack: Int32s,
) -> int:
    """Solids that a bundle may meet, and a range before which it meets none of them, rising; returns how many."""
    count = 0
    for at in range(len(endless)):
        candidates[count], nears[count] = endless[at], 0.0
        count += 1
    # Without a tree its only node is no branch; and of a bundle without rays nothing is known.
    stack[0], top = 0, 1 if len(leaves) > 0 and spread[0, 0] <= spread[0, 1] else 0
    while top > 0:
        top -= 1
        node = int(stack[top])
        # No ray of the bundle enters this node.
        if not _bundle_near(origin, spread, nodes, node) < FAR:
            continue
        # A branch: both children wait.
        if links[node, 1] == 0:
            stack[top], stack[top + 1] = links[node, 0], node + 1
            top += 2
            continue
        for at in range(links[node, 0], links[node, 0] + links[node, 1]):
            near = _bundle_near(origin, spread, bounds, leaves[at])
            if near < FAR:
                place = count
                # Insertion sort: a bundle meets a handful of solids.
                while place > 0 and nears[place - 1] > near:
                    candidates[place], nears[place] = candidates[place - 1], nears[place - 1]
                    place -= 1
                candidates[place], nears[place] = leaves[at], near
                count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _bundle_near(origin: Floats, spread: Floats, boxes: Floats, n: int) -> float:
    """A range before which no ray of a bundle enters a box; infinite when none does. By interval arithmetic."""
    near, far = 0.0, np.inf
    for a in range(3):
        low, high = boxes[n, a] - origin[a], boxes[n, 3 + a] - origin[a]
        slow, fast = spread[a, 0], spread[a, 1]
        # Mirror the axis, so that the bundle moves upwards or stands.
        if fast < 0.0:
            slow, fast, low, high = -fast, -slow, -high, -low
        # All rays move upwards: the earliest entry is that of the fastest, or of the slowest inside.
        if slow > 0.0:
            near = max(near, low / fast if low > 0.0 else low / slow)
            far = min(far, high / slow if high > 0.0 else high / fast)
        # Some stand or turn back: only an entry ahead can be bounded.
        elif low > 0.0:
            near = max(near, low / fast)
        elif high < 0.0:
            near = max(near, high / slow)
    return near if near <= far else np.inf
