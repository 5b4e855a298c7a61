"""Status of live mapping: what arrives, what becomes of it, and what is missing, by cause; one line of it, or JSON."""

import statistics
from collections import Counter, deque
from dataclasses import dataclass, field

from pydantic import BaseModel, ConfigDict

from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.live_source import LiveSource
from cairn_client.live.scan_recorder import ScanRecorder
from cairn_fusion.ros.bag import Topic
from cairn_fusion.ros.bag_index import STATIC_NAME
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.messages import CAMERA_INFO, PATH, TRANSFORMS

SPAN_S = 5.0
"""Span of time over which rates are counted."""
SILENT_S = 5.0
"""Silence of a topic from which on it is named."""
CLOCK_S = 2.0
"""Difference between two clocks from which on it is named."""
PATH_S = 60.0
"""Time after a path's last pose from which on a jump lacks a path."""
SIMULATED_S = 1e8
"""Stamps before 1973 are those of a simulation's clock."""


def shown_times(count: int) -> str:
    """A number of times in words."""
    return "once" if count == 1 else f"{count} times"


class TopicStatus(BaseModel):
    """One topic of the mapping."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    topic: str
    messages: int
    rate_hz: float
    silent_s: float
    """Time since its last message, or since the start, seconds."""
    is_offered: bool
    """True if a publisher is there now, as far as the bridge says."""
    dropped: int
    """Messages that went for room before they were read, or that the network lost as far as the door numbers them."""


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
    _before: deque[_Counts] = field(default_factory=deque)
    _last: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Count of each topic's messages, and the steady time at which that count was first seen."""
    _leads_s: deque[float] = field(default_factory=lambda: deque(maxlen=31))
    _noted_s: float = float("-inf")
    """Stamp whose lead was noted last."""
    _shown: dict[str, float] = field(default_factory=dict)
    """Rates of the last status, by name, for the line."""

    def __post_init__(self) -> None:
        self._before.append(_Counts(self.start_s, 0, 0, {}, Counter()))

    def note_lead(self, wall_s: float) -> None:
        """Note how far this machine's time of day is ahead of the last range image's stamp, if another one came."""
        if self.scans.last_s != self._noted_s:
            self._noted_s = self.scans.last_s
            self._leads_s.append(wall_s - self._noted_s)

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
        offered, dropped = self.source.topics, self.source.dropped + self.early_dropped
        lead_s = statistics.median(self._leads_s) if self._leads_s else None
        rates_hz = {name: (counts[name] - base.topics[name]) / span_s for name in sorted(self.topics)}
        topics = [
            self._topic(name, counts[name], now_s, rate, is_offered=name in offered, dropped=dropped[name])
            for name, rate in rates_hz.items()
        ]
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
            clock_apart_s=lead_s,
            commits=self.mapping.commits,
            commits_waiting=commits_waiting,
            amended=0 if corrections is None else corrections.amended,
            amends_waiting=0 if corrections is None else corrections.waiting,
            jumps=self.mapping.jumps.count,
            links=self.source.links,
            no_link_s=None if lost_s is None else now_s - lost_s,
            missing=self._missing(topics, lead_s, None if lost_s is None else now_s - lost_s),
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

    def _topic(
        self, name: str, count: int, now_s: float, rate_hz: float, *, is_offered: bool, dropped: int
    ) -> TopicStatus:
        if name not in self._last or self._last[name][0] != count:
            self._last[name] = count, now_s
        silent_s = now_s - self._last[name][1]
        return TopicStatus(
            topic=name, messages=count, rate_hz=rate_hz, silent_s=silent_s, is_offered=is_offered, dropped=dropped
        )

    def _missing(self, topics: list[TopicStatus], lead_s: float | None, no_link_s: float | None) -> list[str]:
        if no_link_s is not None:
            return [f"no link to {self.source.url} for {no_link_s:.0f} s"]
        said = []
        for status in topics:
            kind = self.topics[status.topic].type
            # A path comes when the SLAM has a new pose, perhaps never for a robot at rest.
            is_latched = kind in (CAMERA_INFO, PATH) or (kind in TRANSFORMS and STATIC_NAME in status.topic)
            if not status.is_offered:
                said.append(f"{status.topic}: no publisher")
            elif not is_latched and status.silent_s > SILENT_S:
                said.append(f"{status.topic}: publisher there, nothing came for {status.silent_s:.0f} s")
        if lead_s is not None and self.scans.last_s < SIMULATED_S:
            said.append("stamps are of a simulation's clock (use_sim_time)")
        elif lead_s is not None and abs(lead_s) > CLOCK_S:
            said.append(f"clock apart {lead_s:.0f} s: this machine's and the robot's differ")
        if self.scans.frame_error:
            said.append(self.scans.frame_error)
        said += [text for text in (self.mapping.refusal, self.recorder.refusal if self.recorder else "") if text]
        return [*said, *self._uncorrected()]

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
