"""PNG files changed under sound checksums: a chunk's bytes, or the pixels that they are packed of."""

import random
import struct
import zlib
from collections.abc import Callable

SIGNATURE = b"\x89PNG\r\n\x1a\n"
PIXEL_BYTES_MAX = 1 << 20


def mutated_png(data: bytes, rng: random.Random, mutate: Callable[[bytes], bytes]) -> bytes:
    """One chunk changed, its length and CRC put right; what is no PNG is changed as bytes."""
    chunks = _chunks(data)
    if not chunks or rng.random() < 0.2:
        return mutate(data)
    at = rng.randrange(len(chunks))
    kind, body = chunks[at]
    if kind == b"IDAT" and rng.random() < 0.5:
        body = zlib.compress(mutate(zlib.decompressobj().decompress(body, PIXEL_BYTES_MAX)))
    elif rng.random() < 0.1:
        kind = rng.choice((b"IHDR", b"IDAT", b"IEND", b"PLTE", b"tRNS", b"eXIf", b"acTL", b"fcTL"))
    elif rng.random() < 0.1:
        chunks.insert(at, (kind, body))
    else:
        body = mutate(body)
    chunks[at] = kind, body
    return SIGNATURE + b"".join(_chunk(*chunk) for chunk in chunks)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Kind and content of each whole chunk; none if it is no PNG."""
    found: list[tuple[bytes, bytes]] = []
    at = len(SIGNATURE)
    while data.startswith(SIGNATURE) and at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        found.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    try:
        for kind, body in found:
            if kind == b"IDAT":
                zlib.decompressobj().decompress(body, PIXEL_BYTES_MAX)
    except zlib.error:
        return []
    return found
