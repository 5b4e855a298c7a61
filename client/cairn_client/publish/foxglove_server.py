"""Server of the Foxglove WebSocket protocol (github.com/foxglove/ws-protocol, docs/spec.md): messages to any viewer.

    viewer joins  -->  serverInfo, advertise    all topics so far, with the definitions of their messages
    subscribe     -->  the newest message of the topic, then each that comes
    slow viewer   -->  of a topic the newest alone waits: it misses some, and costs no memory

Foxglove and Lichtblick connect to it. There is no access control: it listens on loopback unless another host is given;
beyond loopback every program that reaches the port sees the map. Browsers say which page asks: pages of other origins
than `ORIGINS` and those that are given are refused, so that a page of the web, open on the same machine, reads nothing.
"""

import json
import logging
import socket
import struct
import threading
import uuid
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve
from websockets.typing import Origin, Subprotocol

from cairn_client.links.bridge_link import SUBPROTOCOLS
from cairn_fusion.ros.map_messages import MapMessage, definition_of
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)

"""The newer and the older name; the messages that are sent here are the same."""
ORIGINS = (None, Origin("file://"), Origin("https://app.foxglove.dev"))
"""Programs, the desktop viewers, which are pages of files, and Foxglove's page; `null` is any page in a frame."""
MESSAGE_DATA = struct.Struct("<BIQ")
"""Operation 1, number of the subscription, nanoseconds; the message follows."""
REQUEST_BYTES_MAX = 1 << 16
CLIENTS_MAX = 16
"""Viewers at the same time; further ones are turned away."""
SUBSCRIPTIONS_MAX = 4096
TEXTS_MAX = 2000
"""Texts that wait for a viewer: an advertisement a topic, and complaints."""
SEND_TIME = struct.pack("@ll", 10, 0)
"""Longest time for a viewer to take what is sent: seconds, microseconds."""
TRY_LATER = 1013
"""Close code of RFC 6455's registry."""
WARNING = 1
"""Level of a status."""


class FoxgloveServer:
    """Server that shows the messages sent to it; `send` may be called by any thread.

    Args:
        name: shown to viewers.
        host: name or address to listen on, IPv6 without brackets.
        port: 0 for any that is free.
        origins: origins (scheme://host:port) of further pages that may join.

    Raises:
        BadInputError: kind `bad_address`: the address cannot be listened on.
    """

    def __init__(self, name: str, *, host: str = "127.0.0.1", port: int = 0, origins: Sequence[str] = ()) -> None:
        self._name = name
        self._session = uuid.uuid4().hex
        self._lock = threading.Lock()
        self._channels: dict[str, int] = {}
        self._latest: dict[int, MapMessage] = {}
        self._viewers: set[_Viewer] = set()
        self._server = _listening(self._serve, host, port, origins)
        self.port: int = self._server.socket.getsockname()[1]
        self.url = f"ws://{_shown_address(host, self.port)}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="foxglove", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def send(self, message: MapMessage) -> None:
        """Show a message to all who subscribed to its topic, and to those who will until the next one."""
        with self._lock:
            is_new = message.topic not in self._channels
            channel = self._channels.setdefault(message.topic, len(self._channels) + 1)
            self._latest[channel] = message
            for viewer in self._viewers:
                if is_new:
                    viewer.write(_advertisement({channel: message}))
                viewer.offer(channel, message)

    def close(self) -> None:
        """Send all viewers away, and stop listening."""
        with self._lock:
            viewers = list(self._viewers)
        # All at once: one that takes nothing keeps its thread for SEND_TIME, and as long again to say goodbye.
        for viewer in viewers:
            viewer.stop()
        for viewer in viewers:
            viewer.finish()
        self._server.shutdown()
        self._thread.join()

    def _serve(self, connection: ServerConnection) -> None:
        """Serve one viewer, until it leaves."""
        viewer = _Viewer(connection)
        viewer.write({"op": "serverInfo", "name": self._name, "capabilities": [], "sessionId": self._session})
        with self._lock:
            is_full = len(self._viewers) >= CLIENTS_MAX
            if not is_full:
                viewer.write(_advertisement(self._latest))
                self._viewers.add(viewer)
                viewer.start()
        if is_full:
            connection.close(TRY_LATER, "too many viewers")
            return
        try:
            for request in connection:
                self._answer(viewer, request)
        except ConnectionClosed:
            pass  # it left without a word
        finally:
            with self._lock:
                self._viewers.discard(viewer)
            viewer.finish()

    def _answer(self, viewer: "_Viewer", request: str | bytes) -> None:
        """Do what a viewer asks for; what is not understood is answered by a status, and does nothing."""
        try:
            asked = json.loads(request) if isinstance(request, str) else {}
            match asked:
                case {"op": "subscribe", "subscriptions": [*subscriptions]}:
                    for part in subscriptions:
                        self._subscribe(viewer, int(part["id"]), int(part["channelId"]))
                case {"op": "unsubscribe", "subscriptionIds": [*numbers]}:
                    for number in numbers:
                        viewer.unsubscribe(int(number))
                case _:
                    raise ValueError("this server takes subscribe and unsubscribe alone")
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as exc:
            viewer.write({"op": "status", "level": WARNING, "message": f"cairn: {str(exc)[:200]}"})

    def _subscribe(self, viewer: "_Viewer", number: int, channel: int) -> None:
        with self._lock:
            message = self._latest.get(channel)
            if message is None:
                raise ValueError(f"there is no channel {channel}")
            viewer.subscribe(number, channel)
            viewer.offer(channel, message)


