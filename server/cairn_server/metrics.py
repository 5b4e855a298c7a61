"""Server metrics for Prometheus, under the names that dashboards know them by (PROTOCOL.md, `GET /metrics`).

Counters and histograms live in a registry of the service's own; what the store, the process and the upstream know is
looked up when the page is asked for. The page is the text format 0.0.4.
"""

import threading
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Generic, TypeVar

from prometheus_client import (
    CONTENT_TYPE_PLAIN_0_0_4,
    CollectorRegistry,
    Counter,
    Histogram,
    Metric,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics import MetricWrapperBase
from prometheus_client.registry import Collector

from cairn_map.wire.empty_cell_frames import EmptyCellFrames
from cairn_map.wire.frames import CellFrame, Frame
from cairn_server.processes import used_bytes
from cairn_server.store.store_rows import LOG_ENTRY_BYTES, Backlog, HeardRobot, StoreFigures, UsedPart

MEDIA_TYPE = CONTENT_TYPE_PLAIN_0_0_4
SERIES_MAX = 2000
"""Most combinations of label values of one metric; further ones are counted under the label values `other`."""
SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper ends of the buckets of a duration."""

M = TypeVar("M", bound=MetricWrapperBase)


class Bounded(Generic[M]):
    """Metric with labels whose number of series is bounded, because names in labels may come from clients."""

    def __init__(self, metric: M) -> None:
        self._metric = metric
        self._lock = threading.Lock()
        self._series: dict[tuple[str, ...], M] = {}

    def labels(self, *values: str) -> M:
        """Series of these label values, or of `other` once there are `SERIES_MAX`."""
        with self._lock:
            if values not in self._series:
                if len(self._series) >= SERIES_MAX:
                    values = ("other",) * len(values)
                self._series[values] = self._metric.labels(*values)
            return self._series[values]

    def first_values(self) -> set[str]:
        """Values of the first label so far."""
        with self._lock:
            return {values[0] for values in self._series}


class ServerFigures:
    """Counters and histograms of one service, shared by all its threads; about 2 us for each count."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        by_route = ("method", "route")
        self.requests = self._counter(
            "cairn_http_requests_total", "Requests answered, by route and status.", *by_route, "status"
        )
        self.request_seconds = self._histogram(
            "cairn_http_request_duration_seconds", "Time from a request's head to the end of its answer.", *by_route
        )
        self.received_bytes = self._counter("cairn_http_received_bytes_total", "Bytes of request bodies.", *by_route)
        self.sent_bytes = self._counter("cairn_http_sent_bytes_total", "Bytes of answers' bodies.", *by_route)
        self.errors = self._counter("cairn_errors_total", "Problems answered, by their kind.", "kind")
        self.pushes = self._counter(
            "cairn_pushes_total",
            "Pushes by outcome: new, known, or the kind of the problem (then without a map).",
            "map",
            "outcome",
        )
        self.push_bytes = self._counter("cairn_push_bytes_total", "Bytes of commits that were new.", "map")
        self.robot_commits = self._counter(
            "cairn_robot_commits_total", "Commits of a robot that were new.", "map", "robot"
        )
        self.robot_bytes = self._counter(
            "cairn_robot_commit_bytes_total", "Bytes of commits of a robot that were new.", "map", "robot"
        )
        self.robot_refusals = self._counter(
            "cairn_robot_refusals_total",
            "Requests of a robot that were refused, without those that only read, by the kind of the problem.",
            "map",
            "robot",
            "kind",
        )
        self.frames = self._counter("cairn_fetch_frames_total", "Cell frames made for fetches, by kind.", "kind")
        self.frame_bytes = self._counter("cairn_fetch_frame_bytes_total", "Bytes of cell frames, by kind.", "kind")
        self.fold_seconds = self._histogram(
            "cairn_fold_duration_seconds", "Time of one fold of a group of commits.", "map"
        )
        self.folded = self._counter("cairn_folded_commits_total", "Commits folded into cells.", "map")
        self.clock_jumps = self._counter(
            "cairn_clock_jumps_total", "Jumps of the machine's time of day by over a minute.", "direction"
        )
        self.fold_failures = self._counter("cairn_fold_failures_total", "Folds that failed and are tried again.", "map")

        self.settled_bytes = self._counter(
            "cairn_settled_bytes_total", "Bytes at rest that were moved to the object store.", "what"
        )
        self.objects_deleted = Counter(
            "cairn_objects_deleted_total", "Objects out of use that were deleted.", registry=self.registry
        )
        self.settle_failures = self._counter(
            "cairn_settle_failures_total", "Duties of settling that failed and are tried again, by duty.", "what"
        )

    def _counter(self, name: str, help_text: str, *labels: str) -> Bounded[Counter]:
        return Bounded(Counter(name, help_text, labels, registry=self.registry))

    def _histogram(self, name: str, help_text: str, *labels: str) -> Bounded[Histogram]:
        return Bounded(Histogram(name, help_text, labels, registry=self.registry, buckets=SECONDS))

    def maps_at_work(self) -> set[str]:
        """Names of the maps to which this server took commits, or of which it folded some, since its start."""
        return (self.pushes.first_values() | self.folded.first_values()) - {"", "other"}

    def counted(self, frames: Iterator[Frame | EmptyCellFrames]) -> Iterator[Frame | EmptyCellFrames]:
        """The same frames, counted by kind."""
        for frame in frames:
            if isinstance(frame, CellFrame | EmptyCellFrames):
                kind = frame.kind.name.lower()
                self.frames.labels(kind).inc(frame.count)
                self.frame_bytes.labels(kind).inc(frame.size_bytes)
            yield frame


@dataclass(frozen=True, slots=True)
class _Page(Collector):
    """Metrics of one page, without the times of creation that the library adds as series of their own."""

    metrics: Iterable[Metric]

    def collect(self) -> Iterator[Metric]:
        for metric in self.metrics:
            metric.samples = [sample for sample in metric.samples if not sample.name.endswith("_created")]
            yield metric


def metrics_text(metrics: Iterable[Metric]) -> str:
    """Page of these metrics, in their order."""
    return generate_latest(_Page(metrics)).decode()


def store_metrics(found: StoreFigures, backlogs: list[Backlog], at_work: Collection[str]) -> Iterator[Metric]:
    """Sizes, writes and backlogs of the store; of maps at work also that nothing waits."""
    yield GaugeMetricFamily("cairn_store_size_bytes", "Size of the store at rest.", found.size_bytes)
    cells = GaugeMetricFamily("cairn_cells_size_bytes", "Size of the cells of all maps, by part.", labels=["part"])
    cells.add_metric(["present"], found.cells_bytes - found.history_bytes)
    cells.add_metric(["history"], found.history_bytes)
    yield cells
    evidence = "Size of the commits of all maps whose evidence is kept."
    yield GaugeMetricFamily("cairn_evidence_size_bytes", evidence, found.evidence_bytes)
    log_bytes = LOG_ENTRY_BYTES * found.log_entries
    yield GaugeMetricFamily("cairn_log_size_bytes", "Size of the logs of all maps, about.", log_bytes)
    yield GaugeMetricFamily("cairn_store_unused_bytes", "Part of the store that nothing uses.", found.unused_bytes)
    yield GaugeMetricFamily("cairn_wal_size_bytes", "Size of what the store wrote ahead.", found.ahead_bytes)
    if found.free_bytes is not None:
        yield GaugeMetricFamily("cairn_disk_free_bytes", "Free space on the store's disk.", found.free_bytes)
    yield GaugeMetricFamily("cairn_writer_queue_length", "Jobs that wait to be written.", found.queued)
    yield CounterMetricFamily("cairn_writer_transactions_total", "Transactions made durable.", found.written)
    yield CounterMetricFamily(
        "cairn_wal_truncations_total", "Times that the write-ahead log was emptied.", found.emptied
    )
    failures = CounterMetricFamily(
        "cairn_writer_failures_total", "Transactions that were not written, by kind of error.", labels=["kind"]
    )
    for kind, count in (dict.fromkeys(("disk_full", "store_failed"), 0) | found.failures).items():
        failures.add_metric([kind], count)
    yield failures
    idle = dict.fromkeys(sorted(at_work), 0.0)
    waiting = idle | {b.map: float(b.commits) for b in backlogs}
    ages_s = idle | {b.map: b.waited_s for b in backlogs}
    yield _gauge_by_map("cairn_pending_commits", "Commits that are durable but not folded.", waiting)
    yield _gauge_by_map("cairn_pending_oldest_age_seconds", "Age of the oldest of them; 0 without any.", ages_s)


def upstream_metrics(ages_s: Mapping[str, float], ups: Mapping[str, bool]) -> Iterator[Metric]:
    """Hand-over of each map to the upstream server: its age, and its last outcome."""
    text = "Since all of a map was handed to the upstream server, or since the start."
    yield _gauge_by_map("cairn_upstream_age_seconds", text, ages_s)
    text = "1 if the last round with the upstream server went well: with a map, and without one with the server."
    yield _gauge_by_map("cairn_upstream_up", text, {name: float(is_up) for name, is_up in ups.items()})


def robot_metrics(heard: Iterable[HeardRobot], *, now_s: float) -> Iterator[Metric]:
    """Time since the last sign of each registered robot."""
    gauge = GaugeMetricFamily(
        "cairn_robot_silence_seconds", "Since the last sign of a registered robot.", labels=["map", "robot"]
    )
    for each in heard:
        gauge.add_metric([each.map, each.robot], max(0.0, now_s - each.heard_s))
    yield gauge


def safekeeping_metrics(backup_age_s: float | None, certificate_left_s: float | None) -> Iterator[Metric]:
    """Age of the last backup and rest of the certificate, which an administrator sees to; None: there is none.

    A store without a backup has one that is infinitely old, so that an alarm on its age holds.
    """
    backup = GaugeMetricFamily("cairn_backup_age_seconds", "Since the last `cairn serve backup`; +Inf without any.")
    if backup_age_s is not None:
        backup.add_metric([], backup_age_s)
    yield backup
    certificate = GaugeMetricFamily(
        "cairn_certificate_expiry_seconds", "Until the server's certificate ends; below 0 once it has."
    )
    if certificate_left_s is not None:
        certificate.add_metric([], certificate_left_s)
    yield certificate


def _gauge_by_map(name: str, help_text: str, values: Mapping[str, float]) -> GaugeMetricFamily:
    """Gauge with one value for each map."""
    gauge = GaugeMetricFamily(name, help_text, labels=["map"])
    for map_name, value in values.items():
        gauge.add_metric([map_name], value)
    return gauge


def share_metrics(used: Iterable[UsedPart]) -> Iterator[Metric]:
    """Parts above a half of what robots may use of each map's bounds, fullest first; the reserve has no robot."""
    gauge = GaugeMetricFamily(
        "cairn_share_used_ratio",
        "Used part of a robot's share of a map's bound, from a half on.",
        labels=["map", "robot", "bound"],
    )
    for each in sorted(used, key=lambda each: each.part, reverse=True)[:SERIES_MAX]:
        gauge.add_metric([each.map, each.robot, each.bound], each.part)
    yield gauge


def ready_metrics(is_ready: bool) -> Iterator[Metric]:
    """Answer of `/readyz`, for those who ask for figures alone."""
    yield GaugeMetricFamily("cairn_ready", "1 if a push would be taken and brought into the map, else 0.", is_ready)


def memory_metrics(limit_bytes: int) -> Iterator[Metric]:
    """Memory of all processes of the server, and its limit."""
    yield GaugeMetricFamily("cairn_memory_limit_bytes", "Memory that all processes may take together.", limit_bytes)
    yield GaugeMetricFamily("cairn_memory_bytes", "Memory that all processes take together.", used_bytes())


def clock_metrics(doubt_s: float) -> Iterator[Metric]:
    """Doubt of the store's clock."""
    yield GaugeMetricFamily(
        "cairn_clock_doubt_seconds", "Since the store's time of day is not trusted; 0 while it is.", doubt_s
    )


RELEASED_S = 1_795_478_400.0
"""Date of this program, UTC seconds since 1970 (2026-11-24): a clock that stands before it is wrong. Never before
the day of the newest release in CHANGELOG.md, which a test compares, and never ahead of today."""


PROCESS = ProcessCollector(registry=None)
"""The library's own figures of this process, read from /proc; none where that is missing."""


def program_version() -> str:
    """Version of cairn, `unknown` where it runs from its sources."""
    try:
        return version("cairn-robotics")
    except PackageNotFoundError:
        return "unknown"


def process_metrics() -> Iterator[Metric]:
    """Version, and the processor time, memory, start and open files of this process, as all exporters name them."""
    build = GaugeMetricFamily("cairn_build_info", "Always 1; the version is the label.", labels=["version"])
    build.add_metric([program_version()], 1)
    yield build
    yield from PROCESS.collect()
