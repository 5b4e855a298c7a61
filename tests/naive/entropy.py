"""The slow, obvious twin of adaptive arithmetic coding: FORMAT.md 14 up to its numbers, from the page and not the code.

Everything codes in both directions: a `Coder` of given bytes reads and answers with what it read, one without bytes
writes what it is given. So what to write is an argument that does not matter when reading.
"""

from functools import cache
from typing import Any

KNOTS = (
    *(1, 2, 3, 6, 10, 16, 27, 45, 73, 120, 194, 310, 488, 747, 1101, 1546, 2047),
    *(2549, 2994, 3348, 3607, 3785, 3901, 3975, 4022, 4050, 4068, 4079, 4085, 4089, 4092, 4093, 4094),
)


class Coder:
    """The interval, and the bytes: those that are read, or those written so far."""

    def __init__(self, data: bytes | None = None) -> None:
        self.low, self.high = 0, (1 << 32) - 1
        self.reads = data is not None
        self.data = bytearray(data or b"")
        self.at = 0
        self.code = 0
        for _ in range(4):
            self._take()

    def bit(self, chance: int, bits: int, bit: int) -> int:
        """Code a bit that is 1 with `chance` in 2^bits."""
        middle = self.low + ((self.high - self.low) * chance >> bits)
        if self.reads:
            bit = int(self.code <= middle)
        if bit:
            self.high = middle
        else:
            self.low = middle + 1
        while self.low >> 24 == self.high >> 24:
            if not self.reads:
                self.data.append(self.low >> 24)
            self._take()
            self.low = self.low << 8 & 0xFFFFFFFF
            self.high = self.high << 8 & 0xFFFFFFFF | 255
        return bit

    def end(self) -> bytes:
        """All bytes; when reading, they must be all that were needed."""
        if self.reads:
            assert 0 <= self.at - len(self.data) <= 3
            return bytes(self.data)
        for m in range(1, 5):
            mask = (1 << (32 - 8 * m)) - 1
            value = (self.low + mask) & ~mask
            if value <= self.high:
                return bytes(self.data) + value.to_bytes(4, "big")[:m]
        raise AssertionError("four bytes always suffice")

    def _take(self) -> None:
        self.code = self.code << 8 & 0xFFFFFFFF | (self.data[self.at] if self.at < len(self.data) else 0)
        self.at += 1


@cache
def squash(x: int) -> int:
    """A chance in 2^12 of a logit."""
    i, f = (x >> 7) + 16, x & 127
    return (KNOTS[i] * (128 - f) + KNOTS[min(i + 1, 32)] * f + 64) >> 7


@cache
def stretch(q: int) -> int:
    """A logit of a chance in 2^12."""
    return next((x for x in range(-2047, 2048) if squash(x) >= q), 2047)


def clip(x: int, low: int, high: int) -> int:
    """The nearest number to x from low to high."""
    return max(low, min(high, x))


def half_log(x: int) -> int:
    """Two steps for each doubling."""
    return x if x < 4 else 2 + half_log(x >> 1)


def digits(base: int, values: list[int]) -> int:
    """`list(base; values)`: a number written in that base, the first digit highest."""
    number = 0
    for value in values:
        assert 0 <= value < base
        number = number * base + value
    return number


class Model:
    """What is learned on the way: contexts by any name, weights by any name."""

    def __init__(self, coder: Coder) -> None:
        self.coder = coder
        self.contexts: dict[Any, tuple[int, int]] = {}
        self.weights: dict[Any, list[int]] = {}

    def one(self, context: Any, bit: int) -> int:
        """A bit under one context."""
        p, _ = self.contexts.get(context, (1 << 21, 0))
        bit = self.coder.bit(max(p >> 6, 1), 16, bit)
        self._learn(context, bit)
        return bit

    def mixed(self, contexts: list[Any], row: Any, bit: int) -> int:
        """A bit under several contexts, mixed with one row of weights."""
        w = self.weights.setdefault(row, [(1 << 16) * 3 // (2 * len(contexts))] * len(contexts))
        stretched = [stretch(self.contexts.get(context, (1 << 21, 0))[0] >> 10) for context in contexts]
        t = clip(sum(s * weight for s, weight in zip(stretched, w, strict=True)) >> 16, -2047, 2047)
        bit = self.coder.bit(squash(t), 12, bit)
        for k, s in enumerate(stretched):
            w[k] += (s * ((bit << 12) - squash(t)) * 16 + (1 << 15)) >> 16
        for context in contexts:
            self._learn(context, bit)
        return bit

    def number(self, name: Any, opinions: list[Any], rows: Any, value: int | None) -> int:
        """A number; `name` says whose opinions and tails they are, `rows` which 16 rows of weights."""
        given = value or 0
        magnitude = abs(given)

        def under(slot: int, bit: bool) -> int:
            contexts = [(name, k, opinion, slot) for k, opinion in enumerate(opinions)]
            return self.mixed(contexts, (name, rows, slot), int(bit))

        if under(0, given == 0):
            return 0
        negative = under(1, given < 0)
        length = 0
        while length < 62 and under(2 + min(length, 13), magnitude.bit_length() - 1 > length):
            length += 1
        m = 1
        for n in range(length):
            bit = magnitude >> (length - 1 - n) & 1
            m = 2 * m + self.one((name, "tail", length, m if n < 3 else 0), bit)
        return -m if negative else m

    def _learn(self, context: Any, bit: int) -> None:
        p, n = self.contexts.get(context, (1 << 21, 0))
        step = (1 << 17) // (2 * n + 3)
        p = p + (((1 << 22) - 1 - p) * step >> 16) if bit else p - (p * step >> 16)
        self.contexts[context] = (p, min(n + 1, 255))
