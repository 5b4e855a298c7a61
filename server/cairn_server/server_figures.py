"""What the server counts, under the names that dashboards know it by (PROTOCOL.md, `GET /metrics`)."""

import os
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cairn_map.wire.frames import CELL_HEAD, CellFrame, Frame
from cairn_server.metrics import Counter, Histogram, gauge_lines
from cairn_server.store.store_health import Backlog, StoreFigures


class ServerFigures:
    """Everything that grows; one object for all threads."""

    def __init__(self) -> None:
        by_route = ("method", "route")
        self.requests = Counter(
            "cairn_http_requests_total", "Requests answered, by route and status.", (*by_route, "status")
        )
        self.request_seconds = Histogram(
            "cairn_http_request_duration_seconds", "Time from a request's head to the end of its answer.", by_route
        )
        self.received_bytes = Counter("cairn_http_received_bytes_total", "Bytes of request bodies.", by_route)
        self.sent_bytes = Counter("cairn_http_sent_bytes_total", "Bytes of answers' bodies.", by_route)
        self.errors = Counter("cairn_errors_total", "Problems answered, by their kind.", ("kind",))
        self.pushes = Counter(
            "cairn_pushes_total",
            "Pushes by outcome: new, known, or the kind of the problem (then without a map).",
            ("map", "outcome"),
        )
        self.push_bytes = Counter("cairn_push_bytes_total", "Bytes of commits that were new.", ("map",))
        self.frames = Counter("cairn_fetch_frames_total", "Cell frames made for fetches, by kind.", ("kind",))
        self.frame_bytes = Counter("cairn_fetch_frame_bytes_total", "Bytes of cell frames, by kind.", ("kind",))
        self.fold_seconds = Histogram(
            "cairn_fold_duration_seconds", "Time of one fold of a group of commits.", ("map",)
        )
        self.folded = Counter("cairn_folded_commits_total", "Commits folded into cells.", ("map",))
        self.fold_failures = Counter("cairn_fold_failures_total", "Folds that failed and are tried again.", ("map",))

    def counted(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """The same frames, counted by kind."""
        for frame in frames:
            if isinstance(frame, CellFrame):
                kind = frame.kind.name.lower()
                self.frames.add(1, kind)
                self.frame_bytes.add(CELL_HEAD.size + len(frame.payload), kind)
            yield frame

    def lines(self) -> Iterator[str]:
        """All of it as text."""
        for family in vars(self).values():
            yield from family.lines()


def store_lines(found: StoreFigures, backlogs: list[Backlog]) -> Iterator[str]:
    """The store's figures as text."""
    yield from gauge_lines("cairn_store_size_bytes", "Size of the store at rest.", found.size_bytes)
    yield from gauge_lines("cairn_wal_size_bytes", "Size of what the store wrote ahead.", found.ahead_bytes)
    yield from gauge_lines("cairn_disk_free_bytes", "Free space on the store's disk.", found.free_bytes)
    yield from gauge_lines("cairn_writer_queue_length", "Jobs that wait to be written.", found.queued)
    yield from gauge_lines(
        "cairn_writer_transactions_total", "Transactions made durable.", found.written, kind="counter"
    )
    yield from gauge_lines(
        "cairn_wal_truncations_total", "Times that the write-ahead log was emptied.", found.emptied, kind="counter"
    )
    yield from gauge_lines(
        "cairn_writer_failures_total",
        "Transactions that were not written, by kind of error.",
        dict.fromkeys(("disk_full", "store_failed"), 0) | found.failures,
        label="kind",
        kind="counter",
    )
    now_s = time.time()
    ages = {b.map: 0.0 if b.oldest_s is None else max(0.0, now_s - b.oldest_s) for b in backlogs}
    yield from gauge_lines(
        "cairn_pending_commits",
        "Commits that are durable but not folded.",
        {b.map: b.commits for b in backlogs},
        label="map",
    )
    yield from gauge_lines(
        "cairn_pending_oldest_age_seconds", "Age of the oldest of them; 0 without any.", ages, label="map"
    )


def process_lines() -> Iterator[str]:
    """The process's figures as text, under their usual names."""
    try:
        text = version("cairn-robotics")
    except PackageNotFoundError:
        text = "unknown"
    yield from gauge_lines("cairn_build_info", "Always 1; the version is the label.", {text: 1}, label="version")
    times = os.times()
    yield from gauge_lines(
        "process_cpu_seconds_total", "Processor time used.", round(times.user + times.system, 2), kind="counter"
    )
    statm, descriptors = Path("/proc/self/statm"), Path("/proc/self/fd")
    if statm.exists():
        pages = int(statm.read_text().split()[1])
        yield from gauge_lines("process_resident_memory_bytes", "Memory in use.", pages * os.sysconf("SC_PAGE_SIZE"))
        yield from gauge_lines("process_open_fds", "Open files and sockets.", sum(1 for _ in descriptors.iterdir()))
