"""A measurement's evidence in dense bricks: finding the voxels that a scan hit, and packing them all in the end."""

import numba as nb
import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Index = npt.NDArray[np.int32]
Counts = npt.NDArray[np.uint16]
Floats = npt.NDArray[np.float64]

SPREAD = np.array([0, 1, 8, 9, 64, 65, 72, 73], np.int64)
"""Morton spread of three bits."""
NANOMETRES = 1e9


@nb.njit(cache=True, nogil=True)
def returned_points(range_m: npt.NDArray[np.float32], rays: Floats, T_map_camera: Floats) -> tuple[Index, Floats]:
    """(N,) numbers of the pixels with a range and a ray, and (N, 3) their points, map frame (Eq. 1-5)."""
    pixels = np.empty(range_m.size, np.int32)
    points = np.empty((range_m.size, 3))
    count = 0
    flat, beams = range_m.ravel(), rays.reshape(-1, 3)
    for i in range(len(flat)):
        r = np.float64(flat[i])
        if np.isnan(r) or np.isnan(beams[i, 0]):
            continue
        x, y, z = r * beams[i, 0], r * beams[i, 1], r * beams[i, 2]
        for a in range(3):
            T = T_map_camera[a]
            points[count, a] = T[0] * x + T[1] * y + T[2] * z + T[3]
        pixels[count] = i
        count += 1
    return pixels[:count].copy(), points[:count].copy()


@nb.njit(cache=True, nogil=True)
def hit_voxels(points_m: Floats, voxel_edge_nm: int, corner: Ints, dims: Ints) -> Ints:
    """(N,) brick number times 512 plus place of the voxel that holds each (N, 3) point, map frame; -1 outside the box.

    The rule of FORMAT.md section 2: whole nanometres, then floor.
    """
    out = np.empty(len(points_m), np.int64)
    for n in range(len(points_m)):
        x = np.int64(np.rint(points_m[n, 0] * NANOMETRES)) // voxel_edge_nm - corner[0]
        y = np.int64(np.rint(points_m[n, 1] * NANOMETRES)) // voxel_edge_nm - corner[1]
        z = np.int64(np.rint(points_m[n, 2] * NANOMETRES)) // voxel_edge_nm - corner[2]
        bx, by, bz = x >> 3, y >> 3, z >> 3
        if bx < 0 or by < 0 or bz < 0 or bx >= dims[0] or by >= dims[1] or bz >= dims[2]:
            out[n] = -1
            continue
        brick = (bz * dims[1] + by) * dims[0] + bx
        out[n] = (brick << 9) | SPREAD[x & 7] | (SPREAD[y & 7] << 1) | (SPREAD[z & 7] << 2)
    return out


@nb.njit(cache=True, nogil=True)
def claim_bricks_into(numbers: Ints, shift: int, brick_of: Index, bricks: Index, used: int) -> int:
    """Give each brick that has no place in the pool the next one; returns places used. Clear them afterwards."""
    for n in range(len(numbers)):
        brick = numbers[n] >> shift
        if brick_of[brick] < 0:
            brick_of[brick] = used
            bricks[used] = brick
            used += 1
    return used


@nb.njit(cache=True, nogil=True)
def claim_tables_into(voxels: Ints, brick_of: Index, table_of: Index, used: int) -> int:
    """Give each brick with hits a table; returns tables used."""
    for n in range(len(voxels)):
        slot = brick_of[voxels[n] >> 9]
        if table_of[slot] < 0:
            table_of[slot] = used
            used += 1
    return used


@nb.njit(cache=True, nogil=True)
def number_hits_into(
    voxels: Ints, brick_of: Index, table_of: Index, local_of: Index, touched: Ints
) -> tuple[Index, int]:
    """Number the different voxels of a scan's hits as they come; (N,) the number of each point's voxel, and how many.

    `touched` takes each voxel's place, table times 512 plus place, by number.
    """
    numbers = np.empty(len(voxels), np.int32)
    count = 0
    for n in range(len(voxels)):
        table, place = table_of[brick_of[voxels[n] >> 9]], voxels[n] & 511
        if local_of[table, place] < 0:
            local_of[table, place] = count
            touched[count] = (np.int64(table) << 9) | place
            count += 1
        numbers[n] = local_of[table, place]
    return numbers, count


