"""Publishing through a robot's own Foxglove bridge: its nodes get the map as topics, and no ROS is needed here.

    cairn  -->  advertise, then messages (CDR)  -->  foxglove_bridge (`clientPublish`)  -->  /map for Nav2

A bridge keeps no last message for subscribers that come late, so the floor is sent again every few seconds. Of each
topic the newest message alone waits: a slow link costs no memory. A bridge that starts again is found again.
"""

import json
import logging
import ssl
import struct
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from websockets.sync.client import ClientConnection

from cairn_client.http.bridge_link import CONNECT_S, LINK_ERRORS, certificate_checks, connect_bridge, is_bridge_url
from cairn_fusion.ros.map_messages import GRID, MapMessage
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)

FIRST_ERRORS: tuple[type[Exception], ...] = (ValueError, *LINK_ERRORS)
"""Errors of a link whose first frame is none, or does not come."""
LEFT_OUT = frozenset(["/tf"])
"""Topics that are not sent: the robot's own tree of frames is its own."""
MESSAGE_HEAD = struct.Struct("<BI")
MESSAGE_DATA = 1
CAPABILITY = "clientPublish"
REPEAT_S = 5.0
"""Time after which the floor is sent again."""
AGAIN_S = 2.0
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
        self._checks: ssl.SSLContext | None = certificate_checks(url, ca_file)
        self._steady_s = steady_s
        self._changed = threading.Condition()
        self._newest: dict[str, MapMessage] = {}
        self._waiting: dict[str, None] = {}
        """Topics whose newest message is still to be sent, in their order."""
        self._sent_s: dict[str, float] = {}
        self._is_closing = False
        self._stack = ExitStack()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Connect.

        Raises:
            BadInputError: no bridge is there, or kind `no_client_publish`: it takes no messages.
        """
        link = connect_bridge(self._stack, self.url, self._checks)
        try:
            info = json.loads(link.recv(timeout=CONNECT_S))
            capabilities = info.get("capabilities", []) if isinstance(info, dict) else []
        except FIRST_ERRORS as exc:
            self._stack.close()
            raise BadInputError("no_foxglove", f"{self.url} does not say what it can do: {exc!r:.100}") from exc
        if CAPABILITY not in capabilities:
            self._stack.close()
            raise BadInputError(
                "no_client_publish",
                f"{self.url} takes no messages of clients: start the bridge with {CAPABILITY} among its capabilities",
            )
        self._thread = threading.Thread(target=self._send_all, args=(link,), name="cairn-through", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(CONNECT_S + 1)

    def send(self, message: MapMessage) -> None:
        """Let a message be sent, in the place of one of its topic that waits."""
        if message.topic in LEFT_OUT:
            return
        with self._changed:
            self._newest[message.topic] = message
            self._waiting[message.topic] = None
            self._changed.notify_all()

    def _send_all(self, first: ClientConnection) -> None:
        """Send until `__exit__`, over one link after the other."""
        link: ClientConnection | None = first
        stack = self._stack
        while not self._is_closing:
            with stack:
                try:
                    if link is None:
                        link = connect_bridge(stack, self.url, self._checks)
                    self._send_over(link)
                except BadInputError as exc:
                    log.debug("%s", exc.message)
                except LINK_ERRORS as exc:
                    log.warning("the link to %s is lost: %s", self.url, exc or type(exc).__name__)
            link, stack = None, ExitStack()
            with self._changed:
                self._waiting |= dict.fromkeys(self._newest)
                self._changed.wait_for(lambda: self._is_closing, AGAIN_S)

    def _send_over(self, link: ClientConnection) -> None:
        channels: dict[str, int] = {}
        while message := self._next(link):
            if message.topic not in channels:
                channels[message.topic] = len(channels) + 1
                link.send(_advertisement(channels[message.topic], message))
            link.send(MESSAGE_HEAD.pack(MESSAGE_DATA, channels[message.topic]) + message.data)

    def _next(self, link: ClientConnection) -> MapMessage | None:
        """The next message to be sent; None: the end."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closing, LOOK_S)
                now_s = self._steady_s()
                for topic, message in self._newest.items():
                    if message.type_name == GRID and now_s - self._sent_s.get(topic, now_s) >= REPEAT_S:
                        self._waiting[topic] = None
                if self._waiting:
                    topic = next(iter(self._waiting))
                    del self._waiting[topic]
                    self._sent_s[topic] = now_s
                    return self._newest[topic]
                if self._is_closing:
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
