"""Fingerprints: 128-bit sums that add as evidence adds, fingerprint(a + b) = fingerprint(a) + fingerprint(b).

After any frame a replica checks with it that its base equals the server's, without encoding anything. It detects
accidents, not forgery: a cell's identity is the SHA-256 of its canonical bytes. FORMAT.md section 8 is the norm.
"""

import struct
from dataclasses import dataclass

import numpy as np

from cairn_map.errors import DamagedDataError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_kernels import cell_seeds, weighted_sums
from cairn_map.evidence.grid import CellKey

MASK = (1 << 64) - 1


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """Two sums mod 2^64."""

    first: int = 0
    second: int = 0

    def __add__(self, other: "Fingerprint") -> "Fingerprint":
        return Fingerprint((self.first + other.first) & MASK, (self.second + other.second) & MASK)

    def __sub__(self, other: "Fingerprint") -> "Fingerprint":
        return Fingerprint((self.first - other.first) & MASK, (self.second - other.second) & MASK)

    def to_bytes(self) -> bytes:
        """16 bytes, little endian."""
        return struct.pack("<QQ", self.first, self.second)

    def hex(self) -> str:
        """32 hex digits of the bytes."""
        return self.to_bytes().hex()


ZERO = Fingerprint()
"""Fingerprint of a cell without evidence."""


def fingerprint(evidence: Evidence, key: CellKey) -> Fingerprint:
    """Fingerprint of one cell's evidence, which may have negative numbers."""
    return fingerprint_of_seeds(evidence, cell_seeds(np.uint64(key)))


def fingerprint_of_seeds(evidence: Evidence, seeds: tuple[np.uint64, np.uint64]) -> Fingerprint:
    """Fingerprint of evidence under the two seeds of its cell, or of one row of it (`evidence_kernels`)."""
    # Compiled code gives plain integers, and of such above 2^63 it takes none.
    seed, other = map(np.uint64, seeds)
    first, second = weighted_sums(seed, other, evidence.voxels, evidence.counts, evidence.sampled, evidence.samples)
    return Fingerprint(int(first), int(second))


def fingerprint_from_bytes(data: bytes) -> Fingerprint:
    """Fingerprint of its 16 bytes; the mirror of `Fingerprint.to_bytes`.

    Raises:
        DamagedDataError: not 16 bytes.
    """
    if len(data) != 16:
        raise DamagedDataError("bad_fingerprint", f"a fingerprint is 16 bytes, got {len(data)}")
    return Fingerprint(*struct.unpack("<QQ", data))


def fingerprint_from_hex(text: str) -> Fingerprint:
    """Fingerprint of its 32 hex digits; the mirror of `Fingerprint.hex`.

    Raises:
        DamagedDataError: not 32 hex digits, in lower case.
    """
    try:
        found = fingerprint_from_bytes(bytes.fromhex(text))
        if found.hex() != text:  # bytes.fromhex skips spaces and takes capitals; a fingerprint has one text only
            raise ValueError
        return found
    except ValueError:
        raise DamagedDataError("bad_fingerprint", f"a fingerprint is 32 hex digits, got {text[:40]!r}") from None
