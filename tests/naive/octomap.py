"""Octrees of OctoMap's, read one node after another as OctoMap reads them: the slow twin of `octomap_tree`."""

import io
import struct
from dataclasses import dataclass, field
from itertools import product

HALF = 1 << 15
LEVELS = 16


@dataclass
class Node:
    """Node of an octree; in a .bt, occupied leaves have log-odds of 1, free ones of -1, and inner nodes none."""

    odds: float | None
    rgb: tuple[int, ...] = (255, 255, 255)
    children: dict[int, "Node"] = field(default_factory=dict)


@dataclass
class Tree:
    """`leaves` by lowest voxel number and edge in voxels; `size`: what the head says, `nodes`: all that are there."""

    edge_m: float
    size: int
    nodes: list[Node]
    leaves: dict[tuple[tuple[int, ...], int], Node]


def read_tree(data: bytes) -> Tree:
    head, _, body = data.partition(b"data\n")
    words = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    tree, file = Tree(float(words["res"]), int(words["size"]), [], {}), io.BytesIO(body)
    if tree.size:
        is_coloured = words["id"] == "ColorOcTree"
        root = _bt_node(file) if b" binary " in head.splitlines()[0] else _ot_node(file, is_coloured)
        _gather(tree, root, (-HALF,) * 3, 1 << LEVELS)
    assert not file.read(), "bytes after the tree"
    return tree


def _ot_node(file: io.BytesIO, is_coloured: bool) -> Node:
    odds, *rgb, children = struct.unpack("<f4B", file.read(8)) if is_coloured else struct.unpack("<fB", file.read(5))
    below = {n: _ot_node(file, is_coloured) for n in range(8) if children >> n & 1}
    return Node(odds, tuple(rgb) or (255, 255, 255), below)


def _bt_node(file: io.BytesIO) -> Node:
    (kinds,) = struct.unpack("<H", file.read(2))
    node, inner = Node(None), []
    for n in range(8):
        kind = kinds >> 2 * n & 3
        if kind:
            node.children[n] = Node(-1.0 if kind == 1 else 1.0)
        if kind == 3:
            inner.append(n)
    for n in inner:
        node.children[n] = _bt_node(file)
    return node


def _gather(tree: Tree, node: Node, low: tuple[int, ...], side: int) -> None:
    tree.nodes.append(node)
    if not node.children:
        tree.leaves[low, side] = node
    for n, child in node.children.items():
        _gather(tree, child, tuple(v + (side // 2) * (n >> axis & 1) for axis, v in enumerate(low)), side // 2)


Voxel = tuple[int, ...]


def states_of(tree: Tree) -> tuple[set[Voxel], set[Voxel]]:
    """Voxels that OctoMap holds for occupied and for free: log-odds of zero are occupied."""
    occupied, free = set[Voxel](), set[Voxel]()
    for (low, side), leaf in tree.leaves.items():
        assert leaf.odds is not None
        below = {tuple(v + s for v, s in zip(low, step, strict=True)) for step in product(range(side), repeat=3)}
        (occupied if leaf.odds >= 0 else free).update(below)
    return occupied, free
