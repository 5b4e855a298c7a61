"""What the server does, without HTTP: create, register, push, fetch-missing, retract, read.

Acknowledge only what is durable and fully validated; fold afterwards, in groups. One object for all requests,
called from many threads.
"""

import threading
import time
from itertools import chain

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import INITIAL, OPERATOR, Author, RobotName, new_incarnation, robot_name
from cairn_map.commits.version_vector import VersionVector
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.frames import encode_frame, start_of_reply
from cairn_map.wire.live_events import RobotSign
from cairn_map.wire.messages import (
    BranchInfo,
    CellIndex,
    CreateMap,
    MapInfo,
    MissingRequest,
    Register,
    Registered,
    Retract,
    Retracted,
)
from cairn_map.wire.resumed_replies import reply_digest, without_begun
from cairn_server.access.auth import Caller, new_token, token_hash
from cairn_server.folding.cell_index import FIRST_PAGE, IndexPage, entries_of
from cairn_server.folding.cells import Cells
from cairn_server.folding.damaged_cells import DamagedCells, heal_cell, keep_healed
from cairn_server.folding.fold_process import FoldProcess
from cairn_server.folding.fold_thread import FoldThread
from cairn_server.folding.read_cache import ReadCache
from cairn_server.folding.readiness import FoldHealth, Readiness
from cairn_server.live.branch_list import branch_infos
from cairn_server.live.hub import Hub
from cairn_server.live.robot_reports import RobotReports
from cairn_server.metrics import ServerFigures, metrics_text, process_metrics, store_metrics, upstream_metrics
from cairn_server.settings import Settings
from cairn_server.store.numbering import EvidenceGoneError
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import Branch, MapRow
from cairn_server.sync.checks.check_process import CheckProcess
from cairn_server.sync.handing_over import Joining, server_key
from cairn_server.sync.held_commits import HeldCommits, WantedCommits
from cairn_server.sync.missing import Besides, asker_from_request, header_of, reply_frames
from cairn_server.sync.pushes import Pushes
from cairn_server.sync.replies import StableVectors, vector_at
from cairn_server.sync.retracting import retract_builders, targets_of
from cairn_server.sync.uploads import Uploads
from cairn_server.views.export_tickets import ExportTickets
from cairn_server.views.map_exports import MapExports
from cairn_server.views.map_views import MapViews
from cairn_server.views.view_cache import ViewCache

RESERVED_NAMES = frozenset({OPERATOR, INITIAL, RobotName("main")})


