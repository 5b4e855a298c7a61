"""Logistic mixing: a bit under several contexts at once, whose opinions are mixed by weights that learn.

    stretch(p) = ln(p / (1 - p)), in 1/256, p in 1/4096        squash: its inverse
    p = squash(sum of weight * stretch(opinion))                weight += opinion * error

As in Mahoney's PAQ, with one layer. A number takes a few such bits: zero or not, its sign, its length. FORMAT.md
section 14, "Mixing" and "Number", is the norm.
"""

from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints
from cairn_map.codec.entropy.arithmetic_kernels import Data, Live, Odds, code_bit, learnt, split
from cairn_map.kernels.integer_kernels import U, signed

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


SQUASH = _squash_table().astype(np.int16)
"""Probability in 1/4096 by stretch + 2048. Of 16 bits, like the next one: both stay in a processor's first cache."""
STRETCH = np.minimum(np.searchsorted(SQUASH[1:], np.arange(4096)) - STRETCH_MAX, STRETCH_MAX).astype(np.int16)
"""By probability in 1/4096: the least stretch that gives at least so much."""
Opinions = tuple[Any, ...]
"""First contexts of three or four opinions, integers, each in a table of its own."""


@nb.njit(nogil=True, forceinline=True)
def start_weights(rows: int, opinions: int) -> Ints:
    """(rows, opinions) weights at the start: those of the mean, times 3/2."""
    return np.full((rows, opinions), ONE * 3 // (2 * opinions), np.int64)


@nb.njit(nogil=True, forceinline=True)
def code_mixed(
    live: Live, data: Data, odds: Odds, contexts: Opinions, slot: int, weights: Ints, row: int, bit: int
) -> tuple[int, Live]:
    """Code one bit under context + slot of every opinion, mixed by a row of weights; all of them learn."""
    # The mixed probability: chance = squash(sum of weight * stretch(p)). What it is made of stays in registers: no
    # table of one opinion overlaps another's.
    at0, at1, at2, w = U(contexts[0] + slot), U(contexts[1] + slot), U(contexts[2] + slot), U(row)
    odd0, odd1, odd2 = signed(odds[at0]), signed(odds[at1]), signed(odds[at2])
    loud0, loud1, loud2 = weights[w, U(0)], weights[w, U(1)], weights[w, U(2)]
    s0, s1, s2 = stretched(odd0), stretched(odd1), stretched(odd2)
    total = s0 * loud0 + s1 * loud1 + s2 * loud2
    # A fourth opinion, if there is one: the number of a tuple's members is known when this is compiled.
    at3, odd3, loud3, s3 = at2, odd2, loud2, s2
    if len(contexts) > 3:
        at3 = U(contexts[-1] + slot)
        odd3, loud3 = signed(odds[at3]), weights[w, U(3)]
        s3 = stretched(odd3)
        total += s3 * loud3
    chance = signed(SQUASH[U(min(max(total >> 16, -STRETCH_MAX), STRETCH_MAX) + STRETCH_MAX + 1)])
    bit, live = split(live, data, chance, 12, bit)
    # Weights move along the gradient of the coding cost, stretch(p) * (bit - chance); then the contexts learn.
    error = ((bit << 12) - chance) * LEARNING
    weights[w, U(0)] = loud0 + ((s0 * error + ONE // 2) >> 16)
    weights[w, U(1)] = loud1 + ((s1 * error + ONE // 2) >> 16)
    weights[w, U(2)] = loud2 + ((s2 * error + ONE // 2) >> 16)
    odds[at0], odds[at1], odds[at2] = learnt(odd0, bit), learnt(odd1, bit), learnt(odd2, bit)
    if len(contexts) > 3:
        weights[w, U(3)] = loud3 + ((s3 * error + ONE // 2) >> 16)
        odds[at3] = learnt(odd3, bit)
    return bit, live


@nb.njit(nogil=True, forceinline=True)
def stretched(odd: int) -> int:
    """Stretch of a context's probability."""
    return signed(STRETCH[U(odd >> 20)])


@nb.njit(nogil=True, forceinline=True)
def code_number(
    live: Live, data: Data, odds: Odds, contexts: Opinions, weights: Ints, row: int, tails: Odds, tail: int, number: int
) -> tuple[int, Live]:
    """Code a signed number, magnitude at most 2^63 - 1; small ones are short.

    Zero or not, sign, length of the magnitude in unary, then the bits below its first. Takes SLOTS contexts of every
    opinion, SLOTS rows of weights from `row` on, and TAILS contexts of `tails` from `tail` on.
    """
    # Zero or not, and the sign.
    zero, live = code_mixed(live, data, odds, contexts, 0, weights, row, 1 if number == 0 else 0)
    found = negative = 0
    if not zero:
        negative, live = code_mixed(live, data, odds, contexts, 1, weights, row + 1, 1 if number < 0 else 0)
        found, live = _code_magnitude(live, data, odds, contexts, weights, row, tails, tail, abs(number))
    # One way out, at which every array is named: else the compiler counts references to them here, for each number.
    _ = data.shape, odds.shape, weights.shape, tails.shape
    return (-found if negative else found), live


@nb.njit(nogil=True, forceinline=True)
def _code_magnitude(
    live: Live, data: Data, odds: Odds, contexts: Opinions, weights: Ints, row: int, tails: Odds, tail: int, number: int
) -> tuple[int, Live]:
    """Code a number that is at least 1."""
    # The number of bits below the first, in unary.
    length, longer = 0, 1
    while longer and length < 62:
        slot = 2 + min(length, LENGTH_SLOTS - 1)
        longer, live = code_mixed(
            live, data, odds, contexts, slot, weights, row + slot, 1 if number >> (length + 1) else 0
        )
        length += longer
    # These bits, upper ones first; the first three know those before them.
    found = 1
    for n in range(length):
        context = tail + 8 * length + (found if n < 3 else 0)
        bit, live = code_bit(live, data, tails, context, (number >> (length - 1 - n)) & 1)
        found = 2 * found + bit
    return found, live