@nb.njit(cache=True, nogil=True)
def add_hits_into(hits: Counts, row_of: Index, samples: Ints, touched: Ints, sums: Ints, rows: int) -> int:
    """Count a hit in each touched voxel, and add its row of sums; returns rows used. `samples` has room for all."""
    for n in range(len(touched)):
        table, place = touched[n] >> 9, touched[n] & 511
        hits[table, place] += np.uint16(1)
        if row_of[table, place] < 0:
            row_of[table, place] = rows
            samples[rows, :] = 0
            rows += 1
        for p in range(sums.shape[1]):
            samples[row_of[table, place], p] += sums[n, p]
    return rows


@nb.njit(cache=True, nogil=True)
def forget_hits_into(local_of: Index, touched: Ints) -> None:
    """Undo `number_hits_into`."""
    for n in range(len(touched)):
        local_of[touched[n] >> 9, touched[n] & 511] = -1


@nb.njit(cache=True, nogil=True)
def absorb_into(
    slots: Index,
    misses: Counts,
    table_of: Index,
    hits: Counts,
    row_of: Index,
    samples: Ints,
    tables: int,
    rows: int,
    other_misses: Counts,
    other_table_of: Index,
    other_hits: Counts,
    other_row_of: Index,
    other_samples: Ints,
) -> tuple[int, int]:
    """Add another tally's bricks, which have these slots here; there is room. Returns tables and rows used."""
    for b in range(len(slots)):
        slot, other = slots[b], other_table_of[b]
        for i in range(512):
            misses[slot, i] += other_misses[b, i]
        if other < 0:
            continue
        if table_of[slot] < 0:
            table_of[slot] = tables
            hits[tables, :] = 0
            row_of[tables, :] = -1
            tables += 1
        table = table_of[slot]
        for i in range(512):
            if other_row_of[other, i] < 0:
                continue
            hits[table, i] += other_hits[other, i]
            if row_of[table, i] < 0:
                row_of[table, i] = rows
                samples[rows, :] = 0
                rows += 1
            for p in range(samples.shape[1]):
                samples[row_of[table, i], p] += other_samples[other_row_of[other, i], p]
    return tables, rows


@nb.njit(cache=True, nogil=True)
def count_known(slots: Index, misses: Counts, table_of: Index, hits: Counts) -> tuple[int, int]:
    """Voxels with a count, and those of them with a hit, in some bricks of the pool."""
    known, hit = 0, 0
    for slot in slots:
        table = table_of[slot]
        for i in range(512):
            struck = table >= 0 and hits[table, i] > 0
            hit += 1 if struck else 0
            known += 1 if struck or misses[slot, i] > 0 else 0
    return known, hit


@nb.njit(cache=True, nogil=True)
def pack_known_into(
    slots: Index,
    numbers: Index,
    misses: Counts,
    table_of: Index,
    hits: Counts,
    row_of: Index,
    sums: Ints,
    places: npt.NDArray[np.uint32],
    counts: Index,
    sampled: npt.NDArray[np.uint32],
    samples: Ints,
) -> int:
    """Write the known voxels of a cell's bricks, given in rising order of number; returns rows of samples written."""
    at, row = 0, 0
    for b in range(len(slots)):
        slot, table = slots[b], table_of[slots[b]]
        for i in range(512):
            struck = table >= 0 and hits[table, i] > 0
            if not (struck or misses[slot, i] > 0):
                continue
            places[at] = (np.uint32(numbers[b]) << np.uint32(9)) | np.uint32(i)
            counts[at, 0] = hits[table, i] if struck else 0
            counts[at, 1] = misses[slot, i]
            if struck:
                some = False
                for p in range(sums.shape[1]):
                    samples[row, p] = sums[row_of[table, i], p]
                    some |= samples[row, p] != 0
                if some:
                    sampled[row] = at
                    row += 1
            at += 1
    return row
