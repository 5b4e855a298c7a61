"""Model of counts: hits and misses of the leaves, under those of neighbours that come before (FORMAT.md section 14).

"Hit or not" has three opinions: of the neighbours across faces with the leaves above; of those across edges, too; and
of the mean of their hits and misses. The number of hits is coded as the difference to that mean. Misses are guessed as
the median of the three neighbours across faces; the difference has four opinions: how each of these neighbours differs
from the guess; how those across edges do; the guess itself; and the errors of the neighbours' guesses.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Int32s, Ints, Words32
from cairn_map.codec.entropy.arithmetic_kernels import EVEN, Coder, Data, Live, resumed, suspend_into
from cairn_map.codec.entropy.mixing_kernels import SLOTS, TAILS, Opinions, code_mixed, code_number, start_weights
from cairn_map.codec.entropy.neighbour_kernels import NONE, leaf_at, lower_places, upper_places
from cairn_map.kernels.integer_kernels import U, signed

COUNT_MAX = (1 << 31) - 1
Leaves = tuple[int, int, int, int, int, int, int]
"""The lower neighbours of a leaf, or NONE, in the order of `lower_places`."""
HIT_TABLE = 1 << 14
"""Contexts of one opinion on hits: first those of hit or not, then those of numbers."""
NUMBERS_FROM = 1 << 13
MISS_TABLE = 1 << 14
"""Numbers of contexts of one opinion on misses, each of SLOTS."""


@nb.njit(cache=True, nogil=True)
def code_counts(
    coder: Coder,
    data: Data,
    counts: Int32s,
    starts: Words32,
    sizes: Ints,
    brick_of: Int32s,
    leaf_of: Int32s,
    depth: int,
) -> bool:
    """Code (N, 2) hits and misses of the leaves; False if one that was read is out of range."""
    # Tables of the models: odds, weights and tails of hits and of misses.
    live = resumed(coder)
    N = starts.shape[0]
    hit_odds, hit_weights = np.full(3 * HIT_TABLE, EVEN, np.uint32), start_weights(2 * SLOTS, 3)
    miss_odds, miss_weights = np.full(4 * MISS_TABLE * SLOTS, EVEN, np.uint32), start_weights(24 * SLOTS, 4)
    tails = np.full(2 * TAILS, EVEN, np.uint32)
    errors = np.zeros(N + 1, np.uint8)
    for n in range(N):
        # Neighbours: seven lower ones, which are coded already; and the presence of three upper ones.
        place = signed(starts[n])
        a, b, c, d, e, f, g = lower_places(place, depth)
        near = (
            leaf_at(brick_of, leaf_of, a),
            leaf_at(brick_of, leaf_of, b),
            leaf_at(brick_of, leaf_of, c),
            leaf_at(brick_of, leaf_of, d),
            leaf_at(brick_of, leaf_of, e),
            leaf_at(brick_of, leaf_of, f),
            leaf_at(brick_of, leaf_of, g),
        )
        above = 0
        for up in upper_places(place + sizes[n] - 1, depth):
            above = 2 * above + (1 if leaf_at(brick_of, leaf_of, up) != NONE else 0)
        # Hits, then misses under the hits.
        hits, live = _code_hits(live, data, counts, n, near, above, sizes[n], hit_odds, hit_weights, tails)
        if hits < 0 or hits > COUNT_MAX:
            return False
        counts[n, 0] = hits
        guess, row, contexts = _miss_contexts(counts, n, near, above, sizes[n], errors)
        rest = signed(counts[n, 1]) - guess
        rest, live = code_number(live, data, miss_odds, contexts, miss_weights, row * SLOTS, tails, TAILS, rest)
        if guess + rest < 0 or guess + rest > COUNT_MAX:
            return False
        counts[n, 1] = guess + rest
        errors[n] = min(abs(rest), 7)
    suspend_into(coder, live)
    return True


@nb.njit(nogil=True, forceinline=True)
def _code_hits(
    live: Live,
    data: Data,
    counts: Int32s,
    n: int,
    near: Leaves,
    above: int,
    size: int,
    odds: Words32,
    weights: Ints,
    tails: Words32,
) -> tuple[int, Live]:
    """Code leaf n's hits."""
    # States of the neighbours as digits, 0 none, 1 without hits, 2 with; mean of their hits, and of the faces' misses.
    faces = edges = total = struck = seen = misses = 0
    for i in range(7):
        leaf = near[i]
        state = 0
        if leaf != NONE:
            state = 2 if counts[U(leaf), U(0)] > 0 else 1
        if state == 2:
            total += signed(counts[U(leaf), U(0)])
            struck += 1
        if i < 3:
            faces = 3 * faces + state
            if state:
                misses += signed(counts[U(leaf), U(1)])
                seen += 1
        else:
            edges = 3 * edges + state
    mean = (2 * total + struck) // (2 * struck) if struck else 0
    misses = misses // seen if seen else 0
    # Hit or not.
    large = 1 if size > 1 else 0
    contexts = (
        (faces * 8 + above) * 2 + large,
        HIT_TABLE + (faces * 81 + edges) * 2 + large,
        2 * HIT_TABLE + ((min(mean, 15) * 8 + above) * 8 + min(misses, 7)) * 8 + struck,
    )
    struck_too, live = code_mixed(live, data, odds, contexts, 0, weights, 0, 1 if counts[n, 0] > 0 else 0)
    hits = 0
    if struck_too:
        # How often: the difference to the mean of the neighbours, from 1 on.
        contexts = (
            NUMBERS_FROM + min(mean, 60) * SLOTS,
            HIT_TABLE + NUMBERS_FROM + (struck * 8 + min(mean, 7)) * SLOTS,
            2 * HIT_TABLE + NUMBERS_FROM + (min(misses, 20) * 8 + above) * SLOTS,
        )
        rest = signed(counts[n, 0]) - 1 - mean
        rest, live = code_number(live, data, odds, contexts, weights, SLOTS, tails, 0, rest)
        hits = 1 + mean + rest
    # As in `mixing_kernels.code_number`: no references are counted.
    _ = data.shape, counts.shape, odds.shape, weights.shape, tails.shape
    return hits, live


