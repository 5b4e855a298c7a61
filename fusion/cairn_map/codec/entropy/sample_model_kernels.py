"""Model of samples: their presence, weights and sums, under those of neighbouring rows (FORMAT.md section 14).

A sum is guessed as the mean of the neighbouring rows that come before, nearer ones counting more, times its own weight.
The error of that guess is predicted by the neighbours' errors, by the plane before (colours change together), and by
the differences of the neighbours.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Flags, Int32s, Ints, Words32
from cairn_map.codec.entropy.arithmetic_kernels import EVEN, Coder, Data, code_bit, resumed, suspend_into
from cairn_map.codec.entropy.mixing_kernels import SLOTS, TAILS, code_number, start_weights
from cairn_map.codec.entropy.neighbour_kernels import NONE, leaf_at, lower_places
from cairn_map.codec.octree.sum_kernels import square_guess
from cairn_map.kernels.integer_kernels import U, signed

NEARNESS = np.array([4, 4, 4, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1], np.int64)
"""Weight of a neighbour in a guess, by `neighbour_kernels.STEPS`: faces, edges, the corner."""
SUM_MAX = 1 << 62
GUESSED_MAX = 1 << 40
"""Exclusive bound of sums that take part in guesses: products of larger ones would leave 64 bits."""
WEIGHT_MAX = 1 << 16
"""Exclusive bound of weights that take part in guesses, for the same reason."""
RANK_MAX = (1 << 16) - 1
"""Largest rank in a view's palette."""
SHIFTS = [max(x.bit_length() - 2, 0) for x in range(512)]
"""Bits by which a small number is shifted so that its highest two are left."""
HALF_LOGS = np.array([2 * shift + (x >> shift) for x, shift in enumerate(SHIFTS)], np.int8)
"""Buckets of small numbers, by `half_log`."""
TABLE = 2048
"""Numbers of contexts of one opinion, each of SLOTS."""


@nb.njit(cache=True, nogil=True)
def code_presence(
    coder: Coder,
    data: Data,
    present: Flags,
    starts: Words32,
    sizes: Ints,
    references: Ints,
    hits: Int32s,
    brick_of: Int32s,
    leaf_of: Int32s,
    depth: int,
) -> None:
    """Code the presence of rows by leaf; only voxels may have one. `references`: weights of the channel before."""
    live = resumed(coder)
    odds = np.full(4 * 2 * 8, EVEN, np.uint32)
    for n in range(starts.shape[0]):
        if sizes[n] > 1:
            present[n] = False
            continue
        # One context: hits, a row of the channel before, and rows of the three neighbours across faces.
        near = 0
        for place in lower_places(signed(starts[n]), depth)[:3]:
            leaf = leaf_at(brick_of, leaf_of, place)
            near = 2 * near + (1 if leaf != NONE and present[leaf] else 0)
        context = (min(signed(hits[n]), 3) * 2 + (1 if references[n] > 0 else 0)) * 8 + near
        bit, live = code_bit(live, data, odds, context, 1 if present[n] else 0)
        present[n] = bit == 1
    suspend_into(coder, live)


