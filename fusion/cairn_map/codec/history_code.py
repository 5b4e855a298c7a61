"""Bytes of a cell with epochs, version 2: a head, then each row's streams, coded as those of a cell of version 1.

    head: layer, cell, number of rows | row: epoch, sizes, streams | row: ...

So a row that did not change is copied, not coded again, and one epoch can be read without the others. FORMAT.md section
16 is the norm. `split_history` and `join_history` go between these bytes and cell files of version 1, one for each row.
"""

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from pydantic import ValidationError

from cairn_map.codec.cell_code import EncodedCell, Profile, decode_canonical_cell, decode_cell, encode_cell
from cairn_map.codec.cell_reading import CELL_BYTES_MAX, EVIDENCE_BYTES_MAX
from cairn_map.codec.octree.cell_head import (
    FLAG_SIGNED,
    KNOWN_KINDS,
    MAGIC,
    CellHead,
    channels_from_bytes,
    channels_to_bytes,
    decode_head,
    encode_head,
    end_of_channels,
    height_from_bytes,
    height_to_bytes,
    kind_of,
)
from cairn_map.epochs.cell_history import ROWS_MAX, CellHistory, cell_history
from cairn_map.epochs.epoch import Epoch, check_epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_key, cell_of_key

VERSION = 2
FLAG_EVICTS = 1
"""Flag that is reserved for cells of maps that let old rows go, with fields of their own."""
FIXED_PART = struct.Struct("<4sBBBBIiiiIIBB")
ROW_HEAD = struct.Struct("<qIIBBI")


@dataclass(frozen=True, slots=True)
class HistoryFile:
    """A cell's bytes, split into one cell file of version 1 for each row; no row is decoded."""

    key: CellKey
    layer: MapLayer
    rows: Mapping[Epoch, bytes]


@dataclass(frozen=True, slots=True)
class DecodedHistory:
    """All rows of a cell's bytes."""

    key: CellKey
    layer: MapLayer
    history: CellHistory
    digest: bytes


def is_history(data: bytes) -> bool:
    """True if bytes of a cell claim to be of version 2."""
    return data[4:5] == bytes([VERSION])


def encode_history(
    key: CellKey, history: CellHistory, layer: MapLayer, *, profile: Profile = Profile.FAST
) -> EncodedCell:
    """Bytes and digest of a cell with epochs; an empty history has no rows.

    Raises:
        BadInputError: kind `bad_evidence`: not of the layer's geometry; `bad_layer`: it has no epochs.
    """
    rows = {epoch: encode_cell(key, row, layer.geometry, profile=profile) for epoch, row in history.rows.items()}
    data = join_history(HistoryFile(key, layer, {epoch: row.data for epoch, row in rows.items()}))
    return EncodedCell(data, history_digest(key, layer, {epoch: row.digest for epoch, row in rows.items()}))


