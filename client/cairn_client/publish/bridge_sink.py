"""Publishing through a robot's own Foxglove bridge: its nodes get the map as topics, and no ROS is needed here.

    cairn  -->  advertise, then messages (CDR)  -->  foxglove_bridge (`clientPublish`)  -->  /map for Nav2

A bridge keeps no last message for subscribers that come late, so the floor is sent again every few seconds. A bridge
that starts again is found again, and gets the newest message of each topic.
"""

import json
import logging
import struct
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from websockets.sync.client import ClientConnection

from cairn_client.links.bridge_link import CONNECT_S, LINK_ERRORS, BridgeLinks, is_bridge_url
from cairn_client.publish.newest_messages import NewestMessages
from cairn_fusion.ros.map_messages import GRID, MapMessage
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)

FIRST_ERRORS: tuple[type[Exception], ...] = (ValueError, *LINK_ERRORS)
"""Errors of a link whose first frame is none, or does not come."""
MESSAGE_HEAD = struct.Struct("<BI")
MESSAGE_DATA = 1
CAPABILITY = "clientPublish"
REPEAT_S = 5.0
"""Time after which the floor is sent again."""
AGAIN_S = (2.0,)
"""Pause before a link is tried again."""
LOOK_S = 0.25


class BridgeSink:
    """Sink for a `with` block; messages may be sent from any thread."""

    def __init__(
        self, url: str, *, ca_file: Path | None = None, steady_s: Callable[[], float] = time.monotonic
    ) -> None:
        """Args: url: ws://HOST:PORT or wss://HOST:PORT; ca_file: issuer of the certificate of wss://.

        Raises:
            BadInputError: kind `bad_url`, `bad_option` or `no_file`.
        """
        if not is_bridge_url(url):
            raise BadInputError("bad_url", f"--through takes the URL of a Foxglove bridge, ws://HOST:PORT; got {url!r}")
        self.url = url
        self._links = BridgeLinks(url, ca_file, self._use, pauses_s=AGAIN_S, name="cairn-through")
        self._newest = NewestMessages()
        self._steady_s = steady_s
        self._floors_s: dict[str, float] = {}
        """Steady time at which each floor was sent, by topic."""

    def __enter__(self) -> Self:
        """Connect.

        Raises:
            BadInputError: no bridge is there, or kind `no_client_publish`: it takes no messages.
        """
        self._links.start(self._check_capabilities)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._links.stop()

    def send(self, message: MapMessage) -> None:
        """Let a message be sent, in the place of one of its topic that waits."""
        self._newest.put(message)

    def _check_capabilities(self, link: ClientConnection) -> None:
        try:
            info = json.loads(link.recv(timeout=CONNECT_S))
            capabilities = info.get("capabilities", []) if isinstance(info, dict) else []
        except FIRST_ERRORS as exc:
            raise BadInputError("no_foxglove", f"{self.url} does not say what it can do: {exc!r:.100}") from exc
        if CAPABILITY not in capabilities:
            raise BadInputError(
                "no_client_publish",
                f"{self.url} takes no messages of clients: start the bridge with {CAPABILITY} among its capabilities",
            )

    def _use(self, link: ClientConnection) -> None:
        """Send over one link."""
        channels: dict[str, int] = {}
        try:
            while message := self._next(link):
                if message.topic not in channels:
                    channels[message.topic] = len(channels) + 1
                    link.send(_advertisement(channels[message.topic], message))
                link.send(MESSAGE_HEAD.pack(MESSAGE_DATA, channels[message.topic]) + message.data)
        except LINK_ERRORS as exc:
            log.warning("the link to %s is lost: %s", self.url, exc or type(exc).__name__)
            self._newest.put_again()
            raise

    def _next(self, link: ClientConnection) -> MapMessage | None:
        """The next message to be sent; None: the end."""
        while True:
            now_s = self._steady_s()
            if due := [topic for topic, sent_s in self._floors_s.items() if now_s - sent_s >= REPEAT_S]:
                self._newest.put_again(*due)
            message = self._newest.take(within_s=LOOK_S)
            if message is not None:
                if message.type_name == GRID:
                    self._floors_s[message.topic] = self._steady_s()
                return message
            if self._links.closing.is_set():
                return None
            _forget_what_came(link)


def _forget_what_came(link: ClientConnection) -> None:
    """Read and drop what the bridge says, so that its pings are answered."""
    try:
        while True:
            link.recv(timeout=0)
    except TimeoutError:
        return


def _advertisement(channel: int, message: MapMessage) -> str:
    about: dict[str, Any] = {"id": channel, "topic": message.topic, "encoding": "cdr", "schemaName": message.type_name}
    return json.dumps({"op": "advertise", "channels": [about]})
