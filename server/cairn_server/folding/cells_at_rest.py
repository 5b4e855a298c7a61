"""Stored cells, checked when they are read, and rebuilt from the log when they are damaged."""

import logging
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

from cairn_map.codec.cell_code import DecodedCell, decode_cell, decode_met
from cairn_map.codec.history_code import DecodedHistory
from cairn_map.codec.layer_code import WrittenCell, decode_layer_cell, read_cell, row_coding, write_cell
from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.epochs.cell_history import CellHistory, history_fingerprint
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_server.cell_room import DECODING
from cairn_server.store.stamps import CellStamps, Stamps, decode_cell_stamps, decode_stamps
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow, Contribution

log = logging.getLogger(__name__)
T = TypeVar("T")

SOUND_MAX = 50_000
"""Most cells remembered as sound, some 300 bytes each."""


class DamagedCellError(DamagedDataError):
    """A cell of the map is damaged, and the log cannot rebuild it."""

    def __init__(self, key: CellKey, message: str) -> None:
        super().__init__("damaged_store", message)
        self.key = key

    def __reduce__(self) -> tuple[type["DamagedCellError"], tuple[CellKey, str]]:  # type: ignore[override]
        return type(self), (self.key, self.message)


def stored_history(stored: CellRow, layer: MapLayer) -> CellHistory:
    """All rows of a stored cell's evidence; of a map without epochs it is one, the base.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    found = decode_rows(stored.key, stored.body, layer)
    _check_is(stored, found.digest, history_fingerprint(found.history, stored.key, layer_word=layer.word))
    return found.history


def decode_rows(key: CellKey, body: bytes, layer: MapLayer) -> DecodedHistory:
    """All rows of a cell of the map that was sound when it was stored.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    try:
        return decode_layer_cell(body, key, layer)
    except CairnError as exc:
        raise _not_sound(key, exc) from exc


def stored_surfaces(stored: CellRow) -> Evidence:
    """Voxels of a stored cell without epochs that were hit or have samples, in a third of the time.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    decoded = _decoded(stored.key, stored.body, decode_met)
    _check_is(stored, decoded.digest, stored.fingerprint)
    return decoded.evidence


def check_stored(stored: CellRow, layer: MapLayer) -> None:
    """Refuse a stored cell that is not as it was written; one row of it at a time is decoded.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    if layer.has_epochs:
        _opened(stored, layer)
    else:
        stored_history(stored, layer)


def _opened(stored: CellRow, layer: MapLayer) -> HistoryCell:
    """Stored cell, to be changed.

    Raises:
        DamagedDataError: as `stored_history`.
    """
    if not layer.has_epochs:
        # Its one row is about to be changed: decoded once, not to bytes and again to sums.
        cell = HistoryCell(stored.key, layer, row_coding(layer))
        for epoch, row in stored_history(stored, layer).rows.items():
            cell.open(epoch, row, stored.fingerprint)
        return cell
    try:
        cell = read_cell(stored.body, stored.key, layer)
        written = write_cell(cell)
    except CairnError as exc:
        raise _not_sound(stored.key, exc) from exc
    _check_is(stored, written.digest, written.fingerprint)
    return cell


def _check_is(stored: CellRow, digest: bytes, fingerprint: Fingerprint) -> None:
    if digest != stored.digest:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(stored.key)} at rest does not have its digest")
    if fingerprint != stored.fingerprint:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(stored.key)} at rest does not have its fingerprint")


def _not_sound(key: CellKey, why: CairnError) -> DamagedDataError:
    return DamagedDataError("damaged_store", f"cell {cell_of_key(key)} at rest: {why.message}")


def sound_cell(snapshot: Snapshot, key: CellKey, layer: MapLayer, healed: list[CellRow]) -> CellRow | None:
    """A cell whose bytes may be sent, rebuilt from the log if the stored ones are damaged; None: never seen.

    Bytes that were found sound are remembered by their checksum, so that only new ones are decoded. A rebuilt cell is
    added to `healed`, for the caller to write once nothing is read any more.

    Raises:
        DamagedCellError: it is damaged, and the log cannot rebuild it.
    """
    stored = row_of_cell(snapshot, key)
    if stored is None or _SOUND.knows(stored):
        return stored
    with DECODING.of_cell(layer.geometry, stored.voxels):
        try:
            check_stored(stored, layer)
        except DamagedDataError as exc:
            log.error("%s; rebuilding it from the log", exc.message)
            rebuilt = _proven_rebuilt(snapshot, stored, layer, exc)
            healed.append(rebuilt)
            return rebuilt
    _SOUND.note(stored)
    return stored


def rebuilt_cell(snapshot: Snapshot, stored: CellRow, layer: MapLayer) -> CellRow:
    """Cell as the log says that it is.

    Raises:
        DamagedDataError: kind `damaged_store`: a diff is not sound, or not kept any more.
    """
    if stored.gone_seq:
        raise DamagedDataError("damaged_store", "evidence that it was made from is not kept any more")
    contributions = snapshot.contributions(stored.key, after_seq=0)
    return with_bytes(stored, write_cell(sum_of_contributions(snapshot, stored.key, contributions, layer)))


def with_bytes(stored: CellRow, written: WrittenCell) -> CellRow:
    """A cell's row with these bytes, and all that follows from them."""
    return replace(
        stored,
        digest=written.digest,
        fingerprint=written.fingerprint,
        voxels=written.voxels,
        body=written.data,
        size_bytes=len(written.data),
        hottest_k=written.hottest_k,
        history_bytes=written.history_bytes,
    )


