"""Cells as the store has them, checked when they are read; and made anew from the log when they are damaged."""

import logging
from collections.abc import Iterable

from cairn_map.brick_cell import BrickCell
from cairn_map.cell_code import DecodedCell, decode_cell
from cairn_map.cursor import ENTRY_FOLD
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence import Evidence
from cairn_map.grid import CellKey, Geometry, cell_of_key
from cairn_server.stamps import Stamps, decode_stamps, no_stamps
from cairn_server.store import Snapshot
from cairn_server.store_rows import CellRow, Contribution

log = logging.getLogger(__name__)


def stored_evidence(stored: CellRow) -> Evidence:
    """The evidence of a cell at rest.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    decoded = decode_stored(stored.key, stored.body)
    if decoded.digest != stored.digest:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(stored.key)} at rest does not have its digest")
    return decoded.evidence


def decode_stored(key: CellKey, body: bytes) -> DecodedCell:
    """A cell or diff that was sound when it was stored.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    try:
        return decode_cell(body)
    except CairnError as exc:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(key)} at rest: {exc.message}") from exc


def sum_of_contributions(
    snapshot: Snapshot, key: CellKey, contributions: Iterable[Contribution], geometry: Geometry
) -> BrickCell:
    """What log entries did to a cell, all together.

    Raises:
        DamagedDataError: kind `damaged_store`: a diff is not sound, or not kept any more.
    """
    total = BrickCell(geometry)
    for contribution in contributions:
        body = snapshot.diff(contribution.diff)
        if body is None:
            raise DamagedDataError("damaged_store", f"a diff of cell {cell_of_key(key)} is not there")
        evidence = decode_stored(key, body).evidence
        if contribution.kind == ENTRY_FOLD:
            total.merge(evidence)
        else:
            total.unmerge(evidence)
    return total


def stored_stamps(stored: CellRow, geometry: Geometry) -> Stamps:
    """The stamps of a cell at rest; where they are damaged, more than was changed."""
    try:
        return decode_stamps(stored.stamps, depth=geometry.depth, lm=stored.lm)
    except DamagedDataError as exc:
        log.error("cell %s: %s; taking all of it for changed", cell_of_key(stored.key), exc.message)
        return decode_stamps(b"", depth=geometry.depth, lm=stored.lm)


def cell_to_change(snapshot: Snapshot, key: CellKey, geometry: Geometry) -> tuple[BrickCell, Stamps]:
    """A cell of the map, to be changed; a damaged one is summed up anew from all that the log says about it.

    Raises:
        DamagedDataError: kind `damaged_store`: it is damaged, and so is what it was made from.
    """
    stored = snapshot.cell(key)
    cell = BrickCell(geometry)
    if stored is None:
        return cell, no_stamps(geometry.depth)
    stamps = stored_stamps(stored, geometry)
    try:
        cell.merge(stored_evidence(stored))
    except DamagedDataError as exc:
        if stored.gone_seq:
            raise
        log.error("%s; making it anew from the log", exc.message)
        return sum_of_contributions(snapshot, key, snapshot.contributions(key, after_seq=0), geometry), stamps
    return cell, stamps
