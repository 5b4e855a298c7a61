"""Fetch-missing: main minus branch, as frames (SYNC.md rules 3 to 10).

    request  -->  MissingQuery    parsed, each cursor proven by the log or not
    query    -->  reply_frames    header, a frame for each cell that the asker misses, end

The server keeps nothing about a branch but its row: the request says which state the asker holds, the chain of the log
proves it, and `lm` of each cell says whether it changed since. For each cell the smallest kind of frame is sent.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import numpy.typing as npt

from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import OPERATOR, Author, CommitId, author_from_text
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import ConflictError
from cairn_map.evidence.cell_order import first_to_last
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CELL_LIMIT, Cell, CellKey, cell_key, cell_of_key
from cairn_map.kernels.morton_kernels import UInts, deinterleave
from cairn_map.wire.empty_cell_frames import EmptyCellFrames
from cairn_map.wire.frames import CellFrame, Frame, FrameKind
from cairn_map.wire.messages import Done, More, ReplyHeader
from cairn_server.access.cancellation import CANCELLATION
from cairn_server.folding.cells import CellFaults
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.folding.damaged_cells import as_named
from cairn_server.folding.read_cache import ReadCache
from cairn_server.store.history import folded_ids, is_proven
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow
from cairn_server.store.tiles import is_in_box
from cairn_server.sync.asked_cells import Asked, ListedCells, listed_cells
from cairn_server.sync.cell_changes import change_since

log = logging.getLogger(__name__)

REPLY_BYTES_MAX = 64 << 20
"""A longer reply ends with `more`, and the asker comes back for the rest."""
RETRACTS_MAX = 1024
"""Most retracts that a header lists, for robots that do not find them in its vectors: 64 kB."""
PENDING_AUTHORS_MAX = 256
"""Most authors whose pending commits are named to an asker without an author, who only sees that something is."""
SINCE_ENTRIES_MAX = 4096
"""Most log entries that are read to name the commits since a state; an asker farther behind gets the whole vector."""
EMPTY_CELLS_MAX = 4096
"""Cells that a reply sends as empty since the server never had them; then it ends with `more`, too."""


@dataclass(frozen=True, slots=True)
class HeaderFacts:
    """Facts of a reply's header that are not part of the snapshot."""

    stable: VersionVector
    """Commits that no restore can lose any more."""
    damaged: frozenset[CellKey] = frozenset()
    """Cells that robots are asked for."""
    wanted: tuple[CommitId, ...] = ()
    """Commits that robots are asked to push again."""


@dataclass(frozen=True, slots=True)
class Since:
    """State after which a header's vector begins."""

    text: str
    """As the request states it."""
    cursor: Cursor


@dataclass(frozen=True, slots=True, kw_only=True)
class MissingQuery:
    """Parsed request: what the asker holds, proven by the log or not, and what it wants."""

    author: Author | None
    cursor: Cursor | None
    """State of every cell that is not listed; None: the asker holds none of them."""
    listed: ListedCells
    """Cells that the request lists, each with its own state."""
    unproven: frozenset[Cursor]
    """Cursors of the request that this log does not prove."""
    kinds: frozenset[str]
    """Kinds of frames that the asker can use."""
    compare: bool
    """True if the asker wants a fingerprint of each cell only."""
    box: tuple[Cell, Cell] | None
    size_bytes_max: int
    near: Cell | None
    since: Since | None = None
    """State whose vector the asker has, proven by the log."""

    def wants(self, keys: UInts) -> npt.NDArray[np.bool_]:
        """True for each of these cells that lies in the box asked for, shape (len(keys),)."""
        return np.ones(len(keys), np.bool_) if self.box is None else is_in_box(keys, self.box)

    def is_reset(self, start: Cursor | None) -> bool:
        """True if a cell of this state is answered by its fingerprint: the asker finds out what it has to drop."""
        return self.compare or start in self.unproven


