"""Cancellation of work whose answer is not wanted any more: the client is gone, or the server stops.

A thread cannot be ended from outside. So long work looks at its request's mark between two steps, and ends itself:

    event loop   the connection is lost  -->  cancellation.cancel()
    thread       for each cell: check()  -->  BadInputError `cut_off`

The mark travels with the context of a request (`contextvars`), which threads of the web server inherit. Work that no
request asked for is never cancelled.
"""

import math
import time
from contextvars import ContextVar

from cairn_map.errors import BadInputError, UnreachableError


class StopTime:
    """Time by which all work of a server ends; unknown until it begins to stop."""

    def __init__(self) -> None:
        self._at_s = math.inf

    def set(self, in_s: float) -> None:
        """End all work in so many seconds."""
        self._at_s = min(self._at_s, time.monotonic() + in_s)

    @property
    def is_over(self) -> bool:
        """True once the time has come."""
        return time.monotonic() >= self._at_s


class Cancellation:
    """Mark of one request: set by the event loop, looked at by the thread that works for it."""

    def __init__(self, stop: StopTime) -> None:
        self._stop = stop
        self._is_cancelled = False

    def cancel(self) -> None:
        """Let the work end at its next look."""
        self._is_cancelled = True

    def check(self) -> None:
        """Go on, or end.

        Raises:
            BadInputError: kind `cut_off`: the client is gone.
            UnreachableError: kind `shutting_down`.
        """
        if self._is_cancelled:
            raise BadInputError("cut_off", "the link was cut before the answer was made")
        if self._stop.is_over:
            raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)


CANCELLATION: ContextVar[Cancellation] = ContextVar("cancellation", default=Cancellation(StopTime()))  # noqa: B039
"""Mark of the request that the present thread works for."""
