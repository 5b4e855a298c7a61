"""Logistic mixing: a bit under several contexts at once, whose opinions are mixed by weights that learn.

    stretch(p) = ln(p / (1 - p)), in 1/256, p in 1/4096        squash: its inverse
    p = squash(sum of weight * stretch(opinion))                weight += opinion * error

As in Mahoney's PAQ, with one layer. A number takes a few such bits: zero or not, its sign, its length. FORMAT.md
section 14, "Mixing" and "Number", is the norm.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints
from cairn_map.codec.entropy.arithmetic_kernels import Data, Live, Odds, code_bit, learn, split
from cairn_map.kernels.integer_kernels import signed

KNOTS = np.array(
    [
        *(1, 2, 3, 6, 10, 16, 27, 45, 73, 120, 194, 310, 488, 747, 1101, 1546, 2047),
        *(2549, 2994, 3348, 3607, 3785, 3901, 3975, 4022, 4050, 4068, 4079, 4085, 4089, 4092, 4093, 4094),
    ],
    np.int64,
)
"""4096 / (1 + exp(-x)) at x = -8, -7.5, ... 8; between them in straight lines."""
STRETCH_MAX = 2047
LEARNING = 16
"""Learning rate of the weights."""
ONE = 1 << 16
"""A weight of 1."""

SLOTS = 16
"""Contexts that a number takes from each opinion: zero or not, sign, then one for each bit of its length."""
LENGTH_SLOTS = SLOTS - 2
TAILS = 64 * 8
"""Contexts for the bits below a number's first."""


def _squash_table() -> npt.NDArray[np.int64]:
    x = np.arange(-STRETCH_MAX - 1, STRETCH_MAX + 1)
    low, part = (x >> 7) + 16, x & 127
    table: npt.NDArray[np.int64] = (KNOTS[low] * (128 - part) + KNOTS[np.minimum(low + 1, 32)] * part + 64) >> 7
    return table


SQUASH = _squash_table()
"""Probability in 1/4096 by stretch + 2048."""
STRETCH = np.minimum(np.searchsorted(SQUASH[1:], np.arange(4096)) - STRETCH_MAX, STRETCH_MAX)
"""By probability in 1/4096: the least stretch that gives at least so much."""


@nb.njit(nogil=True, forceinline=True)
def start_weights(rows: int, opinions: int) -> Ints:
    """(rows, opinions) weights at the start: those of the mean, times 3/2."""
    return np.full((rows, opinions), ONE * 3 // (2 * opinions), np.int64)


@nb.njit(nogil=True, forceinline=True)
def code_mixed(
    live: Live, data: Data, odds: Odds, contexts: Ints, slot: int, weights: Ints, row: int, bit: int
) -> tuple[int, Live]:
    """Code one bit under contexts[i] + slot of every opinion i, mixed by a row of weights; all of them learn."""
    # The mixed probability: chance = squash(sum of weight * stretch(p)).
    opinions = contexts.shape[0]
    total = 0
    for i in range(opinions):
        total += STRETCH[signed(odds[signed(contexts[i]) + slot]) >> 20] * weights[row, i]
    chance = SQUASH[min(max(total >> 16, -STRETCH_MAX), STRETCH_MAX) + STRETCH_MAX + 1]
    bit, live = split(live, data, chance, 12, bit)
    # Weights move along the gradient of the coding cost, stretch(p) * (bit - chance); then the contexts learn.
    error = ((bit << 12) - chance) * LEARNING
    for i in range(opinions):
        context = signed(contexts[i]) + slot
        weights[row, i] += (STRETCH[signed(odds[context]) >> 20] * error + ONE // 2) >> 16
        learn(odds, context, bit)
    return bit, live


@nb.njit(nogil=True)
def code_number(
    live: Live, data: Data, odds: Odds, contexts: Ints, weights: Ints, row: int, tails: Odds, tail: int, number: int
) -> tuple[int, Live]:
    """Code a signed number, magnitude at most 2^63 - 1; small ones are short.

    Zero or not, sign, length of the magnitude in unary, then the bits below its first. Takes SLOTS contexts of every
    opinion, SLOTS rows of weights from `row` on, and TAILS contexts of `tails` from `tail` on.
    """
    # Zero or not, and the sign.
    zero, live = code_mixed(live, data, odds, contexts, 0, weights, row, 1 if number == 0 else 0)
    if zero:
        return 0, live
    negative, live = code_mixed(live, data, odds, contexts, 1, weights, row + 1, 1 if number < 0 else 0)
    # The number of bits below the first, in unary.
    magnitude = abs(number)
    length = 0
    while length < 62:
        slot = 2 + min(length, LENGTH_SLOTS - 1)
        longer = 1 if magnitude >> (length + 1) else 0
        longer, live = code_mixed(live, data, odds, contexts, slot, weights, row + slot, longer)
        if not longer:
            break
        length += 1
    # These bits, upper ones first; the first three know those before them.
    found = 1
    for n in range(length):
        context = tail + 8 * length + (found if n < 3 else 0)
        bit, live = code_bit(live, data, tails, context, (magnitude >> (length - 1 - n)) & 1)
        found = 2 * found + bit
    return (-found if negative else found), live
