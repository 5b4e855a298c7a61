"""Bytes of a cell of any map: of version 1 in one without epochs, of version 2 (`history_code`) in one with them.

encode_layer_cell    decode_layer_cell       a history as bytes, and back
write_cell           read_cell               a cell that is folded: rows that did not change are copied
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from cairn_map.codec.cell_code import (
    EncodedCell,
    Profile,
    decode_canonical_cell,
    decode_cell,
    encode_cell,
    encode_empty_cell,
)
from cairn_map.codec.cell_reading import EVIDENCE_BYTES_MAX
from cairn_map.codec.history_code import VERSION as HISTORY_VERSION
from cairn_map.codec.history_code import (
    DecodedHistory,
    HistoryFile,
    check_canonical_history,
    decode_history,
    encode_history,
    history_digest,
    join_history,
    split_history,
)
from cairn_map.epochs.cell_history import CellHistory, cell_history, row_fingerprint
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_cell import CodedRow, HistoryCell, RowCoding
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.cell_order import hottest_k
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey, cell_of_key


@dataclass(frozen=True, slots=True)
class WrittenCell:
    """Bytes of a cell as a map keeps them, and the facts that it keeps next to them."""

    data: bytes
    digest: bytes
    fingerprint: Fingerprint
    voxels: int
    """Voxels with evidence, each counted in each row."""
    hottest_k: float | None
    """Hottest of the rows' `cell_order.hottest_k`."""
    history_bytes: int
    """Bytes of rows older than the newest."""


def encode_layer_cell(
    key: CellKey, history: CellHistory, layer: MapLayer, *, profile: Profile = Profile.FAST
) -> EncodedCell:
    """Bytes and digest of a cell of a map.

    Raises:
        BadInputError: kind `bad_evidence`: not of the map's geometry, or rows by epoch in a map without epochs.
    """
    if layer.has_epochs:
        return encode_history(key, history, layer, profile=profile)
    return encode_cell(key, _base_of(history, layer), layer.geometry, profile=profile)


def decode_layer_cell(
    data: bytes, key: CellKey, layer: MapLayer, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX
) -> DecodedHistory:
    """All rows of a cell of a map; the mirror of `encode_layer_cell`.

    Raises:
        DamagedDataError: cut off, contradictory or out of range; kind `bad_cell`: another cell, or of another layer.
        BadInputError: another version, or too large.
    """
    if layer.has_epochs:
        found = decode_history(data, evidence_bytes_max=evidence_bytes_max)
    else:
        cell = decode_cell(data, evidence_bytes_max=evidence_bytes_max)
        history = cell_history({BASE: cell.evidence})
        found = DecodedHistory(cell.key, MapLayer(geometry=cell.geometry), history, cell.digest)
    _check_is(found.key, found.layer, key, layer)
    return found


def decode_canonical_layer_cell(data: bytes) -> DecodedHistory:
    """A cell of whatever map, refused if a row is not the canonical coding of its evidence.

    Raises:
        DamagedDataError: kind `not_canonical`, or cut off, contradictory or out of range.
        BadInputError: another version, or too large.
    """
    if data[4:5] == bytes([HISTORY_VERSION]):
        check_canonical_history(data)
        return decode_history(data)
    cell = decode_canonical_cell(data)
    history = cell_history({BASE: cell.evidence})
    return DecodedHistory(cell.key, MapLayer(geometry=cell.geometry), history, cell.digest)


def decode_row(data: bytes, key: CellKey, layer: MapLayer) -> Evidence:
    """Evidence of one row, or of a commit's cell.

    Raises:
        DamagedDataError, BadInputError: as `decode_layer_cell`.
    """
    cell = decode_cell(data)
    _check_is(cell.key, MapLayer(geometry=cell.geometry), key, MapLayer(geometry=layer.geometry))
    return cell.evidence


def row_file(data: bytes, epoch: Epoch, key: CellKey, layer: MapLayer) -> bytes:
    """Bytes of a cell that has one row, from that row as a cell file of version 1, which is not decoded.

    Raises:
        BadInputError: kind `bad_evidence`: it is of another cell or geometry.
    """
    return join_history(HistoryFile(key, layer, {epoch: data})) if layer.has_epochs else data


