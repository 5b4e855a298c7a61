"""Octree code of a cell, exact: its evidence as bytes and back, lossless and canonical. Start here.

    head | child masks | leaf masks | hits | misses | per channel: presence, weight, value planes

FORMAT.md sections 4 to 6 are the norm. The same evidence always gives the same canonical bytes (the streams
uncompressed), and the SHA-256 over them is the cell's identity; so stored bytes may be recompressed without changing
it. `cell_reading` decodes parts of a cell, `view_code` is the lossy code.
"""

import hashlib
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np

from cairn_map.codec.cell_reading import EVIDENCE_BYTES_MAX, CellReader, cell_reader
from cairn_map.codec.entropy import small_profile
from cairn_map.codec.octree import channel_streams
from cairn_map.codec.octree.cell_content import (
    CHILD_MASKS,
    HITS,
    LEAF_MASKS,
    MISSES,
    CellContent,
    canonical_bytes,
    content_of,
    count_streams,
    evidence_of,
    met_of,
    topology_streams,
)
from cairn_map.codec.octree.cell_head import CellHead, encode_head
from cairn_map.codec.octree.channel_streams import ChannelRows, stream_of_channel
from cairn_map.codec.octree.streams import MODELLED, StoredStream, join_streams, stored_streams
from cairn_map.codec.plain_cell import plain_bytes
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.compact_cell import CellCoding
from cairn_map.evidence.evidence import Evidence, check_fits, empty_evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key


class Profile(StrEnum):
    """Coding of the streams; both profiles hold the same evidence, and have the same digest."""

    FAST = "fast"
    """Byte planes under zstd; of a level, the votes under a model, which knows that their weights are mostly hits."""
    SMALL = "small"
    """Each number under a model of its neighbours: six tenths of the bytes for some ten times the time."""


@dataclass(frozen=True, slots=True)
class EncodedCell:
    """A cell's bytes and the SHA-256 (32 bytes) of its canonical form."""

    data: bytes
    digest: bytes


@dataclass(frozen=True, slots=True)
class CanonicalCell:
    """Content of canonical bytes, by leaf."""

    key: CellKey
    geometry: Geometry
    content: CellContent
    digest: bytes

    @property
    def evidence(self) -> Evidence:
        """Content by voxel; computed at each call."""
        return evidence_of(self.content)


@dataclass(frozen=True, slots=True)
class DecodedCell:
    """Content of a cell's bytes, by voxel."""

    key: CellKey
    geometry: Geometry
    evidence: Evidence
    digest: bytes


def encode_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, *, profile: Profile = Profile.FAST
) -> EncodedCell:
    """Bytes of one cell; signed evidence (a difference) is marked as such in the head, and always coded `FAST`.

    Raises:
        BadInputError: kind `bad_evidence`: it is not of this geometry.
    """
    # The canonical streams, over which the digest is taken (FORMAT.md sections 4 and 5), each under zstd.
    check_fits(evidence, geometry)
    profile = Profile(profile)
    plain = plain_bytes(key, evidence, geometry) if profile is Profile.FAST else None
    if plain is not None and not geometry.is_flat:
        return EncodedCell(bytes(plain.head) + join_streams(stored_streams(plain.streams)), _digest(plain.canonical))
    signed, content = evidence.is_signed, content_of(evidence, geometry)
    parts = channel_streams.split_samples(content.sampled, content.samples, geometry)
    streams: Mapping[int, bytes | memoryview]
    canonical: bytes | memoryview
    if plain is not None:
        head, streams, canonical = bytes(plain.head), plain.streams, plain.canonical
    else:
        head, raw = _canonical(key, content, parts, geometry, voxels=len(evidence), signed=signed)
        streams, canonical = raw, canonical_bytes(head, raw)
    stored = {stream.number: stream for stream in stored_streams(streams)}
    # Groups that a model makes shorter take the place of theirs (section 14): all bytes in the first stream.
    for first, data in ({} if signed else _modelled(content, parts, geometry, profile)).items():
        group = [number for number in streams if _group(number) == _group(first)]
        if data is not None and len(data) < sum(len(stored[number].body) for number in group):
            for number in group:
                body = data if number == first else b""
                stored[number] = StoredStream(number, MODELLED, len(streams[number]), body)
    return EncodedCell(head + join_streams(list(stored.values())), _digest(canonical))


