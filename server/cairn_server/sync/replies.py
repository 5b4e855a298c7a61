"""Answers about the state of main: replies to fetch-missing, the cell index, the version vector at a cursor."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author
from cairn_map.commits.version_vector import VersionVector
from cairn_map.errors import ConflictError, NotFoundError
from cairn_map.wire.messages import CellIndex
from cairn_map.wire.resumed_replies import reply_digest, without_begun
from cairn_server.folding.cell_index import FIRST_PAGE, IndexPage, entries_of
from cairn_server.folding.cells import CellFaults, Cells
from cairn_server.folding.read_cache import ReadCache
from cairn_server.live.hub import Hub
from cairn_server.metrics import ServerFigures
from cairn_server.store.history import is_proven
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.asked_cells import Asked
from cairn_server.sync.held_commits import WantedCommits
from cairn_server.sync.missing import CellFrames, HeaderFacts, header_of, proven_since, query_of, reply_frames
from cairn_server.sync.reply_parts import MissingReply, ReplyParts
from cairn_server.sync.slices import SLICES_OF_DATABASE, SLICES_OF_FILE, Slices


class StableVectors:
    """Commits that no restore can lose any more, of all maps: those folded longer ago than a setting."""

    def __init__(self, age: StoreAge, after_s: float) -> None:
        """Args: age: of the store. after_s: age since its folding at which a commit is stable."""
        self._age = age
        self._after_s = after_s

    def of(self, snapshot: Snapshot) -> VersionVector:
        """Stable vector of the map in this snapshot."""
        # Of this log alone: ids that a restore took away would end the only copies of their commits.
        return snapshot.vector_at(snapshot.seq_before(self._age.now_s() - self._after_s))


class MainReplies:
    """Answers about main, for all maps of a store; each from one snapshot; called from many threads."""

    def __init__(
        self,
        store: Store,
        cells: Cells,
        hub: Hub,
        wanted: WantedCommits,
        figures: ServerFigures,
        *,
        stable: StableVectors,
        cache_share: float = 1.0,
    ) -> None:
        self._store = store
        self._cells = cells
        self._hub = hub
        self._wanted = wanted
        self._figures = figures
        self._stable = stable
        self._cache = ReadCache(share=cache_share)
        self._slices = Slices(SLICES_OF_FILE if store.replicas is None else SLICES_OF_DATABASE)

    def missing(self, row: MapRow, branch: str, asked: Asked) -> MissingReply:
        """Frames that bring the asker to the head: the first part, and the others as they are read.

        Empty if the asker says that it knows this very reply.
        """
        reading = partial(self._reading, row)
        # Each part is read before it is sent: a slow link must not keep a snapshot open, which holds up the emptying of
        # the store's log.
        with self._slices.turn(), reading() as (snapshot, faults):
            query = query_of(asked, snapshot)
            cells = CellFrames(snapshot, query, row.layer, self._cache, faults)
            frames = without_begun(reply_frames(cells, self._facts(row, snapshot)), asked.request.begun)
            parts = ReplyParts(cells, self._figures.counted(frames), self._slices)
            first = parts.read()
        # For the list of branches and their expiry: what the server sends never depends on it.
        self._store.seen(row, branch, query.cursor)
        if query.cursor is None:
            self._hub.robot_heard(row, branch)
        else:
            self._hub.robot_heard(row, branch, cursor=str(query.cursor))
        if not parts.is_whole:
            return MissingReply(first, parts.others(reading))
        # The digest is of the whole reply: this saves the link's bytes, not the work.
        known = asked.request.known
        return MissingReply(b"" if known is not None and known == reply_digest(first) else first, None)

    @contextmanager
    def _reading(self, row: MapRow) -> Iterator[tuple[Snapshot, CellFaults]]:
        with self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            yield snapshot, faults

    def cell_index(
        self, row: MapRow, author: Author | None, page: IndexPage = FIRST_PAGE, *, since: str | None = None
    ) -> CellIndex:
        """One page of the cells that were ever touched, and the state that it was read from.

        The header's vector is whole, or begins after the cursor `since` if that is proven.
        """
        # Both from one state: an entry that changed after it is in a later page's.
        with self._store.snapshot(row) as snapshot:
            header = header_of(snapshot, author, self._facts(row, snapshot), since=proven_since(since, snapshot))
            return CellIndex(header=header, cells=entries_of(snapshot, page))

    def vector_at(self, row: MapRow, cursor: Cursor) -> VersionVector:
        """Version vector at a cursor.

        Raises:
            ConflictError: kind `other_log`: the cursor is another server's.
            NotFoundError: kind `no_cursor`: it is not proven by the log.
        """
        with self._store.snapshot(row) as snapshot:
            if cursor.log_id != snapshot.head.log_id:
                raise ConflictError("other_log", "the cursor belongs to another server's log; start without one")
            # By its chain: the asker has a cell of exactly this state.
            if not is_proven(cursor, snapshot):
                raise NotFoundError("no_cursor", "the log has no such cursor; ask for the cell again")
            return snapshot.vector_at(cursor.seq)

    def _facts(self, row: MapRow, snapshot: Snapshot) -> HeaderFacts:
        return HeaderFacts(self._stable.of(snapshot), self._cells.damaged(row), self._wanted.of(row.name))
