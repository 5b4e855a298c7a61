"""A robot's events as lines for people, and signals that ask a command to come to its end."""

import select
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
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

    A handler runs between two instructions of the main thread. A signal that comes when the last one before a wait is
    done, or that the system gives to another thread, does not end a wait for a lock. The interpreter itself writes to
    the socket as soon as a signal comes, in whatever thread; the wait is for that.
    """

    def __init__(self, woken: socket.socket) -> None:
        """With the socket that has bytes to read once a signal came."""
        self._is_set = False
        self._woken = woken

    def set(self) -> None:
        """Set the flag; for the handler."""
        self._is_set = True

    def is_set(self) -> bool:
        """True if a signal came."""
        return self._is_set

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a signal, at most so many seconds (None: without end); True if one came."""
        if not self._is_set:
            select.select([self._woken], [], [], timeout_s)
        return self._is_set


@contextmanager
def until_signal() -> Iterator[Stopping]:
    """A flag that ^C or SIGTERM sets; the second one interrupts whatever goes on, as usual."""

    def stop(number: int, frame: FrameType | None) -> None:
        stopping.set()
        restore()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    woken, waking = socket.socketpair()
    with woken, waking:
        waking.setblocking(False)
        stopping = Stopping(woken)
        woken_before = signal.set_wakeup_fd(waking.fileno())
        before = {number: signal.signal(number, stop) for number in SIGNALS}
        try:
            yield stopping
        finally:
            restore()
            signal.set_wakeup_fd(woken_before)