def query_of(asked: Asked, snapshot: Snapshot) -> MissingQuery:
    """Parse a request, and check its cursors against the log.

    Raises:
        ConflictError: kind `other_log`: a cursor belongs to another server's log; drop it (HTTP 410).
        BadInputError: a malformed id, cursor or cell.
    """
    # Each cursor once, however many cells name it: proving one reads the log.
    request, cursor = asked.request, _cursor(asked.request.cursor)
    cursors = tuple(_cursor(text) for text in asked.cursors)
    head = snapshot.head
    unproven: set[Cursor] = set()
    cancellation = CANCELLATION.get()
    for stated in {stated for stated in (cursor, *cursors) if stated is not None}:
        cancellation.check()
        if stated.log_id != head.log_id:
            raise ConflictError("other_log", "the cursor belongs to another server's log; start without one")
        if not is_proven(stated, snapshot):
            unproven.add(stated)
    # A reply is made in memory, so the asker may lower the server's bound on its bytes, and not raise it.
    return MissingQuery(
        author=author_from_text(request.author) if request.author else None,
        cursor=cursor,
        listed=listed_cells(asked, cursors),
        unproven=frozenset(unproven),
        kinds=frozenset(request.kinds),
        compare=request.compare,
        box=(Cell(*request.box[0]), Cell(*request.box[1])) if request.box else None,
        size_bytes_max=min(request.size_bytes_max or REPLY_BYTES_MAX, REPLY_BYTES_MAX),
        near=cell_of_key(cell_key(request.near)) if request.near else None,
        since=proven_since(request.since, snapshot, default=cursor),
    )


def proven_since(text: str | None, snapshot: Snapshot, *, default: Cursor | None = None) -> Since | None:
    """State after which a header's vector begins; None: it is whole, for no such state is stated, or it is no good."""
    cursor = default if text == "cursor" else _cursor(text)
    if text is None or cursor is None or cursor.log_id != snapshot.head.log_id:
        return None
    is_near = snapshot.head.seq - cursor.seq <= SINCE_ENTRIES_MAX
    return Since(text, cursor) if is_near and is_proven(cursor, snapshot) else None


def header_of(
    snapshot: Snapshot, author: Author | None, facts: HeaderFacts, *, since: Since | None = None
) -> ReplyHeader:
    """State of a snapshot, as the author of some of its commits needs to know it.

    With `since` the vector names only the commits folded after that state, which the snapshot's log proves.

    The vector alone speaks of all authors: what is stable or pending matters only of commits that the asker may hold,
    its robot's own and the operator's. So no number of commits of other robots makes the rest of a header grow.
    """
    # Rule 3: the vector is whole, for all ids; the tip shows an author that its disk was rolled back (rule 13).
    head, whole = snapshot.head, snapshot.vector_at(snapshot.head.seq)
    vector = whole
    if since is not None:
        vector = EMPTY.with_commits(folded_ids(snapshot, after_seq=since.cursor.seq, to_seq=head.seq))
    tip = snapshot.tip(author) if author else None
    held = (OPERATOR, author.robot) if author else (OPERATOR,)
    stable, pending = facts.stable.of_robots(held), snapshot.pending()
    pending = pending.of_robots(held) if author else _first_authors(pending)
    # Not validated again: with hundreds of authors that takes longer than the rest of a reply.
    return ReplyHeader.model_construct(
        to=str(head),
        vector=vector.to_json(),
        since=since.text if since is not None else None,
        stable=stable.to_json(),
        pending=pending.to_json(),
        tip=(tip[0], tip[1].hex()) if tip else None,
        retracts=_newest_retracts(whole, stable),
        damaged=as_named(snapshot, facts.damaged),
        wanted=[str(commit) for commit in facts.wanted],
    )


