"""A robot's events as lines for people, and signals that ask a command to come to its end."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from types import FrameType

from cairn_client.cli.arguments import shown_bytes
from cairn_client.robot.robot_events import (
    CellsChanged,
    CellsDropped,
    Committed,
    Event,
    EventStream,
    LinkBack,
    LinkLost,
    OutboxNearlyFull,
    Pushed,
    Refused,
    SyncFailed,
)

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def event_line(event: Event) -> str:
    """An event as one line."""
    match event:
        case Committed(commit=commit, cells=cells, size_bytes=size_bytes):
            return f"committed {commit}: {len(cells)} cells, {shown_bytes(size_bytes)}"
        case Pushed(commit=commit):
            return f"pushed {commit}"
        case Refused(commit=commit, kind=kind, reason=reason):
            return f"the server refuses {commit}: {reason} [{kind}]"
        case CellsChanged(cells=cells):
            return f"{len(cells)} cells have news"
        case CellsDropped(cells=cells):
            return f"{len(cells)} cells of the server made room"
        case OutboxNearlyFull(size_bytes=size_bytes, max_bytes=max_bytes):
            return f"commits that may not be forgotten take {shown_bytes(size_bytes)} of {shown_bytes(max_bytes)}"
        case LinkLost() | SyncFailed():
            again = "" if event.again_s is None else f"; trying again in {event.again_s:.0f} s"
            return f"sync failed {event.tries} times: {event.reason} [{event.kind}]{again}"
        case LinkBack(away_s=away_s):
            return f"the link is back after {away_s:.0f} s"
    return type(event).__name__


@contextmanager
def lines_on_stderr(stream: EventStream) -> Iterator[None]:
    """Write a robot's events to standard error as they happen, until the end of the block."""

    def write() -> None:
        for event in stream:
            sys.stderr.write(event_line(event) + "\n")
            sys.stderr.flush()

    writer = threading.Thread(target=write, name="cairn-events", daemon=True)
    writer.start()
    try:
        yield
    finally:
        stream.close()
        writer.join()


class Stopping:
    """Flag that a signal's handler sets, and that the main thread waits for.

    A `threading.Event` must not be set by a handler: that runs in the main thread, which may hold the event's own lock
    at this moment, on its way into `wait`. What is put into a `SimpleQueue` needs no lock that it could hold.
    """

    def __init__(self) -> None:
        self._is_set = False
        self._said = SimpleQueue[None]()

    def set(self) -> None:
        """Set the flag; may be called from a handler of signals."""
        self._is_set = True
        self._said.put(None)

    def is_set(self) -> bool:
        """True if a signal came."""
        return self._is_set

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a signal, at most so many seconds (None: without end); True if one came. For one thread."""
        if not self._is_set:
            with suppress(Empty):
                self._said.get(timeout=timeout_s)
        return self._is_set


@contextmanager
def until_signal() -> Iterator[Stopping]:
    """A flag that ^C or SIGTERM sets; the second one interrupts whatever goes on, as usual."""
    stopping = Stopping()

    def stop(number: int, frame: FrameType | None) -> None:
        stopping.set()
        restore()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    before = {number: signal.signal(number, stop) for number in SIGNALS}
    try:
        yield stopping
    finally:
        restore()
