"""A cell's evidence as bytes and back: one file per cell, lossless and canonical.

    head | child masks | leaf masks | hits | misses | per channel: presence, weight, value planes

FORMAT.md is the norm. The same evidence always gives the same canonical bytes (the streams uncompressed), and
the SHA-256 over them is the cell's identity; so bytes at rest may be compressed anew without changing it.
"""

import hashlib
import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from cairn_map import channel_streams
from cairn_map.channels import CODE_OF_KIND, Channel
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence import COUNT_MAX, Evidence
from cairn_map.grid import CELL_LIMIT, CellKey, Geometry, cell_key, cell_of_key
from cairn_map.octree import Octree, build_octree, parse_octree
from cairn_map.octree_kernels import expand_into
from cairn_map.streams import decode_column, encode_column, pack_streams, unpack_streams

MAGIC = b"CRNC"
VERSION = 1
KIND_EVIDENCE = 1
FLAG_SIGNED = 1
HEAD = struct.Struct("<4sBBBBIiiiIIBB")
CHILD_MASKS, LEAF_MASKS, HITS, MISSES = 1, 2, 3, 4
CELL_BYTES_MAX = 1 << 28
"""Bytes of one encoded cell that a reader accepts."""


@dataclass(frozen=True, slots=True)
class EncodedCell:
    """A cell's bytes and the SHA-256 (32 bytes) of its canonical form."""

    data: bytes
    digest: bytes


@dataclass(frozen=True, slots=True)
class DecodedCell:
    """What a cell's bytes say."""

    key: CellKey
    geometry: Geometry
    evidence: Evidence
    digest: bytes


def encode_cell(key: CellKey, evidence: Evidence, geometry: Geometry) -> EncodedCell:
    """The bytes of one cell; signed evidence (a difference) is marked as such in the head."""
    signed = evidence.is_signed
    octree, rows = build_octree(evidence, depth=geometry.depth)
    streams = {CHILD_MASKS: octree.child_masks.tobytes(), LEAF_MASKS: octree.leaf_masks.tobytes()}
    for number, column in ((HITS, 0), (MISSES, 1)):
        streams[number] = encode_column(channel_streams.words(evidence.counts[rows, column].astype(np.int64), signed))
    leaf_of_row = np.cumsum(np.bincount(rows, minlength=len(evidence))) - 1
    streams |= channel_streams.encode_channels(
        leaf_of_row[evidence.sampled], evidence.samples, geometry, leaves=len(rows), signed=signed
    )
    head = _head(key, geometry, voxels=len(evidence), leaves=len(rows), streams=len(streams), signed=signed)
    return EncodedCell(head + pack_streams(streams), _digest(head, streams))


def decode_cell(data: bytes) -> DecodedCell:
    """What a cell's bytes say, with every size checked before anything is allocated.

    The result is sound evidence, but the bytes might be another coding of it than the canonical one;
    `decode_canonical_cell` refuses that.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: a version or kind of cell that this reader does not know, or too large.
    """
    head, key, geometry, voxels, leaves, stream_count, signed = _read_head(data)
    streams = unpack_streams(data[len(head) :], count=stream_count)
    octree = parse_octree(_masks(streams, CHILD_MASKS), _masks(streams, LEAF_MASKS), depth=geometry.depth)
    if len(octree.starts) != leaves or int(octree.sizes.sum()) != voxels:
        raise DamagedDataError(
            "bad_cell", f"the head names {voxels} voxels in {leaves} leaves, the octree has {int(octree.sizes.sum())}"
        )
    leaf_counts = np.stack([_counts(streams, number, leaves, signed) for number in (HITS, MISSES)], axis=1)
    places, samples = channel_streams.decode_channels(streams, geometry, leaves=leaves, signed=signed)
    return DecodedCell(key, geometry, _evidence(octree, leaf_counts, places, samples, voxels), _digest(head, streams))


def decode_canonical_cell(data: bytes) -> DecodedCell:
    """`decode_cell`, and refuse bytes that are not the canonical coding of what they say.

    Raises:
        DamagedDataError: kind `not_canonical`, or as `decode_cell`.
    """
    cell = decode_cell(data)
    if encode_cell(cell.key, cell.evidence, cell.geometry).digest != cell.digest:
        raise DamagedDataError("not_canonical", f"cell {cell_of_key(cell.key)} is not in canonical form")
    return cell


