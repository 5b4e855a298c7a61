"""What a camera sees of a map: for each pixel's ray the first occupied node that is no smaller than the pixel.

A ray walks as in `ray_kernels`, but only stops where something is: `skips` says for every brick how large a cube around
it holds nothing occupied, so that a room is crossed in a few steps. Far away, where a voxel is smaller than a pixel,
nodes of 2, 4 or 8 voxels stand for it, the finest that no pixel's ray can miss: an obstacle never slips through.
Lengths are in voxel edges.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Floats, Int32s, Ints
from cairn_map.codec.entropy.arithmetic_kernels import signed
from cairn_map.evidence.grid import NANOMETRES
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, NONE, OCCUPIED_BITS, Grid, U, place_of, slot_of
from cairn_map.queries.ray_kernels import NOWHERE, along, beyond, is_in_box

Ranges = npt.NDArray[np.float32]
Places = npt.NDArray[np.uint32]
NODE_DEPTH = 3
"""Nodes have 2^3 voxels along an edge at most: a brick."""
FIRST_OF_8 = U(0x0101010101010101)


@nb.njit(cache=True, nogil=True)
def skips_into(grid: Grid, skips: Bytes) -> None:
    """(C, 8^(depth - 3)): 2^n voxels along an edge, aligned, hold nothing occupied around a brick; 0 if it holds some.

    Bricks are in Morton order, so that those of one larger cube follow each other.
    """
    bricks = skips.shape[1]
    for slot in range(skips.shape[0]):
        for b in range(bricks):
            row = grid.bricks[slot, b]
            some = U(0)
            if row >= 0:
                for w in range(8):
                    some |= grid.words[row, w, OCCUPIED_BITS]
            skips[slot, b] = 0 if some else NODE_DEPTH
        for up in range(1, grid.depth - NODE_DEPTH + 1):
            group = 8**up
            for first in range(0, bricks, group):
                is_empty = True
                for b in range(first, first + group, group // 8):
                    is_empty &= skips[slot, b] == NODE_DEPTH + up - 1
                if is_empty:
                    skips[slot, first : first + group] = NODE_DEPTH + up


@nb.njit(cache=True, nogil=True)
def see_into(
    grid: Grid,
    skips: Bytes,
    T_map_camera: Floats,
    rays: Floats,
    pixel_rad: float,
    starts: Ranges,
    ends: Ranges,
    is_beyond: bool,
    ranges: Ranges,
    slots: Int32s,
    places: Places,
    nodes: Bytes,
) -> None:
    """The first occupied node along each of (N, 3) unit rays of a camera at a place in the map.

    Args:
        grid: the map's states.
        skips: of `skips_into`.
        T_map_camera: (4, 4), metres; within the numbered space.
        rays: (N, 3), camera frame; NaN looks nowhere.
        pixel_rad: angle that a node must span to be met by some ray.
        starts: (N,) where each walk begins; NaN for nowhere.
        ends: (N,) where it ends; NaN for nowhere.
        is_beyond: walk through whatever is there until a free voxel is met, and only then look: for what lies beyond a
            surface, and is not its own other side.
        ranges: (N,) out: where the node is entered; NaN where there is none.
        slots: (N,) out: its cell, NONE where there is none.
        places: (N,) out: Morton code inside the cell of the voxel at which it is entered.
        nodes: (N,) out: n of its 2^n voxels along an edge.
    """
    start, direction, voxel = np.empty(3), np.empty(3), np.empty(3, np.int64)
    for axis in range(3):
        start[axis] = np.rint(T_map_camera[axis, 3] * NANOMETRES) / grid.edge_nm
    for n in range(rays.shape[0]):
        ranges[n], slots[n], places[n], nodes[n] = np.nan, NONE, 0, 0
        if not starts[n] <= ends[n]:  # NaN, too
            continue
        for axis in range(3):
            direction[axis] = (
                T_map_camera[axis, 0] * rays[n, 0]
                + T_map_camera[axis, 1] * rays[n, 1]
                + T_map_camera[axis, 2] * rays[n, 2]
            )
        at = begin_into(grid, start, direction, starts[n], voxel)
        if at <= ends[n]:  # False for NaN
            ranges[n], slots[n], places[n], nodes[n] = look(
                grid, skips, start, direction, at, float(ends[n]), pixel_rad, is_beyond, voxel
            )


@nb.njit(nogil=True)
def begin_into(grid: Grid, start: Floats, direction: Floats, at: float, voxel: Ints) -> float:
    """Where in the box of all cells a walk from `at` on begins, and in which voxel; NaN if it does not."""
    enters, leaves = float(at), np.inf
    inside = True
    for axis in range(3):
        reached = start[axis] + enters * direction[axis]
        inside &= (reached >= grid.low[axis]) & (reached < grid.high[axis])
        if inside:
            voxel[axis] = int(np.floor(reached))
    if inside:
        return enters
    for axis in range(3):
        if direction[axis] == 0:
            if not grid.low[axis] <= start[axis] < grid.high[axis]:
                return np.nan
            continue
        a = (grid.low[axis] - start[axis]) / direction[axis]
        b = (grid.high[axis] - start[axis]) / direction[axis]
        enters, leaves = max(enters, min(a, b)), min(leaves, max(a, b))
    if not enters < leaves:
        return np.nan
    for axis in range(3):
        reached = int(np.floor(start[axis] + enters * direction[axis]))
        voxel[axis] = min(max(reached, grid.low[axis]), grid.high[axis] - 1)
    return enters


@nb.njit(nogil=True)
def look(
    grid: Grid,
    skips: Bytes,
    start: Floats,
    direction: Floats,
    at: float,
    range_max: float,
    pixel_rad: float,
    is_beyond: bool,
    voxel: Ints,
) -> tuple[float, int, int, int]:
    """Range, cell, place and node of the first that is occupied, from a voxel on that is entered at `at`."""
    depth, mask = grid.depth, (1 << grid.depth) - 1
    x, y, z = voxel[0], voxel[1], voxel[2]
    start_x, inverse_x, up_x = along(start[0], direction[0], x)
    start_y, inverse_y, up_y = along(start[1], direction[1], y)
    start_z, inverse_z, up_z = along(start[2], direction[2], z)
    cell_x, cell_y, cell_z, slot = NOWHERE, NOWHERE, NOWHERE, NONE
    waits = is_beyond
    while at <= range_max:
        if (x >> depth != cell_x) | (y >> depth != cell_y) | (z >> depth != cell_z):
            voxel[0], voxel[1], voxel[2] = x, y, z
            if not is_in_box(grid, voxel):
                break
            cell_x, cell_y, cell_z = x >> depth, y >> depth, z >> depth
            slot = slot_of(grid, cell_x, cell_y, cell_z)
        size = 1 << depth
        if slot >= 0:
            place = place_of(x, y, z, mask)
            skip = signed(skips[U(slot), U(place >> 9)])
            size = 1 << skip
            if waits or skip == 0:
                size = 8
                brick = signed(grid.bricks[U(slot), U(place >> 9)])
                if brick >= 0:
                    size = 4
                    b, w = U(brick), U((place >> 6) & 7)
                    occupied = grid.words[b, w, OCCUPIED_BITS]
                    node = node_at(at * pixel_rad)
                    if node:
                        occupied = U(0) if skip else in_nodes(occupied, node)
                    ends = ~occupied & grid.words[b, w, KNOWN_BITS] if waits else occupied
                    if ends != U(0):
                        # Voxel by voxel, until one ends it or the block is left.
                        block_x, block_y, block_z = x & -4, y & -4, z & -4
                        bit = U(place & 63)
                        while (ends >> bit) & U(1) == U(0):
                            to_x = (x + (up_x & 1) - start_x) * inverse_x
                            to_y = (y + (up_y & 1) - start_y) * inverse_y
                            to_z = (z + (up_z & 1) - start_z) * inverse_z
                            leaves = min(to_x, to_y, to_z)
                            at = max(at, leaves)
                            x += (up_x | 1) * -int(to_x == leaves)
                            y += (up_y | 1) * -int(to_y == leaves)
                            z += (up_z | 1) * -int(to_z == leaves)
                            if ((x ^ block_x) | (y ^ block_y) | (z ^ block_z)) & -4 != 0:
                                break
                            bit = U(place_of(x, y, z, 3))
                        else:
                            if waits:
                                waits = False
                                continue
                            if at <= range_max:
                                return at, slot, place_of(x, y, z, mask), node
                            break
                        continue
        to_x = ((x & -size) + (up_x & size) - start_x) * inverse_x
        to_y = ((y & -size) + (up_y & size) - start_y) * inverse_y
        to_z = ((z & -size) + (up_z & size) - start_z) * inverse_z
        at = max(at, min(to_x, to_y, to_z))
        x = beyond(x, size, up_x, start_x + at * direction[0], to_x <= at)
        y = beyond(y, size, up_y, start_y + at * direction[1], to_y <= at)
        z = beyond(z, size, up_z, start_z + at * direction[2], to_z <= at)
    return np.nan, NONE, 0, 0


@nb.njit(nogil=True, forceinline=True)
def node_at(pixel: float) -> int:
    """N of the smallest nodes, 2^n voxels along an edge, that are no smaller than a pixel there; 3 at most."""
    return int(pixel > 1) + int(pixel > 2) + int(pixel > 4)


@nb.njit(nogil=True, forceinline=True)
def in_nodes(occupied: np.uint64, node: int) -> np.uint64:
    """Of 4^3 voxels, in a brick with some occupied: those in an occupied node, n from 1."""
    if node == 1:
        some = occupied | (occupied >> U(4))
        some |= some >> U(2)
        some |= some >> U(1)
        return (some & FIRST_OF_8) * U(255)
    if node == 2:
        return ~U(0) if occupied else U(0)
    return ~U(0)
