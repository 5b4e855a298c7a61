"""What a cell needs to come from a state of its past to the present one: the smallest that says it (SYNC.md rule 4).

delta   sum of what others did since            while all their evidence is kept, and they are few
state   present sums of the blocks changed since    always; finding them takes no history
full    the whole cell                              always
"""

import logging

from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.cursor import ENTRY_FOLD, Cursor
from cairn_map.commits.ids import Author
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.blocks import of_blocks
from cairn_map.evidence.grid import Geometry, cell_of_key
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_server.folding.cells_at_rest import sum_of_contributions
from cairn_server.folding.read_cache import Change, ChangeName, ReadCache, state_of
from cairn_server.store.stamps import blocks_after
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow, Contribution

log = logging.getLogger(__name__)

DELTA_ENTRIES_MAX = 32
"""A delta of more log entries than this is not tried: it would hardly be smaller than the changed blocks."""
STATE_SHARE_MAX = 0.8
"""Where more of a cell's blocks changed, the whole cell is sent as it lies there: it costs no time to encode."""
STATE_HEAD_BYTES = 128
"""Changed blocks are encoded only if their share of the cell's bytes, and this, is no more than the best so far. They
take more: 1.13 to 1.7 times their share in scans of the simulated building, and hundreds of bytes if they are few."""
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
        cache: of cells, and of changes made for others.
        asker: whose own commits a delta leaves out.
        kinds: frames that the asker can use.
    """
    history = cache.history(snapshot, row, limit=DELTA_ENTRIES_MAX + 1)
    entries = [entry for entry in history if entry.seq > start.seq]
    # What takes an own commit out again is not own: the asker must hear of it (SYNC.md rule 11).
    foreign = [entry for entry in entries if entry.kind != ENTRY_FOLD or entry.author != asker]
    is_told = start.seq >= row.gone_seq and len(entries) <= DELTA_ENTRIES_MAX
    # Whoever stands before the same entry of the cell needs the same, and most of a team does.
    name = ChangeName(
        state=state_of(snapshot, row),
        after_seq=entries[0].seq - 1 if is_told and entries else start.seq,
        own=asker if len(foreign) < len(entries) else None,
        kinds=kinds,
    )
    summed = foreign if is_told and "delta" in kinds else None
    change = cache.changes.get(name, lambda: _smallest(snapshot, row, summed, name, geometry, cache))
    if change is None:
        return None
    return CellFrame(
        kind=change.kind,
        cell=row.key,
        from_cursor=start,
        to_cursor=snapshot.head.cursor,
        fingerprint=row.fingerprint,
        own_excluded=change.kind is FrameKind.DELTA and asker is not None,
        blocks=change.blocks,
        payload=change.payload,
    )


def _smallest(
    snapshot: Snapshot,
    row: CellRow,
    summed: list[Contribution] | None,
    name: ChangeName,
    geometry: Geometry,
    cache: ReadCache,
) -> Change | None:
    """The smaller one of both, if it is smaller than the whole cell."""
    delta = _delta(snapshot, row, summed, geometry) if summed is not None else None
    smallest = row.size_bytes if delta is None else min(len(delta), row.size_bytes)
    state = None
    if "state" in name.kinds:
        state = _state(snapshot, row, name.after_seq, geometry, cache, size_bytes_max=smallest)
    if state is not None:
        return state
    if delta is None or len(delta) >= row.size_bytes:
        return None
    return Change(FrameKind.DELTA, delta)


def _delta(snapshot: Snapshot, row: CellRow, foreign: list[Contribution], geometry: Geometry) -> bytes | None:
    """Sum of what others did to a cell; None if that is not worth it, or cannot be said after all."""
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
    snapshot: Snapshot, row: CellRow, after_seq: int, geometry: Geometry, cache: ReadCache, *, size_bytes_max: int
) -> Change | None:
    """The changed blocks' present sums, if they can be less than `size_bytes_max`."""
    try:
        stamps = cache.stamps(snapshot, row, geometry)
        blocks, known = blocks_after(stamps, after_seq), int((stamps > 0).sum())
        if len(blocks) > STATE_SHARE_MAX * known or BLOCK_NUMBER_BYTES * len(blocks) >= size_bytes_max:
            return None
        if STATE_HEAD_BYTES + row.size_bytes * len(blocks) / max(known, 1) > size_bytes_max:
            return None
        evidence = cache.evidence(snapshot, row)  # last, as it is dear
    except DamagedDataError as exc:
        log.error("cell %s: %s; no changed blocks of it", cell_of_key(row.key), exc.message)
        return None
    payload = encode_cell(row.key, of_blocks(evidence, blocks), geometry).data
    is_smaller = len(payload) + BLOCK_NUMBER_BYTES * len(blocks) < size_bytes_max
    return Change(FrameKind.STATE, payload, blocks) if is_smaller else None
