"""Solids and rays in a dense box of voxels: which part of each voxel is solid, and which voxels a ray passes.

    add_solid_into       blocks of 8^3 voxels, then voxels, then their 4^3 samples; each only where the surface may be
    mark_seen_into       the voxels along a ray (Amanatides and Woo 1987), cut at the box

`truth_grid` is the caller that checks; the slow twins stand in tests/cairn_sim/evaluation/test_truth_grid.py.
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from cairn_map.arrays import Floats
from cairn_sim.scene.solid_kernels import BOX, CYLINDER, SPHERE, inverse_of

Longs = npt.NDArray[np.int64]
Masks = npt.NDArray[np.uint64]
Marks = npt.NDArray[np.uint8]

BLOCK = 8
"""Voxels along a block's edge: a wall's inside and a room's air are dealt with 512 voxels at a time."""
SAMPLES = 4
"""Along a voxel's edge; the centres of as many cubes."""
ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
TOUCH_M = 1e-9
"""A sample this far outside is inside, so that faces on a grid's own lines do not hang on rounding."""
GRAZE_M = 1e-9
"""A voxel is passed if the ray stays longer than this: not by a ray that touches an edge, or ends on a face."""
PASSED, HIT = 1, 2


@njit(cache=True, nogil=True, error_model="numpy")
def add_solid_into(
    kind: int, frame: Floats, half_m: Floats, first_m: Floats, edge_m: float, start: Longs, stop: Longs, masks: Masks
) -> None:
    """Set the bits of the samples that lie in one solid.

    Sample (i, j, k) of a voxel, 0 to 3 along x, y, z, is bit 16 i + 4 j + k.

    Args:
        kind: box, cylinder, sphere, plane, as in `Shapes`; so are `frame` (12,) and `half_m` (3,).
        frame: R_solid_map by rows, then the centre in the map.
        half_m: half of what it spans along its own axes.
        first_m: (3,) centre of voxel (0, 0, 0), map frame.
        edge_m: of a voxel.
        start: (3,) first voxel of the box that the solid may touch.
        stop: (3,) the voxel behind the last one.
        masks: (X, Y, Z) of the box.
    """
    hx, hy, hz = half_m[0], half_m[1], half_m[2]
    # The first voxel's centre and the step to the next along the map's x, y and z, in the solid's axes.
    dx, dy, dz = first_m[0] - frame[9], first_m[1] - frame[10], first_m[2] - frame[11]
    cx = frame[0] * dx + frame[1] * dy + frame[2] * dz
    cy = frame[3] * dx + frame[4] * dy + frame[5] * dz
    cz = frame[6] * dx + frame[7] * dy + frame[8] * dz
    xx, xy, xz = frame[0] * edge_m, frame[3] * edge_m, frame[6] * edge_m
    yx, yy, yz = frame[1] * edge_m, frame[4] * edge_m, frame[7] * edge_m
    zx, zy, zz = frame[2] * edge_m, frame[5] * edge_m, frame[8] * edge_m
    # From the centre to the outermost samples, with room for rounding.
    voxel_reach = math.sqrt(3.0) * edge_m * (SAMPLES - 1) / (2 * SAMPLES) + TOUCH_M
    block_reach = math.sqrt(3.0) * edge_m * (BLOCK - 1) / 2 + voxel_reach
    middle = (BLOCK - 1) / 2
    # Stage 1, blocks of 8^3 voxels: `_excess` bounds the distance, so a block far from the surface is wholly in or
    # out.
    for bx in range(start[0], stop[0], BLOCK):
        for by in range(start[1], stop[1], BLOCK):
            for bz in range(start[2], stop[2], BLOCK):
                mx, my, mz = bx + middle, by + middle, bz + middle
                excess = _excess(
                    kind,
                    cx + mx * xx + my * yx + mz * zx,
                    cy + mx * xy + my * yy + mz * zy,
                    cz + mx * xz + my * yz + mz * zz,
                    hx,
                    hy,
                    hz,
                )
                if excess > block_reach:
                    continue
                # Stage 2, voxels of a block that the surface may cross.
                for i in range(bx, min(bx + BLOCK, stop[0])):
                    for j in range(by, min(by + BLOCK, stop[1])):
                        px, py, pz = cx + i * xx + j * yx, cy + i * xy + j * yy, cz + i * xz + j * yz
                        for k in range(bz, min(bz + BLOCK, stop[2])):
                            if excess < -block_reach:
                                masks[i, j, k] = ALL
                                continue
                            # Another solid fills this voxel already.
                            if masks[i, j, k] == ALL:
                                continue
                            x, y, z = px + k * zx, py + k * zy, pz + k * zz
                            here = _excess(kind, x, y, z, hx, hy, hz)
                            if here < -voxel_reach:
                                masks[i, j, k] = ALL
                            # Stage 3, the 4^3 samples of a voxel that the surface may cross.
                            elif here <= voxel_reach:
                                masks[i, j, k] |= _mask(kind, x, y, z, xx, xy, xz, yx, yy, yz, zx, zy, zz, hx, hy, hz)


@njit(cache=True, nogil=True, error_model="numpy")
def _excess(kind: int, x: float, y: float, z: float, hx: float, hy: float, hz: float) -> float:
    """Below 0 inside a solid, above 0 outside; never farther from 0 than the surface is from the point."""
    if kind == BOX:
        return max(max(abs(x) - hx, abs(y) - hy), abs(z) - hz)
    if kind == CYLINDER:
        return max(math.sqrt(x * x + y * y) - hx, abs(z) - hz)
    if kind == SPHERE:
        return math.sqrt(x * x + y * y + z * z) - hx
    return z