def encode_empty_cell(key: CellKey, geometry: Geometry) -> bytes:
    """Bytes of a cell without evidence, those that `encode_cell` gives; the streams are coded once for a geometry."""
    streams, joined = _empty_streams(geometry)
    head = CellHead(key=key, geometry=geometry, voxels=0, leaves=0, streams=streams, signed=False)
    return encode_head(head) + joined


@lru_cache(maxsize=16)
def _empty_streams(geometry: Geometry) -> tuple[int, bytes]:
    """Number of streams of an empty cell, and their stored bytes."""
    _, streams = _encoded(CellKey(0), empty_evidence(geometry), geometry)
    return len(streams), join_streams(stored_streams(streams))


def encode_cells(
    diff: Mapping[CellKey, Evidence], geometry: Geometry, *, profile: Profile = Profile.FAST, threads: int | None = None
) -> dict[CellKey, EncodedCell]:
    """Bytes of many cells, rising in number; `threads` None: one for each processor.

    Raises:
        BadInputError: as `encode_cell`.
    """
    keys = sorted(diff)
    if len(keys) == 1:
        return {keys[0]: encode_cell(keys[0], diff[keys[0]], geometry, profile=profile)}
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        encoded = pool.map(lambda key: encode_cell(key, diff[key], geometry, profile=profile), keys)
        return dict(zip(keys, encoded, strict=True))


def coding_of(geometry: Geometry) -> CellCoding:
    """Code by which a map of this geometry holds cells as bytes."""
    return CellCoding(
        encode=lambda key, evidence: encode_cell(key, evidence, geometry).data,
        decode=lambda data: decode_cell(data).evidence,
    )


def cell_digest(key: CellKey, evidence: Evidence, geometry: Geometry) -> bytes:
    """Digest of one cell's evidence, as `encode_cell` gives it, without compressing anything.

    Raises:
        BadInputError: kind `bad_evidence`: it is not of this geometry.
    """
    return _digest(_canonical_bytes(key, evidence, geometry))