def _head(key: CellKey, geometry: Geometry, *, voxels: int, leaves: int, streams: int, signed: bool) -> bytes:
    head = HEAD.pack(
        MAGIC,
        VERSION,
        KIND_EVIDENCE,
        geometry.depth,
        FLAG_SIGNED if signed else 0,
        geometry.voxel_edge_um,
        *cell_of_key(key),
        voxels,
        leaves,
        len(geometry.channels),
        streams,
    )
    for channel in geometry.channels:
        name, unit = channel.name.encode(), channel.unit.encode()
        head += struct.pack("<BBB", CODE_OF_KIND[channel.kind], len(name), len(unit)) + name + unit
        head += struct.pack("<dd", channel.step, channel.zero)
    return head


def _read_head(data: bytes) -> tuple[bytes, CellKey, Geometry, int, int, int, bool]:
    if len(data) < HEAD.size or data[:4] != MAGIC:
        raise DamagedDataError("bad_cell", "not a cairn cell: it must begin with CRNC and a whole head")
    if len(data) > CELL_BYTES_MAX:
        raise BadInputError("too_large", f"a cell has at most {CELL_BYTES_MAX} bytes, got {len(data)}")
    _, version, kind, depth, flags, edge_um, i, j, k, voxels, leaves, channels, streams = HEAD.unpack_from(data)
    if version != VERSION or kind != KIND_EVIDENCE:
        raise BadInputError("unknown_version", f"this reader knows cells of version 1, kind 1; got {version}, {kind}")
    if flags & ~FLAG_SIGNED or not all(-CELL_LIMIT <= v < CELL_LIMIT for v in (i, j, k)):
        raise DamagedDataError("bad_cell", "unknown flags, or a cell number out of range")
    at = HEAD.size
    found: list[Channel] = []
    try:
        for _ in range(channels):
            code, name_bytes, unit_bytes = struct.unpack_from("<BBB", data, at)
            at += 3
            name, unit = data[at : at + name_bytes], data[at + name_bytes : at + name_bytes + unit_bytes]
            at += name_bytes + unit_bytes
            step, zero = struct.unpack_from("<dd", data, at)
            at += 16
            channel_kind = next((kind for kind, number in CODE_OF_KIND.items() if number == code), None)
            fields = {"kind": channel_kind, "name": name.decode(), "unit": unit.decode(), "step": step, "zero": zero}
            found.append(Channel.model_validate(fields))
        geometry = Geometry(voxel_edge_um=edge_um, depth=depth, channels=tuple(found))
    except (struct.error, UnicodeDecodeError, ValidationError) as exc:
        raise DamagedDataError("bad_cell", f"the cell's head is damaged: {str(exc).splitlines()[0]}") from exc
    if not leaves <= voxels <= 8**depth:
        raise DamagedDataError("bad_cell", f"{voxels} voxels in {leaves} leaves do not fit a cell of depth {depth}")
    return data[:at], cell_key((i, j, k)), geometry, voxels, leaves, streams, bool(flags & FLAG_SIGNED)


def _masks(streams: dict[int, bytes], number: int) -> npt.NDArray[np.uint8]:
    return np.frombuffer(channel_streams.required(streams, number), np.uint8)


def _counts(streams: dict[int, bytes], number: int, leaves: int, signed: bool) -> npt.NDArray[np.int32]:
    words = decode_column(channel_streams.required(streams, number), rows=leaves)
    return channel_streams.numbers(words, signed, limit=COUNT_MAX).astype(np.int32)


def _evidence(
    octree: Octree,
    leaf_counts: npt.NDArray[np.int32],
    places: npt.NDArray[np.int64],
    samples: npt.NDArray[np.int64],
    voxels: int,
) -> Evidence:
    if (octree.sizes[places] != 1).any():
        raise DamagedDataError("bad_cell", "a collapsed leaf cannot hold samples")
    has_samples = np.zeros(len(octree.starts), np.bool_)
    has_samples[places] = True
    if not (has_samples | (leaf_counts != 0).any(axis=1)).all():
        raise DamagedDataError("bad_cell", "a leaf without evidence must not be there")
    evidence = Evidence(
        np.empty(voxels, np.uint32),
        np.empty((voxels, 2), np.int32),
        (np.cumsum(octree.sizes) - octree.sizes)[places].astype(np.uint32),
        samples,
    )
    expand_into(octree.starts, octree.sizes, leaf_counts, evidence.voxels, evidence.counts)
    return evidence


def _digest(head: bytes, streams: dict[int, bytes]) -> bytes:
    sha = hashlib.sha256(head)
    for number, raw in streams.items():
        sha.update(struct.pack("<BI", number, len(raw)))
        sha.update(raw)
    return sha.digest()
