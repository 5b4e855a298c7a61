"""Status of live mapping: what arrives, what becomes of it, and what is missing, by cause; one line of it, or JSON."""

from collections import Counter, deque
from dataclasses import dataclass, field

from pydantic import BaseModel, ConfigDict

from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.live_source import LiveSource
from cairn_client.live.scan_recorder import ScanRecorder
from cairn_client.live.source_watch import CLOCK_S, SourceWatch, TopicStatus
from cairn_fusion.ros.bag import Topic
from cairn_fusion.ros.live_scans import LiveScans

SPAN_S = 5.0
"""Span of time over which rates are counted."""
PATH_S = 60.0
"""Time after a path's last pose from which on a jump lacks a path."""


def shown_times(count: int) -> str:
    """A number of times in words."""
    return "once" if count == 1 else f"{count} times"


class LiveStatus(BaseModel):
    """Status as `cairn robot live --json` prints it, a line each; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    running_s: float
    arrived: int
    """Range images that came."""
    taken: int
    """Scans that became evidence."""
    not_moved: int
    """Scans of a robot that had not moved."""
    dropped: int
    """Scans that gave way to newer ones, because mapping was slower, or for which there was no room."""
    left_out: dict[str, int]
    """Range images that became no scan, by cause."""
    waiting: int
    """Range images that wait for their pose, for other images, or for their turn."""
    alone: int
    """Scans without an image of another camera."""
    damaged: int
    """Messages and frames that could not be read."""
    arrived_hz: float
    taken_hz: float
    newest_s: float | None
    """Age of the scan taken last by its stamp, seconds; None: there is none."""
    clock_apart_s: float | None
    """Median lead of this machine's clock over the stamps of images, seconds; None: unknown."""
    commits: int
    commits_waiting: int
    """Commits that the server has not acknowledged."""
    amended: int
    """Measurements moved to corrected poses, each as often as it was."""
    amends_waiting: int
    jumps: int
    """Times that the odometry's frame moved in the map by more than half a voxel, at the robot."""
    links: int
    """Times that the bridge was connected."""
    no_link_s: float | None
    """Time since the bridge was lost, seconds; None: it is there."""
    missing: list[str]
    """Sentences about what is missing, by cause, and the next step."""
    topics: list[TopicStatus]


@dataclass(frozen=True, slots=True)
class _Counts:
    """Counts at a time."""

    steady_s: float
    arrived: int
    taken: int
    left: dict[str, int]
    topics: Counter[str]


@dataclass(slots=True)
class StatusWatch:
    """Watch over one live mapping: counts of the last seconds, for rates."""

    robot: str
    source: LiveSource
    scans: LiveScans
    mapping: LiveMapping
    topics: dict[str, Topic]
    start_s: float
    """Steady time of the start."""
    early_dropped: Counter[str] = field(default_factory=Counter)
    """Messages that went for room while the source was opened, by topic."""
    recorder: ScanRecorder | None = None
    _arrivals: SourceWatch = field(init=False)
    _before: deque[_Counts] = field(default_factory=deque)
    _shown: dict[str, float] = field(default_factory=dict)
    """Rates of the last status, by name, for the line."""

    def __post_init__(self) -> None:
        self._arrivals = SourceWatch(self.source, self.scans, self.topics)
        self._before.append(_Counts(self.start_s, 0, 0, {}, Counter()))

    def note_lead(self, wall_s: float) -> None:
        """Note how far this machine's time of day is ahead of the last range image's stamp, if another one came."""
        self._arrivals.note_lead(wall_s)

    def status(self, now_s: float, wall_s: float, *, commits_waiting: int) -> LiveStatus:
        """The status at a steady time, and by this machine's time of day."""
        left = self._left()
        counts = self.source.counts
        now = _Counts(now_s, self.scans.arrived.total(), self.mapping.taken, left, counts)
        self._before.append(now)
        while len(self._before) > 2 and now_s - self._before[1].steady_s >= SPAN_S:
            self._before.popleft()
        base = self._before[0]
        span_s = max(now_s - base.steady_s, 1e-9)
        self._shown = {name: (count - base.left.get(name, 0)) / span_s for name, count in left.items()}
        rates_hz = {name: (counts[name] - base.topics[name]) / span_s for name in sorted(self.topics)}
        topics = self._arrivals.topic_statuses(
            now_s, counts, rates_hz, dropped=self.source.dropped + self.early_dropped
        )
        lost_s, corrections = self.source.lost_since_s, self.mapping.corrections
        return LiveStatus(
            robot=self.robot,
            running_s=now_s - self.start_s,
            arrived=now.arrived,
            taken=now.taken,
            not_moved=self.mapping.not_moved,
            dropped=self.mapping.dropped,
            left_out={cause.value: count for cause, count in sorted(self.scans.left_out.items())},
            waiting=self.mapping.waiting,
            alone=self.scans.alone,
            damaged=self.scans.damaged + self.source.damaged,
            arrived_hz=(now.arrived - base.arrived) / span_s,
            taken_hz=(now.taken - base.taken) / span_s,
            newest_s=wall_s - self.mapping.newest_s if self.mapping.taken else None,
            clock_apart_s=self._arrivals.lead_s,
            commits=self.mapping.commits,
            commits_waiting=commits_waiting,
            amended=0 if corrections is None else corrections.amended,
            amends_waiting=0 if corrections is None else corrections.waiting,
            jumps=self.mapping.jumps.count,
            links=self.source.links,
            no_link_s=None if lost_s is None else now_s - lost_s,
            missing=self._missing(topics, None if lost_s is None else now_s - lost_s),
            topics=topics,
        )

    def line(self, status: LiveStatus) -> str:
        """A status as one line for people."""
        causes = [f"{rate:.1f}/s {name}" for name, rate in self._shown.items() if rate >= 0.05]
        line = f"{status.robot}: {status.taken_hz:.1f} scans/s of {status.arrived_hz:.1f}"
        line += f" ({', '.join(causes)})" if causes else ""
        if status.newest_s is not None and abs(status.clock_apart_s or 0.0) <= CLOCK_S:
            line += f", newest {status.newest_s:.1f} s old"
        line += f", {status.commits_waiting} commits wait"
        return f"{line}; {'; '.join(status.missing)}" if status.missing else line

    def _left(self) -> dict[str, int]:
        """Counts of scans and range images that are not mapped, by cause."""
        causes = {cause.value: count for cause, count in self.scans.left_out.items()}
        return {"not moved": self.mapping.not_moved, "dropped": self.mapping.dropped, **causes}

    def _missing(self, topics: list[TopicStatus], no_link_s: float | None) -> list[str]:
        if no_link_s is not None:
            return [f"no link to {self.source.url} for {no_link_s:.0f} s"]
        said = [*self._arrivals.silences(topics), self._arrivals.clock_fault, self.scans.frame_error]
        said += [self.mapping.refusal, self.recorder.refusal if self.recorder else ""]
        return [*(text for text in said if text), *self._uncorrected()]

    def _uncorrected(self) -> list[str]:
        """Sentences about jumps of the odometry in the map that no path followed."""
        jumps, corrections = self.mapping.jumps, self.mapping.corrections
        if corrections is not None and corrections.refusal:
            return [corrections.refusal]
        if not jumps.count or (corrections is not None and corrections.newest_s > jumps.last_s - PATH_S):
            return []
        said = f"odometry jumped in the map {shown_times(jumps.count)}, by up to {jumps.largest_m:.2f} m, and "
        if corrections is None:
            return [
                f"{said}what was mapped before stays: name the SLAM's optimised path as corrections in the topics file"
            ]
        return [f"{said}no path came since"]
