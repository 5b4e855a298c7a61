"""Slow, obvious twins of evidence, from FORMAT.md 2, 3 and 8: Morton numbers, sums, fingerprints.

Evidence here is a dict: place -> (hits, misses, samples), samples a tuple of all sums, voxels of zeros left out.
"""

from tests.naive.columns import WORD

Voxel = tuple[int, int, tuple[int, ...]]
Evidence = dict[int, Voxel]


def interleave(x: int, y: int, z: int) -> int:
    """Bit b of x, y, z becomes bit 3 b, 3 b + 1, 3 b + 2."""
    return sum(((v >> b) & 1) << (3 * b + axis) for axis, v in enumerate((x, y, z)) for b in range(21))


def deinterleave(code: int) -> tuple[int, int, int]:
    """The mirror of `interleave`."""
    x, y, z = (sum(((code >> (3 * b + axis)) & 1) << b for b in range(21)) for axis in range(3))
    return x, y, z


def cell_number(cell: tuple[int, int, int]) -> int:
    """63-bit number of a cell."""
    i, j, k = (v + (1 << 20) for v in cell)
    return interleave(i, j, k)


def merged(a: Evidence, b: Evidence, *, sign: int = 1) -> Evidence:
    """a + sign * b, zeros left out."""
    total = dict(a)
    for place, (hits, misses, samples) in b.items():
        old = total.pop(place, (0, 0, (0,) * len(samples)))
        new = (
            old[0] + sign * hits,
            old[1] + sign * misses,
            tuple(o + sign * s for o, s in zip(old[2], samples, strict=True)),
        )
        if new[0] or new[1] or any(new[2]):
            total[place] = new
    return total


def fits(evidence: Evidence) -> bool:
    """Whether every number is one that a cell can hold."""
    return all(
        max(abs(hits), abs(misses)) < 1 << 31 and all(abs(value) <= 1 << 62 for value in samples)
        for hits, misses, samples in evidence.values()
    )


def mix(x: int) -> int:
    """SplitMix64."""
    x = (x + 0x9E3779B97F4A7C15) % WORD
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) % WORD
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) % WORD
    return x ^ (x >> 31)


def fingerprint(evidence: Evidence, number: int) -> tuple[int, int]:
    """Both sums of one cell."""
    seeds = (mix(number), mix(number ^ (WORD - 1)))
    first, second = (
        sum(
            value * (mix(seed ^ (place << 8 | plane)) | 1)
            for place, (hits, misses, samples) in evidence.items()
            for plane, value in enumerate((hits, misses, *samples))
        )
        % WORD
        for seed in seeds
    )
    return first, second
