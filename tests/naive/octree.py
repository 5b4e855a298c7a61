"""Slow, obvious twin of the octree (FORMAT.md 4): nodes as objects, in and out of masks."""

import io
from collections.abc import Iterator

from tests.naive.evidence import Evidence, Voxel


class Node:
    """A node is a leaf, with the evidence of every voxel in it, or inner, with children."""

    def __init__(self, children: dict[int, "Node"] | None = None, voxel: Voxel | None = None) -> None:
        self.children = children or {}
        self.voxel = voxel

    @property
    def is_leaf(self) -> bool:
        return self.voxel is not None


def tree_of(evidence: Evidence, depth: int) -> Node | None:
    """The collapsed tree; None if there is no evidence."""

    def node(d: int, number: int, places: list[int]) -> Node:
        if d == depth:
            return Node(voxel=evidence[number])
        below: dict[int, list[int]] = {}
        for place in places:
            below.setdefault(place >> (3 * (depth - d - 1)) & 7, []).append(place)
        children = {c: node(d + 1, number * 8 + c, below[c]) for c in sorted(below)}
        voxels = [child.voxel for child in children.values()]
        alike = len({voxel[:2] for voxel in voxels if voxel}) == 1 and len(voxels) == 8 and None not in voxels
        if d > 0 and alike and not any(any(voxel[2]) for voxel in voxels if voxel):
            return Node(voxel=voxels[0])
        return Node(children)

    return node(0, 0, sorted(evidence)) if evidence else None


def masks_of(root: Node | None, depth: int) -> tuple[bytes, bytes]:
    """Child masks and leaf masks, breadth first."""
    child_masks, leaf_masks = bytearray(), bytearray()
    nodes = [root] if root else []
    for d in range(depth):
        child_masks += bytes(sum(1 << c for c in node.children) for node in nodes)
        if d < depth - 1:
            leaf_masks += bytes(sum(1 << c for c, child in node.children.items() if child.is_leaf) for node in nodes)
        nodes = [child for node in nodes for child in node.children.values() if not child.is_leaf]
    return bytes(child_masks), bytes(leaf_masks)


def leaves_of(root: Node | None, depth: int) -> list[tuple[int, int, Voxel]]:
    """(first place, size in voxels, evidence) of each leaf, in Morton order."""

    def walk(node: Node, number: int, d: int) -> Iterator[tuple[int, int, Voxel]]:
        if node.voxel is not None:
            yield number << (3 * (depth - d)), 8 ** (depth - d), node.voxel
        for c, child in node.children.items():
            yield from walk(child, number * 8 + c, d + 1)

    return list(walk(root, 0, 0)) if root else []


def leaves_above(root: Node | None, depth: int, stop: int) -> list[tuple[int, int]]:
    """(first place, size in voxels) of each leaf no deeper than `stop`, where inner nodes are leaves, too."""

    def walk(node: Node, number: int, d: int) -> Iterator[tuple[int, int]]:
        if node.is_leaf or d == stop:
            yield number << (3 * (depth - d)), 8 ** (depth - d)
        else:
            for c, child in node.children.items():
                yield from walk(child, number * 8 + c, d + 1)

    return list(walk(root, 0, 0)) if root else []


def leaves_of_masks(child_masks: bytes, leaf_masks: bytes, depth: int) -> list[tuple[int, int]]:
    """(first place, size in voxels) of each leaf, in Morton order."""
    children, leaves = io.BytesIO(child_masks), io.BytesIO(leaf_masks)
    found: list[tuple[int, int]] = []
    numbers = [0] if child_masks else []
    for d in range(depth):
        inner: list[int] = []
        exists = children.read(len(numbers))
        is_leaf = exists if d == depth - 1 else leaves.read(len(numbers))
        for number, mask, leaf_mask in zip(numbers, exists, is_leaf, strict=True):
            assert mask
            assert not leaf_mask & ~mask
            for c in range(8):
                if leaf_mask >> c & 1:
                    found.append(((number * 8 + c) << (3 * (depth - 1 - d)), 8 ** (depth - 1 - d)))
                elif mask >> c & 1:
                    inner.append(number * 8 + c)
        numbers = inner
    assert not children.read()
    assert not leaves.read()
    return sorted(found)
