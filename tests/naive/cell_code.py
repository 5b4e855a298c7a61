"""Slow, obvious twin of the cell file (FORMAT.md 6, 14), written from the page and not from the code."""

import hashlib
import io
import struct
from collections.abc import Callable, Iterator
from typing import Any

import zstandard
from tests.naive import modelled
from tests.naive.columns import decode_column, encode_column, mean_guess, signed, square_guess, unzigzag, zigzag
from tests.naive.entropy import Coder
from tests.naive.evidence import Evidence, Voxel, deinterleave
from tests.naive.octree import leaves_of, leaves_of_masks, masks_of, tree_of

PLANES = {1: 4, 2: 2, 3: 3, 4: 2}
"""Of each kind of channel: colour, intensity, temperature, scalar."""
TEMPERATURE = 3
STORED, ZSTD, MODELLED = range(3)
CODES = {"colour": 1, "intensity": 2, "temperature": 3, "scalar": 4}


def encode_cell(header: dict[str, Any], evidence: Evidence) -> tuple[bytes, bytes]:
    """The cell file with streams as they are, and the digest.

    `header` has depth, voxel_edge_um, cell and channels (kind code, name, unit, step, zero).
    """
    head, streams = _head_and_streams(header, evidence)
    body = b"".join(struct.pack("<BBII", number, STORED, len(raw), len(raw)) + raw for number, raw in streams.items())
    return head + body, cell_digest(head, streams)


def encode_modelled_cell(header: dict[str, Any], evidence: Evidence) -> tuple[bytes, bytes]:
    """Likewise with every group modelled, whether it pays or not."""
    head, streams = _head_and_streams(header, evidence)
    groups = modelled_groups(header, evidence)
    body = b"".join(
        struct.pack("<BBII", number, MODELLED, len(raw), len(groups.get(number, b""))) + groups.get(number, b"")
        for number, raw in streams.items()
    )
    return head + body, cell_digest(head, streams)


def modelled_groups(header: dict[str, Any], evidence: Evidence) -> dict[int, bytes]:
    """The stored bytes of each group of modelled streams, by the number of its first stream."""
    depth = header["depth"]
    root = tree_of(evidence, depth)
    found = leaves_of(root, depth)
    leaves, counts = [_cube(place, size) for place, size, _ in found], [voxel[:2] for _, _, voxel in found]
    coders = {1: Coder(), 3: Coder()}
    if root:
        modelled.code_masks(coders[1], depth, _mask_pairs(*masks_of(root, depth)))
    modelled.code_counts(coders[3], leaves, counts)
    before: dict[int, int] = {}
    for c, (code, rows) in enumerate(_rows_by_channel([voxel for _, _, voxel in found], header["channels"])):
        coder = coders[16 + 8 * c] = Coder()
        hits = [count[0] for count in counts]
        modelled.code_channel(coder, leaves, hits, before, PLANES[code], code == TEMPERATURE, rows)
        before = {leaf: row[-1] for leaf, row in rows.items()}
    return {first: coder.end() for first, coder in coders.items()}


def decode_cell(data: bytes) -> tuple[dict[str, Any], Evidence]:
    """What a sound cell file says: its header with the digest, and its evidence."""
    file = io.BytesIO(data)
    magic, version, kind, depth, flags, edge_um = struct.unpack("<4sBBBBI", file.read(12))
    assert (magic, version, kind) == (b"CRNC", 1, 1)
    cell = struct.unpack("<iii", file.read(12))
    voxels, leaf_count, channel_count, stream_count = struct.unpack("<IIBB", file.read(10))
    channels = []
    for _ in range(channel_count):
        code, name_bytes, unit_bytes = file.read(3)
        name, unit = file.read(name_bytes).decode(), file.read(unit_bytes).decode()
        channels.append((code, name, unit, *struct.unpack("<dd", file.read(16))))
    head = data[: file.tell()]
    stored = dict(_stored_stream(file) for _ in range(stream_count))
    assert not file.read()
    streams = _raw_streams(stored, depth, leaf_count, channels)
    assert all(len(streams[number]) == raw_bytes for number, (_, raw_bytes, _) in stored.items())
    assert len(streams) == stream_count
    assert not flags & 1 or all(coding != MODELLED for coding, _, _ in stored.values())

    leaves = leaves_of_masks(streams[1], streams[2], depth)
    assert len(leaves) == leaf_count
    plain = unzigzag if flags & 1 else int
    hits = [plain(word) for word in decode_column(streams[3], leaf_count)]
    misses = [plain(word) for word in decode_column(streams[4], leaf_count)]
    sums: list[tuple[int, ...]] = [()] * leaf_count
    for c, (code, *_) in enumerate(channels):
        rows = _channel_rows(streams, 16 + 8 * c, code, leaf_count, plain)
        sums = [sums[n] + rows.get(n, (0,) * PLANES[code]) for n in range(leaf_count)]
    evidence = {
        start + step: (hits[n], misses[n], sums[n]) for n, (start, size) in enumerate(leaves) for step in range(size)
    }
    assert len(evidence) == voxels
    header = {"depth": depth, "voxel_edge_um": edge_um, "cell": cell, "channels": channels, "signed": bool(flags & 1)}
    return header | {"leaves": leaf_count, "digest": cell_digest(head, streams)}, evidence