@dataclass(slots=True)
class CellFrames:
    """Frames of single cells for one asker, all from one state."""

    snapshot: Snapshot
    query: MissingQuery
    layer: MapLayer
    cache: ReadCache
    faults: CellFaults
    """Cells met on the way that are damaged, or away; filled here."""

    def read_from(self, snapshot: Snapshot, faults: CellFaults) -> None:
        """Read from another snapshot of the same state from here on."""
        self.snapshot, self.faults = snapshot, faults

    def frame_of(self, row: CellRow, start: Cursor | None) -> CellFrame | None:
        """Smallest frame that brings a cell from the asker's state `start` to this one; None: it has that state."""
        # Compare only, or a state that this log does not prove: a fingerprint.
        if self.query.is_reset(start):
            return self._frame(FrameKind.RESET, row.key, start, row.fingerprint)
        # The asker's state of the cell is the present one.
        if start is not None and row.lm <= start.seq:
            return None
        try:
            return self._bytes_of(row, start)
        except AwayError as exc:
            if not self.faults.away:  # once a reply: thousands may be away
                name = cell_of_key(row.key)
                log.warning("cell %s is sent without its bytes, and others may be: %s", name, exc.message)
            self.faults.away += 1
            return self._frame(FrameKind.FULL, row.key, start, row.fingerprint)

    def _bytes_of(self, row: CellRow, start: Cursor | None) -> CellFrame:
        """Smallest frame with bytes.

        Raises:
            AwayError: they are in the object store, which does not answer.
        """
        # Delta or changed blocks, where one is smaller than the whole cell.
        if start is not None:
            query = self.query
            change = change_since(
                self.snapshot, row, start, self.layer, self.cache, asker=query.author, kinds=query.kinds
            )
            if change is not None:
                return change
        # Whole, as it is stored: a first fetch, or no smaller frame.
        return self._frame(FrameKind.FULL, row.key, start, row.fingerprint, self._body(row.key))

    def frames_of_unknown(self, keys: UInts, start: Cursor | None) -> EmptyCellFrames | None:
        """Frames of cells that the asker lists at one state and the server never had: they are as good as empty."""
        if self.query.is_reset(start):
            kind = FrameKind.RESET
        # Asked for with nothing held: without an answer it is asked for again.
        elif start is None:
            kind = FrameKind.FULL
        # At a proven state it is empty already.
        else:
            return None
        to = self.snapshot.head
        return EmptyCellFrames(kind=kind, cells=keys, from_cursor=start, to_cursor=to, layer=self.layer)

    def _body(self, key: CellKey) -> bytes:
        """A cell's bytes; empty if they are lost, which the asker reports while it gets all other cells."""
        try:
            stored = sound_cell(self.snapshot, key, self.layer, self.faults.healed)
        except DamagedCellError as exc:
            self.faults.damaged.add(key)
            log.error("cell %s is sent without its bytes: %s", cell_of_key(key), exc.message)
            return b""
        return stored.body if stored else b""

    def _frame(
        self, kind: FrameKind, key: CellKey, start: Cursor | None, fingerprint: Fingerprint, payload: bytes = b""
    ) -> CellFrame:
        to = self.snapshot.head
        return CellFrame(kind=kind, cell=key, from_cursor=start, to_cursor=to, fingerprint=fingerprint, payload=payload)


