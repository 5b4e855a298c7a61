"""Nodes of OctoMap's octrees as rows of an array: parents of leaves, pruning, and the bytes of a file.

    leaves, mixed levels  --grown-->  all nodes above them, depth first  --parts_of_file-->  bytes of .ot or .bt

A tree is made in pieces: the root of a finished subtree stands as a placeholder (a branch without children) among the
leaves of the tree above it, and its bytes are put in its place. Inner nodes have the highest log-odds and the mean
colour of their children, as OctoMap's `updateInnerOccupancy` makes them.
"""

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

Nodes = npt.NDArray[np.void]
"""(N,) of `NODE`."""
Codes = npt.NDArray[np.uint64]
"""(N,) Morton numbers of nodes of one level."""

LEVELS = 16
"""Levels of an octree below its root, which is level 0."""
UNCOLOURED = 255
"""White, which OctoMap takes for no colour; a node that is white is written one step darker."""
FREE, OCCUPIED, BRANCH = 1, 2, 3
"""Kinds of nodes, the two bits of a child in a .bt; a child that is not there, unknown space, is 0."""
NODE = np.dtype(
    [
        ("code", "<u8"),
        ("level", "u1"),
        ("kind", "u1"),
        ("odds", "<f4"),
        ("rgb", "u1", 3),
        ("children", "u1"),  # a bit for each child that is there
        ("kinds", "<u2"),  # two bits for each child
        ("nodes", "<u4"),  # of the subtree, its root included
        ("leaves", "<u4"),  # of the subtree
    ]
)
OT_NODE = np.dtype([("odds", "<f4"), ("rgb", "u1", 3), ("children", "u1")])
OT_PLAIN_NODE = np.dtype([("odds", "<f4"), ("children", "u1")])


def leaves_of(codes: Codes, level: int, kind: int, odds: npt.NDArray[np.floating] | float) -> Nodes:
    """Leaves of one level and kind without a colour."""
    leaves = np.zeros(len(codes), NODE)
    leaves["code"], leaves["level"], leaves["kind"], leaves["odds"] = codes, level, kind, odds
    leaves["rgb"], leaves["nodes"], leaves["leaves"] = UNCOLOURED, 1, 1
    return leaves


def grown(leaves: Nodes, top: int) -> Nodes:
    """Leaves in any order, and all nodes above them up to level `top`, in the order of a file.

    Eight leaves that are alike become one.
    """
    deepest = int(leaves["level"].max(initial=top))
    # Layer by layer: a layer's nodes are the parents of the layer below, and the leaves of its own level.
    layers, layer = list[Nodes](), leaves[:0]
    for level in range(deepest, top - 1, -1):
        layer = np.concatenate([layer, leaves[leaves["level"] == level]])
        layer = layer[np.argsort(layer["code"])]
        if level > top:
            children, layer = _parents(layer)
            layers.append(children)
    nodes = np.concatenate([*layers, layer])
    # Depth first: by the first deepest node below, and of nodes that share it the highest first.
    first = nodes["code"] << (3 * (deepest - nodes["level"].astype(np.uint64)))
    return nodes[np.lexsort((nodes["level"], first))]


def _parents(layer: Nodes) -> tuple[Nodes, Nodes]:
    """A layer without the leaves that were alike, and its parents, both rising in number."""
    # Runs of children with the same parent; `child` is 0 to 7.
    above, child = layer["code"] >> np.uint64(3), (layer["code"] & np.uint64(7)).astype(np.uint16)
    starts = np.nonzero(np.diff(above, prepend=~above[:1]))[0]
    parents = np.zeros(len(starts), NODE)
    if not len(starts):
        return layer, parents
    parents["code"], parents["level"] = above[starts], layer["level"][0] - 1
    parents["odds"] = np.maximum.reduceat(layer["odds"], starts)
    # The mean colour of the children that have one, rounded down as OctoMap does.
    coloured = (layer["rgb"] != UNCOLOURED).any(axis=1)
    count = np.add.reduceat(coloured.astype(np.int64), starts)
    sums = np.add.reduceat(layer["rgb"].astype(np.int64) * coloured[:, None], starts, axis=0)
    parents["rgb"] = np.where(count[:, None] > 0, sums // np.maximum(count, 1)[:, None], UNCOLOURED)
    # Pruning: eight leaves of the same kind, log-odds and colour are their parent.
    rows = np.diff(starts, append=len(layer))
    first = layer[starts]
    differs = layer["kind"] != np.repeat(first["kind"], rows)
    differs |= layer["odds"] != np.repeat(first["odds"], rows)
    differs |= (layer["rgb"] != np.repeat(first["rgb"], rows, axis=0)).any(axis=1)
    alike = (rows == 8) & (first["kind"] != BRANCH) & ~np.logical_or.reduceat(differs, starts)
    parents["kind"] = np.where(alike, first["kind"], BRANCH)
    bits, pairs = np.uint16(1) << child, layer["kind"].astype(np.uint16) << (2 * child)
    parents["children"] = np.where(alike, 0, np.bitwise_or.reduceat(bits, starts))
    parents["kinds"] = np.where(alike, 0, np.bitwise_or.reduceat(pairs, starts))
    parents["nodes"] = np.where(alike, 1, np.add.reduceat(layer["nodes"], starts) + 1)
    parents["leaves"] = np.where(alike, 1, np.add.reduceat(layer["leaves"], starts))
    return layer[~np.repeat(alike, rows)], parents


def placeholder(nodes: Nodes) -> Nodes:
    """(1,) root of a tree in the order of a file, as a node of the tree above it; a leaf stays one."""
    root = nodes[:1].copy()
    root["children"] = root["kinds"] = 0
    return root


def parts_of_file(nodes: Nodes, bodies: Iterable[bytes], form: str) -> Iterator[bytes]:
    """Bytes of nodes in the order of a file, with those of each placeholder's subtree in its place."""
    start = 0
    (places,) = np.nonzero((nodes["kind"] == BRANCH) & (nodes["children"] == 0))
    for at, body in zip(places.tolist(), bodies, strict=True):
        yield _bytes_of(nodes[start:at], form)
        yield body
        start = at + 1
    yield _bytes_of(nodes[start:], form)


def without_colours(body: bytes) -> bytes:
    """Nodes of an .ot as those of a tree without colours."""
    return _as(OT_PLAIN_NODE, np.frombuffer(body, OT_NODE))


def _bytes_of(nodes: Nodes, form: str) -> bytes:
    return nodes["kinds"][nodes["children"] > 0].tobytes() if form == "bt" else _as(OT_NODE, nodes)


def _as(dtype: np.dtype[np.void], nodes: Nodes) -> bytes:
    rows = np.empty(len(nodes), dtype)
    for name in dtype.names or ():
        rows[name] = nodes[name]
    return rows.tobytes()
