"""Maps and their robots: creation, registration, and what the server tells about them.

How far a branch is behind the head is counted in log entries and in bytes of others' commits. The log is read once for
all branches, and no further back than `LAG_ENTRIES_MAX`: a branch older than that is behind by a known number of
entries and an unknown number of bytes; it would fetch whole cells in any case.
"""

import logging
import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable
from itertools import accumulate

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import map_of_layer, robot_name
from cairn_map.errors import BadInputError
from cairn_map.wire.live_events import RobotSign
from cairn_map.wire.messages import BranchInfo, CreateMap, MapDeleted, MapInfo, MapSizes, Register, Registered
from cairn_server.access.auth import check_robot_name, new_token, token_hash
from cairn_server.cell_room import check_geometry
from cairn_server.live.hub import Hub
from cairn_server.live.live_map import LiveRobots
from cairn_server.live.robot_reports import RobotReports
from cairn_server.map_refusals import layer_of_map
from cairn_server.memory_shares import MemoryShares
from cairn_server.store.admission import OWN_WORD, Grounds
from cairn_server.store.store import Store
from cairn_server.store.store_rows import LOG_ENTRY_BYTES, Branch, EntrySize, MapRow
from cairn_server.sync.handing_over import server_key

log = logging.getLogger(__name__)

LAG_ENTRIES_MAX = 10_000


class Maps:
    """Maps of a store and the robots registered on them; called from many threads."""

    def __init__(
        self,
        store: Store,
        hub: Hub,
        reports: RobotReports,
        shares: MemoryShares,
        *,
        on_delete: Callable[[], None] = lambda: None,
    ) -> None:
        """`on_delete` is called when there are rows of a deleted map to be removed."""
        self._store = store
        self._on_delete = on_delete
        self._shares = shares
        self._hub = hub
        self._reports = reports

    def create(self, name: str, request: CreateMap) -> tuple[MapInfo, bool]:
        """Create a map unless an equal one exists; its facts, and whether it is new.

        Raises:
            BadInputError: kind `bad_name`; a layer is added to its map.
            BadInputError: kind `cell_too_large`: one full cell would take more memory than this server has for it.
            ConflictError: kind `map_exists`: another geometry, sensor model or length of epochs; `older_servers`.
        """
        if map_of_layer(name) is not None:
            raise BadInputError("bad_name", f"{name[:80]} would be a layer: add it to its map (cairn map layer add)")
        if all(row.name != name for row in self._store.maps()):
            check_geometry(request.geometry, self._shares)
        row, is_new = self._store.create_map(robot_name(name), request.geometry, request.sensor_model, request.epoch_s)
        return self.info(row), is_new

    def delete(self, row: MapRow, *, by: str) -> MapDeleted:
        """Delete a map and its layers for good: tokens end, listeners are sent away, rows go in the background.

        Raises:
            BadInputError: kind `layer_of_map`: a layer stays for as long as its map.
            NotFoundError: kind `gone`: it was deleted already.
        """
        if row.of_map is not None:
            raise layer_of_map(row.name, "it goes with the map; to leave it alone costs nothing")
        layers = self._store.layers(row)
        gone = self._store.delete_map(row, by=by)
        for each in (row, *layers):
            self._hub.map_gone(each)
        self._on_delete()
        return MapDeleted(name=gone.name, deleted_s=gone.deleted_s)

    def warn_of_large_cells(self) -> None:
        """Log each map that was made while this server had more memory for a cell."""
        for row in self._store.maps():
            try:
                check_geometry(row.geometry, self._shares)
            except BadInputError as exc:
                log.warning("map %s may take more memory than memory_bytes: %s", row.name, exc.message)

    def info(self, row: MapRow) -> MapInfo:
        """Extent, sizes and head of a map."""
        with self._store.snapshot(row) as snapshot:
            totals, head = snapshot.totals(), snapshot.head
        x_m, y_m, z_m = row.geometry.cell_edges_m
        box_m = None
        if totals.corner_cells:
            low, high = totals.corner_cells
            box_m = (
                (low[0] * x_m, low[1] * y_m, low[2] * z_m),
                ((high[0] + 1) * x_m, (high[1] + 1) * y_m, (high[2] + 1) * z_m),
            )
        return MapInfo(
            name=row.name,
            geometry=row.geometry,
            sensor_model=row.sensor_model,
            cursor=str(head),
            cells=totals.cells,
            size_bytes=totals.size_bytes,
            commits=totals.commits,
            branches=totals.branches,
            box_m=box_m,
            server_key=server_key(row).public_key.hex(),
            epoch_s=row.epoch_s,
            history_bytes=totals.history_bytes,
        )

    def sizes(self, row: MapRow) -> MapSizes:
        """Bytes of a map, by what they are for; nothing of the map is read through."""
        with self._store.snapshot(row) as snapshot:
            totals, entries = snapshot.totals(), snapshot.head.seq
        return MapSizes(
            present_bytes=totals.size_bytes - totals.history_bytes,
            history_bytes=totals.history_bytes,
            evidence_bytes=totals.evidence_bytes,
            log_bytes=LOG_ENTRY_BYTES * entries,
            log_entries=entries,
        )

    def register(self, row: MapRow, request: Register, grounds: Grounds = OWN_WORD) -> Registered:
        """Register a robot: its branch and a new token; registering again replaces the old token.

        Raises:
            BadInputError: kind `reserved_name`.
            DeniedError: kind `not_admitted`: the name is bound to another key.
        """
        check_robot_name(request.robot)
        token = new_token()
        branch = Branch(request.robot, request.mode, tuple(request.sensors), None, time.time(), request.incarnation)
        self._store.register(row, branch, token_hash(token), grounds)
        self._hub.robot_came(row, RobotSign(branch=branch.name, mode=branch.mode, time_s=branch.last_seen_s))
        return Registered(branch=request.robot, token=token, map=self.info(row))

    def deregister(self, row: MapRow, branch: str) -> None:
        """Remove a robot and its token; its evidence stays.

        Raises:
            NotFoundError: kind `no_branch`.
        """
        self._store.deregister(row, branch)
        self._reports.forget(row, branch)
        self._hub.robot_left(row, branch)

    def expel(self, row: MapRow, branch: str) -> None:
        """Remove a robot and its tokens from a map and all its layers; its evidence stays.

        Raises:
            NotFoundError: kind `no_branch`: it is on none of them.
        """
        found = [each for each in (row, *self._store.layers(row)) if self._store.branch(each, branch) is not None]
        for each in found or [row]:
            self.deregister(each, branch)

    def branches(self, row: MapRow) -> list[BranchInfo]:
        """All robots of a map by name, and how far each is behind the head."""
        return _branch_infos(self._store, row, self._hub.present_robots(row))


