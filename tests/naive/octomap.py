"""Octrees of OctoMap's, read one node after another as OctoMap reads them: the slow twin of `octomap_tree`."""

import io
import struct
from dataclasses import dataclass, field

HALF = 1 << 15
LEVELS = 16


@dataclass
class Node:
    """Of a .bt the leaves have log-odds of 1 and inner nodes none."""

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
        root = _bt_node(file) if b" binary " in head.splitlines()[0] else _ot_node(file)
        _gather(tree, root, (-HALF,) * 3, 1 << LEVELS)
    assert not file.read(), "bytes after the tree"
    return tree


def _ot_node(file: io.BytesIO) -> Node:
    odds, *rgb, children = struct.unpack("<f4B", file.read(8))
    return Node(odds, tuple(rgb), {n: _ot_node(file) for n in range(8) if children >> n & 1})


def _bt_node(file: io.BytesIO) -> Node:
    (kinds,) = struct.unpack("<H", file.read(2))
    node, inner = Node(None), []
    for n in range(8):
        kind = kinds >> 2 * n & 3
        assert kind != 1, "a free node"
        if kind:
            node.children[n] = Node(1.0)
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
