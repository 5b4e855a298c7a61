"""Watch over a live source: what arrives of each topic, and sentences about what does not, by cause.

The status line of `cairn robot live` and `cairn doctor SOURCE` say them in these words.
"""

import statistics
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from pydantic import BaseModel, ConfigDict

from cairn_client.live.live_source import LiveSource
from cairn_fusion.ros.bag import Topic
from cairn_fusion.ros.bag_index import STATIC_NAME
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.messages import CAMERA_INFO, PATH, TRANSFORMS

SILENT_S = 5.0
"""Silence of a topic from which on it is named."""
CLOCK_S = 2.0
"""Difference between two clocks from which on it is named."""
SIMULATED_S = 1e8
"""Stamps before 1973 are those of a simulation's clock."""


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


@dataclass(slots=True)
class SourceWatch:
    """Watch over the topics and the clock of one live source."""

    source: LiveSource
    scans: LiveScans
    topics: dict[str, Topic]
    silent_s: float = SILENT_S
    _last: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Count of each topic's messages, and the steady time at which that count was first seen."""
    _leads_s: deque[float] = field(default_factory=lambda: deque(maxlen=31))
    _noted_s: float = float("-inf")
    """Stamp whose lead was noted last."""

    def note_lead(self, wall_s: float) -> None:
        """Note how far this machine's time of day is ahead of the last range image's stamp, if another one came."""
        if self.scans.last_s != self._noted_s:
            self._noted_s = self.scans.last_s
            self._leads_s.append(wall_s - self._noted_s)

    @property
    def lead_s(self) -> float | None:
        """Median lead of this machine's clock over the stamps of images, seconds; None: unknown."""
        return statistics.median(self._leads_s) if self._leads_s else None

    @property
    def clock_fault(self) -> str:
        """Sentence about the robot's clock; empty if it agrees with this machine's, or is unknown."""
        lead_s = self.lead_s
        if lead_s is not None and self.scans.last_s < SIMULATED_S:
            return "stamps are of a simulation's clock (use_sim_time)"
        if lead_s is not None and abs(lead_s) > CLOCK_S:
            return f"clock apart {lead_s:.0f} s: this machine's and the robot's differ"
        return ""

    def topic_statuses(
        self, now_s: float, counts: Mapping[str, int], rates_hz: Mapping[str, float], *, dropped: Counter[str]
    ) -> list[TopicStatus]:
        """Status of each topic that has a rate, at a steady time.

        Args:
            now_s: steady seconds; topics are silent since the call that found their last message.
            counts: messages so far, by topic.
            rates_hz: messages a second, by topic.
            dropped: messages that were lost, by topic.
        """
        offered = self.source.topics
        for name in rates_hz:
            if name not in self._last or self._last[name][0] != counts[name]:
                self._last[name] = counts[name], now_s
        return [
            TopicStatus(
                topic=name,
                messages=counts[name],
                rate_hz=rate_hz,
                silent_s=now_s - self._last[name][1],
                is_offered=name in offered,
                dropped=dropped[name],
            )
            for name, rate_hz in rates_hz.items()
        ]

    def silences(self, statuses: list[TopicStatus]) -> list[str]:
        """Sentences about the topics of which nothing comes, or that nothing publishes."""
        said = []
        for status in statuses:
            kind = self.topics[status.topic].type
            # A path comes when the SLAM has a new pose, perhaps never for a robot at rest.
            is_latched = kind in (CAMERA_INFO, PATH) or (kind in TRANSFORMS and STATIC_NAME in status.topic)
            if not status.is_offered:
                said.append(f"{status.topic}: no publisher")
            elif not is_latched and status.silent_s > self.silent_s:
                said.append(f"{status.topic}: publisher there, nothing came for {status.silent_s:.0f} s")
        return said