def _branch_infos(store: Store, row: MapRow, robots: LiveRobots) -> list[BranchInfo]:
    """All branches by name, each with its last sign of life."""
    with store.snapshot(row) as snapshot:
        head = snapshot.head
    branches = store.branches(row)
    starts = [cursor.seq for branch in branches if (cursor := _of_log(branch.cursor, head)) and cursor.seq < head.seq]
    after = max(min(starts, default=head.seq), head.seq - LAG_ENTRIES_MAX)
    lags = _Lags(store.notes.entry_sizes(row, after_seq=after, limit=LAG_ENTRIES_MAX) if starts else [], after)
    found = []
    for branch in branches:
        sign, cursor = robots.of(branch.name), _of_log(branch.cursor, head)
        found.append(
            BranchInfo(
                branch=branch.name,
                mode=branch.mode,
                sensors=list(branch.sensors),
                cursor=str(branch.cursor) if branch.cursor else None,
                behind=max(0, head.seq - cursor.seq) if cursor else None,
                behind_bytes=lags.of(branch, cursor) if cursor else None,
                incarnation=branch.incarnation,
                last_seen_s=max(branch.last_seen_s, sign.time_s if sign else 0.0),
                status=sign.status if sign else None,
                view_s=sign.view_s if sign else None,
            )
        )
    return found


class _Lags:
    """Bytes of the log entries after any cursor, from running sums over all entries and over each author's."""

    def __init__(self, entries: list[EntrySize], after: int) -> None:
        self._after = after
        self._all = _Sums(entries)
        by_author: defaultdict[tuple[str, str], list[EntrySize]] = defaultdict(list)
        for entry in entries:
            if entry.author is not None:
                by_author[entry.author].append(entry)
        self._own = {author: _Sums(own) for author, own in by_author.items()}

    def of(self, branch: Branch, cursor: Cursor) -> int | None:
        """Bytes of what others did after a branch's cursor; None if the cursor is older than the entries read."""
        if cursor.seq < self._after:
            return None
        own = self._own.get((branch.name, branch.incarnation))
        return self._all.after(cursor.seq) - (own.after(cursor.seq) if own else 0)


class _Sums:
    """Running sums of the sizes of log entries."""

    def __init__(self, entries: list[EntrySize]) -> None:
        self._seqs = [entry.seq for entry in entries]
        self._sums = [0, *accumulate(entry.size_bytes for entry in entries)]

    def after(self, seq: int) -> int:
        """Bytes of the entries after one."""
        return self._sums[-1] - self._sums[bisect_right(self._seqs, seq)]


def _of_log(cursor: Cursor | None, head: Cursor) -> Cursor | None:
    return cursor if cursor is not None and cursor.log_id == head.log_id else None
