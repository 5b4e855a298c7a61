"""Events of a robot, sent as they happen, by the thread in which they happen.

    for event in robot.events():                 # in a thread of its own; ends when the robot is closed
        match event:
            case Committed(commit=commit):
                ...
            case LinkLost(reason=reason, again_s=again_s):
                ...

A slow reader loses the oldest events, and sees how many (`EventStream.dropped`); the robot never waits for a reader.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self

from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Cell

SIZE = 1000
"""Default number of events that wait for one reader."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """An event of a robot."""

    time_s: float = field(default_factory=time.time)
    """Time of the event by this robot's clock: UTC, seconds since 1970."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Committed(Event):
    """A measurement is durable here, and waits for the server."""

    commit: CommitId
    cells: tuple[Cell, ...]
    size_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Pushed(Event):
    """The server has a commit for good."""

    commit: CommitId


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused(Event):
    """The server will not take a commit; it stays here, and other commits are pushed all the same."""

    commit: CommitId
    kind: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CellsChanged(Event):
    """The server's newer state of these cells is here; own evidence that it folded counts, too."""

    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class CellsDropped(Event):
    """These cells of the server were dropped to make room (`limits`); they come again when the robot is near them."""

    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class OutboxNearlyFull(Event):
    """Commits that may not be forgotten take most of their room; when it is all taken, `commit` refuses."""

    size_bytes: int
    max_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLost(Event):
    """A round with the server failed because there is no link, or because the server asks to be called later."""

    kind: str
    reason: str
    tries: int
    """Rounds that failed in a row."""
    again_s: float | None
    """Seconds until the background thread tries again; None after a round that the program called."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SyncFailed(Event):
    """A round with the server failed though there was a link: it refuses this robot, or its answer is damaged."""

    kind: str
    reason: str
    tries: int
    """Rounds that failed in a row."""
    again_s: float | None
    """Seconds until the background thread tries again; None after a round that the program called."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkBack(Event):
    """A round with the server succeeded again."""

    away_s: float
    """Seconds since the first failure."""


class EventStream:
    """One reader's events, oldest first; iterate over it, or `take` what is there."""

    def __init__(self, size: int = SIZE) -> None:
        """Make a stream in which up to `size` events wait."""
        if size < 1:
            raise BadInputError("bad_option", f"a stream of events has room for at least 1, got {size}")
        self._news = threading.Condition()
        self._waiting: deque[Event] = deque(maxlen=size)
        self._is_closed = False
        self.dropped = 0
        """Events that were lost because this reader was too slow."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Event]:
        """Events until the robot or this stream is closed; waits for the next one."""
        while events := self.take(timeout_s=None):
            yield from events

    def take(self, *, timeout_s: float | None = 0.0) -> list[Event]:
        """All events that are there, after a wait of so many seconds for the first one; None waits until the end."""
        with self._news:
            self._news.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            events = list(self._waiting)
            self._waiting.clear()
            return events

    def put(self, event: Event) -> None:
        """Add an event, in the place of the oldest one if there is no room."""
        with self._news:
            if not self._is_closed:
                self.dropped += len(self._waiting) == self._waiting.maxlen
                self._waiting.append(event)
                self._news.notify_all()

    def close(self) -> None:
        """End the stream; the events that wait can still be read."""
        with self._news:
            self._is_closed = True
            self._news.notify_all()

    @property
    def is_closed(self) -> bool:
        """True if nothing more will come."""
        return self._is_closed


class Events:
    """A robot's events, for any number of readers."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._streams: list[EventStream] = []

    def open(self, size: int = SIZE) -> EventStream:
        """A stream of the events from here on."""
        stream = EventStream(size)
        with self._lock:
            self._streams = [known for known in self._streams if not known.is_closed] + [stream]
        return stream

    def send(self, event: Event) -> None:
        """Put an event into all streams; no reader is waited for."""
        for stream in self._streams:
            stream.put(event)

    def close(self) -> None:
        """End all streams."""
        with self._lock:
            for stream in self._streams:
                stream.close()
