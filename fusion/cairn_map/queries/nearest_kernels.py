"""Search for the nearest occupied or unknown voxel. Lengths are in voxel edges, to the nearest point of the voxel.

Bricks are searched in shells, the surfaces of growing cubes around the point's own brick, until the next shell is
farther away than the voxel found. Where the shells come to more places than the cells have for bricks, an occupied
voxel is looked for in all cells instead: two cells far apart make the box of a small map large. These kernels check
nothing.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Floats, Ints
from cairn_map.evidence.grid import NANOMETRES
from cairn_map.kernels.integer_kernels import U, signed
from cairn_map.kernels.morton_kernels import squeeze
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, OCCUPIED_BITS, Grid, brick_of, voxel_of, x_in_block
from cairn_map.queries.point_kernels import is_within


@nb.njit(cache=True, nogil=True)
def nearest_into(
    grid: Grid, points: Floats, reach_m: float, radius: float, unknown: bool, distances: Floats, voxels: Ints
) -> bool:
    """Write (N,) distances from (N, 3) points (metres) to the nearest voxel, unknown or else occupied, and its number.

    Where none is within `radius`, the distance is infinite and the number that of the point's own voxel. Returns True
    if all points are finite and within reach.
    """
    inside = True
    start, own = np.empty(3), np.empty(3, np.int64)
    for n in range(points.shape[0]):
        inside &= is_within(points, n, reach_m)
        for axis in range(3):
            start[axis] = np.rint(points[n, axis] * NANOMETRES) / grid.edge_nm
            own[axis] = voxel_of(points[n, axis], grid.edge_nm)
        voxels[n] = own
        distances[n] = np.inf
        # A point outside may have any number, infinity too; the caller refuses all of them.
        if inside:
            distances[n] = search_into(grid, start, own, radius, unknown, voxels[n])
    return inside


@nb.njit(nogil=True)
def search_into(grid: Grid, start: Floats, own: Ints, radius: float, unknown: bool, voxel: Ints) -> float:
    """Distance from one point to the nearest voxel, infinite if there is none; writes the voxel found."""
    best = np.nextafter(radius * radius, np.inf)  # squared; what lies at the radius itself still counts
    found = False
    places = 0
    # Bounds of the search, in bricks: the box of all cells.
    bx, by, bz = own[0] >> 3, own[1] >> 3, own[2] >> 3
    low_x, low_y, low_z = grid.low[0] >> 3, grid.low[1] >> 3, grid.low[2] >> 3
    high_x, high_y, high_z = (grid.high[0] >> 3) - 1, (grid.high[1] >> 3) - 1, (grid.high[2] >> 3) - 1
    # Around the map all is unknown, one brick far at least.
    if unknown:
        low_x, low_y, low_z = min(low_x, bx) - 1, min(low_y, by) - 1, min(low_z, bz) - 1
        high_x, high_y, high_z = max(high_x, bx) + 1, max(high_y, by) + 1, max(high_z, bz) + 1
    # Invariant: no brick of an earlier shell holds a voxel nearer than `best`.
    first = max(low_x - bx, bx - high_x, low_y - by, by - high_y, low_z - bz, bz - high_z, 0)
    last = max(high_x - bx, bx - low_x, high_y - by, by - low_y, high_z - bz, bz - low_z)
    for shell in range(first, last + 1):
        gap = shell_distance(start, bx, by, bz, shell)
        if gap * gap >= best:
            break
        for x in range(max(bx - shell, low_x), min(bx + shell, high_x) + 1):
            for y in range(max(by - shell, low_y), min(by + shell, high_y) + 1):
                # What is unknown is found where no brick is, so those shells end by themselves.
                if places > grid.bricks.size and not unknown:
                    nearer = search_all_into(grid, start, best, voxel)
                    return np.sqrt(nearer) if found or nearer < best else np.inf
                # A column of the shell: all of it on the cube's sides, else only its two ends.
                step = 1 if abs(x - bx) == shell or abs(y - by) == shell else max(2 * shell, 1)
                from_z = bz - shell
                if step == 1:
                    from_z = max(from_z, low_z)
                to_z = min(bz + shell, high_z)
                places += 1 + max(0, to_z - from_z) // step
                for z in range(from_z, to_z + 1, step):
                    if z < low_z or box_distance_squared(start, 8 * x, 8 * y, 8 * z, 8) >= best:
                        continue
                    closer = search_brick_into(grid, start, x, y, z, best, unknown, voxel)
                    if closer < best:
                        best, found = closer, True
    return np.sqrt(best) if found else np.inf


@nb.njit(nogil=True)
def search_all_into(grid: Grid, start: Floats, best: float, voxel: Ints) -> float:
    """Least squared distance to an occupied voxel of any brick, if it is below `best`, else `best`; writes it."""
    for slot in range(grid.cells.shape[0]):
        x0, y0, z0 = (
            grid.cells[slot, 0] << grid.depth,
            grid.cells[slot, 1] << grid.depth,
            grid.cells[slot, 2] << grid.depth,
        )
        if box_distance_squared(start, x0, y0, z0, 1 << grid.depth) >= best:
            continue
        for b in range(grid.bricks.shape[1]):
            if grid.bricks[slot, b] < 0:
                continue
            # b is the brick's Morton code in the cell.
            x, y, z = signed(squeeze(U(b))), signed(squeeze(U(b >> 1))), signed(squeeze(U(b >> 2)))
            bx, by, bz = (x0 >> 3) + x, (y0 >> 3) + y, (z0 >> 3) + z
            if box_distance_squared(start, 8 * bx, 8 * by, 8 * bz, 8) < best:
                best = search_brick_into(grid, start, bx, by, bz, best, False, voxel)
    return best


@nb.njit(nogil=True)
def search_brick_into(
    grid: Grid, start: Floats, bx: int, by: int, bz: int, best: float, unknown: bool, voxel: Ints
) -> float:
    """Least squared distance to a voxel of a brick, if it is below `best`, else `best`; writes that voxel."""
    brick = brick_of(grid, 8 * bx, 8 * by, 8 * bz)
    if brick < 0:
        # All of an absent brick is unknown: its nearest point counts.
        if not unknown:
            return best
        corner = (8 * bx, 8 * by, 8 * bz)
        for axis in range(3):
            voxel[axis] = min(max(int(np.floor(start[axis])), corner[axis]), corner[axis] + 7)
        return box_distance_squared(start, 8 * bx, 8 * by, 8 * bz, 8)
    for w in range(8):
        words = grid.words[brick, w]
        bits = ~words[KNOWN_BITS] if unknown else words[OCCUPIED_BITS]
        x, y, z = 8 * bx + 4 * (w & 1), 8 * by + 2 * (w & 2), 8 * bz + (w & 4)
        # Blocks without such a voxel, or farther away, are skipped.
        if bits == U(0) or box_distance_squared(start, x, y, z, 4) >= best:
            continue
        for n in range(64):
            if (bits >> U(n)) & U(1) != U(0):
                vx, vy, vz = x + x_in_block(n), y + x_in_block(n >> 1), z + x_in_block(n >> 2)
                distance = box_distance_squared(start, vx, vy, vz, 1)
                if distance < best:
                    best = distance
                    voxel[0], voxel[1], voxel[2] = vx, vy, vz
    return best


@nb.njit(nogil=True, forceinline=True)
def shell_distance(start: Floats, bx: int, by: int, bz: int, shell: int) -> float:
    """Lower bound of the distance to the bricks that are `shell` bricks away from (bx, by, bz); 0 for that brick."""
    least = np.inf
    for axis, brick in enumerate((bx, by, bz)):
        least = min(least, start[axis] - 8 * (brick - shell + 1), 8 * (brick + shell) - start[axis])
    return max(least, 0.0)


@nb.njit(nogil=True, forceinline=True)
def box_distance_squared(start: Floats, x: int, y: int, z: int, size: int) -> float:
    """Squared distance from a point to the cube of `size` whose lowest corner is (x, y, z); 0 inside."""
    gx = max(x - start[0], start[0] - (x + size), 0.0)
    gy = max(y - start[1], start[1] - (y + size), 0.0)
    gz = max(z - start[2], start[2] - (z + size), 0.0)
    return gx * gx + gy * gy + gz * gz  # type: ignore[no-any-return]
