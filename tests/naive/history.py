"""Slow, obvious twins of cells with epochs, from FORMAT.md 16: rows, their sums, fingerprint, file and reading.

A history is a dict: epoch -> evidence (`naive.evidence`), the base under `None`.
"""

import hashlib
import io
import math
import struct
from collections.abc import Iterable
from typing import Any

from tests.naive import cell_code
from tests.naive.columns import WORD
from tests.naive.evidence import Evidence, merged, mix

History = dict[int | None, Evidence]


def history_of(commits: Iterable[tuple[int | None, Evidence, int]]) -> History:
    """Rows of (epoch, evidence, 1 or -1) in any order: each commit is added to the row of its epoch, or taken out."""
    rows: History = {}
    for epoch, evidence, sign in commits:
        rows[epoch] = merged(rows.get(epoch, {}), evidence, sign=sign)
    return {epoch: row for epoch, row in rows.items() if row}


def total(history: History) -> Evidence:
    """All rows together."""
    found: Evidence = {}
    for row in history.values():
        found = merged(found, row)
    return found


def fingerprint(history: History, number: int, layer_word: int) -> tuple[int, int]:
    """Both sums of one cell."""
    start = (number + layer_word) % WORD
    sums = [0, 0]
    for epoch, row in history.items():
        for n, cell in enumerate((start, start ^ (WORD - 1))):
            seed = mix(cell) if epoch is None else mix((mix(cell) + epoch + 1) % WORD)
            for place, (hits, misses, samples) in row.items():
                for plane, value in enumerate((hits, misses, *samples)):
                    sums[n] += value * (mix(seed ^ (place << 8 | plane)) | 1)
    return sums[0] % WORD, sums[1] % WORD


def log_odds(history: History, place: int, model: tuple[float, float, float, float]) -> float | None:
    """Rule R1 for one voxel: clamped after each row; None if it is unknown. `model`: hit, miss, low, high."""
    hit, miss, low, high = model
    found, is_known = 0.0, False
    for epoch in sorted(history, key=lambda epoch: -math.inf if epoch is None else epoch):
        hits, misses, _ = history[epoch].get(place, (0, 0, ()))
        if hits or misses:
            found, is_known = min(max(found + (hits * hit + misses * miss), low), high), True
    return found if is_known else None


def decode_history(data: bytes) -> tuple[dict[str, Any], History]:
    """What a sound cell file of version 2 says."""
    file = io.BytesIO(data)
    magic, version, kind, depth, flags, edge_um, *cell = struct.unpack("<4sBBBBIiii", file.read(24))
    assert (magic, version, kind, flags) == (b"CRNC", 2, 1, 0)
    epoch_s, rows, channel_count, name_bytes = struct.unpack("<IIBB", file.read(10))
    name, channels = file.read(name_bytes).decode(), b""
    for _ in range(channel_count):
        sizes = file.read(3)
        channels += sizes + file.read(sizes[1] + sizes[2] + 16)
    digest = hashlib.sha256(data[: file.tell()])
    history: History = {}
    for _ in range(rows):
        epoch, voxels, leaves, signed, streams, size = struct.unpack("<qIIBBI", file.read(22))
        head = struct.pack("<4sBBBBIiii", b"CRNC", 1, 1, depth, signed, edge_um, *cell)
        head += struct.pack("<IIBB", voxels, leaves, channel_count, streams)
        header, row = cell_code.decode_cell(head + channels + file.read(size))
        digest.update(struct.pack("<q", epoch) + header["digest"])
        history[None if epoch == -(1 << 63) else epoch] = row
    assert not file.read()
    return {"layer": name, "epoch_s": epoch_s, "cell": tuple(cell), "digest": digest.digest()}, history
