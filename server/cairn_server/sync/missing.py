"""Fetch-missing: main minus branch, as frames (SYNC.md rules 3 to 10).

The server keeps nothing about a branch but its row: the request says which state the asker holds, the chain
proves it, and `lm` of each cell says whether it changed since. Per cell the smallest kind of frame wins.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import Author, CommitId, author_from_text
from cairn_map.commits.version_vector import VersionVector
from cairn_map.errors import BadInputError, ConflictError
from cairn_map.evidence.cell_order import first_to_last
from cairn_map.evidence.evidence import empty_evidence
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CELL_LIMIT, Cell, CellKey, Geometry, cell_key, cell_of_key
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_map.wire.frames import CELL_HEAD, CellFrame, Frame, FrameKind
from cairn_map.wire.messages import CURSORS_MAX, Done, MissingRequest, More, ReplyHeader
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.folding.damaged_cells import as_named
from cairn_server.folding.read_cache import ReadCache
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow
from cairn_server.sync.cell_changes import change_since

log = logging.getLogger(__name__)

REPLY_BYTES_MAX = 64 << 20
"""A longer reply ends with `more`, and the asker comes back for the rest."""


@dataclass(frozen=True, slots=True)
class Besides:
    """What a header says beside a snapshot's own state."""

    stable: VersionVector
    damaged: frozenset[CellKey] = frozenset()
    wanted: tuple[CommitId, ...] = ()


@dataclass(slots=True)
class Asker:
    """What a request says the asker holds, with every cursor proven or not."""

    author: Author | None
    cursor: Cursor | None
    cells: dict[CellKey, Cursor | None]
    kinds: frozenset[str]
    compare: bool
    box: tuple[Cell, Cell] | None = None
    size_bytes_max: int = REPLY_BYTES_MAX
    near: Cell | None = None
    unproven: set[Cursor] = field(default_factory=set)
    healed: list[CellRow] = field(default_factory=list)
    """Damaged cells that were made anew for it."""
    damaged: set[CellKey] = field(default_factory=set)
    """Cells that could not be."""

    def wants(self, key: CellKey) -> bool:
        """Whether a cell lies in the box that is asked for."""
        if self.box is None:
            return True
        low, high = self.box
        return all(a <= b <= c for a, b, c in zip(low, cell_of_key(key), high, strict=True))


def asker_from_request(request: MissingRequest, snapshot: Snapshot) -> Asker:
    """The asker, its cursors parsed and checked against the log.

    Raises:
        ConflictError: kind `other_log`: a cursor belongs to another server's log; drop it (HTTP 410).
        BadInputError: a malformed id, cursor or cell.
    """
    asker = Asker(
        author=author_from_text(request.author) if request.author else None,
        cursor=_cursor(request.cursor),
        cells=_listed(request),
        kinds=frozenset(request.kinds),
        box=(Cell(*request.box[0]), Cell(*request.box[1])) if request.box else None,
        size_bytes_max=min(request.size_bytes_max or REPLY_BYTES_MAX, REPLY_BYTES_MAX),
        near=cell_of_key(cell_key(request.near)) if request.near else None,
        compare=request.compare,
    )
    head = snapshot.head.cursor
    for cursor in {cursor for cursor in (asker.cursor, *asker.cells.values()) if cursor is not None}:
        if cursor.log_id != head.log_id:
            raise ConflictError("other_log", "the cursor belongs to another server's log; start without one")
        if not _is_proven(cursor, snapshot):
            asker.unproven.add(cursor)
    return asker


def reply_frames(
    snapshot: Snapshot,
    asker: Asker,
    geometry: Geometry,
    cache: ReadCache,
    besides: Besides,
) -> Iterator[Frame]:
    """Header, frames of the cells that the asker misses, and the end; all from one snapshot."""
    head = snapshot.head
    yield header_of(snapshot, asker.author, besides)
    rest = ZERO
    sent_bytes = 0
    listed = dict(asker.cells)
    for row in in_order([row for row in snapshot.cells() if asker.wants(row.key)], asker.near):
        start = listed.pop(row.key, asker.cursor)
        frame = _frame_for(snapshot, asker, row, start, geometry, cache)
        if frame is None:
            rest += row.fingerprint
            continue
        sent_bytes += CELL_HEAD.size + len(frame.payload)
        yield frame
        if sent_bytes > asker.size_bytes_max:
            yield More(to=str(head.cursor))
            return
    for key, start in ((key, start) for key, start in listed.items() if asker.wants(key)):
        unknown = _unknown_cell(key, asker, start, head.cursor, geometry)
        if unknown is not None:
            yield unknown
    yield Done(to=str(head.cursor), rest=rest.hex())