def decode_history(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> DecodedHistory:
    """All rows of a cell's bytes, which may be coded in another way than the canonical one.

    Args:
        data: bytes from anywhere.
        evidence_bytes_max: most memory of all rows' evidence together.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: another version, or too large.
    """
    file, rows, left = split_history(data), {}, evidence_bytes_max
    for epoch, body in file.rows.items():
        rows[epoch] = decode_cell(body, evidence_bytes_max=left)
        left -= rows[epoch].evidence.size_bytes
    digest = history_digest(file.key, file.layer, {epoch: row.digest for epoch, row in rows.items()})
    return DecodedHistory(
        file.key, file.layer, cell_history({epoch: row.evidence for epoch, row in rows.items()}), digest
    )


def check_canonical_history(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> None:
    """Refuse bytes of which a row is not the canonical coding of its evidence; one row at a time is in memory.

    Raises:
        DamagedDataError: kind `not_canonical`, or as `decode_history`.
        BadInputError: as `decode_history`.
    """
    left = evidence_bytes_max
    for body in split_history(data).rows.values():
        left -= decode_canonical_cell(body, evidence_bytes_max=left).evidence.size_bytes


def history_digest(key: CellKey, layer: MapLayer, rows: Mapping[Epoch, bytes]) -> bytes:
    """Identity of a cell with epochs: SHA-256 over its head, and of each row its epoch and the digest of its cell file.

    Args:
        key: the cell's number.
        layer: its layer.
        rows: digests (32 bytes) of the rows as cells of version 1, rising in epoch.
    """
    found = hashlib.sha256(_encode_head(key, layer, len(rows)))
    for epoch, digest in rows.items():
        found.update(struct.pack("<q", epoch) + digest)
    return found.digest()


def join_history(file: HistoryFile) -> bytes:
    """Bytes of a cell with epochs, from a cell file of version 1 for each row, rising in epoch.

    Raises:
        BadInputError: kind `bad_evidence`: a row of another cell or geometry, or `too_large`.
    """
    parts = [_encode_head(file.key, file.layer, len(file.rows))]
    for epoch, body in file.rows.items():
        head, head_bytes = decode_head(body)
        if head.key != file.key or head.geometry != file.layer.geometry:
            raise BadInputError("bad_evidence", "a row of a cell's history is of another cell or geometry")
        size = len(body) - len(head_bytes)
        parts.append(ROW_HEAD.pack(epoch, head.voxels, head.leaves, FLAG_SIGNED * head.signed, head.streams, size))
        parts.append(body[len(head_bytes) :])
    data = b"".join(parts)
    _check_size(len(data), len(file.rows))
    return data


def split_history(data: bytes) -> HistoryFile:
    """Rows of a cell's bytes, each as a cell file of version 1, its streams not decoded; the mirror of `join_history`.

    Raises:
        DamagedDataError: kind `bad_cell`: cut off, contradictory or out of range.
        BadInputError: kind `unknown_version` or `too_large`.
    """
    key, layer, count, at = _decode_head(data)
    _check_size(len(data), count)
    rows: dict[Epoch, bytes] = {}
    last: int | None = None
    for _ in range(count):
        if at + ROW_HEAD.size > len(data):
            raise DamagedDataError("bad_cell", "the cell is cut off in its rows")
        number, voxels, leaves, flags, streams, size = ROW_HEAD.unpack_from(data, at)
        at += ROW_HEAD.size + size
        if at > len(data) or flags & ~FLAG_SIGNED or not 0 < leaves <= voxels <= 8**layer.geometry.depth:
            raise DamagedDataError("bad_cell", "a row of the cell is cut off, empty or contradictory")
        if last is not None and number <= last:
            raise DamagedDataError("bad_cell", "the cell's rows must rise in epoch")
        try:
            epoch = check_epoch(number)
        except BadInputError as exc:
            raise DamagedDataError("bad_cell", exc.message) from exc
        head = CellHead(
            key=key, geometry=layer.geometry, voxels=voxels, leaves=leaves, streams=streams, signed=bool(flags)
        )
        rows[epoch] = encode_head(head) + data[at - size : at]
        last = number
    if at != len(data):
        raise DamagedDataError("bad_cell", f"{len(data) - at} bytes are left over after the cell's last row")
    return HistoryFile(key, layer, rows)


def _encode_head(key: CellKey, layer: MapLayer, rows: int) -> bytes:
    if layer.epoch_s is None:
        raise BadInputError("bad_layer", "a layer without epochs is written in format version 1")
    geometry, name = layer.geometry, layer.name.encode()
    fixed = FIXED_PART.pack(
        MAGIC,
        VERSION,
        kind_of(geometry),
        geometry.depth,
        0,
        geometry.voxel_edge_um,
        *cell_of_key(key),
        layer.epoch_s,
        rows,
        len(geometry.channels),
        len(name),
    )
    return fixed + name + height_to_bytes(geometry) + channels_to_bytes(geometry)


def _decode_head(data: bytes) -> tuple[CellKey, MapLayer, int, int]:
    """Cell, layer, number of rows, and length of the head."""
    if len(data) < FIXED_PART.size or data[:4] != MAGIC:
        raise DamagedDataError("bad_cell", "not a cairn cell: it must begin with CRNC and a whole head")
    _, version, kind, depth, flags, edge_um, i, j, k, epoch_s, rows, channels, name_bytes = FIXED_PART.unpack_from(data)
    if version != VERSION or kind not in KNOWN_KINDS:
        raise BadInputError("unknown_version", f"expected a cell of version 2, kind 1 or 3; got {version}, {kind}")
    if flags & FLAG_EVICTS:
        raise BadInputError("unknown_version", "this reader knows no cells of maps that let old rows go")
    if flags or not all(-CELL_LIMIT <= v < CELL_LIMIT for v in (i, j, k)):
        raise DamagedDataError("bad_cell", "unknown flags, or a cell number out of range")
    at = FIXED_PART.size + name_bytes
    try:
        step_um, start = height_from_bytes(data, at, kind)
        end = end_of_channels(data, start, channels)
        layer = _layer(data[FIXED_PART.size : at], epoch_s, edge_um, step_um, depth, channels, data[start:end])
    except (struct.error, UnicodeDecodeError, ValidationError) as exc:
        raise DamagedDataError("bad_cell", f"the cell's head is damaged: {str(exc).splitlines()[0]}") from exc
    if channels_to_bytes(layer.geometry) != data[start:end]:
        raise DamagedDataError("not_canonical", "the cell's head is not in canonical form")
    return cell_key((i, j, k)), layer, rows, end


@lru_cache(maxsize=16)
def _layer(
    name: bytes, epoch_s: int, edge_um: int, step_um: int | None, depth: int, channel_count: int, channels: bytes
) -> MapLayer:
    found = channels_from_bytes(channels, channel_count)
    geometry = Geometry(voxel_edge_um=edge_um, height_step_um=step_um, depth=depth, channels=found)
    return MapLayer(name=name.decode(), geometry=geometry, epoch_s=epoch_s)


def _check_size(size_bytes: int, rows: int) -> None:
    if size_bytes > CELL_BYTES_MAX or rows > ROWS_MAX:
        raise BadInputError(
            "too_large",
            f"a cell has at most {CELL_BYTES_MAX} bytes and {ROWS_MAX} rows of epochs, got {size_bytes} and {rows}",
        )
