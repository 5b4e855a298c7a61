"""Slow, obvious twins of the kernels and codecs, one section each, written from FORMAT.md and not from the code.

Evidence here is a dict: place -> (hits, misses, samples), samples a tuple of all sums, voxels of zeros left out.
"""

import hashlib
import io
import itertools
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import zstandard
from tests import naive_modelled
from tests.naive_coding import Coder

Voxel = tuple[int, int, tuple[int, ...]]
Evidence = dict[int, Voxel]

WORD = 1 << 64
PLANES = {1: 4, 2: 2, 3: 3, 4: 2}
"""Of each kind of channel: colour, intensity, temperature, scalar."""
TEMPERATURE = 3
STORED, ZSTD, MODELLED = range(3)
CODES = {"colour": 1, "intensity": 2, "temperature": 3, "scalar": 4}


# --- Morton numbers (FORMAT.md 2) -------------------------------------------------------------------------------


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


# --- Evidence (FORMAT.md 3) -------------------------------------------------------------------------------------


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


# --- Columns (FORMAT.md 5) --------------------------------------------------------------------------------------


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


# --- Octree (FORMAT.md 4) ---------------------------------------------------------------------------------------


class Node:
    """A node is a leaf, with the evidence of every voxel in it, or inner, with children."""

    def __init__(self, children: dict[int, "Node"] | None = None, voxel: Voxel | None = None) -> None:
        self.children = children or {}
        self.voxel = voxel

    @property
    def is_leaf(self) -> bool:
        return self.voxel is not None


def tree_of(evidence: Evidence, depth: int) -> Node | None:
    """The collapsed tree; None if there is no evidence."""

    def node(d: int, number: int, places: list[int]) -> Node:
        if d == depth:
            return Node(voxel=evidence[number])
        below: dict[int, list[int]] = {}
        for place in places:
            below.setdefault(place >> (3 * (depth - d - 1)) & 7, []).append(place)
        children = {c: node(d + 1, number * 8 + c, below[c]) for c in sorted(below)}
        voxels = [child.voxel for child in children.values()]
        alike = len({voxel[:2] for voxel in voxels if voxel}) == 1 and len(voxels) == 8 and None not in voxels
        if d > 0 and alike and not any(any(voxel[2]) for voxel in voxels if voxel):
            return Node(voxel=voxels[0])
        return Node(children)

    return node(0, 0, sorted(evidence)) if evidence else None


def masks_of(root: Node | None, depth: int) -> tuple[bytes, bytes]:
    """Child masks and leaf masks, breadth first."""
    child_masks, leaf_masks = bytearray(), bytearray()
    nodes = [root] if root else []
    for d in range(depth):
        child_masks += bytes(sum(1 << c for c in node.children) for node in nodes)
        if d < depth - 1:
            leaf_masks += bytes(sum(1 << c for c, child in node.children.items() if child.is_leaf) for node in nodes)
        nodes = [child for node in nodes for child in node.children.values() if not child.is_leaf]
    return bytes(child_masks), bytes(leaf_masks)


def leaves_of(root: Node | None, depth: int) -> list[tuple[int, int, Voxel]]:
    """(first place, size in voxels, evidence) of each leaf, in Morton order."""

    def walk(node: Node, number: int, d: int) -> Iterator[tuple[int, int, Voxel]]:
        if node.voxel is not None:
            yield number << (3 * (depth - d)), 8 ** (depth - d), node.voxel
        for c, child in node.children.items():
            yield from walk(child, number * 8 + c, d + 1)

    return list(walk(root, 0, 0)) if root else []


def leaves_above(root: Node | None, depth: int, stop: int) -> list[tuple[int, int]]:
    """(first place, size in voxels) of each leaf no deeper than `stop`, where inner nodes are leaves, too."""

    def walk(node: Node, number: int, d: int) -> Iterator[tuple[int, int]]:
        if node.is_leaf or d == stop:
            yield number << (3 * (depth - d)), 8 ** (depth - d)
        else:
            for c, child in node.children.items():
                yield from walk(child, number * 8 + c, d + 1)

    return list(walk(root, 0, 0)) if root else []


def leaves_of_masks(child_masks: bytes, leaf_masks: bytes, depth: int) -> list[tuple[int, int]]:
    """(first place, size in voxels) of each leaf, in Morton order."""
    children, leaves = io.BytesIO(child_masks), io.BytesIO(leaf_masks)
    found: list[tuple[int, int]] = []
    numbers = [0] if child_masks else []
    for d in range(depth):
        inner: list[int] = []
        exists = children.read(len(numbers))
        is_leaf = exists if d == depth - 1 else leaves.read(len(numbers))
        for number, mask, leaf_mask in zip(numbers, exists, is_leaf, strict=True):
            assert mask
            assert not leaf_mask & ~mask
            for c in range(8):
                if leaf_mask >> c & 1:
                    found.append(((number * 8 + c) << (3 * (depth - 1 - d)), 8 ** (depth - 1 - d)))
                elif mask >> c & 1:
                    inner.append(number * 8 + c)
        numbers = inner
    assert not children.read()
    assert not leaves.read()
    return sorted(found)


