"""Deadline of one request: what its answer may take in all, which grows with the bytes that went and came.

A timeout of each read alone bounds nothing: a server that sends one byte in time, or one more answer "102 Processing",
holds its reader for ever. So a request may take

    grace_s + (bytes sent + bytes of the body that came) / least_bytes_per_s

of waiting for the link; what the caller does between two parts of the body does not count. Past it, the connection is
cut from a timer's thread, wherever the request waits: in the head, between two chunks, in the body of an error; and cut
again, until the request has ended: a connection may be made only after the first cut.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from cairn_map.errors import UnreachableError

LEAST_CHECK_S = 0.1
"""Shortest time of a timer, and the time between two cuts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Slowest pace at which an answer is waited for."""

    grace_s: float = 120.0
    """Seconds that a request without any bytes may take: four times as long as one read."""
    least_bytes_per_s: float = 256.0
    """Bytes each second that lengthen it: a fifth of what a link of 10 kbit/s carries."""

    def allowed_s(self, size_bytes: int) -> float:
        """Seconds that a request may take of which so many bytes went or came."""
        return self.grace_s + size_bytes / self.least_bytes_per_s


PACE = Pace()


class RequestDeadline:
    """Deadline of one request, for the length of a `with`; it calls `cut` from a thread of its own."""

    def __init__(self, pace: Pace, cut: Callable[[], None], *, sent_bytes: int) -> None:
        self._pace = pace
        self._cut = cut
        self._lock = threading.Lock()
        self._bytes = sent_bytes
        self._spent_s = 0.0
        self._since_s: float | None = None
        """Steady time since which the caller waits for the link; None: it does not."""
        self._timer: threading.Timer | None = None
        self._is_ended = False
        self.is_over = False
        """True if the connection was cut."""

    def __enter__(self) -> Self:
        self._since_s = time.monotonic()
        with self._lock:
            self._set_timer()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def end(self) -> None:
        """Let the request take as long as it likes from here on: it is over, or its answer is a stream of news."""
        with self._lock:
            self._is_ended = True
            if self._timer is not None:
                self._timer.cancel()

    def note(self, size_bytes: int) -> None:
        """Note bytes of the body that came."""
        with self._lock:
            self._bytes += size_bytes

    @contextmanager
    def resting(self) -> Iterator[None]:
        """Context in which the caller does something else than wait for the link."""
        with self._lock:
            if self._since_s is not None:
                self._spent_s += time.monotonic() - self._since_s
            self._since_s = None
        try:
            yield
        finally:
            with self._lock:
                self._since_s = time.monotonic()

    def check(self) -> None:
        """Raise an error if the request was cut for this deadline.

        Raises:
            UnreachableError: kind `no_link`.
        """
        if self.is_over:
            allowed_s = self._pace.allowed_s(self._bytes)
            raise UnreachableError(
                "no_link",
                f"the server took longer than {allowed_s:.0f} s for a request of which {self._bytes} bytes "
                "went or came; try again later, or over a better link",
            )

    def _left_s(self) -> float:
        waited_s = 0.0 if self._since_s is None else time.monotonic() - self._since_s
        return self._pace.allowed_s(self._bytes) - self._spent_s - waited_s

    def _set_timer(self) -> None:
        self._timer = threading.Timer(max(self._left_s(), LEAST_CHECK_S), self._look)
        self._timer.daemon = True
        self._timer.start()

    def _look(self) -> None:
        with self._lock:
            if self._is_ended:
                return
            # Else more came since, or the caller is busy with what came: look again when that is used up.
            if self.is_over or (self._since_s is not None and self._left_s() <= 0):
                self.is_over = True
                # Under the lock, so that no later request on these connections is cut in place of this one.
                self._cut()
            self._set_timer()
