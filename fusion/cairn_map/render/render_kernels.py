"""Kernels of rendering: rays of a camera to the nodes that its pixels see, readings of these nodes, and their colours.

A pixel sees the first occupied node along its ray that is no smaller than the pixel. Rays walk as in `ray_kernels`, but
stop only at occupied voxels: `skips` gives for every brick the largest cube around it that holds nothing occupied, so
that a room is crossed in a few steps. Far away, where a voxel is smaller than a pixel, nodes of 2, 4 or 8 voxels along
an edge stand for it, the finest that no pixel's ray can miss: an obstacle never slips through. Lengths are in voxel
edges. These kernels check nothing.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Floats, Int32s, Ints, Rgb
from cairn_map.evidence.grid import NANOMETRES
from cairn_map.kernels.integer_kernels import U, signed
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, NONE, OCCUPIED_BITS, Grid, place_of, slot_of
from cairn_map.queries.ray_kernels import NOWHERE, enter_box_into, is_in_box, leave_block, ray_through, walk_block

Table = npt.NDArray[np.float32]

Values = npt.NDArray[np.float32]

Ranges = npt.NDArray[np.float32]
Places = npt.NDArray[np.uint32]
NODE_DEPTH = 3
"""Nodes have 2^3 voxels along an edge at most: a brick."""
FIRST_OF_8 = U(0x0101010101010101)
"""Bit 0 of each byte: in Morton order, the first of each 2^3 voxels of a block."""


@nb.njit(cache=True, nogil=True)
def skips_into(grid: Grid, skips: Bytes) -> None:
    """Write (C, 8^(depth - 3)): n of the largest aligned cube, 2^n voxels along an edge, around each brick that holds
    nothing occupied; 0 where the brick itself holds an occupied voxel.

    Bricks are in Morton order, so that those of one larger cube follow each other.
    """
    bricks = skips.shape[1]
    for slot in range(skips.shape[0]):
        # Bricks alone.
        for b in range(bricks):
            row = grid.bricks[slot, b]
            some = U(0)
            if row >= 0:
                for w in range(8):
                    some |= grid.words[row, w, OCCUPIED_BITS]
            skips[slot, b] = 0 if some else NODE_DEPTH
        # Then cubes of 8, 64, ... bricks: empty if their eight parts are.
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
    """Find the first occupied node along each of (N, 3) unit rays of a camera in the map.

    Args:
        grid: the map's states.
        skips: of `skips_into`.
        T_map_camera: (4, 4), metres; within the numbered space.
        rays: (N, 3), camera frame; NaN looks nowhere.
        pixel_rad: angle that a node must span to be met by some ray.
        starts: (N,) where each walk begins; NaN for nowhere.
        ends: (N,) where it ends; NaN for nowhere.
        is_beyond: walk through everything until a free voxel is met, and only then look: for what lies beyond a
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
        # d_map = R_map_camera d_camera
        for axis in range(3):
            direction[axis] = (
                T_map_camera[axis, 0] * rays[n, 0]
                + T_map_camera[axis, 1] * rays[n, 1]
                + T_map_camera[axis, 2] * rays[n, 2]
            )
        # A pixel that looks nowhere: no comparison with NaN ends a walk, so none may begin.
        if np.isnan(direction[0] + direction[1] + direction[2]):
            continue
        at = float(starts[n])
        for axis in range(3):
            voxel[axis] = int(np.floor(start[axis] + at * direction[axis]))
        at = enter_box_into(grid, start, direction, at, voxel)
        if at <= ends[n]:
            ranges[n], slots[n], places[n], nodes[n] = look(
                grid, skips, start, direction, at, float(ends[n]), pixel_rad, is_beyond, voxel
            )


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
    """Range, cell, place and node of the first occupied node along a ray that enters `voxel` at `at`."""
    depth, mask = grid.depth, (1 << grid.depth) - 1
    x, y, z = voxel[0], voxel[1], voxel[2]
    ray = ray_through(start, direction, x, y, z)
    cell_x, cell_y, cell_z, slot = NOWHERE, NOWHERE, NOWHERE, NONE
    waits = is_beyond
    # Invariant: the ray enters voxel (x, y, z) at range `at`; while it `waits`, it has met no free voxel yet.
    while at <= range_max:
        # The cell: looked up only when another one is entered.
        if (x >> depth != cell_x) | (y >> depth != cell_y) | (z >> depth != cell_z):
            voxel[0], voxel[1], voxel[2] = x, y, z
            if not is_in_box(grid, voxel):
                break
            cell_x, cell_y, cell_z = x >> depth, y >> depth, z >> depth
            slot = slot_of(grid, cell_x, cell_y, cell_z)
        # The block that can be crossed in one step: an absent cell, or the largest cube without anything occupied.
        size = 1 << depth
        if slot >= 0:
            place = place_of(x, y, z, mask)
            skip = signed(skips[U(slot), U(place >> 9)])
            size = 1 << skip
            if waits or skip == 0:
                size = 8
                brick = signed(grid.bricks[U(slot), U(place >> 9)])
                if brick >= 0:
                    # 4^3 voxels, enlarged to the nodes that a pixel cannot miss at this range.
                    size = 4
                    b, w = U(brick), U((place >> 6) & 7)
                    occupied = grid.words[b, w, OCCUPIED_BITS]
                    node = node_at(at * pixel_rad)
                    if node:
                        occupied = U(0) if skip else in_nodes(occupied, node)
                    ends = ~occupied & grid.words[b, w, KNOWN_BITS] if waits else occupied
                    if ends != U(0):
                        x, y, z, at, _, is_met = walk_block(ray, x, y, z, at, ends, U(place & 63))
                        if is_met and not waits:
                            if at <= range_max:
                                return at, slot, place_of(x, y, z, mask), node
                            break
                        # Either the block is left, or its first free voxel is met: from here on the ray looks.
                        waits = waits and not is_met
                        continue
        x, y, z, at = leave_block(ray, x, y, z, at, size)
    return np.nan, NONE, 0, 0


