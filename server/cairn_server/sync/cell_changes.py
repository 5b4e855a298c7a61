"""Smallest frame that brings a cell from a past state to the present one (SYNC.md rule 4).

delta   sum of what others did since                while all their evidence is kept, and their commits are few
state   present sums of the blocks changed since    always; finding them takes no history
full    the whole cell                              always
"""

import logging

from cairn_map.codec.layer_code import encode_layer_cell, row_file
from cairn_map.commits.cursor import ENTRY_FOLD, Cursor
from cairn_map.commits.ids import Author
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import cell_of_key
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_server.cell_room import DECODING, changed_bytes, decoded_bytes
from cairn_server.folding.cells_at_rest import sum_of_contributions
from cairn_server.folding.read_cache import Change, ChangeName, ReadCache, state_of
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.stamps import blocks_after
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow, Contribution

log = logging.getLogger(__name__)

DELTA_ENTRIES_MAX = 32
"""Most log entries summed to a delta: one of more would hardly be smaller than the changed blocks."""
STATE_SHARE_MAX = 0.8
"""Share of changed blocks above which the whole cell is sent: its stored bytes need no encoding."""
STATE_HEAD_BYTES = 128
"""Least overhead of a state frame: changed blocks are encoded only if their share of the cell's bytes plus this is no
more than the best frame so far. They take more than their share: 1.13 to 1.7 times it in scans of the simulated
building, and hundreds of bytes more if they are few."""
BLOCK_NUMBER_BYTES = 4


def change_since(
    snapshot: Snapshot,
    row: CellRow,
    start: Cursor,
    layer: MapLayer,
    cache: ReadCache,
    *,
    asker: Author | None,
    kinds: frozenset[str],
) -> CellFrame | None:
    """A `delta` or `state` frame, if one is smaller than the whole cell.

    Args:
        snapshot: the state to come to.
        row: the cell, changed after `start`.
        start: the asker's state of the cell; a proven cursor.
        layer: of the map.
        cache: of cells, and of changes made for other askers.
        asker: author whose own commits a delta leaves out.
        kinds: frames that the asker can use.
    """
    # What happened to the cell since, as far as a delta could use it; one entry more shows that there are too many.
    history = cache.history(snapshot, row, limit=DELTA_ENTRIES_MAX + 1)
    entries = [entry for entry in history if entry.seq > start.seq]
    # What takes an own commit out again is not own: the asker must hear of it (SYNC.md rule 11).
    foreign = [entry for entry in entries if entry.kind != ENTRY_FOLD or entry.author != asker]
    is_told = start.seq >= row.gone_seq and len(entries) <= DELTA_ENTRIES_MAX
    # Key of the change: all askers before the same entry of the cell need the same frame, and most of a team do.
    name = ChangeName(
        state=state_of(snapshot, row),
        after_seq=entries[0].seq - 1 if is_told and entries else start.seq,
        own=asker if len(foreign) < len(entries) else None,
        kinds=kinds,
    )
    # Made once for all of them.
    summed = foreign if is_told and "delta" in kinds else None
    change = cache.changes.get(name, lambda: _smallest(snapshot, row, summed, name, layer, cache))
    if change is None:
        return None
    return CellFrame(
        kind=change.kind,
        cell=row.key,
        from_cursor=start,
        to_cursor=snapshot.head,
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
    layer: MapLayer,
    cache: ReadCache,
) -> Change | None:
    """Smaller one of the delta and the state, if it is smaller than the whole cell."""
    delta = _delta(snapshot, row, summed, layer, cache) if summed is not None else None
    smallest = row.size_bytes if delta is None else min(len(delta), row.size_bytes)
    state = None
    # The blocks that one commit touched have all of its voxels and others: their present sums are hardly ever smaller,
    # and cost a decoded cell.
    is_own_sum = delta is not None and summed is not None and len(summed) == 1 and len(delta) < row.size_bytes
    if "state" in name.kinds and not is_own_sum:
        state = _state(snapshot, row, name.after_seq, layer, cache, size_bytes_max=smallest)
    if state is not None:
        return state
    if delta is None or len(delta) >= row.size_bytes:
        return None
    return Change(FrameKind.DELTA, delta)


def _delta(
    snapshot: Snapshot, row: CellRow, foreign: list[Contribution], layer: MapLayer, cache: ReadCache
) -> bytes | None:
    """Encoded sum by epoch of what others did to a cell; None: it would be too large, or a diff is damaged or away."""
    # Diffs that together have four times the cell's bytes hardly sum up to less than the cell.
    if sum(entry.size_bytes for entry in foreign) > 4 * row.size_bytes:
        return None
    if len(foreign) == 1 and foreign[0].kind == ENTRY_FOLD:
        try:
            diff = snapshot.diff(foreign[0].commit, row.key)  # its own sum
            return row_file(diff, foreign[0].epoch, row.key, layer) if diff else None  # empty: its segment is lost
        except AwayError:
            return None
    # Of several commits: decoded and added up, one cell at a time in the room that all requests share.
    size_bytes = changed_bytes(layer.geometry, row.voxels, rows=len({entry.epoch for entry in foreign}))
    if size_bytes > DECODING.limit_bytes:
        return None
    try:
        with DECODING.of(size_bytes):
            history = sum_of_contributions(snapshot, row.key, foreign, layer, diff_of=cache.diff).history()
            return encode_layer_cell(row.key, history, layer).data if len(history) else b""
    except AwayError:
        return None
    except DamagedDataError as exc:
        log.error("cell %s: a diff at rest is damaged, sending the whole cell: %s", cell_of_key(row.key), exc.message)
        return None


def _state(
    snapshot: Snapshot, row: CellRow, after_seq: int, layer: MapLayer, cache: ReadCache, *, size_bytes_max: int
) -> Change | None:
    """Frame of the changed blocks' present rows, if it can have less than `size_bytes_max` and the cell is here."""
    try:
        # Estimate from the stamps alone whether it can be small enough, before the cell is decoded.
        stamps = cache.stamps(snapshot, row, layer.geometry)
        blocks, known = blocks_after(stamps, after_seq), int((stamps > 0).sum())
        if len(blocks) > STATE_SHARE_MAX * known or BLOCK_NUMBER_BYTES * len(blocks) >= size_bytes_max:
            return None
        if STATE_HEAD_BYTES + row.size_bytes * len(blocks) / max(known, 1) > size_bytes_max:
            return None
        if decoded_bytes(layer.geometry, row.voxels) > DECODING.limit_bytes:
            return None
        # Last, since it is expensive. All take room before they ask the cache: its maker has it, too.
        with DECODING.of_cell(layer.geometry, row.voxels):
            changed = cache.evidence(snapshot, row, layer).of_blocks(blocks)
    except AwayError:
        return None
    except DamagedDataError as exc:
        log.error("cell %s: %s; no changed blocks of it", cell_of_key(row.key), exc.message)
        return None
    payload = encode_layer_cell(row.key, changed, layer).data
    is_smaller = len(payload) + BLOCK_NUMBER_BYTES * len(blocks) < size_bytes_max
    return Change(FrameKind.STATE, payload, blocks) if is_smaller else None