def decode_stored(key: CellKey, body: bytes) -> DecodedCell:
    """A commit's diff of a cell, which was sound when it was stored.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    return _decoded(key, body, decode_cell)


def _decoded(key: CellKey, body: bytes, decode: Callable[[bytes], DecodedCell]) -> DecodedCell:
    try:
        decoded = decode(body)
    except CairnError as exc:
        raise _not_sound(key, exc) from exc
    if decoded.key != key:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(key)} at rest is cell {cell_of_key(decoded.key)}")
    return decoded


def stored_diff(snapshot: Snapshot, key: CellKey, contribution: Contribution) -> Evidence:
    """Evidence of the commit of a log entry about a cell.

    Raises:
        DamagedDataError: kind `damaged_store`: it is not sound, or not kept any more.
    """
    body = snapshot.diff(contribution.commit, key)
    if body is None:
        raise DamagedDataError("damaged_store", f"a diff of cell {cell_of_key(key)} is not there")
    return decode_stored(key, body).evidence


def sum_of_contributions(
    snapshot: Snapshot,
    key: CellKey,
    contributions: Iterable[Contribution],
    layer: MapLayer,
    *,
    diff_of: Callable[[Snapshot, CellKey, Contribution], Evidence] = stored_diff,
) -> HistoryCell:
    """Sum of what log entries did to a cell, each in the epoch of its commit (rule T6).

    Raises:
        DamagedDataError: kind `damaged_store`: a diff is not sound, or not kept any more.
    """
    total = HistoryCell(key, layer, row_coding(layer))
    for contribution in contributions:
        evidence = diff_of(snapshot, key, contribution)
        if contribution.kind == ENTRY_FOLD:
            total.merge(contribution.epoch, evidence)
        else:
            total.unmerge(contribution.epoch, evidence)
    return total


def stored_stamps(stored: CellRow, geometry: Geometry) -> Stamps:
    """Stamps of a stored cell; if they are damaged, all blocks count as changed."""
    return _sound_stamps(stored, lambda data: decode_stamps(data, depth=geometry.depth, lm=stored.lm))


def stamps_to_change(stored: CellRow, geometry: Geometry) -> CellStamps:
    """`stored_stamps`, to be changed."""
    return _sound_stamps(stored, lambda data: decode_cell_stamps(data, depth=geometry.depth, lm=stored.lm))


def _sound_stamps(stored: CellRow, decode: Callable[[bytes], T]) -> T:
    try:
        return decode(stored.stamps)
    except DamagedDataError as exc:
        log.error("cell %s: %s; taking all of it as changed", cell_of_key(stored.key), exc.message)
        return decode(b"")


def cell_to_change(
    snapshot: Snapshot, key: CellKey, stored: CellRow | None, layer: MapLayer
) -> tuple[HistoryCell, CellStamps]:
    """Cell of a row of the map, to be changed; a damaged one is rebuilt from the log.

    Raises:
        DamagedCellError: it is damaged, and the log cannot rebuild it.
    """
    if stored is None:
        return HistoryCell(key, layer, row_coding(layer)), CellStamps(layer.geometry.depth)
    stamps = stamps_to_change(stored, layer.geometry)
    try:
        return _opened(stored, layer), stamps
    except DamagedDataError as exc:
        log.error("%s; rebuilding it from the log", exc.message)
        return _opened(_proven_rebuilt(snapshot, stored, layer, exc), layer), stamps


def row_of_cell(snapshot: Snapshot, key: CellKey) -> CellRow | None:
    """A cell as it is stored, unchecked; None: never seen.

    Raises:
        DamagedCellError: its row cannot be read.
    """
    try:
        return snapshot.cell(key)
    except DamagedDataError as exc:
        raise DamagedCellError(key, exc.message) from exc


def _proven_rebuilt(snapshot: Snapshot, stored: CellRow, layer: MapLayer, why: DamagedDataError) -> CellRow:
    """A damaged cell rebuilt from the log, if its digest or its fingerprint proves that the log has all of it."""
    try:
        rebuilt = rebuilt_cell(snapshot, stored, layer)
    except DamagedDataError as exc:
        raise DamagedCellError(
            stored.key,
            f"{why.message}, and cannot be rebuilt: {exc.message}; send the cell as it was, or restore a backup",
        ) from exc
    if rebuilt.digest != stored.digest and rebuilt.fingerprint != stored.fingerprint:
        raise DamagedCellError(
            stored.key,
            f"{why.message}, and its commits do not add up to it; send the cell as it was, or restore a backup",
        )
    return rebuilt


class _SoundBodies:
    """Cells whose bytes were found to have their digest, by checksum; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[bytes, Fingerprint, int, int], None] = OrderedDict()

    def knows(self, stored: CellRow) -> bool:
        """True if these very bytes were found sound."""
        facts = _facts(stored)
        with self._lock:
            return facts in self._known

    def note(self, stored: CellRow) -> None:
        """Note that these bytes were found sound."""
        facts = _facts(stored)
        with self._lock:
            self._known[facts] = None
            if len(self._known) > SOUND_MAX:
                self._known.popitem(last=False)


def _facts(stored: CellRow) -> tuple[bytes, Fingerprint, int, int]:
    return stored.digest, stored.fingerprint, len(stored.body), zlib.crc32(stored.body)


_SOUND = _SoundBodies()
