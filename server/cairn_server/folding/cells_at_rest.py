"""Stored cells, checked when they are read, and rebuilt from the log when they are damaged."""

import logging
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

from cairn_map.codec.cell_code import DecodedCell, decode_cell, decode_met, encode_cell
from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.cell_order import hottest_k
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import Fingerprint, fingerprint
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


def stored_evidence(stored: CellRow) -> Evidence:
    """Evidence of a stored cell.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    decoded = _as_it_was(stored, decode_cell)
    if fingerprint(decoded.evidence, stored.key) != stored.fingerprint:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(stored.key)} at rest does not have its fingerprint")
    return decoded.evidence


def stored_surfaces(stored: CellRow) -> Evidence:
    """Voxels of `stored_evidence` that were hit or have samples, in a third of the time.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    return _as_it_was(stored, decode_met).evidence


def _as_it_was(stored: CellRow, decode: Callable[[bytes], DecodedCell]) -> DecodedCell:
    decoded = _decoded(stored.key, stored.body, decode)
    if decoded.digest != stored.digest:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(stored.key)} at rest does not have its digest")
    return decoded


def sound_cell(snapshot: Snapshot, key: CellKey, geometry: Geometry, healed: list[CellRow]) -> CellRow | None:
    """A cell whose bytes may be sent, rebuilt from the log if the stored ones are damaged; None: never seen.

    Bytes that were found sound are remembered by their checksum, so that only new ones are decoded. A rebuilt cell is
    added to `healed`, for the caller to write once nothing is read any more.

    Raises:
        DamagedCellError: it is damaged, and the log cannot rebuild it.
    """
    stored = row_of_cell(snapshot, key)
    if stored is None or _SOUND.knows(stored):
        return stored
    with DECODING.of_cell(geometry, stored.voxels):
        try:
            stored_evidence(stored)
        except DamagedDataError as exc:
            log.error("%s; rebuilding it from the log", exc.message)
            rebuilt = _proven_rebuilt(snapshot, stored, geometry, exc)
            healed.append(rebuilt)
            return rebuilt
    _SOUND.note(stored)
    return stored


def rebuilt_cell(snapshot: Snapshot, stored: CellRow, geometry: Geometry) -> CellRow:
    """Cell as the log says that it is.

    Raises:
        DamagedDataError: kind `damaged_store`: a diff is not sound, or not kept any more.
    """
    if stored.gone_seq:
        raise DamagedDataError("damaged_store", "evidence that it was made from is not kept any more")
    contributions = snapshot.contributions(stored.key, after_seq=0)
    evidence = sum_of_contributions(snapshot, stored.key, contributions, geometry).packed()
    encoded = encode_cell(stored.key, evidence, geometry)
    return replace(
        stored,
        digest=encoded.digest,
        fingerprint=fingerprint(evidence, stored.key),
        voxels=len(evidence),
        body=encoded.data,
        size_bytes=len(encoded.data),
        hottest_k=hottest_k(evidence, geometry),
    )


def decode_stored(key: CellKey, body: bytes) -> DecodedCell:
    """A cell or diff that was sound when it was stored.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    return _decoded(key, body, decode_cell)


def _decoded(key: CellKey, body: bytes, decode: Callable[[bytes], DecodedCell]) -> DecodedCell:
    try:
        decoded = decode(body)
    except CairnError as exc:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(key)} at rest: {exc.message}") from exc
    if decoded.key != key:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(key)} at rest is cell {cell_of_key(decoded.key)}")
    return decoded


def sum_of_contributions(
    snapshot: Snapshot, key: CellKey, contributions: Iterable[Contribution], geometry: Geometry
) -> BrickCell:
    """Sum of what log entries did to a cell.

    Raises:
        DamagedDataError: kind `damaged_store`: a diff is not sound, or not kept any more.
    """
    total = BrickCell(geometry)
    for contribution in contributions:
        body = snapshot.diff(contribution.commit, key)
        if body is None:
            raise DamagedDataError("damaged_store", f"a diff of cell {cell_of_key(key)} is not there")
        evidence = decode_stored(key, body).evidence
        if contribution.kind == ENTRY_FOLD:
            total.merge(evidence)
        else:
            total.unmerge(evidence)
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
    snapshot: Snapshot, key: CellKey, stored: CellRow | None, geometry: Geometry
) -> tuple[BrickCell, CellStamps]:
    """Cell of a row of the map, to be changed; a damaged one is rebuilt from the log.

    Raises:
        DamagedCellError: it is damaged, and the log cannot rebuild it.
    """
    cell = BrickCell(geometry)
    if stored is None:
        return cell, CellStamps(geometry.depth)
    stamps = stamps_to_change(stored, geometry)
    try:
        cell.merge(stored_evidence(stored))
    except DamagedDataError as exc:
        log.error("%s; rebuilding it from the log", exc.message)
        cell.merge(stored_evidence(_proven_rebuilt(snapshot, stored, geometry, exc)))
    return cell, stamps


def row_of_cell(snapshot: Snapshot, key: CellKey) -> CellRow | None:
    """A cell as it is stored, unchecked; None: never seen.

    Raises:
        DamagedCellError: its row cannot be read.
    """
    try:
        return snapshot.cell(key)
    except DamagedDataError as exc:
        raise DamagedCellError(key, exc.message) from exc


def _proven_rebuilt(snapshot: Snapshot, stored: CellRow, geometry: Geometry, why: DamagedDataError) -> CellRow:
    """A damaged cell rebuilt from the log, if its digest or its fingerprint proves that the log has all of it."""
    try:
        rebuilt = rebuilt_cell(snapshot, stored, geometry)
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
