"""Turns at a bounded resource, shared fairly: some at once in all, fewer of one caller, and the rest wait in order.

    places = 4, share = 2          at work    waiting
    mole asks six times            m m        m m m m
    wren and fox ask               m m w f    m m m m       no caller waits behind another one's queue

Callers that wait are served one after the other, each with its own oldest request. Everything happens in one event
loop, so there are no locks; who waits costs no thread.
"""

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import Hashable
from itertools import chain

from cairn_map.errors import UnreachableError

Waiting = deque[asyncio.Future[None]]


class Turns:
    """Turns of all callers at one resource; for one event loop."""

    def __init__(self, *, places: int, share: int, wait_s: float) -> None:
        """At most `places` at once, `share` of them of one caller, none waits longer than `wait_s`."""
        self._places = places
        self._share = share
        self._wait_s = wait_s
        self._of: Counter[Hashable] = Counter()
        self._waiting: OrderedDict[Hashable, Waiting] = OrderedDict()
        self._is_closed = False

    @property
    def taken(self) -> int:
        """Turns that are taken now."""
        return self._of.total()

    @property
    def waiting(self) -> int:
        """Requests that wait for a turn now."""
        return sum(map(len, self._waiting.values()))

    async def take(self, caller: Hashable) -> None:
        """Take a turn, which `give_back` ends.

        Raises:
            UnreachableError: kind `busy`: it did not come in time; kind `shutting_down`.
        """
        if self._may_take(caller) and caller not in self._waiting:
            self._of[caller] += 1
            return
        if self._is_closed:
            raise _closed()
        mine = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(caller, deque()).append(mine)
        try:
            async with asyncio.timeout(self._wait_s):
                await mine
        except (TimeoutError, asyncio.CancelledError) as exc:
            self._forget(caller, mine)
            if isinstance(exc, asyncio.CancelledError):
                raise
            message = (
                f"no turn in {self._wait_s:g} s: {self.taken} requests are at work, of this caller {self._of[caller]}"
            )
            raise UnreachableError("busy", message, retry_after_s=2.0) from None

    def close(self) -> None:
        """Refuse all that wait, and all that would have to; those at work go on."""
        self._is_closed = True
        waiting, self._waiting = self._waiting, OrderedDict()
        for mine in chain.from_iterable(waiting.values()):
            if not mine.done():
                mine.set_exception(_closed())

    def give_back(self, caller: Hashable) -> None:
        """End a turn; the next one that waits has it."""
        self._of[caller] -= 1
        if not self._of[caller]:
            del self._of[caller]
        self._hand_out()

    def _may_take(self, caller: Hashable) -> bool:
        return self.taken < self._places and self._of[caller] < self._share

    def _hand_out(self) -> None:
        """Give free turns to those that wait: to each caller one, then again from the first."""
        while (caller := next(filter(self._may_take, self._waiting), None)) is not None:
            queue = self._waiting.pop(caller)
            mine = queue.popleft()
            if queue:
                self._waiting[caller] = queue  # behind the others
            if not mine.done():
                self._of[caller] += 1
                mine.set_result(None)

    def _forget(self, caller: Hashable, mine: "asyncio.Future[None]") -> None:
        """Leave the queue; a turn that came at the very moment goes on to the next one."""
        queue = self._waiting.get(caller)
        if queue is not None and mine in queue:
            queue.remove(mine)
            if not queue:
                del self._waiting[caller]
        elif mine.done() and not mine.cancelled() and mine.exception() is None:
            self.give_back(caller)


def _closed() -> UnreachableError:
    return UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