@nb.njit(nogil=True, forceinline=True)
def _miss_contexts(
    counts: Int32s, n: int, near: Leaves, above: int, size: int, errors: npt.NDArray[np.uint8]
) -> tuple[int, int, Opinions]:
    """Guess of leaf n's misses, the row of weights, and the contexts of the difference."""
    # Neighbours across faces: their misses, errors and states.
    known = error = faces = 0
    low, high, total, last = COUNT_MAX, 0, 0, 0
    for i in range(3):
        faces = 3 * faces
        if near[i] != NONE:
            value = signed(counts[U(near[i]), U(1)])
            low, high, total, last = min(low, value), max(high, value), total + value, value
            known += 1
            error += signed(errors[U(near[i])])
            faces += 2 if counts[U(near[i]), U(0)] > 0 else 1
    # The guess: median of three, else the last of those that exist.
    guess = last
    if known == 3:
        guess = total - low - high
    elif known == 0:
        for i in range(3, 7):
            if near[i] != NONE:
                guess = signed(counts[U(near[i]), U(1)])
    # Differences of the neighbours to the guess, as digits.
    sides = corners = 0
    for i in range(7):
        if i < 3:
            sides = 8 * sides + _against(counts, near[i], guess, 3)
        else:
            corners = 4 * corners + _against(counts, near[i], guess, 1)
    hits = min(signed(counts[n, 0]), 2)
    level = 0
    while size > 1 and level < 2:
        size >>= 3
        level += 1
    before = signed(errors[n - 1]) if n > 0 else 0
    contexts = (
        (sides * 3 + hits) * SLOTS,
        (MISS_TABLE + corners * 3 + level) * SLOTS,
        (2 * MISS_TABLE + ((min(guess, 40) * 3 + hits) * 8 + above) * 3 + level) * SLOTS,
        (3 * MISS_TABLE + ((min(error, 15) * 4 + known) * 27 + faces) * 8 + before) * SLOTS,
    )
    return guess, (hits * 4 + known) * 2 + (1 if level else 0), contexts


@nb.njit(nogil=True, forceinline=True)
def _against(counts: Int32s, leaf: int, guess: int, most: int) -> int:
    """Difference of a neighbour's misses to the guess, clipped to 0 to 2 most; 2 most + 1 if there is no neighbour."""
    found = 2 * most + 1
    if leaf != NONE:
        found = min(max(signed(counts[U(leaf), U(1)]) - guess, -most), most) + most
    _ = counts.shape
    return found
