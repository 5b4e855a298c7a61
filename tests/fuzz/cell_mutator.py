"""Cells changed below their compression: other raw streams, or other evidence altogether.

bytes           as libFuzzer does it
streams         one stream's raw bytes, compressed anew under true lengths
sound streams   then the masks made to agree, and every count and length made to follow from them
evidence        other numbers in other voxels, encoded anew: whatever the coding is
"""

import random
import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import zstandard

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.codec.octree.cell_head import CellHead, decode_head, encode_head
from cairn_map.errors import CairnError
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX, packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry

Mutate = Callable[[bytes], bytes]
Streams = dict[int, bytes]

STREAM_HEAD = struct.Struct("<BBII")
STORED, ZSTD, MODELLED = 0, 1, 2
CHILD_MASKS, LEAF_MASKS, HITS, MISSES = 1, 2, 3, 4
FIRST_CHANNEL, STREAMS_PER_CHANNEL = 16, 8
RAW_BYTES_MAX = 1 << 16
"""Of a stream that is worth changing."""
NODES_MAX = 4096
EVIDENCE_BYTES_MAX = 1 << 18


def mutated_cell(data: bytes, rng: random.Random, mutate: Mutate) -> bytes:
    """A cell that resembles another; what is no cell is changed as bytes."""
    way = rng.randrange(8)
    try:
        if way == 0:
            return mutate(data)
        if way <= 2:
            return _other_evidence(data, rng)
        return _other_streams(data, rng, mutate, is_sound=way >= 5)
    except (CairnError, struct.error, zstandard.ZstdError, ValueError):
        return mutate(data)


