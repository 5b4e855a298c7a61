"""Commits and replies changed inside: a cell, a text or a frame, under sound lengths and checksums."""

import random
import struct
import zlib
from collections.abc import Callable

from tests.fuzz.cell_mutator import mutated_cell
from tests.fuzz.json_mutator import mutated_json

Mutate = Callable[[bytes], bytes]

COMMIT_HEAD = struct.Struct("<4sBI")
FRAME_HEAD = struct.Struct("<IB")
REPLY_START = b"CRNS\x01"
CELL_FRAME_HEAD_BYTES = 105
DELTA, STATE, FULL, RESET = 2, 3, 4, 5


def mutated_commit(data: bytes, rng: random.Random, mutate: Mutate) -> bytes:
    """The meta or a cell changed; what is no commit is changed as bytes."""
    if rng.random() < 0.1:
        return mutate(data)
    try:
        magic, version, size = COMMIT_HEAD.unpack_from(data)
        at = COMMIT_HEAD.size + size
        meta = data[COMMIT_HEAD.size : at]
        (count,) = struct.unpack_from("<I", data, at)
        at += 4
        cells: list[bytes] = []
        for _ in range(min(count, 16)):
            (size,) = struct.unpack_from("<I", data, at)
            cells.append(data[at + 4 : at + 4 + size])
            at += 4 + size
    except struct.error:
        return mutate(data)
    if cells and rng.random() < 0.6:
        n = rng.randrange(len(cells))
        cells[n] = mutated_cell(cells[n], rng, mutate)
    elif cells and rng.random() < 0.1:
        cells.append(rng.choice(cells))
    else:
        meta = mutated_json(meta, rng, mutate)
    parts = [COMMIT_HEAD.pack(magic, version, len(meta)), meta, struct.pack("<I", len(cells))]
    return b"".join([*parts, *(struct.pack("<I", len(cell)) + cell for cell in cells)])


def mutated_reply(data: bytes, rng: random.Random, mutate: Mutate) -> bytes:
    """One frame changed, taken out, doubled or of another type; what is no reply is changed as bytes."""
    frames = _frames(data)
    if not frames or rng.random() < 0.1:
        return mutate(data)
    at = rng.randrange(len(frames))
    kind, body = frames[at]
    way = rng.random()
    if way < 0.05:
        frames[at] = rng.randrange(9), body
    elif way < 0.1:
        frames.insert(rng.randrange(len(frames)), (kind, body))
    elif way < 0.15:
        del frames[at]
    elif kind in (DELTA, FULL) and way < 0.6:
        payload = mutated_cell(body[CELL_FRAME_HEAD_BYTES:], rng, mutate)
        frames[at] = kind, body[:CELL_FRAME_HEAD_BYTES] + payload
    elif kind in (DELTA, STATE, FULL, RESET):
        frames[at] = kind, mutate(body)
    else:
        frames[at] = kind, mutated_json(body, rng, mutate)
    return REPLY_START + b"".join(_frame(*frame) for frame in frames)


def _frame(kind: int, body: bytes) -> bytes:
    framed = FRAME_HEAD.pack(len(body), kind) + body
    return framed + struct.pack("<I", zlib.crc32(framed))


def _frames(data: bytes) -> list[tuple[int, bytes]]:
    """Type and body of each whole frame; none if it is no reply."""
    found: list[tuple[int, bytes]] = []
    at = len(REPLY_START)
    while data.startswith(REPLY_START) and at + FRAME_HEAD.size + 4 <= len(data):
        size, kind = FRAME_HEAD.unpack_from(data, at)
        found.append((kind, data[at + FRAME_HEAD.size : at + FRAME_HEAD.size + size]))
        at += FRAME_HEAD.size + size + 4
    return found


def bytewise(rng: random.Random) -> Callable[[bytes], bytes]:
    """A few other bytes: what stands in for libFuzzer's own changes."""

    def changed(data: bytes) -> bytes:
        made = bytearray(data)
        for _ in range(rng.randrange(1, 4)):
            made[rng.randrange(len(made) + 1) :][: rng.randrange(2)] = b""
            at = rng.randrange(len(made) + 1)
            made[at : at + rng.randrange(3)] = rng.randbytes(rng.randrange(3))
        return bytes(made)

    return changed
