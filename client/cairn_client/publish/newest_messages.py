"""Newest message of each topic on its way to a robot's network: a link that is slow, or lost, costs no memory.

The robot's own tree of frames is its own: `/tf` is left out.
"""

import threading

from cairn_fusion.ros.map_messages import MapMessage

LEFT_OUT = frozenset(["/tf"])
"""Topics that no robot's network gets."""


class NewestMessages:
    """Messages that wait, of each topic the newest; thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: dict[str, MapMessage] = {}
        self._waiting: dict[str, None] = {}
        """Topics whose newest message is still to be sent, in their order."""

    def put(self, message: MapMessage) -> None:
        """Let a message wait, in the place of one of its topic that does."""
        if message.topic in LEFT_OUT:
            return
        with self._changed:
            self._newest[message.topic] = message
            self._waiting[message.topic] = None
            self._changed.notify_all()

    def put_again(self, *topics: str) -> None:
        """Let the newest message of each of these topics wait, though it was taken; without names that of all."""
        with self._changed:
            self._waiting |= dict.fromkeys(topics or self._newest)

    def take(self, *, within_s: float) -> MapMessage | None:
        """The message that waits longest, as soon as there is one; None: none came in that time."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting, within_s)
            if not self._waiting:
                return None
            topic = next(iter(self._waiting))
            del self._waiting[topic]
            return self._newest[topic]