def header_of(snapshot: Snapshot, author: Author | None, besides: Besides) -> ReplyHeader:
    """The state of a snapshot, as the author of some of its commits needs to know it."""
    head = snapshot.head
    tip = snapshot.tip(author) if author else None
    # Not checked once more: of hundreds of authors that takes longer than all else in a reply.
    return ReplyHeader.model_construct(
        to=str(head.cursor),
        vector=head.vector.to_json(),
        stable=besides.stable.to_json(),
        pending=snapshot.pending().to_json(),
        tip=(tip[0], tip[1].hex()) if tip else None,
        retracts=[str(commit) for commit in snapshot.retracting() if commit not in besides.stable],
        damaged=as_named(snapshot, besides.damaged),
        wanted=[str(commit) for commit in besides.wanted],
    )


def _frame_for(
    snapshot: Snapshot, asker: Asker, row: CellRow, start: Cursor | None, geometry: Geometry, cache: ReadCache
) -> CellFrame | None:
    if asker.compare or start in asker.unproven:
        return _frame(FrameKind.RESET, row.key, start, snapshot.head.cursor, row.fingerprint)
    if start is not None and row.lm <= start.seq:
        return None
    if start is not None:
        change = change_since(snapshot, row, start, geometry, cache, asker=asker.author, kinds=asker.kinds)
        if change is not None:
            return change
    body = _body(snapshot, row.key, geometry, asker)
    return _frame(FrameKind.FULL, row.key, start, snapshot.head.cursor, row.fingerprint, body)


def _body(snapshot: Snapshot, key: CellKey, geometry: Geometry, asker: Asker) -> bytes:
    """A cell's bytes; none if they are damaged for good, which its asker reports, while all other cells come."""
    try:
        stored = sound_cell(snapshot, key, geometry, asker.healed)
    except DamagedCellError as exc:
        asker.damaged.add(key)
        log.error("cell %s is sent without its bytes: %s", cell_of_key(key), exc.message)
        return b""
    return stored.body if stored else b""


def _unknown_cell(key: CellKey, asker: Asker, start: Cursor | None, to: Cursor, geometry: Geometry) -> CellFrame | None:
    """A cell that the asker names and the server never had: as good as empty."""
    if asker.compare or start in asker.unproven:
        return _frame(FrameKind.RESET, key, start, to, ZERO)
    if start is None:
        return _frame(FrameKind.FULL, key, None, to, ZERO, encode_cell(key, empty_evidence(geometry), geometry).data)
    return None


def _frame(
    kind: FrameKind, key: CellKey, start: Cursor | None, to: Cursor, fingerprint: Fingerprint, payload: bytes = b""
) -> CellFrame:
    return CellFrame(kind=kind, cell=key, from_cursor=start, to_cursor=to, fingerprint=fingerprint, payload=payload)


def _listed(request: MissingRequest) -> dict[CellKey, Cursor | None]:
    """The cells that a request lists, one by one or by cursor."""
    groups = [*request.groups, *((entry.cursor, [entry.cell]) for entry in request.cells)]
    count = sum(len(cells) for _, cells in groups)
    if count > CURSORS_MAX:
        raise BadInputError("bad_message", f"{count} cells are listed, at most {CURSORS_MAX} may be")
    listed: dict[CellKey, Cursor | None] = {}
    for text, cells in groups:
        listed |= dict.fromkeys(map(cell_key, cells), _cursor(text))
    if len(listed) != count:
        raise BadInputError("bad_message", "a cell is named twice in the request")
    return listed


def _cursor(text: str | None) -> Cursor | None:
    return cursor_from_text(text) if text is not None else None


def _is_proven(cursor: Cursor, snapshot: Snapshot) -> bool:
    head = snapshot.head.cursor
    return cursor.seq <= head.seq and snapshot.chain_at(cursor.seq) == cursor.chain


def in_order(rows: Sequence[CellRow], near: Cell | None) -> list[CellRow]:
    """The cells around a cell first, and hot ones before others (`cell_order`)."""
    order = first_to_last(
        deinterleave(np.fromiter((row.key for row in rows), np.uint64, len(rows))) - CELL_LIMIT,
        near=near,
        changed=np.fromiter((row.lm for row in rows), np.int64, len(rows)),
        hottest_k=np.array([row.hottest_k for row in rows], np.float64),
    )
    return [rows[n] for n in order]
