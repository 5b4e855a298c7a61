"""Inbox of a live source: messages between the thread that receives and the one that maps, bounded by their bytes.

Newest wins: when the bytes are used up the oldest images go, counted by topic. Small messages stay as long as any image
is there, because a lost transform costs all scans around it.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable

from cairn_fusion.ros.bag import HELD_BYTES, BagMessage

BYTES_MAX = 256_000_000
SMALL_BYTES = 1 << 16
"""Size up to which a message is none that goes first."""
LEFT_SHARE = 0.75
"""Share of the bytes that is kept when they are used up, so that not each message has to make room."""


class Inbox:
    """Messages that wait; thread-safe."""

    def __init__(self, *, bytes_max: int = BYTES_MAX) -> None:
        self._bytes_max = bytes_max
        self._waiting: list[BagMessage] = []
        self._size_bytes = 0
        self._changed = threading.Condition()
        self._dropped: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._last_ns = 0
        self._is_closed = False

    @property
    def dropped(self) -> Counter[str]:
        """Messages that went for room, by topic."""
        with self._changed:
            return self._dropped.copy()

    @property
    def counts(self) -> Counter[str]:
        """Messages that were received, by topic."""
        with self._changed:
            return self._counts.copy()

    def receive(self, topic: str, data: bytes | memoryview) -> None:
        """Add a message that comes now, and count it."""
        with self._changed:
            self._counts[topic] += 1
            # The order of a topic's messages is that of their times, whatever the clock does.
            self._last_ns = max(self._last_ns, time.time_ns())
            self.put(BagMessage(topic, self._last_ns, data))

    def put(self, message: BagMessage) -> None:
        """Add a message; the oldest images go if the bytes are used up."""
        with self._changed:
            self._waiting.append(message)
            self._size_bytes += len(message.data) + HELD_BYTES
            if self._size_bytes > self._bytes_max:
                self._make_room(lambda size: size > SMALL_BYTES)
                self._make_room(lambda size: True)
            self._changed.notify_all()

    def take(self, *, within_s: float) -> list[BagMessage]:
        """All that waits, as soon as there is any; empty after that time, and once the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, within_s)
            taken, self._waiting, self._size_bytes = self._waiting, [], 0
            return taken

    def close(self) -> None:
        """End the wait of `take`."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _make_room(self, may_go: Callable[[int], bool]) -> None:
        """Drop the oldest messages of these sizes until a share of the bytes is free, or none of them is left."""
        if self._size_bytes <= self._bytes_max:
            return
        kept: list[BagMessage] = []
        # The newest stays in any case: newest wins.
        for message in self._waiting[:-1]:
            size = len(message.data)
            if self._size_bytes > LEFT_SHARE * self._bytes_max and may_go(size):
                self._size_bytes -= size + HELD_BYTES
                self._dropped[message.topic] += 1
            else:
                kept.append(message)
        self._waiting = [*kept, self._waiting[-1]]
