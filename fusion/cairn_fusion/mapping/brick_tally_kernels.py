"""Kernels of `brick_tally`: voxels that a scan hit, their numbers, and the packing of a measurement's dense bricks.

A voxel's number is its brick's number times 512 plus its place in the brick, in Morton order.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Counts, Floats, Int32s, Ints

NANOMETRES = 1e9
BRICK_VOXELS = 8


@nb.njit(cache=True, nogil=True)
def returned_points(
    range_m: npt.NDArray[np.float32], rays: Floats, T_map_camera: Floats
) -> tuple[Int32s, Floats, float]:
    """Numbers (N,) of pixels with a range and a ray, their points (N, 3), map frame (Eq. 1-5); the longest range."""
    pixels = np.empty(range_m.size, np.int32)
    points = np.empty((range_m.size, 3))
    count = 0
    flat, beams, farthest_m = range_m.ravel(), rays.reshape(-1, 3), 0.0
    r00, r01, r02, t0 = T_map_camera[0, 0], T_map_camera[0, 1], T_map_camera[0, 2], T_map_camera[0, 3]
    r10, r11, r12, t1 = T_map_camera[1, 0], T_map_camera[1, 1], T_map_camera[1, 2], T_map_camera[1, 3]
    r20, r21, r22, t2 = T_map_camera[2, 0], T_map_camera[2, 1], T_map_camera[2, 2], T_map_camera[2, 3]
    for i in range(len(flat)):
        r = np.float64(flat[i])
        farthest_m = r if r > farthest_m else farthest_m
        if np.isnan(r) or np.isnan(beams[i, 0]):
            continue
        # Eq. 1 and 4: the range is measured along the beam, so the point is range times unit ray.
        x, y, z = r * beams[i, 0], r * beams[i, 1], r * beams[i, 2]
        # Eq. 5, with the map in place of the other camera.
        points[count, 0] = r00 * x + r01 * y + r02 * z + t0
        points[count, 1] = r10 * x + r11 * y + r12 * z + t1
        points[count, 2] = r20 * x + r21 * y + r22 * z + t2
        pixels[count] = i
        count += 1
    return pixels[:count], points[:count], farthest_m


@nb.njit(cache=True, nogil=True, error_model="numpy")
def hit_voxels(points_m: Floats, voxel_edge_nm: int, corner: Ints, dims: Ints) -> Ints:
    """(N,) brick number times 512 plus place of the voxel that holds each (N, 3) point, map frame; -1 outside the box.

    The rule of FORMAT.md section 2: whole nanometres, then floor. The product of floats is right or next to it.
    """
    count = len(points_m)
    out, own, places = np.empty(count, np.int64), np.empty(count), np.empty((3, count), np.int32)
    edge, share = np.float64(voxel_edge_nm), 1.0 / np.float64(voxel_edge_nm)
    # Axis by axis, side by side and in floats, which hold whole numbers below 2^53 exactly: vector instructions.
    for axis in range(3):
        first, last = np.float64(corner[axis]), np.float64(BRICK_VOXELS * dims[axis])
        for n in range(count):
            own[n] = points_m[n, axis]
        for n in range(count):
            # The quotient may be off by one next to a border; the remainder, exact in whole nanometres, tells.
            x = np.rint(own[n] * NANOMETRES)
            i = np.floor(x * share)
            over = x - i * edge
            i = i + 1.0 if over >= edge else i
            i = (i - 1.0 if over < 0.0 else i) - first
            places[axis, n] = np.int32(i if (i >= 0.0) & (i < last) else -1.0)
    w, h = dims[0], dims[1]
    for n in range(count):
        i, j, k = places[0, n], places[1, n], places[2, n]
        # Morton order: bit b of x, y, z becomes bit 3 b, 3 b + 1, 3 b + 2.
        place = (i & 1) | (i & 2) << 2 | (i & 4) << 4
        place |= (j & 1) << 1 | (j & 2) << 3 | (j & 4) << 5
        place |= (k & 1) << 2 | (k & 2) << 4 | (k & 4) << 6
        # One negative coordinate makes the disjunction negative: outside the box.
        brick = (np.int64(k >> 3) * h + np.int64(j >> 3)) * w + np.int64(i >> 3)
        out[n] = brick << 9 | np.int64(place) if (i | j | k) >= 0 else -1
    return out


@nb.njit(cache=True, nogil=True)
def claim_into(numbers: Ints, shift: int, place_of: Int32s, bricks: Int32s, used: int) -> int:
    """Give each brick that has no place the next one; returns places used.

    `place_of` (bricks of the box,) is one more than a brick's place, 0 for none; `bricks` has room for all.
    """
    for n in range(len(numbers)):
        brick = numbers[n] >> shift
        if place_of[brick] == 0:
            bricks[used] = brick
            used += 1
            place_of[brick] = used
    return used


@nb.njit(cache=True, nogil=True)
def number_hits_into(voxels: Ints, table_of: Int32s, struck: Int32s, touched: Ints) -> tuple[Int32s, int]:
    """Number the different voxels of a scan's hits as they come; (N,) the number of each point's voxel, and how many.

    Args:
        voxels: (N,) of `hit_voxels`.
        table_of: of `claim_into`.
        struck: (T, 512) becomes one more than the number of a voxel; 0 before.
        touched: (N,) takes the voxels by number.
    """
    numbers = np.empty(len(voxels), np.int32)
    count = 0
    for n in range(len(voxels)):
        table, place = table_of[voxels[n] >> 9] - 1, voxels[n] & 511
        # Numbers are kept plus one, so that 0 means none and fresh memory needs no filling.
        number = struck[table, place]
        if number == 0:
            touched[count] = voxels[n]
            count += 1
            struck[table, place] = number = count
        numbers[n] = number - 1
    return numbers, count


@nb.njit(cache=True, nogil=True)
def forget_hits_into(bricks: Int32s, table_of: Int32s, struck: Int32s, touched: Ints) -> None:
    """Undo `number_hits_into` and `claim_into`."""
    # Only the entries that were written: clearing the tables whole would cost more than the scan.
    for n in range(len(touched)):
        struck[table_of[touched[n] >> 9] - 1, touched[n] & 511] = 0
    for n in range(len(bricks)):
        table_of[bricks[n]] = 0


@nb.njit(cache=True, nogil=True)
def claim_rows_into(voxels: Ints, table_of: Int32s, row_of: Int32s, rows: Int32s, used: int) -> int:
    """Give each voxel that has no row the next one; returns rows used. Rows and sums in one loop take a third longer.

    `row_of` (T, 512) is one more than a voxel's row, 0 for none; `rows` (N,) takes the row of each.
    """
    for n in range(len(voxels)):
        table, place = table_of[voxels[n] >> 9] - 1, voxels[n] & 511
        row = row_of[table, place]
        if row == 0:
            used += 1
            row_of[table, place] = row = used
        rows[n] = row - 1
    return used


@nb.njit(cache=True, nogil=True)
def add_hits_into(sums: Ints, rows: Int32s, added: Ints) -> None:
    """Count a hit in some rows of (R, 1 + P) sums, all different, and add their (N, P) samples."""
    for n in range(len(rows)):
        row = rows[n]
        sums[row, 0] += 1
        for p in range(added.shape[1]):
            sums[row, 1 + p] += added[n, p]


@nb.njit(cache=True, nogil=True)
def count_known(slots: Int32s, tables: Int32s, misses: Counts, row_of: Int32s) -> tuple[int, int]:
    """Voxels with a count, and those of them with a hit, in bricks with these slots and tables, -1 for none."""
    # Three loops, so that each is free of branches: bricks with misses only, with hits only, with both.
    known, hit = np.int64(0), np.int64(0)
    for b in range(len(slots)):
        slot, table = slots[b], tables[b]
        if table < 0:
            # A sum of comparisons becomes vector instructions.
            for i in range(512):
                known += np.int64(misses[slot, i] > 0)
        elif slot < 0:
            for i in range(512):
                hit += np.int64(row_of[table, i] > 0)
                known += np.int64(row_of[table, i] > 0)
        else:
            for i in range(512):
                hit += np.int64(row_of[table, i] > 0)
                known += np.int64((misses[slot, i] > 0) | (row_of[table, i] > 0))
    return int(known), int(hit)


@nb.njit(cache=True, nogil=True)
def pack_known_into(
    slots: Int32s,
    tables: Int32s,
    numbers: Int32s,
    misses: Counts,
    row_of: Int32s,
    sums: Ints,
    places: npt.NDArray[np.uint32],
    counts: Int32s,
    sampled: npt.NDArray[np.uint32],
    samples: Ints,
) -> int:
    """Write the known voxels of a cell's bricks, given in rising order of number; returns rows of samples written.

    The first arguments are those of `count_known`; the last four are the arrays of an `Evidence`.
    """
    kept, seen = np.empty(512, np.uint32), np.empty(512, np.uint16)
    # Unsigned: Numba counts signed numbers from the end if they are negative, and tests for it each time.
    at, row = np.uint64(0), np.uint64(0)
    for b in range(len(slots)):
        slot, table = slots[b], tables[b]
        first = np.uint32(numbers[b]) << np.uint32(9)
        # Stage 1: the brick's misses, of which most bricks without hits have all or none.
        if slot >= 0:
            for i in range(512):
                seen[i] = misses[slot, i]
        else:
            seen[:] = 0
        missed = np.int64(0)
        for i in range(512):
            missed += np.int64(seen[i] > 0)
        if missed == 512 and table < 0:
            for i in range(512):
                places[at + np.uint64(i)] = first | np.uint32(i)
                counts[at + np.uint64(i), 0] = 0
                counts[at + np.uint64(i), 1] = seen[i]
            at += np.uint64(512)
            continue
        if missed == 0 and table < 0:
            continue
        # Stage 2: the known voxels, with their misses.
        known = _known_into(kept, seen, table, row_of)
        for n in range(known):
            i = kept[n]
            places[at + n] = first | i
            counts[at + n, 0] = 0
            counts[at + n, 1] = seen[i]
        # Stage 3: hits and samples of those that were hit.
        if table >= 0:
            row = _pack_hits_into(counts, sampled, samples, kept, known, table, row_of, sums, at, row)
        at += known
    return int(row)


@nb.njit(forceinline=True)
def _known_into(kept: npt.NDArray[np.uint32], seen: Counts, table: int, row_of: Int32s) -> np.uint64:
    """Places in a brick of the voxels with a miss or a hit, into `kept`; returns their number."""
    known = np.uint64(0)
    # Each place is written, and counts only if it is known: no branch that could be guessed wrong.
    if table < 0:
        for i in range(512):
            kept[known] = i
            known += np.uint64(seen[i] > 0)
    else:
        for i in range(512):
            kept[known] = i
            known += np.uint64((seen[i] > 0) | (row_of[table, i] > 0))
    return known


@nb.njit(forceinline=True)
def _pack_hits_into(
    counts: Int32s,
    sampled: npt.NDArray[np.uint32],
    samples: Ints,
    kept: npt.NDArray[np.uint32],
    known: np.uint64,
    table: int,
    row_of: Int32s,
    sums: Ints,
    at: np.uint64,
    row: np.uint64,
) -> np.uint64:
    """Hits, and rows of samples from `row` on, of a brick's known voxels, which begin at `at`; returns the next row."""
    for n in range(known):
        struck = row_of[table, kept[n]] - 1
        if struck < 0:
            continue
        counts[at + n, 0] = sums[struck, 0]
        some = False
        for p in range(samples.shape[1]):
            samples[row, p] = sums[struck, 1 + p]
            some |= sums[struck, 1 + p] != 0
        # A row without any sample is written over by the next one.
        if some:
            sampled[row] = at + n
            row += np.uint64(1)
    return row
