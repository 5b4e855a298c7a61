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

from cairn_map import channel_streams
from cairn_map.cell_head import CellHead, decode_head, encode_head
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence import COUNT_MAX, Evidence, check_fits
from cairn_map.grid import CellKey, Geometry, cell_of_key
from cairn_map.octree import Octree, build_octree, parse_octree
from cairn_map.octree_kernels import expand_into
from cairn_map.streams import RAW_BYTES_MAX, decode_column, encode_column, pack_streams, unpack_streams

CHILD_MASKS, LEAF_MASKS, HITS, MISSES = 1, 2, 3, 4
CELL_BYTES_MAX = 1 << 28
"""Bytes of one encoded cell that a reader accepts."""
EVIDENCE_BYTES_MAX = 1 << 31
"""Bytes of one cell's packed evidence: the largest cell, full, with the standard channels in every voxel, has 1.4e9."""
VOXEL_BYTES = 12
"""Of packed evidence: a voxel's number and two counts."""


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
    """The bytes of one cell; signed evidence (a difference) is marked as such in the head.

    Raises:
        BadInputError: kind `bad_evidence`: it is not of this geometry.
    """
    head, streams = _canonical(key, evidence, geometry)
    return EncodedCell(head + pack_streams(streams), _digest(head, streams))


def cell_digest(key: CellKey, evidence: Evidence, geometry: Geometry) -> bytes:
    """The digest that `encode_cell` gives, without compressing anything.

    Raises:
        BadInputError: kind `bad_evidence`: it is not of this geometry.
    """
    return _digest(*_canonical(key, evidence, geometry))


def _canonical(key: CellKey, evidence: Evidence, geometry: Geometry) -> tuple[bytes, dict[int, bytes]]:
    """Head and uncompressed streams of one cell."""
    check_fits(evidence, geometry)
    signed = evidence.is_signed
    octree, rows = build_octree(evidence, depth=geometry.depth)
    streams = {CHILD_MASKS: octree.child_masks.tobytes(), LEAF_MASKS: octree.leaf_masks.tobytes()}
    for number, column in ((HITS, 0), (MISSES, 1)):
        streams[number] = encode_column(channel_streams.words(evidence.counts[rows, column].astype(np.int64), signed))
    leaf_rows = np.searchsorted(rows, evidence.sampled, side="right") - 1
    streams |= channel_streams.encode_channels(leaf_rows, evidence.samples, geometry, leaves=len(rows), signed=signed)
    head = encode_head(
        CellHead(
            key=key, geometry=geometry, voxels=len(evidence), leaves=len(rows), streams=len(streams), signed=signed
        )
    )
    return head, streams


def decode_cell(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> DecodedCell:
    """What a cell's bytes say, with every size checked before anything is allocated.

    The result is sound evidence, but the bytes might be another coding of it than the canonical one;
    `decode_canonical_cell` refuses that. A hundred bytes can stand for 200 MB of evidence (collapsed air), so who
    reads what strangers wrote sets `evidence_bytes_max`.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: a version or kind of cell that this reader does not know, or too large.
    """
    if len(data) > CELL_BYTES_MAX:
        raise BadInputError("too_large", f"a cell has at most {CELL_BYTES_MAX} bytes, got {len(data)}")
    head, head_bytes = decode_head(data)
    geometry, leaves, signed = head.geometry, head.leaves, head.signed
    sampled_max = (evidence_bytes_max - VOXEL_BYTES * head.voxels) // (4 + 8 * geometry.plane_count)
    if sampled_max < 0:
        raise BadInputError("too_large", f"{head.voxels} voxels are more than {evidence_bytes_max} bytes of evidence")
    streams = unpack_streams(
        data[len(head_bytes) :], count=head.streams, raw_bytes_max=min(RAW_BYTES_MAX, head.raw_bytes_max)
    )
    octree = parse_octree(_masks(streams, CHILD_MASKS), _masks(streams, LEAF_MASKS), depth=geometry.depth)
    if len(octree.starts) != leaves or int(octree.sizes.sum()) != head.voxels:
        raise DamagedDataError("bad_cell", "the octree has other numbers of voxels or leaves than the head names")
    leaf_counts = np.stack([_counts(streams, number, leaves, signed) for number in (HITS, MISSES)], axis=1)
    places, samples = channel_streams.decode_channels(
        streams, geometry, leaves=leaves, signed=signed, sampled_max=sampled_max
    )
    evidence = _evidence(octree, leaf_counts, places, samples, head.voxels)
    return DecodedCell(head.key, geometry, evidence, _digest(head_bytes, streams))


def decode_canonical_cell(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> DecodedCell:
    """`decode_cell`, and refuse bytes that are not the canonical coding of what they say.

    Raises:
        DamagedDataError: kind `not_canonical`, or as `decode_cell`.
        BadInputError: as `decode_cell`.
    """
    cell = decode_cell(data, evidence_bytes_max=evidence_bytes_max)
    if cell_digest(cell.key, cell.evidence, cell.geometry) != cell.digest:
        raise DamagedDataError("not_canonical", f"cell {cell_of_key(cell.key)} is not in canonical form")
    return cell


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
