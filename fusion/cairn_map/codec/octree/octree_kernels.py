"""Octrees from packed rows and back: child masks, leaf masks, and the first row of each leaf (FORMAT.md section 4).

A node's eight children with equal counts and no samples collapse into one leaf, as far up as they can, but never
the root. So the tree is a function of the evidence alone.

Rows come in Morton order, so nodes of a depth are finished in the order in which their masks are written, and the
leaves of a node that collapses are the last eight that were found. One pass is enough.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Int32s, Ints, Words32

NO_ROW = -1
"""In place of a row: an inner node."""


@nb.njit(cache=True, nogil=True)
def build_into(
    voxels: Words32,
    counts: Int32s,
    sampled: Words32,
    child_masks: Bytes,
    leaf_masks: Bytes,
    masks: Ints,
    leaf_rows: Ints,
) -> int:
    """Write masks and leaves of the octree of V rows; returns the number of leaves.

    `child_masks` and `leaf_masks` are (depth, room), `masks` (depth,) zeros that take the number of masks of each
    depth, and `leaf_rows` (V,) takes the row at which each leaf begins.
    """
    depth = masks.shape[0]
    V = voxels.shape[0]
    # One open node for each depth, on the way from the root to the present voxels: masks of its children so far.
    children = np.zeros(depth, np.uint8)
    leaves = np.zeros(depth, np.uint8)
    # First row of the children of an open node, while they are all leaves with equal counts; else NO_ROW.
    alike = np.full(depth, NO_ROW, np.int64)
    count = 0
    s = 0
    n = 0
    while n < V:
        # The voxels [n, end) of one parent; `fixed` if one of them has samples.
        parent = voxels[n] >> np.uint32(3)
        end = n + 1
        while end < V and voxels[end] >> np.uint32(3) == parent:
            end += 1
        while s < sampled.shape[0] and sampled[s] < n:
            s += 1
        fixed = s < sampled.shape[0] and sampled[s] < end
        # Either all eight are one leaf, or each is one.
        if depth > 1 and end - n == 8 and not fixed and _equal_counts(counts, n):
            leaf_rows[count] = n
            count += 1
            _add_child(children, leaves, alike, counts, depth - 2, np.int64(parent) & 7, n)
        else:
            mask = np.uint8(0)
            for m in range(n, end):
                leaf_rows[count] = m
                count += 1
                mask |= np.uint8(1) << np.uint8(voxels[m] & np.uint32(7))
            child_masks[depth - 1, masks[depth - 1]] = mask
            masks[depth - 1] += 1
            if depth > 1:
                _add_child(children, leaves, alike, counts, depth - 2, np.int64(parent) & 7, NO_ROW)
        n = end
        # Close the open nodes that do not hold the next voxel, from the deepest up.
        d = depth - 2
        key = np.int64(parent) >> 3
        after = np.int64(voxels[n]) >> 6 if n < V else -1
        while d >= 0 and key != after:
            count -= _close_into(children, leaves, alike, counts, child_masks, leaf_masks, masks, d, key & 7)
            d -= 1
            key >>= 3
            after = after >> 3 if after >= 0 else -1
    return count


@nb.njit(nogil=True, forceinline=True)
def _close_into(
    children: Bytes,
    leaves: Bytes,
    alike: Ints,
    counts: Int32s,
    child_masks: Bytes,
    leaf_masks: Bytes,
    masks: Ints,
    d: int,
    c: int | np.int64,
) -> int:
    """Close the open node of depth d, which is child c of the one above; returns the number of leaves that vanish."""
    vanished = 0
    if d > 0 and alike[d] != NO_ROW and children[d] == 255:
        # Eight equal leaves, the last eight, become one leaf of the node above.
        _add_child(children, leaves, alike, counts, d - 1, c, alike[d])  # pyright: ignore[reportArgumentType]
        vanished = 7
    else:
        # An inner node: its masks are complete.
        child_masks[d, masks[d]] = children[d]
        leaf_masks[d, masks[d]] = leaves[d]
        masks[d] += 1
        if d > 0:
            _add_child(children, leaves, alike, counts, d - 1, c, NO_ROW)
    children[d] = leaves[d] = 0
    return vanished


@nb.njit(nogil=True)
def _equal_counts(counts: Int32s, n: int) -> bool:
    """True if the eight rows from n on have equal counts."""
    different = 0
    for m in range(n + 1, n + 8):
        different |= (counts[m, 0] ^ counts[n, 0]) | (counts[m, 1] ^ counts[n, 1])
    return different == 0


@nb.njit(nogil=True)
def _add_child(
    children: Bytes, leaves: Bytes, alike: Ints, counts: Int32s, d: int, c: int | np.int64, row: int | np.int64
) -> None:
    """Add child c to the open node of depth d: a leaf that begins at a row, or an inner node (NO_ROW)."""
    if children[d] == 0:
        alike[d] = row
    elif (
        row == NO_ROW
        or alike[d] == NO_ROW
        or counts[row, 0] != counts[alike[d], 0]
        or counts[row, 1] != counts[alike[d], 1]
    ):
        alike[d] = NO_ROW
    children[d] |= np.uint8(1 << c)
    if row != NO_ROW:
        leaves[d] |= np.uint8(1 << c)


@nb.njit(nogil=True, forceinline=True)
def ones(byte: np.uint8) -> int:
    """Number of bits of a byte that are 1."""
    # Sums of pairs of bits, of fours, of eight.
    pairs = byte - ((byte >> 1) & 0x55)
    fours = (pairs & 0x33) + ((pairs >> 2) & 0x33)
    return np.int64((fours + (fours >> 4)) & 15)  # type: ignore[return-value]


@nb.njit(cache=True, nogil=True)
def measure_masks(child_masks: Bytes, leaf_masks: Bytes, firsts: Ints, stop: int) -> tuple[int, int, int]:
    """Numbers of child masks, leaf masks and leaves above depth `stop`, or -1 three times if the masks are not sound.

    `firsts` (depth + 1,) takes the index of the first child mask of each depth, and the end of the last one.
    """
    depth = firsts.shape[0] - 1
    nodes = min(1, child_masks.shape[0])
    at = leaf_at = leaves = 0
    # Invariant: depth d has `nodes` inner nodes, of which the masks begin at `at` and `leaf_at`.
    for d in range(stop):
        firsts[d] = at
        if at + nodes > child_masks.shape[0] or (d < depth - 1 and leaf_at + nodes > leaf_masks.shape[0]):
            return -1, -1, -1
        below = 0
        for n in range(nodes):
            mask = child_masks[at + n]
            leaf = mask if d == depth - 1 else leaf_masks[leaf_at + n]
            if mask == 0 or leaf & ~mask != 0:
                return -1, -1, -1
            leaves += ones(leaf)
            below += ones(mask & ~leaf)
        at += nodes
        if d < depth - 1:
            leaf_at += nodes
        nodes = below
    firsts[stop] = at
    return at, leaf_at, leaves


@nb.njit(cache=True, nogil=True)
def list_leaves_into(
    child_masks: Bytes, leaf_masks: Bytes, firsts: Ints, stop: int, starts: Words32, sizes: Ints
) -> None:
    """Write first voxel and size of each leaf, in Morton order; inner nodes at depth `stop` count as leaves.

    The masks are sound (`measure_masks`), and there is room for all leaves and one more: a voxel is written before its
    bit is tested, because a branch on each bit of a mask would be mispredicted half the time.
    """
    # Depth first, with one open node for each depth: its key, and the children that are not visited yet. `places` is
    # the index of the next mask of each depth.
    depth = firsts.shape[0] - 1
    places = firsts.copy()
    keys = np.zeros(depth + 1, np.int64)
    children = np.zeros(depth + 1, np.uint8)
    leaves = np.zeros(depth + 1, np.uint8)
    if child_masks.shape[0] == 0:
        return
    children[0], leaves[0] = child_masks[0], (leaf_masks[0] if depth > 1 else child_masks[0])
    places[0] = 1
    d = 0
    count = 0
    while d >= 0:
        if children[d] == 0:
            d -= 1
            continue
        # The next child of the open node: its lowest bit, which is cleared.
        c = 0
        while (children[d] >> c) & 1 == 0:
            c += 1
        children[d] &= np.uint8(children[d] - 1)
        key = 8 * keys[d] + c
        if d == stop - 1 or (leaves[d] >> c) & 1:
            shift = 3 * (depth - 1 - d)
            starts[count] = np.uint32(key << shift)
            sizes[count] = 1 << shift
            count += 1
            continue
        # An inner child: it is opened.
        d += 1
        at = places[d]
        places[d] = at + 1
        if d == depth - 1:
            # Most nodes are here, and all of their children are voxels.
            mask = child_masks[at]
            for c in range(8):
                starts[count] = np.uint32(8 * key + c)
                sizes[count] = 1
                count += (mask >> c) & 1
            d -= 1
            continue
        keys[d] = key
        children[d] = child_masks[at]
        # Leaf masks stand in the child masks' order, and only the last depth has none.
        leaves[d] = leaf_masks[at]


@nb.njit(cache=True, nogil=True)
def expand_into(starts: Words32, sizes: Ints, leaf_counts: Int32s, voxels: Words32, counts: Int32s) -> None:
    """Write one row per voxel of every leaf; the outputs have room for the sum of the sizes."""
    V = 0
    for n in range(starts.shape[0]):
        hits, misses = leaf_counts[n, 0], leaf_counts[n, 1]
        for step in range(sizes[n]):
            voxels[V] = starts[n] + np.uint32(step)
            counts[V, 0] = hits
            counts[V, 1] = misses
            V += 1


@nb.njit(cache=True, nogil=True)
def expand_content_into(
    starts: Words32, sizes: Ints, leaf_counts: Int32s, sampled: Ints, voxels: Words32, counts: Int32s, rows: Words32
) -> bool:
    """`expand_into`, and write the row of each of the (S,) leaves `sampled`, which rise.

    Returns False, and stops, where a leaf of several voxels has samples, or one without samples has no counts.
    """
    # Unsigned indices: a signed one is tested for being negative.
    V, s = np.uint64(0), 0
    pairs, out = leaf_counts.reshape(-1), counts.reshape(-1)
    for n in range(starts.shape[0]):
        hits, misses = pairs[np.uint64(2 * n)], pairs[np.uint64(2 * n + 1)]
        if s < sampled.shape[0] and sampled[s] == n:
            if sizes[n] != 1:
                return False
            rows[s] = V
            s += 1
        elif hits | misses == 0:
            return False
        for step in range(np.uint64(sizes[n])):
            voxels[V] = starts[n] + np.uint32(step)
            out[V + V] = hits
            out[V + V + np.uint64(1)] = misses
            V += np.uint64(1)
    return True


@nb.njit(cache=True, nogil=True)
def check_leaves(starts: Words32, sizes: Ints, counts: Int32s, sampled: Ints, whole: int) -> tuple[bool, bool]:
    """Two answers: True if no leaf is empty and none of several voxels has samples; True if all is collapsed.

    The cell has `whole` voxels.
    """
    # `alike`: length of the run of leaves without samples that agree in size, parent and counts. Eight of them fill
    # their parent, which should have been one leaf, unless it is the root.
    collapsed = True
    s = alike = 0
    size_before, parent_before, hits_before, misses_before = np.int64(0), np.int64(0), np.int32(0), np.int32(0)
    for n in range(starts.shape[0]):
        size, hits, misses = sizes[n], counts[n, 0], counts[n, 1]
        parent = np.int64(starts[n]) & -(8 * size)
        has_samples = s < sampled.shape[0] and sampled[s] == n
        s += has_samples
        if (has_samples and size != 1) or (not has_samples and hits | misses == 0):
            return False, False
        different = (size ^ size_before) | (parent ^ parent_before) | (hits ^ hits_before) | (misses ^ misses_before)
        alike = 0 if has_samples else 1 if different != 0 else alike + 1
        collapsed &= alike < 8 or 8 * size >= whole
        size_before, parent_before, hits_before, misses_before = size, parent, hits, misses
    return True, collapsed


@nb.njit(cache=True, nogil=True)
def bricks_of_leaves(starts: Words32, sizes: Ints) -> int:
    """Number of bricks of 8^3 voxels that leaves, rising, touch."""
    # `after`: one beyond the last brick counted.
    bricks = 0
    after = np.int64(0)
    for n in range(starts.shape[0]):
        # Bricks [first, stop) of the leaf.
        first, stop = np.int64(starts[n]) >> 9, (np.int64(starts[n]) + sizes[n] + 511) >> 9
        bricks += stop - max(first, after)
        after = stop
    return bricks


@nb.njit(cache=True, nogil=True)
def leaves_of_rows(leaf_rows: Ints, rows: Words32) -> Ints:
    """(S,) leaf that begins at each of the rows, which rise; at every one of them a leaf begins."""
    out = np.empty(rows.shape[0], np.int64)
    leaf = 0
    for n in range(rows.shape[0]):
        while leaf_rows[leaf] < rows[n]:
            leaf += 1
        out[n] = leaf
    return out
