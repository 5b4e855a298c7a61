"""What a cell needs to come from a state of its past to the present one: the smallest that says it (SYNC.md rule 4).

delta   sum of what others did since            while all their evidence is kept, and they are few
state   present sums of the blocks changed since    always; finding them takes no history
full    the whole cell                              always
"""

import logging

from cairn_map.blocks import Blocks, of_blocks
from cairn_map.cell_code import encode_cell
from cairn_map.cursor import ENTRY_FOLD, Cursor
from cairn_map.errors import DamagedDataError
from cairn_map.frames import CellFrame, FrameKind
from cairn_map.grid import Geometry, cell_of_key
from cairn_map.ids import Author
from cairn_server.cells_at_rest import sum_of_contributions
from cairn_server.read_cache import ReadCache
from cairn_server.stamps import blocks_after
from cairn_server.store import Snapshot
from cairn_server.store_rows import CellRow

log = logging.getLogger(__name__)

DELTA_ENTRIES_MAX = 32
"""A delta of more log entries than this is not tried: it would hardly be smaller than the changed blocks."""
STATE_SHARE_MAX = 0.8
"""Where more of a cell's blocks changed, the whole cell is sent as it lies there: it costs no time to encode."""
STATE_HOPE = 2.0
"""Changed blocks are encoded only if their share of the cell's bytes is no more than so many times the best so far."""
BLOCK_NUMBER_BYTES = 4


def change_since(
    snapshot: Snapshot,
    row: CellRow,
    start: Cursor,
    geometry: Geometry,
    cache: ReadCache,
    *,
    asker: Author | None,
    kinds: frozenset[str],
) -> CellFrame | None:
    """A `delta` or `state` frame, if one is smaller than the whole cell.

    Args:
        snapshot: the state to come to.
        row: the cell, changed after `start`.
        start: a proven cursor.
        geometry: of the map.
        cache: of decoded cells.
        asker: whose own commits a delta leaves out.
        kinds: frames that the asker can use.
    """
    delta = _delta(snapshot, row, start, asker, geometry) if "delta" in kinds else None
    smallest = row.size_bytes if delta is None else min(len(delta), row.size_bytes)
    state = _state(snapshot, row, start, geometry, cache, size_bytes_max=smallest) if "state" in kinds else None
    if state is None and (delta is None or len(delta) >= row.size_bytes):
        return None
    payload, blocks = state or (delta or b"", None)
    kind = FrameKind.DELTA if state is None else FrameKind.STATE
    return CellFrame(
        kind=kind,
        cell=row.key,
        from_cursor=start,
        to_cursor=snapshot.head.cursor,
        fingerprint=row.fingerprint,
        own_excluded=kind is FrameKind.DELTA and asker is not None,
        blocks=blocks,
        payload=payload,
    )


def _delta(snapshot: Snapshot, row: CellRow, start: Cursor, asker: Author | None, geometry: Geometry) -> bytes | None:
    """Sum of what others did to a cell since `start`; None if that cannot be said or is not worth it."""
    entries = snapshot.contributions(row.key, after_seq=start.seq, limit=DELTA_ENTRIES_MAX + 1)
    if start.seq < row.gone_seq or len(entries) > DELTA_ENTRIES_MAX:
        return None
    # What takes an own commit out again is not own: the asker must hear of it (SYNC.md rule 11).
    foreign = [entry for entry in entries if entry.kind != ENTRY_FOLD or entry.author != asker]
    if sum(entry.size_bytes for entry in foreign) > 4 * row.size_bytes:
        return None
    if len(foreign) == 1 and foreign[0].kind == ENTRY_FOLD:
        return snapshot.diff(foreign[0].diff)  # one commit's diff is its own sum
    try:
        evidence = sum_of_contributions(snapshot, row.key, foreign, geometry).packed()
    except DamagedDataError as exc:
        log.error("cell %s: a diff at rest is damaged, sending the whole cell: %s", cell_of_key(row.key), exc.message)
        return None
    return encode_cell(row.key, evidence, geometry).data if len(evidence) else b""


def _state(
    snapshot: Snapshot, row: CellRow, start: Cursor, geometry: Geometry, cache: ReadCache, *, size_bytes_max: int
) -> tuple[bytes, Blocks] | None:
    """The changed blocks' present sums, if they can be less than `size_bytes_max`, and the blocks."""
    try:
        evidence, stamps = cache.read(snapshot, row, geometry)
    except DamagedDataError as exc:
        log.error("cell %s: %s; no changed blocks of it", cell_of_key(row.key), exc.message)
        return None
    blocks, known = blocks_after(stamps, start.seq), int((stamps > 0).sum())
    if len(blocks) > STATE_SHARE_MAX * known or BLOCK_NUMBER_BYTES * len(blocks) >= size_bytes_max:
        return None
    if row.size_bytes * len(blocks) > STATE_HOPE * known * size_bytes_max:
        return None
    payload = encode_cell(row.key, of_blocks(evidence, blocks), geometry).data
    return (payload, blocks) if len(payload) + BLOCK_NUMBER_BYTES * len(blocks) < size_bytes_max else None