def decode_cell(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> DecodedCell:
    """Evidence of a cell's bytes; every size is checked before anything is allocated.

    The result is sound evidence, but the bytes might be another coding of it than the canonical one;
    `decode_canonical_cell` refuses that. A hundred bytes can stand for 200 MB of evidence (collapsed air), so set
    `evidence_bytes_max` for bytes from an untrusted source.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: a version or kind of cell that this reader does not know, or too large.
    """
    reader = cell_reader(data, evidence_bytes_max=evidence_bytes_max)
    evidence = evidence_of(reader.content())
    return DecodedCell(reader.head.key, reader.head.geometry, evidence, _digest(reader.canonical_bytes()))


def decode_met(data: bytes) -> DecodedCell:
    """`decode_cell`, restricted to voxels that were hit or have samples: all that are visible.

    Raises:
        DamagedDataError, BadInputError: as `decode_cell`.
    """
    reader = cell_reader(data)
    evidence = evidence_of(met_of(reader.content()))
    return DecodedCell(reader.head.key, reader.head.geometry, evidence, _digest(reader.canonical_bytes()))


def decode_canonical_cell(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> DecodedCell:
    """`decode_cell`, but refuse bytes that are not the canonical coding of their evidence.

    Raises:
        DamagedDataError: kind `not_canonical`, or as `decode_cell`.
        BadInputError: as `decode_cell`.
    """
    cell = read_canonical_cell(cell_reader(data, evidence_bytes_max=evidence_bytes_max))
    return DecodedCell(cell.key, cell.geometry, cell.evidence, cell.digest)


def read_canonical_cell(reader: CellReader) -> CanonicalCell:
    """Content of a reader's bytes, by leaf; refused unless they are its canonical coding.

    Raises:
        DamagedDataError, BadInputError: as `decode_canonical_cell`.
    """
    # Plain cells are checked while they are read; others are encoded again and compared.
    head, content = reader.head, reader.content()
    is_canonical, data = reader.is_canonical(content), reader.canonical_bytes()
    if is_canonical is None:
        is_canonical = _canonical_bytes(head.key, evidence_of(content), head.geometry) == data
    if not is_canonical:
        raise DamagedDataError("not_canonical", f"cell {cell_of_key(head.key)} is not in canonical form")
    return CanonicalCell(head.key, head.geometry, content, _digest(data))


def recompressed_cell(data: bytes, *, profile: Profile) -> bytes:
    """The same cell, with the same digest, in another profile.

    Raises:
        DamagedDataError, BadInputError: as `decode_canonical_cell`.
    """
    cell = decode_canonical_cell(data)
    return encode_cell(cell.key, cell.evidence, cell.geometry, profile=profile).data


def _canonical_bytes(key: CellKey, evidence: Evidence, geometry: Geometry) -> bytes | memoryview:
    """Canonical bytes of evidence."""
    check_fits(evidence, geometry)
    plain = plain_bytes(key, evidence, geometry)
    return plain.canonical if plain is not None else canonical_bytes(*_encoded(key, evidence, geometry))


def _encoded(key: CellKey, evidence: Evidence, geometry: Geometry) -> tuple[bytes, dict[int, bytes]]:
    """Head and raw streams of evidence, which is checked to fit the geometry."""
    check_fits(evidence, geometry)
    content = content_of(evidence, geometry)
    parts = channel_streams.split_samples(content.sampled, content.samples, geometry)
    return _canonical(key, content, parts, geometry, voxels=len(evidence), signed=evidence.is_signed)


def _canonical(
    key: CellKey, content: CellContent, parts: list[ChannelRows], geometry: Geometry, *, voxels: int, signed: bool
) -> tuple[bytes, dict[int, bytes]]:
    """Head and raw streams of one cell."""
    leaves = len(content.counts)
    streams = topology_streams(content.octree) | count_streams(content.counts, signed=signed)
    for c, (channel, rows) in enumerate(zip(geometry.channels, parts, strict=True)):
        streams |= channel_streams.encode_channel(stream_of_channel(c), channel, rows, leaves=leaves, signed=signed)
    head = CellHead(key=key, geometry=geometry, voxels=voxels, leaves=leaves, streams=len(streams), signed=signed)
    return encode_head(head), streams


def _modelled(
    content: CellContent, parts: list[ChannelRows], geometry: Geometry, profile: Profile
) -> dict[int, bytes | None]:
    """By the number of its first stream: the bytes of each group under its model; None where they would be longer.

    All groups in the profile *small*, those of channels in the profile *fast* of a level, none in that of other cells.
    """
    leaves = len(content.counts)
    if profile is Profile.FAST and not (geometry.is_flat and leaves):
        return {}
    ground = small_profile.ground_of(content.octree, depth=geometry.depth)
    groups: dict[int, bytes | None] = {}
    if profile is Profile.SMALL:
        groups[CHILD_MASKS] = small_profile.encode_masks(content.octree, depth=geometry.depth)
        groups[HITS] = small_profile.encode_counts(content, ground)
    # A channel is modelled on the weights of the channel before it.
    hits, before = content.counts[:, 0].copy(), np.zeros(leaves, np.int64)
    for c, (channel, rows) in enumerate(zip(geometry.channels, parts, strict=True)):
        # Votes for classes have no model: they are few numbers, and small ones.
        if channel.kind is not ChannelKind.CLASSES:
            groups[stream_of_channel(c)] = small_profile.encode_channel(channel, rows, hits, before, ground)
        before = small_profile.weights_by_leaf(rows, leaves)
    return groups


def _group(number: int) -> int:
    """Number of the first stream of a stream's group."""
    return {CHILD_MASKS: CHILD_MASKS, LEAF_MASKS: CHILD_MASKS, HITS: HITS, MISSES: HITS}.get(number, number & ~7)


def _digest(data: bytes | memoryview) -> bytes:
    return hashlib.sha256(data).digest()