def reply_frames(cells: CellFrames, facts: HeaderFacts) -> Iterator[Frame | EmptyCellFrames]:
    """Header, frames of the cells that the asker misses, and the end of a reply."""
    snapshot, query, listed = cells.snapshot, cells.query, cells.query.listed
    to = str(snapshot.head)
    # All from one state (rule 3): what is folded meanwhile is wholly in the next reply.
    yield header_of(snapshot, query.author, facts, since=query.since)
    # Every cell of main: a frame, or its fingerprint in `rest`, so that the asker can check the whole map.
    rest = snapshot.fingerprint_sum(query.box)
    sent_bytes = 0
    cancellation = CANCELLATION.get()
    rows = in_order(_candidates(snapshot, query), query.near)
    places = listed.places(_keys_of(rows))
    for row, place in zip(rows, places.tolist(), strict=True):
        cancellation.check()
        start = listed.cursor(place) if place >= 0 else query.cursor
        # All was taken out of it again: who holds nothing, and does not ask for it by name, has the same.
        if place < 0 and start is None and not row.voxels and row.fingerprint == ZERO:
            continue
        frame = cells.frame_of(row, start)
        if frame is None:
            continue
        rest -= row.fingerprint
        # At least one frame in each reply, so that every reply brings the asker on.
        sent_bytes += frame.size_bytes
        yield frame
        if sent_bytes > query.size_bytes_max:
            yield More(to=to)
            return
    # What is left of the list is not in main.
    is_unknown = query.wants(listed.keys)
    is_unknown[places[places >= 0]] = False
    is_whole = True
    for start, keys in listed.by_cursor(is_unknown):
        cancellation.check()
        unknown = cells.frames_of_unknown(keys, start)
        if unknown is None:
            continue
        # Fingerprints alone are cheap, and must all come: the asker takes them as the answer to all that it listed.
        if unknown.kind is FrameKind.FULL and unknown.count > EMPTY_CELLS_MAX:
            unknown, is_whole = replace(unknown, cells=keys[:EMPTY_CELLS_MAX]), False
        yield unknown
    yield Done(to=to, rest=rest.hex()) if is_whole else More(to=to)


def _keys_of(rows: Sequence[CellRow]) -> UInts:
    return np.fromiter((row.key for row in rows), np.uint64, len(rows))


def _candidates(snapshot: Snapshot, query: MissingQuery) -> list[CellRow]:
    """Cells of main that may get a frame: all others stand at the asker's state."""
    # Cells at no proven state get one each.
    if query.cursor is None or query.is_reset(query.cursor):
        return list(snapshot.cells(box=query.box))
    listed = query.listed.keys[query.wants(query.listed.keys)]
    # A list longer than the map: reading through the map is less than asking for each.
    if len(listed) and len(listed) > snapshot.totals().cells:
        return list(snapshot.cells(box=query.box))
    # What changed since the state of the cells that are not listed, and the listed ones, whatever their state.
    changed = {row.key: row for row in snapshot.cells(after_seq=query.cursor.seq, box=query.box)}
    more = snapshot.cells_of([key for key in map(CellKey, listed.tolist()) if key not in changed])
    return [*changed.values(), *more]


def _newest_retracts(vector: VersionVector, stable: VersionVector) -> list[str]:
    """The operator's commits that a restore could lose, those of each incarnation from the newest on."""
    spans = vector.of_robots((OPERATOR,)).minus(stable).intervals
    newest = (
        str(CommitId(author, n))
        for author, each in spans.items()
        for first, last in reversed(each)
        for n in range(last, first - 1, -1)
    )
    return list(islice(newest, RETRACTS_MAX))


def _first_authors(vector: VersionVector) -> VersionVector:
    if len(vector.intervals) <= PENDING_AUTHORS_MAX:
        return vector
    return VersionVector(dict(islice(vector.intervals.items(), PENDING_AUTHORS_MAX)))


def _cursor(text: str | None) -> Cursor | None:
    return cursor_from_text(text) if text is not None else None


def in_order(rows: Sequence[CellRow], near: Cell | None) -> list[CellRow]:
    """Cells in the order of a reply: near the asker first, hot ones before others (`cell_order.first_to_last`).

    Any order is right, since each frame stands alone.
    """
    order = first_to_last(
        deinterleave(_keys_of(rows)) - CELL_LIMIT,
        near=near,
        changed=np.fromiter((row.lm for row in rows), np.int64, len(rows)),
        hottest_k=np.array([row.hottest_k for row in rows], np.float64),
    )
    return [rows[n] for n in order]