class _Viewer:
    """One connection: what waits to be written to it, and its subscriptions."""

    def __init__(self, connection: ServerConnection) -> None:
        # A viewer that takes nothing for so long is gone: else its thread would wait for it without an end.
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, SEND_TIME)
        self._connection = connection
        self._has_news = threading.Condition()
        self._texts: list[str] = []
        self._messages: dict[int, MapMessage] = {}
        """The newest message of each channel, until it is written."""
        self._numbers: dict[int, int] = {}
        """Number of the subscription by channel."""
        self._is_stopped = False
        self._writer = threading.Thread(target=self._write_all, name="foxglove-viewer", daemon=True)

    def write(self, text: dict[str, Any]) -> None:
        """Add a text to what is to be written; a viewer that lets too many of them wait is sent away."""
        with self._has_news:
            self._texts.append(json.dumps(text))
            if len(self._texts) > TEXTS_MAX:
                self._texts.clear()
                self._messages.clear()
                self._is_stopped = True
            self._has_news.notify()

    def offer(self, channel: int, message: MapMessage) -> None:
        """Add a message, in the place of one of its channel that still waits, if the channel is subscribed to."""
        with self._has_news:
            if channel in self._numbers:
                self._messages.pop(channel, None)
                self._messages[channel] = message
                self._has_news.notify()

    def subscribe(self, number: int, channel: int) -> None:
        """Begin a subscription.

        Raises:
            ValueError: its number is used, or no number of 32 bits, or there are too many.
        """
        with self._has_news:
            if not 0 <= number < 1 << 32 or number in self._numbers.values() or channel in self._numbers:
                raise ValueError(f"subscription {number} of channel {channel} is there, or not possible")
            if len(self._numbers) >= SUBSCRIPTIONS_MAX:
                raise ValueError(f"there are {SUBSCRIPTIONS_MAX} subscriptions")
            self._numbers[channel] = number

    def unsubscribe(self, number: int) -> None:
        """End a subscription; one that is not there has ended."""
        with self._has_news:
            for channel in [channel for channel, known in self._numbers.items() if known == number]:
                del self._numbers[channel]
                self._messages.pop(channel, None)

    def start(self) -> None:
        """Begin to write."""
        self._writer.start()

    def stop(self) -> None:
        """Begin to end the connection: nothing is written after what waits."""
        with self._has_news:
            self._is_stopped = True
            self._has_news.notify()

    def finish(self) -> None:
        """End the connection, once all that waits is written, or is not taken."""
        self.stop()
        self._writer.join()

    def _write_all(self) -> None:
        """Write what waits, until the connection ends."""
        try:
            while (frame := self._next()) is not None:
                self._connection.send(frame)
            self._connection.close()
        except (ConnectionClosed, OSError):
            log.debug("a viewer left")

    def _next(self) -> str | bytes | None:
        """The next text, else the next message; None: nothing comes any more."""
        with self._has_news:
            self._has_news.wait_for(lambda: self._is_stopped or self._texts or self._messages)
            if self._texts:
                return self._texts.pop(0)
            if not self._messages:
                return None
            channel = next(iter(self._messages))
            message = self._messages.pop(channel)
            return MESSAGE_DATA.pack(1, self._numbers[channel], message.time_ns) + message.data


def _listening(handler: Any, host: str, port: int, origins: Sequence[str]) -> Server:
    try:
        return serve(
            handler,
            host,
            port,
            family=socket.AF_INET6 if ":" in host else socket.AF_INET,
            origins=[*ORIGINS, *map(Origin, origins)],
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            compression=None,  # a cloud of megabytes would take longer to pack than to send
            max_size=REQUEST_BYTES_MAX,
            logger=_silence(),
        )
    except (OSError, OverflowError) as exc:
        said = exc.strerror if isinstance(exc, OSError) and exc.strerror else str(exc)
        raise BadInputError(
            "bad_address",
            f"cannot listen on {_shown_address(host, port)}: {said}; give another port, or 0 for any that is free",
        ) from exc


def _shown_address(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _silence() -> logging.Logger:
    """A logger of its own that says nothing: on an operator's terminal only the command's lines stand."""
    logger = logging.Logger("foxglove")
    logger.addHandler(logging.NullHandler())
    return logger


def _advertisement(messages: dict[int, MapMessage]) -> dict[str, Any]:
    channels = [
        {
            "id": channel,
            "topic": message.topic,
            "encoding": "cdr",
            "schemaName": message.type_name,
            "schema": definition_of(message.type_name),
            "schemaEncoding": "ros2msg",
        }
        for channel, message in messages.items()
    ]
    return {"op": "advertise", "channels": channels}