@nb.njit(cache=True, nogil=True)
def code_weights(coder: Coder, data: Data, weights: Ints, references: Ints, near: Int32s) -> bool:
    """Code (S,) weights, each near its reference; False if one that was read is out of range."""
    live = resumed(coder)
    odds, loud = np.full(3 * TABLE * SLOTS, EVEN, np.uint32), start_weights(SLOTS, 3)
    tails = np.full(TAILS, EVEN, np.uint32)
    errors = np.zeros(weights.shape[0], np.int64)
    for s in range(weights.shape[0]):
        # The neighbours' mean error, in buckets.
        error = count = 0
        for i in range(near.shape[1]):
            row = signed(near[s, i])
            if row != NONE:
                error += signed(errors[row])
                count += 1
        error = min(half_log((4 * error) // count), 40) if count else 41
        # Three opinions on the difference to the reference: the reference, the number of neighbours, their error.
        reference = references[s]
        contexts = (
            min(reference, 60) * SLOTS,
            (TABLE + min(count, 7) * 16 + min(reference, 15)) * SLOTS,
            (2 * TABLE + error * 16 + min(reference, 15)) * SLOTS,
        )
        rest, live = code_number(live, data, odds, contexts, loud, 0, tails, 0, weights[s] - reference)
        weights[s] = reference + rest
        errors[s] = min(abs(rest), GUESSED_MAX)
        if weights[s] < 0 or weights[s] > SUM_MAX:
            return False
    suspend_into(coder, live)
    return True


@nb.njit(cache=True, nogil=True)
def code_sums(coder: Coder, data: Data, sums: Ints, rests: Ints, weights: Ints, near: Int32s) -> bool:
    """Code (S, C) sums; `rests` takes the residuals of the guesses; False if a sum that was read is out of range."""
    planes = sums.shape[1]
    live = resumed(coder)
    odds, loud = np.full(planes * 3 * TABLE * SLOTS, EVEN, np.uint32), start_weights(planes * 4 * SLOTS, 3)
    tails = np.full(planes * TAILS, EVEN, np.uint32)
    # Means times 4 of rows that take part in guesses: a division takes longer than all the rest of a neighbour.
    means = np.full(sums.shape, NONE, np.int64)
    rows, nearness = np.empty(near.shape[1], np.int64), np.empty(near.shape[1], np.int64)
    # Row by row, in a row plane by plane: `before` is the residual of the plane before, in buckets with its sign.
    for s in range(sums.shape[0]):
        weight = weights[s]
        size = min(half_log(weight), 11)
        before = 0
        # Neighbours that exist, listed once for all planes.
        found = 0
        for i in range(U(near.shape[1])):
            if near[U(s), i] != NONE:
                rows[U(found)], nearness[U(found)] = near[U(s), i], NEARNESS[i]
                found += 1
        for c in range(planes):
            # Three opinions on the residual: the error, the residual of the plane before, the neighbours' spread.
            guess, error, spread, count = _guess(sums, rests, means, weights, rows, nearness, found, weight, c)
            contexts = (
                (3 * c * TABLE + min(weight, 23) * 48 + error) * SLOTS,
                ((3 * c + 1) * TABLE + before * 16 + min(error // 2, 15)) * SLOTS,
                ((3 * c + 2) * TABLE + spread * 12 + size) * SLOTS,
            )
            row = (4 * c + min(count, 3)) * SLOTS
            rest, live = code_number(live, data, odds, contexts, loud, row, tails, c * TAILS, sums[s, c] - guess)
            sums[s, c] = guess + rest
            if sums[s, c] < 0 or sums[s, c] > SUM_MAX:
                return False
            rests[s, c] = min(max(rest, -GUESSED_MAX), GUESSED_MAX)
            if 0 < weight < WEIGHT_MAX and sums[s, c] < GUESSED_MAX:
                means[s, c] = 4 * sums[s, c] // weight
            before = min(half_log(abs(rests[s, c])), 30) * 2 + (1 if rest < 0 else 0)
    suspend_into(coder, live)
    return True


@nb.njit(nogil=True, forceinline=True)
def _guess(
    sums: Ints, rests: Ints, means: Ints, weights: Ints, rows: Ints, nearness: Ints, found: int, weight: int, c: int
) -> tuple[int, int, int, int]:
    """Guess of plane c of a row of a weight; the listed rows' error and their spread, in buckets; and their number."""
    # Weighted sums over the neighbours that count.
    total = worth = error = count = 0
    low, high = SUM_MAX, 0
    plane = U(c)
    for i in range(U(found)):
        row = U(rows[i])
        mean = means[row, plane]
        if mean == NONE:
            continue
        total += nearness[i] * sums[row, plane]
        worth += nearness[i] * weights[row]
        error += abs(rests[row, plane])
        low, high = min(low, mean), max(high, mean)
        count += 1
    if count == 0 or weight >= WEIGHT_MAX:
        return 0, 47, 40, 0
    # guess = total / worth * weight, without leaving 64 bits. Nothing here is negative, and a division of numbers
    # without a sign takes half as long.
    whole = U(total) // U(worth)
    rest = U(total) - whole * U(worth)
    part = rest * U(weight) // U(worth) if weight > 1 else U(0)
    guess = signed(whole * U(weight) + part)
    spread = min(half_log(high - low), 39) if count > 1 else 40
    return guess, min(half_log(signed(U(4 * error) // U(count))), 46), spread, count


@nb.njit(cache=True, nogil=True)
def code_squares(coder: Coder, data: Data, squares: Ints, sums: Ints, rests: Ints, weights: Ints, near: Int32s) -> bool:
    """Code (S,) sums of squares; False if one that was read is out of range.

    Coded is the excess over the squares of equal samples, which is the spread; the opinions are of the neighbours'
    spread, of the residual of the sum itself, and of the weight.
    """
    live = resumed(coder)
    odds, loud = np.full(3 * TABLE * SLOTS, EVEN, np.uint32), start_weights(4 * SLOTS, 3)
    tails = np.full(TAILS, EVEN, np.uint32)
    spreads = np.zeros(squares.shape[0], np.int64)
    for s in range(squares.shape[0]):
        # The neighbours' mean spread.
        weight = weights[s]
        total = worth = count = 0
        for i in range(near.shape[1]):
            row = near[s, i]
            if row != NONE and 0 < weights[row] < WEIGHT_MAX:
                total += NEARNESS[i] * spreads[row]
                worth += NEARNESS[i] * weights[row]
                count += 1
        # Weights beyond their bound are rare enough to be guessed like that one.
        heavy = min(max(weight, 1), WEIGHT_MAX)
        expected = min(half_log(total // worth * heavy), 62) if count else 63
        off = min(half_log(abs(rests[s]) // heavy), 30)
        contexts = (
            (min(weight, 15) * 64 + expected) * SLOTS,
            (TABLE + off * 16 + min(weight, 15)) * SLOTS,
            (2 * TABLE + min(half_log(weight), 20) * 8 + min(count, 7)) * SLOTS,
        )
        # The guess of equal samples (section 5), where it does not leave 64 bits.
        guess = 0
        if 0 < weight < WEIGHT_MAX and sums[s] // weight < 1 << 20:
            guess = signed(square_guess(np.uint64(sums[s]), np.uint64(weight)))
        rest, live = code_number(live, data, odds, contexts, loud, min(weight, 3) * SLOTS, tails, 0, squares[s] - guess)
        squares[s] = guess + rest
        if squares[s] < 0 or squares[s] > SUM_MAX:
            return False
        spreads[s] = min(abs(rest), GUESSED_MAX)
    suspend_into(coder, live)
    return True


@nb.njit(cache=True, nogil=True)
def code_ranks(coder: Coder, data: Data, ranks: Ints, near: Int32s) -> bool:
    """Code (S,) ranks, most of them low; False if one that was read is out of range.

    Opinions: the mean of the neighbours' ranks; the ranks across the faces; the number of neighbours with rank 0.
    """
    live = resumed(coder)
    odds, loud = np.full(3 * TABLE * SLOTS, EVEN, np.uint32), start_weights(SLOTS, 3)
    tails = np.full(TAILS, EVEN, np.uint32)
    for s in range(ranks.shape[0]):
        total = worth = count = firsts = faces = 0
        for i in range(near.shape[1]):
            row = near[s, i]
            if row != NONE:
                total += NEARNESS[i] * ranks[row]
                worth += NEARNESS[i]
                count += 1
                firsts += 1 if ranks[row] == 0 else 0
            if i < 3:
                faces = 9 * faces + (min(ranks[row], 7) if row != NONE else 8)
        mean = min(half_log(4 * total // worth), 40) if count else 41
        contexts = (
            (mean * 4 + min(count, 3)) * SLOTS,
            (TABLE + faces) * SLOTS,
            (2 * TABLE + firsts * 14 + count) * SLOTS,
        )
        ranks[s], live = code_number(live, data, odds, contexts, loud, 0, tails, 0, signed(ranks[s]))
        if ranks[s] < 0 or ranks[s] > RANK_MAX:
            return False
    suspend_into(coder, live)
    return True


@nb.njit(nogil=True, forceinline=True)
def half_log(x: int) -> int:
    """Bucket of x, which is not negative; sizes grow by half: 0, 1, 2, 3, 4 (4-5), 5 (6-7), 6 (8-11), 7 (12-15), ..."""
    n = 0
    y = x
    while y >= HALF_LOGS.shape[0]:
        y >>= 1
        n += 2
    return n + signed(HALF_LOGS[U(y)])