def _other_evidence(data: bytes, rng: random.Random) -> bytes:
    cell = decode_cell(data, evidence_bytes_max=EVIDENCE_BYTES_MAX)
    evidence, geometry = cell.evidence, cell.geometry
    places = evidence.voxels.astype(np.int64)
    counts = evidence.counts.astype(np.int64)
    samples = np.zeros((len(places), geometry.plane_count), np.int64)
    samples[evidence.sampled] = evidence.samples
    draw = np.random.default_rng(rng.randrange(1 << 32))
    if rng.random() < 0.3:
        geometry = _other_geometry(geometry, rng)
        samples = np.resize(samples, (len(places), geometry.plane_count))
        keep = places < 8**geometry.depth
        places, counts, samples = places[keep], counts[keep], samples[keep]
    if rng.random() < 0.5:
        size = 8 ** rng.randrange(3)
        new = rng.randrange(8**geometry.depth // size) * size + np.arange(size)
        new = np.setdiff1d(new, places)
        places = np.concatenate([places, new])
        counts = np.concatenate([counts, np.tile([[rng.randrange(3), rng.randrange(3)]], (len(new), 1))])
        samples = np.concatenate([samples, np.zeros((len(new), geometry.plane_count), np.int64)])
    low = -1 if cell.evidence.is_signed or rng.random() < 0.1 else 0
    for _ in range(rng.choice((0, 1, 3, 20))):
        if not len(places):
            break
        row = rng.randrange(len(places))
        top = 1 << rng.randrange(63)
        if rng.random() < 0.5 or not geometry.plane_count:
            counts[row, rng.randrange(2)] = draw.integers(low * min(top, COUNT_MAX), min(top, COUNT_MAX) + 1)
        else:
            samples[row, rng.randrange(geometry.plane_count)] = draw.integers(
                low * min(top, SUM_MAX), min(top, SUM_MAX)
            )
    if rng.random() < 0.2:
        keep = draw.random(len(places)) < 0.8
        places, counts, samples = places[keep], counts[keep], samples[keep]
    made = packed_evidence(places.astype(np.uint32), counts, samples, geometry)
    return encode_cell(CellKey(cell.key), made, geometry, profile=rng.choice(list(Profile))).data


def _other_geometry(geometry: Geometry, rng: random.Random) -> Geometry:
    """Another depth, and some of the channels."""
    channels = tuple(channel for channel in geometry.channels if rng.random() < 0.7)
    return Geometry(voxel_edge_um=geometry.voxel_edge_um, depth=rng.choice((3, 3, 4, 5, 8)), channels=channels)


def _other_streams(data: bytes, rng: random.Random, mutate: Mutate, *, is_sound: bool) -> bytes:
    head, head_bytes = decode_head(data)
    streams, modelled = _streams(data[len(head_bytes) :])
    for _ in range(rng.choice((1, 1, 2, 4))):
        number = rng.choice(list(streams) or [CHILD_MASKS])
        streams[number] = mutate(streams.get(number, b""))
    if is_sound and not modelled:
        head = replace(head, signed=head.signed ^ (rng.random() < 0.05))
        head, streams = _agreed(head, streams)
        head_bytes = encode_head(head)
    elif rng.random() < 0.2:
        head_bytes = mutate(head_bytes)
    is_packed = rng.random() < 0.5
    return head_bytes + b"".join(
        STREAM_HEAD.pack(number, MODELLED, modelled[number], len(raw)) + raw
        if number in modelled
        else _stream(number, raw, is_packed)
        for number, raw in streams.items()
    )


def _streams(data: bytes) -> tuple[Streams, dict[int, int]]:
    """Raw streams by number; what is modelled stays as it is, and comes with the raw length that it claims."""
    streams: Streams = {}
    modelled: dict[int, int] = {}
    at = 0
    while at < len(data):
        number, coding, raw_bytes, stored = STREAM_HEAD.unpack_from(data, at)
        at += STREAM_HEAD.size
        body = data[at : at + stored]
        at += stored
        if coding == ZSTD:
            with zstandard.ZstdDecompressor(max_window_size=1 << 23).stream_reader(body) as reader:
                body = reader.read(RAW_BYTES_MAX)
        elif coding == MODELLED:
            modelled[number] = raw_bytes
        streams[number] = body
    return streams, modelled


def _stream(number: int, raw: bytes, is_packed: bool) -> bytes:
    body = zstandard.ZstdCompressor(write_content_size=False).compress(raw) if is_packed else raw
    return STREAM_HEAD.pack(number, ZSTD if is_packed else STORED, len(raw), len(body)) + body


def _agreed(head: CellHead, streams: Streams) -> tuple[CellHead, Streams]:
    """A head and streams that do not contradict each other in any number or length."""
    masks, leaf_masks, leaves, voxels = _sound_masks(
        streams.get(CHILD_MASKS, b""), streams.get(LEAF_MASKS, b""), head.geometry.depth
    )
    agreed = {CHILD_MASKS: masks, LEAF_MASKS: leaf_masks}
    for number in (HITS, MISSES):
        agreed[number] = _column(streams.get(number, b""), leaves)
    for c, channel in enumerate(head.geometry.channels):
        first = FIRST_CHANNEL + STREAMS_PER_CHANNEL * c
        bits = np.unpackbits(np.frombuffer(streams.get(first, b""), np.uint8), bitorder="little")
        bits = np.append(bits, np.zeros(leaves, np.uint8))[:leaves]
        agreed[first] = np.packbits(bits, bitorder="little").tobytes()
        for number in range(first + 1, first + 1 + len(channel.planes)):
            agreed[number] = _column(streams.get(number, b""), int(bits.sum()))
    return replace(head, voxels=voxels, leaves=leaves, streams=len(agreed)), agreed


def _sound_masks(children: bytes, leaves: bytes, depth: int) -> tuple[bytes, bytes, int, int]:
    """Masks that make an octree of this depth, and how many leaves and voxels it has."""
    child_masks, leaf_masks = bytearray(), bytearray()
    inner = 1 if children else 0
    at = leaf_at = leaf_count = voxels = 0
    for d in range(depth):
        left = 0
        for n in range(inner):
            child = children[at + n] if at + n < len(children) and children[at + n] else 1
            leaf = leaves[leaf_at + n] & child if leaf_at + n < len(leaves) else 0
            if d == depth - 1:
                leaf = child
            else:
                if len(child_masks) > NODES_MAX:
                    child = leaf = leaf or child
                leaf_masks.append(leaf)
            child_masks.append(child)
            leaf_count += leaf.bit_count()
            voxels += leaf.bit_count() << 3 * (depth - 1 - d)
            left += (child & ~leaf).bit_count()
        at += inner
        leaf_at += inner
        inner = left
    return bytes(child_masks), bytes(leaf_masks), leaf_count, voxels


def _column(stream: bytes, rows: int) -> bytes:
    """The column with so many rows, zeros where it was shorter."""
    planes = min(stream[0], 8) if stream else 0
    return bytes([planes]) + stream[1 : 1 + planes * rows].ljust(planes * rows, b"\0")