@nb.njit(nogil=True, forceinline=True)
def node_at(pixel: float) -> int:
    """Exponent n of the smallest nodes, 2^n voxels along an edge, that are no smaller than a pixel there; 3 at most."""
    return int(pixel > 1) + int(pixel > 2) + int(pixel > 4)


@nb.njit(nogil=True, forceinline=True)
def in_nodes(occupied: np.uint64, node: int) -> np.uint64:
    """Bits of those of 4^3 voxels, in a brick with some occupied, that lie in an occupied node; `node` is n from 1."""
    if node == 1:
        # Any bit of a byte, gathered in its bit 0, and spread to all eight.
        some = occupied | (occupied >> U(4))
        some |= some >> U(2)
        some |= some >> U(1)
        return (some & FIRST_OF_8) * U(255)
    if node == 2:
        return ~U(0) if occupied else U(0)
    return ~U(0)


@nb.njit(cache=True, nogil=True)
def paint_into(values: Values, palette: Rgb, low: float, high: float, unknown: Rgb, out: Rgb) -> None:
    """Write (N, 3) colours of (N,) values between the two ends of a palette (256, 3); `unknown` (3,) for NaN."""
    step = 255 / (high - low)
    for n in range(values.shape[0]):
        value = values[n]
        if np.isnan(value):
            for c in range(3):
                out[n, c] = unknown[c]
        else:
            # Clamped to the palette, and rounded.
            level = int(min(max((value - low) * step, 0.0), 255.0) + 0.5)
            for c in range(3):
                out[n, c] = palette[level, c]


@nb.njit(cache=True, nogil=True)
def blend_into(image: Rgb, ink: Rgb, out: Rgb) -> None:
    """Write (N, 3) pixels under (N, 4) ink: colours that are multiplied by their cover already, and the cover."""
    for n in range(image.shape[0]):
        # out = image (1 - cover) + ink, with 255 for 1; 127 rounds to the nearest.
        rest = 255 - int(ink[n, 3])
        for c in range(3):
            out[n, c] = min((image[n, c] * rest + 127) // 255 + int(ink[n, c]), 255)


@nb.njit(cache=True, nogil=True)
def read_nodes_into(
    rows: Int32s, places: Places, nodes: Bytes, bricks: npt.NDArray[np.int16], table: Table, out: Table
) -> None:
    """Write (N, P) entries of a cell's table (`node_tables`) for the listed pixels, whose nodes lie in its bricks."""
    firsts = (0, 512, 576, 584)  # node_tables.FIRST_OF_NODE
    for n in range(U(rows.shape[0])):
        row = U(rows[n])
        place, node = places[row], nodes[row]
        brick = U(bricks[place >> U(9)])
        # The voxel's Morton number in the brick; without its lowest 3 n bits that of its node.
        at = U(firsts[node]) + ((place & U(511)) >> U(3 * node))
        for p in range(out.shape[1]):
            out[row, p] = table[brick, at, p]