def cell_digest(head: bytes, streams: dict[int, bytes]) -> bytes:
    """SHA-256 over the head and the raw streams."""
    parts = [struct.pack("<BI", number, len(raw)) + raw for number, raw in sorted(streams.items())]
    return hashlib.sha256(head + b"".join(parts)).digest()


def _head_and_streams(header: dict[str, Any], evidence: Evidence) -> tuple[bytes, dict[int, bytes]]:
    depth, channels = header["depth"], header["channels"]
    root = tree_of(evidence, depth)
    leaves = [voxel for _, _, voxel in leaves_of(root, depth)]
    is_signed = any(n < 0 for hits, misses, samples in evidence.values() for n in (hits, misses, *samples))
    plain = zigzag if is_signed else int
    streams = dict(zip((1, 2), masks_of(root, depth), strict=True))
    streams |= _count_streams([voxel[:2] for voxel in leaves], plain)
    for c, (code, rows) in enumerate(_rows_by_channel(leaves, channels)):
        streams |= _channel_streams(16 + 8 * c, code, rows, len(leaves), plain)
    head = struct.pack("<4sBBBBI", b"CRNC", 1, 1, depth, int(is_signed), header["voxel_edge_um"])
    head += struct.pack("<iii", *header["cell"])
    head += struct.pack("<IIBB", len(evidence), len(leaves), len(channels), len(streams))
    for code, name, unit, step, zero in channels:
        head += bytes([code, len(name.encode()), len(unit.encode())]) + name.encode() + unit.encode()
        head += struct.pack("<dd", step, zero)
    return head, streams


def _stored_stream(file: io.BytesIO) -> tuple[int, tuple[int, int, bytes]]:
    number, coding, raw_bytes, stored_bytes = struct.unpack("<BBII", file.read(10))
    return number, (coding, raw_bytes, file.read(stored_bytes))


def _raw_streams(
    stored: dict[int, tuple[int, int, bytes]], depth: int, leaf_count: int, channels: list[Any]
) -> dict[int, bytes]:
    """All streams as they would be without any coding."""
    raw: dict[int, bytes] = {}

    def is_modelled(numbers: list[int]) -> bool:
        codings = {stored[number][0] for number in numbers}
        assert codings == {MODELLED} or MODELLED not in codings
        assert MODELLED not in codings or not any(stored[number][2] for number in numbers[1:])
        if MODELLED not in codings:
            raw.update({number: _unpacked(*stored[number]) for number in numbers})
        return MODELLED in codings

    if is_modelled([1, 2]):
        coder = Coder(stored[1][2])
        raw |= _mask_streams(modelled.code_masks(coder, depth, None) if leaf_count else [], depth)
        coder.end()
    leaves = [_cube(place, size) for place, size in leaves_of_masks(raw[1], raw[2], depth)]
    if is_modelled([3, 4]):
        coder = Coder(stored[3][2])
        raw |= _count_streams(modelled.code_counts(coder, leaves, None), int)
        coder.end()
    hits, before = decode_column(raw[3], leaf_count), dict[int, int]()
    for c, (code, *_) in enumerate(channels):
        first = 16 + 8 * c
        if is_modelled(list(range(first, first + 1 + PLANES[code]))):
            coder = Coder(stored[first][2])
            rows = modelled.code_channel(coder, leaves, hits, before, PLANES[code], code == TEMPERATURE, None)
            coder.end()
            raw |= _channel_streams(first, code, rows, leaf_count, int)
        before = {leaf: row[-1] for leaf, row in _channel_rows(raw, first, code, leaf_count, int).items()}
    return raw


