"""The map server without HTTP: its parts over one store, wired together.

    folding   cells, readiness; the thread that folds
    live      listeners, robots' reports
    maps      creation, registration, facts of maps and branches
    sync      pushes, uploads, retracts, replies to fetch-missing, holdings for relays
    views     cells in all forms, pictures, exports

Only what is durable and fully validated is acknowledged; folding comes afterwards, in groups. Each part is called from
many threads.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

from cairn_map.errors import UnreachableError
from cairn_server.access.auth import TokenHolders
from cairn_server.access.cancellation import StopTime
from cairn_server.access.rate_limits import ActLimit
from cairn_server.access.server_certificate import ServerCertificate, certificate_of
from cairn_server.access.wrong_tokens import WrongTokens
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import Cells
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.fold_process import FoldProcess
from cairn_server.folding.fold_thread import FoldThread
from cairn_server.folding.readiness import FoldHealth, Readiness
from cairn_server.live.fold_news import FoldNews
from cairn_server.live.hub import Hub
from cairn_server.live.replica_watch import ReplicaWatch
from cairn_server.live.robot_reports import RobotReports
from cairn_server.live.site import Site
from cairn_server.maps import Maps
from cairn_server.metrics import (
    SERIES_MAX,
    ServerFigures,
    clock_metrics,
    memory_metrics,
    metrics_text,
    process_metrics,
    ready_metrics,
    robot_metrics,
    safekeeping_metrics,
    share_metrics,
    store_metrics,
    upstream_metrics,
)
from cairn_server.settings import Settings
from cairn_server.store.backup_note import backup_age_s
from cairn_server.store.row_spool import remove_spools
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, UsedPart
from cairn_server.sync.admissions import Admissions
from cairn_server.sync.attachment_transfer import AttachmentTransfer
from cairn_server.sync.clock_trust import ClockTrust
from cairn_server.sync.handing_over import UpstreamProgress
from cairn_server.sync.held_commits import HeldCommits, WantedCommits
from cairn_server.sync.map_layers import MapLayers
from cairn_server.sync.marking import Marking
from cairn_server.sync.operator_commits import OperatorCommits
from cairn_server.sync.pushes import Pushes
from cairn_server.sync.replies import MainReplies, StableVectors
from cairn_server.sync.retracting import Retracts
from cairn_server.sync.uploads import Uploads
from cairn_server.views.cell_views import CellViews
from cairn_server.views.export_tickets import ExportTickets
from cairn_server.views.hot_spot_search import HotSpotSearch
from cairn_server.views.hottest_search import HottestSearch
from cairn_server.views.map_changes import MapChangesSearch
from cairn_server.views.map_exports import MapExports
from cairn_server.views.map_views import MapViews
from cairn_server.views.retract_preview import RetractPreviews
from cairn_server.views.value_spread import ValueSpread

KEEP_FULL_AUTHORS_S = 300.0
"""Time for which the list of filling shares of authors is kept, however often the metrics are asked for."""
WORK_GRACE_S = 4.0
"""Time after the signal to stop for which requests that compute for long go on."""


@dataclass(frozen=True, slots=True)
class SyncParts:
    """Parts of the sync protocol."""

    admissions: Admissions
    pushes: Pushes
    uploads: Uploads
    retracts: Retracts
    marking: Marking
    layers: MapLayers
    attachments: AttachmentTransfer
    replies: MainReplies
    held: HeldCommits
    upstream: UpstreamProgress


@dataclass(frozen=True, slots=True)
class ViewParts:
    """Parts that show a map."""

    cells: CellViews
    pictures: MapViews
    exports: MapExports
    tickets: ExportTickets
    changes: MapChangesSearch
    hottest: HottestSearch
    hot_spots: HotSpotSearch
    spread: ValueSpread
    retracts: RetractPreviews


class Service:
    """Parts of a map server on one store, made and ended together."""

    def __init__(
        self,
        store: Store,
        settings: Settings,
        *,
        certificate: ServerCertificate | None = None,
        fold_process: FoldProcess | None = None,
        warming: Callable[[], str | None] = lambda: None,
    ) -> None:
        """Start the parts; without `fold_process` a thread folds, if the service is to fold at all.

        It is not ready until `warming` is None: what the start still waits for. `certificate` was read before.
        """
        self.store = store
        self.settings = settings
        self.certificate = certificate or certificate_of(settings)
        self.holders = TokenHolders(store, settings)
        self.figures = ServerFigures()
        self._full_authors_now: list[UsedPart] = []
        self._full_authors_until_s = -math.inf
        self.stop_time = StopTime()
        shared_uses = store.replicas.uses if store.replicas is not None else None
        self.acts = ActLimit(settings.quotas.acts_per_hour, shared=shared_uses)
        self.wrong_tokens = WrongTokens(store)
        self.live = Hub(store, connections=settings.limit_concurrency)
        self.reports = RobotReports(store, self.live)
        self.fold_news = FoldNews()
        self._fold_thread: FoldThread | None = None
        self.clock = ClockTrust(store)
        answers = settings.folding != "only"
        self.site = Site(store, answers=answers, is_folding=self._folds, clock_complaint=self.clock.complaint)
        self.watch: ReplicaWatch | None = None
        if store.replicas is not None:
            self.watch = ReplicaWatch(
                store,
                store.replicas,
                self.live,
                self.reports,
                self.fold_news,
                self.site,
                look_at_clock=self.clock.look,
            )
        self.maps = Maps(store, self.live, self.reports, settings.memory, on_delete=self._clear_deleted)
        self.maps.warn_of_large_cells()
        DECODING.limit_bytes = settings.memory.decoding_bytes
        remove_spools(settings.folder)
        upstream = UpstreamProgress(store.age, settings.upstream, store.replicas)
        damaged, folds = DamagedCells(), FoldHealth(self.figures)
        if settings.folding != "elsewhere":
            self._fold_thread = FoldThread(
                store,
                folds,
                damaged,
                keep_evidence_s=settings.keep_evidence_s,
                on_fold=self._folded,
                may_forget_s=upstream.may_forget_s,
                process=fold_process,
                memory=FoldMemory.of_server(settings.memory, settings.folder, is_all=settings.folding == "only"),
            )
        self.readiness = Readiness(store.health, folds, settings, self._is_folding, warming)
        self.cells = Cells(store, damaged, on_heal=self._wake_folding)

        self.sync = self._sync_parts(upstream)
        self.views = self._view_parts()

    def _sync_parts(self, upstream: UpstreamProgress) -> SyncParts:
        store, settings, wanted = self.store, self.settings, WantedCommits()

        def on_new() -> None:
            self._wake_folding()
            upstream.wake()

        admissions, commits = Admissions(store, settings.quotas), OperatorCommits(store)
        pushes = Pushes(store, settings, self.live, wanted, admissions, self.clock, on_new=on_new)
        return SyncParts(
            admissions,
            pushes,
            Uploads(store, pushes),
            Retracts(store, commits, wanted, on_new=on_new),
            Marking(store, commits, on_new=on_new),
            MapLayers(store, commits, settings.memory, info=self.maps.info, on_new=on_new),
            AttachmentTransfer(store.attachments),
            MainReplies(
                store,
                self.cells,
                self.live,
                wanted,
                self.figures,
                stable=StableVectors(store.age, settings.stable_after_s),
                cache_share=settings.memory.cache_share,
            ),
            HeldCommits(store, wanted),
            upstream,
        )

    def _view_parts(self) -> ViewParts:
        exports, changes = MapExports(self.store, self.cells), MapChangesSearch(self.store, self.cells)
        return ViewParts(
            CellViews(self.store, self.cells),
            MapViews(self.store, self.cells, cache_share=self.settings.memory.cache_share),
            exports,
            ExportTickets(self.store, self.holders, exports),
            changes,
            HottestSearch(self.store, self.cells),
            HotSpotSearch(self.store, self.cells, cache_share=self.settings.memory.cache_share),
            ValueSpread(self.store, self.cells),
            RetractPreviews(self.store, self.cells, turn=changes.turn),
        )

    def _folded(self, row: MapRow) -> None:
        """Tell of a fold by this server."""
        self.site.folded()
        self.fold_news.note(row.number)
        self.live.folded(row)

    def _wake_folding(self) -> None:
        if self._fold_thread is not None:
            self._fold_thread.wake()

    def _clear_deleted(self) -> None:
        """Begin to remove the rows of a map that was deleted."""
        if self._fold_thread is not None:
            self._fold_thread.upkeep.hurry()
            self._fold_thread.wake()

    def _folds(self) -> bool:
        """True while this server folds."""
        return self._fold_thread is not None and self._fold_thread.is_alive()

    def _is_folding(self) -> bool:
        """True unless what came is to be folded here, and cannot."""
        return self._fold_thread is None or self._fold_thread.is_alive()

    def _full_authors(self) -> list[UsedPart]:
        """Shares of authors that are filling, as they were some minutes ago: reading them reads all authors."""
        if time.monotonic() >= self._full_authors_until_s:
            self._full_authors_now = self.store.shares.full_authors()
            self._full_authors_until_s = time.monotonic() + KEEP_FULL_AUTHORS_S
        return self._full_authors_now

    def metrics_text(self) -> str:
        """All metrics for Prometheus."""
        health = self.store.health
        store = store_metrics(health.figures(), health.backlogs(), self.figures.maps_at_work())
        now_s, names = time.time(), [row.name for row in self.store.maps()[:SERIES_MAX]]
        upstream = upstream_metrics(self.sync.upstream.ages_s(names), self.sync.upstream.ups(names))
        robots = robot_metrics(self.store.notes.heard(limit=SERIES_MAX), now_s=now_s)
        # A database is copied by its own tools, which leave no note here.
        backup_s = backup_age_s(self.settings.folder, now_s=now_s) if self.settings.store is None else None
        kept = safekeeping_metrics(backup_s, self.certificate.ends_s - now_s if self.certificate is not None else None)
        shares = share_metrics([*self.store.shares.full_sums(), *self._full_authors()])
        memory = memory_metrics(self.settings.memory.limit_bytes)
        clock = clock_metrics(self.clock.doubt_s())
        counted = self.figures.registry.collect()
        ready = ready_metrics(self._is_ready())
        return metrics_text(
            chain(counted, ready, store, shares, upstream, robots, kept, memory, clock, process_metrics())
        )

    def _is_ready(self) -> bool:
        try:
            self.readiness.check()
        except UnreachableError:
            return False
        return True

    def stop_streams(self) -> None:
        """Count as not ready and end live streams, which never end alone; requests are still answered for a while."""
        self.stop_time.set(WORK_GRACE_S)
        self.readiness.close()
        self.live.close()

    def close(self) -> None:
        """Stop folding and close the store; what was acknowledged is folded after the next start."""
        self.stop_streams()
        self.sync.pushes.close()
        self.views.tickets.close()
        if self._fold_thread is not None:
            self._fold_thread.close()
        if self.watch is not None:
            self.watch.close()
        self.site.leave()
        self.reports.close()
        self.store.close()