def read_cell(data: bytes, key: CellKey, layer: MapLayer) -> HistoryCell:
    """A stored cell, to be changed; each row is decoded once, one at a time, for its digest and fingerprint.

    Raises:
        DamagedDataError, BadInputError: as `decode_layer_cell`.
    """
    cell = HistoryCell(key, layer, row_coding(layer))
    for epoch, body in row_bodies(data, key, layer).items():
        decoded = decode_cell(body)
        _check_is(decoded.key, MapLayer(geometry=decoded.geometry), key, MapLayer(geometry=layer.geometry))
        if len(decoded.evidence):
            fingerprint = row_fingerprint(decoded.evidence, epoch, key, layer_word=layer.word)
            cell.put(epoch, _coded(decoded.evidence, EncodedCell(body, decoded.digest), fingerprint, layer))
    return cell


def write_cell(cell: HistoryCell, *, profile: Profile = Profile.FAST) -> WrittenCell:
    """Bytes of a cell, of which only the rows that changed are coded; the mirror of `read_cell`.

    Raises:
        BadInputError: kind `too_large`: more bytes or rows than a reader takes.
    """
    rows, layer, key = cell.coded(), cell.layer, cell.key
    fingerprint = sum((row.fingerprint for row in rows.values()), ZERO)
    bodies = {epoch: row.data for epoch, row in rows.items()}
    if layer.has_epochs:
        data = join_history(HistoryFile(key, layer, bodies))
        digest = history_digest(key, layer, {epoch: row.digest for epoch, row in rows.items()})
    elif rows:
        data, digest = rows[BASE].data, rows[BASE].digest
    else:
        data = encode_empty_cell(key, layer.geometry)
        digest = decode_cell(data).digest
    return WrittenCell(
        data,
        digest,
        fingerprint,
        voxels=sum(row.voxels for row in rows.values()),
        hottest_k=max((row.hottest_k for row in rows.values() if row.hottest_k is not None), default=None),
        history_bytes=sum(len(body) for epoch, body in bodies.items() if epoch != max(bodies)),
    )


@lru_cache(maxsize=64)
def row_coding(layer: MapLayer) -> RowCoding:
    """Code by which the rows of a map's cells are held as bytes."""

    def encode(key: CellKey, epoch: Epoch, evidence: Evidence, fingerprint: Fingerprint) -> CodedRow:
        return _coded(evidence, encode_cell(key, evidence, layer.geometry), fingerprint, layer)

    return RowCoding(
        encode=encode,
        decode=lambda row: decode_cell(row.data).evidence,
        fingerprint=lambda key, epoch, evidence: row_fingerprint(evidence, epoch, key, layer_word=layer.word),
    )


def _coded(evidence: Evidence, encoded: EncodedCell, fingerprint: Fingerprint, layer: MapLayer) -> CodedRow:
    return CodedRow(encoded.data, encoded.digest, fingerprint, len(evidence), hottest_k(evidence, layer.geometry))


def row_bodies(data: bytes, key: CellKey, layer: MapLayer) -> Mapping[Epoch, bytes]:
    """Rows of a cell's bytes, each as a cell file of version 1; none is decoded.

    Raises:
        DamagedDataError, BadInputError: as `decode_layer_cell`.
    """
    if not layer.has_epochs:
        return {BASE: data}
    file = split_history(data)
    _check_is(file.key, file.layer, key, layer)
    return file.rows


def _base_of(history: CellHistory, layer: MapLayer) -> Evidence:
    if any(epoch != BASE for epoch in history):
        raise BadInputError("bad_evidence", "a map without epochs has cells of one row, the base")
    return history.rows.get(BASE) or empty_evidence(layer.geometry)


def _check_is(key: CellKey, layer: MapLayer, wanted: CellKey, of: MapLayer) -> None:
    if key != wanted or layer != of:
        raise DamagedDataError(
            "bad_cell", f"expected cell {cell_of_key(wanted)} with {of}, got cell {cell_of_key(key)} with {layer}"
        )
