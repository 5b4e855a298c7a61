"""Model of an octree's masks: each child's state under the known states of its neighbours (FORMAT.md section 14).

A child is absent, inner or a leaf. Depth by depth, its lower neighbours are known, and so are its parent's upper
ones. Surfaces and borders of known space are smooth, so these predict most states. Three opinions, of

    faces     three lower neighbours, three upper ones (one depth above, where they lie outside the parent)
    edges     the lower neighbours across three edges and the corner, and the three across faces
    family    the child's number, the parent's children that exist already, the parent's upper neighbours
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes
from cairn_map.codec.entropy.arithmetic_kernels import EVEN, Coder, Data, resumed, suspend_into
from cairn_map.codec.entropy.mixing_kernels import Opinions, code_mixed, start_weights
from cairn_map.codec.entropy.neighbour_kernels import NONE, lower_places, upper_places
from cairn_map.kernels.integer_kernels import U, signed

ABSENT, INNER, LEAF, SIBLING = 0, 1, 2, 3
"""States; SIBLING: an upper neighbour inside the same parent, which is unknown yet."""
FACES = 27 * 64
EDGES = 81 * 27
FAMILY = 256 * 27 * 8
GROUPS = 4
"""Depths above the voxels with contexts of their own; the last one is for all further depths."""


@nb.njit(cache=True, nogil=True)
def code_masks(
    coder: Coder, data: Data, child_masks: Bytes, leaf_masks: Bytes, depth: int, stop: int
) -> tuple[int, int]:
    """Code an octree's masks down to depth `stop`; returns the numbers of child and leaf masks, -1, -1 without room.

    Encoding reads the masks, decoding writes them.
    """
    # States of all nodes, depth by depth, those of the present depth from `offset` on; `keys`: the inner nodes.
    live = resumed(coder)
    odds = np.full(GROUPS * 2 * (FACES + EDGES + FAMILY), EVEN, np.uint32)
    weights = start_weights(2 * GROUPS, 3)
    states = np.zeros((8 ** (stop + 1) - 1) // 7, np.uint8)
    states[0] = INNER
    keys = np.zeros(child_masks.shape[0] + 1, np.uint32)
    first, last = 0, min(1, child_masks.shape[0])
    at = leaf_at = offset = 0
    for d in range(stop):
        is_last = d == depth - 1
        group = min(depth - 1 - d, GROUPS - 1)
        below = offset + (1 << (3 * d))
        found = last
        # Inner nodes [first, last) of this depth; those of the next one are appended from `found` on.
        for n in range(first, last):
            if at >= child_masks.shape[0] or (not is_last and leaf_at >= leaf_masks.shape[0]):
                return -1, -1
            # The parent's upper neighbours serve all eight children.
            key = signed(keys[n])
            upper = upper_states(states, offset, key, d)
            child_mask = signed(child_masks[at])
            leaf_mask = signed(leaf_masks[leaf_at]) if not is_last else 255
            children = leaves = 0
            # Two questions about each child: does it exist, and is it a leaf?
            for c in range(8):
                child = 8 * key + c
                contexts = _contexts(states, below, child, d + 1, upper, children, group)
                there, live = code_mixed(live, data, odds, contexts, 0, weights, 2 * group, (child_mask >> c) & 1)
                if not there:
                    continue
                leaf = 1
                if not is_last:
                    leaf, live = code_mixed(live, data, odds, contexts, 1, weights, 2 * group + 1, (leaf_mask >> c) & 1)
                children |= 1 << c
                leaves |= leaf << c
                states[U(below + child)] = LEAF if leaf else INNER
                if not leaf:
                    if found >= keys.shape[0]:
                        return -1, -1
                    keys[found] = child
                    found += 1
            # The masks, complete: the same when encoding, new when decoding.
            child_masks[at] = children
            at += 1
            if not is_last:
                leaf_masks[leaf_at] = leaves
                leaf_at += 1
        first, last = last, found
        offset = below
    suspend_into(coder, live)
    return at, leaf_at


@nb.njit(nogil=True, forceinline=True)
def _contexts(states: Bytes, offset: int, child: int, depth: int, upper: int, before: int, group: int) -> Opinions:
    """Contexts of a child at its depth, whose states begin at `offset`; `before`: siblings that exist."""
    # States as digits: lower neighbours across faces and edges, upper ones of the parent.
    faces = edges = above = 0
    lower = lower_places(child, depth)
    for i in range(3):
        faces = 3 * faces + state_of(states, offset, lower[i], depth)
    for i in range(3, 7):
        edges = 3 * edges + state_of(states, offset, lower[i], depth)
    near = faces
    for axis in range(3):
        state = (upper >> (2 * axis)) & 3
        near = 4 * near + (state if (child >> axis) & 1 else SIBLING)
        above = 3 * above + state
    # The three opinions, each in a table of its own, two contexts each: one for each question.
    family = (above * 256 + before) * 8 + (child & 7)
    return (
        2 * (near * GROUPS + group),
        2 * (GROUPS * FACES + (edges * 27 + faces) * GROUPS + group),
        2 * (GROUPS * (FACES + EDGES) + family * GROUPS + group),
    )


@nb.njit(nogil=True, forceinline=True)
def upper_states(states: Bytes, offset: int, key: int, depth: int) -> int:
    """States of the three neighbours one step up, two bits each."""
    x, y, z = upper_places(key, depth)
    found = state_of(states, offset, x, depth)
    found |= state_of(states, offset, y, depth) << 2
    return found | (state_of(states, offset, z, depth) << 4)


@nb.njit(nogil=True, forceinline=True)
def state_of(states: Bytes, offset: int, key: int, depth: int) -> int:
    """State of a node, whose depth's states begin at `offset`; LEAF in a larger leaf, ABSENT beyond the cell."""
    state = ABSENT
    if key != NONE:
        state = signed(states[U(offset + key)])
        if state == ABSENT:
            # A node inside a leaf has no state of its own: its ancestors are asked, up to the first that exists.
            while state == ABSENT and depth > 0:
                depth -= 1
                offset -= 1 << (3 * depth)
                key >>= 3
                state = signed(states[U(offset + key)])
            state = LEAF if state == LEAF else ABSENT
    # As in `mixing_kernels.code_number`: no references are counted.
    _ = states.shape
    return state
