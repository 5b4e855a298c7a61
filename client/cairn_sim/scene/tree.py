"""A tree of boxes around solids, so that a ray asks a few of them and not all: a bounding volume hierarchy.

    nodes   (M, 6) lowest and highest corner of what is below
    links   (M, 2) a branch: number of its second child, 0 (the first child is the next node)
                   a leaf:   where its solids begin in `order`, and how many there are

Each branch is cut where the surface area heuristic expects the least work: the sum over both halves of the area
times the number of solids (MacDonald and Booth 1990). Every cut of every axis is tried; a scene has hundreds of
solids, not millions.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Int32s

LEAF_MAX = 2
"""Solids of a leaf. 1, 2 and 4 differ by less than 5 % in the building; 2 has half the nodes of 1."""
NOWHERE_M = 1e300
"""Where the node of an empty tree is: farther than the kernels' FAR, so that no ray gets there."""
DEPTH_MAX = 48
"""Of branches; below it a node is a leaf, whatever it holds, so that the kernel's stack is bounded."""


def tree_of(bounds_m: Floats) -> tuple[Floats, Int32s, Int32s]:
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