@njit(cache=True, nogil=True, error_model="numpy")
def _mask(
    kind: int,
    x: float,
    y: float,
    z: float,
    xx: float,
    xy: float,
    xz: float,
    yx: float,
    yy: float,
    yz: float,
    zx: float,
    zy: float,
    zz: float,
    hx: float,
    hy: float,
    hz: float,
) -> np.uint64:
    """The samples in a solid of the voxel with its centre at x, y, z; xx to zz are the steps to the next voxels."""
    mask, bit = np.uint64(0), np.uint64(1)
    for i in range(SAMPLES):
        # Centres of 4^3 cubes, as shares of the edge from the voxel's centre.
        a = (2 * i + 1 - SAMPLES) / (2 * SAMPLES)
        for j in range(SAMPLES):
            b = (2 * j + 1 - SAMPLES) / (2 * SAMPLES)
            px, py, pz = x + a * xx + b * yx, y + a * xy + b * yy, z + a * xz + b * yz
            for k in range(SAMPLES):
                c = (2 * k + 1 - SAMPLES) / (2 * SAMPLES)
                if _excess(kind, px + c * zx, py + c * zy, pz + c * zz, hx, hy, hz) <= TOUCH_M:
                    mask |= bit
                bit <<= np.uint64(1)
    return mask


@njit(cache=True, nogil=True, error_model="numpy")
def mark_seen_into(
    origin: Floats, directions: Floats, range_m: Floats, max_range_m: float, low: Longs, edge_nm: int, marks: Marks
) -> None:
    """Mark the voxels that hold an end point as HIT, and those that rays pass before it as PASSED; a hit wins.

    Args:
        origin: (3,) of all rays, metres, map frame.
        directions: (N, 3) unit vectors, map frame.
        range_m: (N,) to the end points.
        max_range_m: rays that end beyond it, or nowhere, mark nothing.
        low: (3,) number of the box's first voxel.
        edge_nm: of a voxel.
        marks: (X, Y, Z) of the box; what lies outside is not marked, but passed.
    """
    nx, ny, nz = marks.shape
    per_m = 1e9 / edge_nm
    # In voxels from the box's corner.
    ox, oy, oz = origin[0] * per_m - low[0], origin[1] * per_m - low[1], origin[2] * per_m - low[2]
    for n in range(len(directions)):
        far = range_m[n]
        if not far <= max_range_m:
            continue
        # The end point's voxel; a hit is never overwritten by a later pass.
        hx = _voxel(origin[0] + far * directions[n, 0], edge_nm) - low[0]
        hy = _voxel(origin[1] + far * directions[n, 1], edge_nm) - low[1]
        hz = _voxel(origin[2] + far * directions[n, 2], edge_nm) - low[2]
        if 0 <= hx < nx and 0 <= hy < ny and 0 <= hz < nz:
            marks[hx, hy, hz] = HIT
        # The part of the ray inside the box, in units of voxels.
        dx, dy, dz = directions[n, 0] * per_m, directions[n, 1] * per_m, directions[n, 2] * per_m
        ix, iy, iz = inverse_of(dx), inverse_of(dy), inverse_of(dz)
        ax, bx = _inside(ox, ix, nx)
        ay, by = _inside(oy, iy, ny)
        az, bz = _inside(oz, iz, nz)
        t, far = max(max(ax, ay), max(az, 0.0)), min(min(bx, by), min(bz, far))
        if not far - t > GRAZE_M:
            continue
        # Walk from border to border (Amanatides and Woo 1987): the next is the nearest of three.
        x, y, z = _start(ox + t * dx, nx), _start(oy + t * dy, ny), _start(oz + t * dz, nz)
        tx, sx, ux = _borders(ox, ix, x)
        ty, sy, uy = _borders(oy, iy, y)
        tz, sz, uz = _borders(oz, iz, z)
        while True:
            out = min(min(tx, ty), tz)
            # A voxel counts as passed if the ray stays in it, and if no hit lies there.
            if out - t > GRAZE_M and marks[x, y, z] == 0:
                marks[x, y, z] = PASSED
            if out >= far - GRAZE_M:
                break
            # Step across the border that is reached first.
            t = out
            if tx == out:
                x += ux
                tx += sx
            elif ty == out:
                y += uy
                ty += sy
            else:
                z += uz
                tz += sz
            if not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
                break


@njit(cache=True, nogil=True, error_model="numpy")
def _voxel(at_m: float, edge_nm: int) -> int:
    """As `grid.voxels_of_points`: rounded to nanometres, then the floor in integers."""
    voxel: int = np.int64(np.rint(at_m * 1e9)) // edge_nm  # type: ignore[assignment]
    return voxel


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(o: float, inverse: float, count: int) -> tuple[float, float]:
    """Distances along the ray at which one axis enters 0 to `count`, and leaves it."""
    a, b = -o * inverse, (count - o) * inverse
    return min(a, b), max(a, b)


@njit(cache=True, nogil=True, error_model="numpy")
def _start(at: float, count: int) -> int:
    """The voxel at a place along one axis; inside the box, whatever the rounding."""
    return min(max(math.floor(at), 0), count - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _borders(o: float, inverse: float, at: int) -> tuple[float, float, int]:
    """Along one axis: the ray's length at the first border, from each border to the next, and the step."""
    if inverse > 0.0:
        return (at + 1 - o) * inverse, inverse, 1
    return (at - o) * inverse, -inverse, -1
