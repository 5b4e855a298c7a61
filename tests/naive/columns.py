"""Slow, obvious twins of columns (FORMAT.md 5): signed numbers as words, words as byte planes, expected values."""

WORD = 1 << 64


def zigzag(value: int) -> int:
    """0, -1, 1, -2 become 0, 1, 2, 3; of a number in 64-bit two's complement."""
    value = signed(value)
    return 2 * value if value >= 0 else -2 * value - 1


def unzigzag(word: int) -> int:
    """The mirror of `zigzag`."""
    return word // 2 if word % 2 == 0 else -(word + 1) // 2


def signed(word: int) -> int:
    """The two's complement number that a word stands for."""
    word %= WORD
    return word - WORD if word >= WORD // 2 else word


def encode_column(words: list[int]) -> bytes:
    """Byte planes."""
    planes = 0
    while any(word >> (8 * planes) for word in words):
        planes += 1
    return bytes([planes]) + bytes((word >> (8 * p)) & 255 for p in range(planes) for word in words)


def decode_column(stream: bytes, rows: int) -> list[int]:
    """The mirror of `encode_column`."""
    planes = stream[0]
    assert planes <= 8
    assert len(stream) == 1 + planes * rows
    return [sum(stream[1 + p * rows + n] << (8 * p) for p in range(planes)) for n in range(rows)]


def mean_guess(n: int, values: list[int], weights: list[int]) -> int:
    """What a value plane's row n is expected to be: the previous mean times this weight, in words."""
    if n == 0 or weights[n - 1] == 0:
        return 0
    return (values[n - 1] * weights[n]) % WORD // (weights[n - 1] % WORD)


def square_guess(total: int, weight: int) -> int:
    """The sum of squares if all samples were alike, in words."""
    if weight == 0:
        return 0
    s, w = total % WORD, weight % WORD
    q = s // w
    return (q * q * w + 2 * q * (s - q * w)) % WORD
