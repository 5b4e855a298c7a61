"""Adaptive binary arithmetic coding: one bit after the other, each under a probability that learns.

    coder    low, high, code, position, decoding      the interval [low, high], 32 bits each
    data     uint8      the bytes written, or read
    odds     uint32     one per context: probability of a 1 in the upper 22 bits, times seen in the lower 10

Encoding and decoding are one function: when encoding, `code_bit` writes the bit that it is given and returns it; when
decoding, it ignores that bit and returns the one that was written. So a model is programmed once, and its two
directions cannot disagree. Only integers: the same bytes on every machine. FORMAT.md section 14 is the norm.

Inside a kernel a coder is a tuple, which the compiler keeps in registers: fifteen times as fast as an array. Between
kernels it is an array.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.kernels.integer_kernels import signed

Coder = npt.NDArray[np.int64]
Live = tuple[int, int, int, int, bool]
"""A coder inside a kernel."""
Data = npt.NDArray[np.uint8]
Odds = npt.NDArray[np.uint32]

LOW, HIGH, CODE, AT, DECODING = 0, 1, 2, 3, 4
TOP = 0xFFFFFFFF
EVEN = np.uint32(1 << 31)
"""Odds of a context that is not used yet: one half, seen 0 times."""
SEEN_MAX = 255
STEPS = np.array([(1 << 17) // (2 * n + 3) for n in range(SEEN_MAX + 1)], np.int32)
"""By times seen: the fraction by which a probability moves towards the bit, in 1/65536: 2/3, 2/5, 2/7, ... at first a
mean of all bits, later one that forgets the oldest."""


@nb.njit(cache=True, nogil=True)
def start_encoding() -> Coder:
    """A coder that will write from the start of its data."""
    coder = np.zeros(5, np.int64)
    coder[HIGH] = TOP
    return coder


@nb.njit(cache=True, nogil=True)
def start_decoding(data: Data) -> Coder:
    """A coder that reads `data` from the start."""
    coder = start_encoding()
    coder[DECODING] = 1
    coder[AT] = 4
    for at in range(4):
        coder[CODE] = (coder[CODE] << 8) | byte_at(data, at)
    return coder


@nb.njit(nogil=True, forceinline=True)
def resumed(coder: Coder) -> Live:
    """Coder inside a kernel, in the state of an array."""
    return coder[LOW], coder[HIGH], coder[CODE], coder[AT], coder[DECODING] == 1


@nb.njit(nogil=True, forceinline=True)
def suspend_into(coder: Coder, live: Live) -> None:
    """Store a coder in its array, for the next kernel."""
    coder[LOW], coder[HIGH], coder[CODE], coder[AT] = live[0], live[1], live[2], live[3]


@nb.njit(nogil=True, forceinline=True)
def code_bit(live: Live, data: Data, odds: Odds, context: int, bit: int) -> tuple[int, Live]:
    """Code one bit under a context, and let the context learn it."""
    # At least 1/65536, else an interval could become empty.
    odd = signed(odds[np.uint64(context)])
    bit, live = split(live, data, max(odd >> 16, 1), 16, bit)
    odds[np.uint64(context)] = learnt(odd, bit)
    return bit, live


@nb.njit(nogil=True, forceinline=True)
def split(live: Live, data: Data, chance: int, bits: int, bit: int) -> tuple[int, Live]:
    """Code one bit whose probability of being 1 is chance / 2^bits.

    Behind the end of `data` zeros are read, and nothing is written: `finish_encoding` then returns -1.
    """
    # A 1 takes the lower part of the interval [low, high], a 0 the upper one.
    low, high, code, at, decoding = live
    middle = low + (((high - low) * chance) >> bits)
    if decoding:
        bit = 1 if code <= middle else 0
    if bit:
        high = middle
    else:
        low = middle + 1
    # Bytes that both ends share are final: they are written, or left behind, and the interval grows by a byte.
    while (low ^ high) & 0xFF000000 == 0:
        if decoding:
            code = ((code << 8) & TOP) | byte_at(data, at)
        elif at < data.shape[0]:
            data[at] = high >> 24
        at += 1
        low = (low << 8) & TOP
        high = ((high << 8) & TOP) | 255
    return bit, (low, high, code, at, decoding)


@nb.njit(nogil=True, forceinline=True)
def learnt(odd: int, bit: int) -> np.uint32:
    """Odds of a context after a bit: its probability moves towards the bit."""
    # chance += (bit - chance) * step, in 22 bits.
    seen, chance = odd & 1023, odd >> 10
    step = signed(STEPS[np.uint64(seen)])
    if bit:
        chance += (((1 << 22) - 1 - chance) * step) >> 16
    else:
        chance -= (chance * step) >> 16
    return np.uint32((chance << 10) | min(seen + 1, SEEN_MAX))


@nb.njit(nogil=True, forceinline=True)
def byte_at(data: Data, at: int) -> int:
    """A byte, or 0 behind the end."""
    return signed(data[np.uint64(at)]) if at < data.shape[0] else 0


@nb.njit(cache=True, nogil=True)
def finish_encoding(coder: Coder, data: Data) -> int:
    """Write the fewest bytes that name the interval; returns the number of all bytes, or -1 if there was no room."""
    # The least number of `count` bytes, zeros behind them, that is not below the interval; some count fits into it.
    for count in range(1, 5):
        mask = TOP >> (8 * count)
        value = (coder[LOW] + mask) & ~mask
        if value <= coder[HIGH]:
            if coder[AT] + count > data.shape[0]:
                return -1
            for n in range(count):
                data[coder[AT] + n] = (value >> (24 - 8 * n)) & 255
            return signed(coder[AT]) + count
    return -1


@nb.njit(cache=True, nogil=True)
def finish_decoding(coder: Coder, data: Data) -> bool:
    """True if exactly an encoder's bytes were read: of the four bytes read ahead it omits up to three."""
    left: int = signed(coder[AT]) - data.shape[0]
    return left >= 0 and left <= 3