# --- The cell file (FORMAT.md 6) --------------------------------------------------------------------------------


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
        naive_modelled.code_masks(coders[1], depth, _mask_pairs(*masks_of(root, depth)))
    naive_modelled.code_counts(coders[3], leaves, counts)
    before: dict[int, int] = {}
    for c, (code, rows) in enumerate(_rows_by_channel([voxel for _, _, voxel in found], header["channels"])):
        coder = coders[16 + 8 * c] = Coder()
        hits = [count[0] for count in counts]
        naive_modelled.code_channel(coder, leaves, hits, before, PLANES[code], code == TEMPERATURE, rows)
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
        raw |= _mask_streams(naive_modelled.code_masks(coder, depth, None) if leaf_count else [], depth)
        coder.end()
    leaves = [_cube(place, size) for place, size in leaves_of_masks(raw[1], raw[2], depth)]
    if is_modelled([3, 4]):
        coder = Coder(stored[3][2])
        raw |= _count_streams(naive_modelled.code_counts(coder, leaves, None), int)
        coder.end()
    hits, before = decode_column(raw[3], leaf_count), dict[int, int]()
    for c, (code, *_) in enumerate(channels):
        first = 16 + 8 * c
        if is_modelled(list(range(first, first + 1 + PLANES[code]))):
            coder = Coder(stored[first][2])
            rows = naive_modelled.code_channel(coder, leaves, hits, before, PLANES[code], code == TEMPERATURE, None)
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


def _cube(place: int, size: int) -> naive_modelled.Leaf:
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


# --- Fingerprint (FORMAT.md 8) ----------------------------------------------------------------------------------


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


# --- Commit and reply (FORMAT.md 7, 10) -------------------------------------------------------------------------


def commit_parts(data: bytes) -> tuple[bytes, list[bytes], bytes]:
    """Meta, cell files and SHA-256 of a sound commit."""
    file = io.BytesIO(data)
    assert file.read(5) == b"CRCM\x01"
    (meta_bytes,) = struct.unpack("<I", file.read(4))
    meta = file.read(meta_bytes)
    (count,) = struct.unpack("<I", file.read(4))
    cells = [file.read(*struct.unpack("<I", file.read(4))) for _ in range(count)]
    assert not file.read()
    sha = hashlib.sha256(b"cairn-commit-1" + struct.pack("<II", meta_bytes, count) + meta)
    for cell in cells:
        sha.update(decode_cell(cell)[0]["digest"])
    return meta, cells, sha.digest()


def frame_bodies(data: bytes) -> list[tuple[int, bytes]]:
    """(type, body) of each frame of a sound reply."""
    file = io.BytesIO(data)
    assert file.read(5) == b"CRNS\x01"
    frames: list[tuple[int, bytes]] = []
    while prefix := file.read(5):
        size, kind = struct.unpack("<IB", prefix)
        body = file.read(size)
        assert struct.unpack("<I", file.read(4)) == (zlib.crc32(prefix + body),)
        frames.append((kind, body))
    return frames


# --- Version vector (FORMAT.md 9) -------------------------------------------------------------------------------


def ids_of_vector(value: dict[str, list[list[int]]]) -> set[tuple[str, int]]:
    """The plain set of (author, n) that a version vector in JSON stands for."""
    return {(author, n) for author, spans in value.items() for first, last in spans for n in range(first, last + 1)}


def vector_of_ids(ids: Iterable[tuple[str, int]]) -> dict[str, list[list[int]]]:
    """The version vector in JSON of a set of (author, n)."""
    vector: dict[str, list[list[int]]] = {}
    for author, n in sorted(ids):
        spans = vector.setdefault(author, [])
        if spans and spans[-1][1] == n - 1:
            spans[-1][1] = n
        else:
            spans.append([n, n])
    return vector


# --- Rays through voxels (cairn_fusion.mapping.cast_kernels) --------------------------------------------------


def passes(start: tuple[float, ...], end: tuple[float, ...], voxel: tuple[int, ...], *, grown: float) -> bool:
    """Whether a segment meets a voxel's cube, grown by so much on each side (or shrunken, if negative).

    A statement about the solid, not a walk: the parameters at which each axis is inside must overlap.
    """
    first, last = 0.0, 1.0
    for s, e, v in zip(start, end, voxel, strict=True):
        low, high = v - grown, v + 1 + grown
        if e == s:
            if not low <= s <= high:
                return False
            continue
        a, b = sorted(((low - s) / (e - s), (high - s) / (e - s)))
        first, last = max(first, a), min(last, b)
    return first <= last


def voxels_passed(start: tuple[float, ...], end: tuple[float, ...], *, grown: float) -> set[tuple[int, ...]]:
    """All voxels that a segment meets, each tried."""
    spans = [
        range(math.floor(min(s, e) - grown) - 1, math.floor(max(s, e) + grown) + 2)
        for s, e in zip(start, end, strict=True)
    ]
    return {voxel for voxel in itertools.product(*spans) if passes(start, end, voxel, grown=grown)}