def _unpacked(coding: int, raw_bytes: int, body: bytes) -> bytes:
    if coding == ZSTD:
        body = zstandard.ZstdDecompressor().decompressobj().decompress(body)
    assert coding in (STORED, ZSTD)
    assert len(body) == raw_bytes
    return body


def _cube(place: int, size: int) -> modelled.Leaf:
    """(First voxel, edge) of a leaf of so many voxels."""
    return deinterleave(place), 1 << ((size.bit_length() - 1) // 3)


def _mask_pairs(child_masks: bytes, leaf_masks: bytes) -> list[tuple[int, int]]:
    """(child mask, leaf mask) of each inner node; all children of the last ones are leaves."""
    return list(zip(child_masks, leaf_masks + child_masks[len(leaf_masks) :], strict=True))


def _mask_streams(pairs: list[tuple[int, int]], depth: int) -> dict[int, bytes]:
    """The mirror of `_mask_pairs`: the last depth has no leaf masks."""
    nodes = above = 0
    below = min(1, len(pairs))
    for _ in range(depth):
        nodes, above = nodes + below, nodes
        below = sum((mask & ~leaf).bit_count() for mask, leaf in pairs[above:nodes])
    return {1: bytes(mask for mask, _ in pairs), 2: bytes(leaf for _, leaf in pairs[:above])}


def _rows_by_channel(leaves: list[Voxel], channels: list[Any]) -> Iterator[tuple[int, dict[int, tuple[int, ...]]]]:
    """(Kind code, row of sums by leaf) of each channel; rows of zeros left out."""
    at = 0
    for code, *_ in channels:
        rows = {n: voxel[2][at : at + PLANES[code]] for n, voxel in enumerate(leaves)}
        at += PLANES[code]
        yield code, {n: row for n, row in rows.items() if any(row)}


def _count_streams(counts: list[tuple[int, int]], plain: Callable[[int], int]) -> dict[int, bytes]:
    return {3 + column: encode_column([plain(count[column]) for count in counts]) for column in range(2)}


def _channel_streams(
    first: int, code: int, rows: dict[int, tuple[int, ...]], leaf_count: int, plain: Callable[[int], int]
) -> dict[int, bytes]:
    *planes, weights = [[row[p] for row in rows.values()] for p in range(PLANES[code])]
    streams = {
        first: sum(1 << n for n in rows).to_bytes((leaf_count + 7) // 8, "little"),
        first + 1: encode_column([plain(w) for w in weights]),
    }
    for p, plane in enumerate(planes):
        if code == TEMPERATURE and p == 1:
            guesses = [square_guess(total, w) for total, w in zip(planes[0], weights, strict=True)]
        else:
            guesses = [mean_guess(n, plane, weights) for n in range(len(plane))]
        residuals = [zigzag(value - guess) for value, guess in zip(plane, guesses, strict=True)]
        streams[first + 2 + p] = encode_column(residuals)
    return streams


def _channel_rows(
    streams: dict[int, bytes], first: int, code: int, leaf_count: int, plain: Callable[[int], int]
) -> dict[int, tuple[int, ...]]:
    bits = int.from_bytes(streams[first], "little")
    present = [n for n in range(leaf_count) if bits >> n & 1]
    weights = [plain(word) for word in decode_column(streams[first + 1], len(present))]
    planes: list[list[int]] = []
    for p in range(PLANES[code] - 1):
        words = decode_column(streams[first + 2 + p], len(present))
        plane: list[int] = []
        for n, word in enumerate(words):
            is_square = code == TEMPERATURE and p == 1
            guess = square_guess(planes[0][n], weights[n]) if is_square else mean_guess(n, plane, weights)
            plane.append(signed(guess + unzigzag(word)))
        planes.append(plane)
    return dict(zip(present, zip(*planes, weights, strict=True), strict=True))