class Service:
    """The map server's operations on one store."""

    def __init__(
        self,
        store: Store,
        settings: Settings,
        *,
        fold_process: FoldProcess | None = None,
        check_process: CheckProcess | None = None,
    ) -> None:
        """Use the processes given; without them the same is done here."""
        self.store = store
        self.settings = settings
        self.figures = ServerFigures()
        self.damaged = DamagedCells()
        self.folds = FoldHealth(self.figures)
        self.live = Hub(store)
        self.reports = RobotReports(store, self.live)
        self.joining = Joining(is_joined=settings.upstream is not None)
        self.cells = Cells(store, self.damaged)
        self._folder = FoldThread(
            store,
            self.folds,
            self.damaged,
            keep_evidence_s=settings.keep_evidence_s,
            on_fold=self.live.folded,
            may_forget_s=self.joining.may_forget_s,
            process=fold_process,
        )
        self.readiness = Readiness(store.health, self.folds, settings, self._folder.is_alive)
        self._wanted = WantedCommits()
        self.held = HeldCommits(store, self._wanted.of)
        self.pushes = Pushes(store, settings, self.live, self._wanted, on_new=self._came, process=check_process)
        self.uploads = Uploads(store, self.pushes)
        self._stable = StableVectors(settings.stable_after_s)
        self._reads = ReadCache()
        self.views = MapViews(store, self.damaged)
        self.exports = MapExports(store, self.damaged)
        self.tickets = ExportTickets(store, settings, self.exports)
        self.cell_views = ViewCache()
        self._healing = threading.Lock()
        self.operator = new_incarnation()
        """Of the retracts made here. A new one with every start: a restored server must not number over lost ones."""

    def create_map(self, name: str, request: CreateMap) -> tuple[MapInfo, bool]:
        """The map, and whether it is new."""
        row, is_new = self.store.create_map(robot_name(name), request.geometry, request.sensor_model)
        return self.map_info(row), is_new

    def map_info(self, row: MapRow) -> MapInfo:
        """A map's extent, sizes and head."""
        with self.store.snapshot(row) as snapshot:
            totals, head = snapshot.totals(), snapshot.head
        edge_m = row.geometry.cell_edge_m
        box_m = None
        if totals.corner_cells:
            low, high = totals.corner_cells
            box_m = (
                (low[0] * edge_m, low[1] * edge_m, low[2] * edge_m),
                ((high[0] + 1) * edge_m, (high[1] + 1) * edge_m, (high[2] + 1) * edge_m),
            )
        return MapInfo(
            name=row.name,
            geometry=row.geometry,
            sensor_model=row.sensor_model,
            cursor=str(head.cursor),
            cells=totals.cells,
            size_bytes=totals.size_bytes,
            commits=totals.commits,
            branches=totals.branches,
            box_m=box_m,
            server_key=server_key(row).public_key.hex(),
        )

    def register(self, row: MapRow, request: Register) -> Registered:
        """A new token for a robot; registering again replaces the old one.

        Raises:
            BadInputError: kind `reserved_name`.
        """
        if request.robot in RESERVED_NAMES:
            raise BadInputError(
                "reserved_name", f"{request.robot} is not a robot's name; reserved are operator, initial, main"
            )
        token = new_token()
        branch = Branch(request.robot, request.mode, tuple(request.sensors), None, time.time(), request.incarnation)
        self.store.register(row, branch, token_hash(token))
        self.live.robot_came(row, RobotSign(branch=branch.name, mode=branch.mode, time_s=branch.last_seen_s))
        return Registered(branch=request.robot, token=token, map=self.map_info(row))

    def push(self, row: MapRow, caller: Caller, id_text: str, data: bytes, **beside: str | None) -> bool:
        """`Pushes.keep`."""
        return self.pushes.keep(row, caller, id_text, data, **beside)

    def missing(self, row: MapRow, branch: str, request: MissingRequest) -> bytes:
        """The frames that bring the asker to the head; one snapshot, wholly in memory before it is sent.

        Nothing, if the asker knows this reply.
        """
        with self.store.snapshot(row) as snapshot:
            asker = asker_from_request(request, snapshot)
            parts = [start_of_reply()]
            frames = reply_frames(snapshot, asker, row.geometry, self._reads, self._besides(row, snapshot))
            parts += [encode_frame(f) for f in self.figures.counted(without_begun(frames, request.begun))]
        keep_healed(self.store, row, asker.healed)
        self.damaged.note(row.name, asker.damaged)
        self.store.seen(row, branch, asker.cursor)
        self.live.robot_heard(row, branch, **({"cursor": str(asker.cursor)} if asker.cursor else {}))
        reply = b"".join(parts)
        return b"" if request.known is not None and request.known == reply_digest(reply) else reply

    def retract(self, row: MapRow, request: Retract, *, by: Caller) -> Retracted:
        """Undo commits exactly. Durable on return.

        More targets than one commit can name become several; the last one's id is answered.

        Raises:
            NotFoundError: kind `nothing_to_retract`: none is named, or none fits.
            BadInputError: kind `not_retractable`: a retract is not retracted.
            ConflictError: kind `evidence_gone`: robots that have a commit's bytes must push them again first, and are
                asked to from now on.
        """
        with self.store.snapshot(row) as snapshot:
            targets = targets_of(request, snapshot)
        names = [str(target) for target in targets]
        if request.preview:
            return Retracted(id=None, commits=names)
        author = Author(OPERATOR, self.operator)
        builders = retract_builders(row, author, targets, request.note)
        try:
            ids = [str(self.store.append_built(row, author, build).id) for build in builders]
        except EvidenceGoneError as exc:
            self._wanted.note(row.name, exc.commits)
            raise
        detail = f"map {row.name}: {ids[-1]} takes out {len(names)} commits: {request.note}"
        self.store.audit_log.add(by.name, "retract", detail)
        self._came()
        return Retracted(id=ids[-1], commits=names)

    def cell_index(self, row: MapRow, author: Author | None, page: IndexPage = FIRST_PAGE) -> CellIndex:
        """Some of the cells that were ever touched, and the state that they were read from."""
        with self.store.snapshot(row) as snapshot:
            header = header_of(snapshot, author, self._besides(row, snapshot))
            return CellIndex(header=header, cells=entries_of(snapshot, page))

    def heal_cell(self, row: MapRow, key: CellKey, data: bytes, *, by: Caller) -> bool:
        """Put a damaged cell right with bytes that somebody still has; False if it is sound."""
        with self._healing:
            is_healed = heal_cell(self.store, row, key, data, by=by.name)
        self.damaged.forget(row.name, key)
        self._folder.wake()
        return is_healed

    def vector_at(self, row: MapRow, cursor: Cursor) -> VersionVector:
        """The ids folded at or before a cursor of late."""
        with self.store.snapshot(row) as snapshot:
            return vector_at(snapshot, cursor)

    def branches(self, row: MapRow) -> list[BranchInfo]:
        """All robots, and how far behind each is."""
        return branch_infos(self.store, row, self.live.robots(row))

    def deregister(self, row: MapRow, branch: str) -> None:
        """Remove a robot and its token; its evidence stays.

        Raises:
            NotFoundError: kind `no_branch`.
        """
        self.store.deregister(row, branch)
        self.reports.forget(row, branch)
        self.live.robot_left(row, branch)

    def _came(self) -> None:
        self._folder.wake()
        self.joining.wake()

    def _besides(self, row: MapRow, snapshot: Snapshot) -> Besides:
        return Besides(self._stable.of(row, snapshot), self.damaged.of(row.name), self._wanted.of(row.name))

    def metrics_text(self) -> str:
        """All figures for Prometheus."""
        store = store_metrics(self.store.health.figures(), self.store.health.backlogs())
        upstream = upstream_metrics(self.joining.ages_s())
        return metrics_text(chain(self.figures.registry.collect(), store, upstream, process_metrics()))

    def stop_streams(self) -> None:
        """Count as not ready and end live streams, which never end alone; requests are still answered."""
        self.readiness.close()
        self.live.close()

    def close(self) -> None:
        """Stop folding and close the store; what was acknowledged is folded after the next start."""
        self.stop_streams()
        self.pushes.close()
        self.tickets.close()
        self._folder.close()
        self.reports.close()
        self.store.close()
