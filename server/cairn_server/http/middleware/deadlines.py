"""Deadlines of connections: for a request's head, for its body, and for taking the answer.

uvicorn waits for ever for a head or a body that comes a byte a minute, so a few thousand such connections would leave
no place for robots. Here a head has a fixed time, and a body and an answer have some seconds and then a lowest rate. A
slow radio link is served; one that dribbles is cut, and its robot asks again.

    accepted -- head_s --> head -- body_grace_s + bytes / body_bytes_per_s --> body --> handled --> answer, as a body

Delays by the server itself (it reads no faster than it works) do not count against the client. What is read in one go
is parsed in one go, so nothing that costs much for each byte may be in it: no body in chunks, which may have a byte
each, and few frames from who listens at a WebSocket. The classes here rest
on private parts of uvicorn: docs/decisions/012-private-hooks.md has the versions, the reasons, and how to upgrade.
"""

import asyncio
import json
import logging
from typing import Any, Literal

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from cairn_map.errors import BadInputError
from cairn_map.wire.messages import Problem
from cairn_server.access.connection_places import ConnectionPlace, ConnectionPlaces
from cairn_server.settings import Settings

log = logging.getLogger(__name__)

TICK_S = 1.0
"""Time between two looks at a connection."""
JOINED_BYTES_MAX = 1 << 14
HEARD_BYTES, HEARD_BYTES_PER_S = 1 << 13, 1 << 10
"""Bytes that a listener at a WebSocket may send at once, and for each second: answers to pings, and little else."""
HEAD_BYTES_MAX = 1 << 14
"""Longest head of a request: 12 000 short lines take 24 ms to parse."""
STOP_S = 4.0
"""Time in which a body must be whole once the server stops."""
PLACE = "place"
"""Name of a connection's place in the state of its requests; it has none if it is a proxy's."""
Stage = Literal["head", "body", "answer"]


class _Joined:
    """Transport that sends all that is written in one turn of the event loop at once: an answer's head and its body.

    That saves a system call, and wakes the client once; for a small answer it is a tenth of the cost.
    """

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._loop = loop
        self._parts: list[bytes] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send data at the end of this turn, or at once if it is so large that copying it would cost more."""
        if len(data) > JOINED_BYTES_MAX:
            self._flush()
            self._transport.write(data)
        elif data:
            if not self._parts:
                self._loop.call_soon(self._flush)
            self._parts.append(data)

    def get_write_buffer_size(self) -> int:
        """Bytes that wait to be sent; none of a connection that is lost."""
        try:
            waiting = self._transport.get_write_buffer_size()
        except AttributeError:  # a TLS transport that was lost knows no protocol any more
            return 0
        return waiting + sum(map(len, self._parts))

    def close(self) -> None:
        """Send all that was written, and close."""
        self._flush()
        self._transport.close()

    def _flush(self) -> None:
        parts, self._parts = self._parts, []
        if parts and not self._transport.is_closing():
            self._transport.write(b"".join(parts))


class _SizedBodies(h11.Connection):
    """Parser that refuses a body without `Content-Length` at its head."""

    is_unsized = False

    def next_event(self) -> Any:
        """Next part of a request.

        Raises:
            h11.RemoteProtocolError: the body comes in chunks, or the request is none.
        """
        event = super().next_event()
        if isinstance(event, h11.Request) and any(name == b"transfer-encoding" for name, _ in event.headers):
            self.is_unsized = True
            raise h11.RemoteProtocolError("a body without Content-Length")
        return event


class PunctualProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 connection, aborted when the client takes too long."""

    conn: _SizedBodies

    settings = Settings()
    places = ConnectionPlaces(2)
    _place: ConnectionPlace | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a place for a new connection, and begin."""
        self.begin(transport, self.places.enter(address_of(transport), transport.abort))

    def begin(self, transport: asyncio.Transport, place: ConnectionPlace | None) -> None:
        """Start the clock of a new connection, which has a place or is a trusted proxy's."""
        self._place = place
        self.conn = _SizedBodies(h11.SERVER, HEAD_BYTES_MAX)
        # Requests find it in their state: a good token makes the connection its own.
        self.app_state = {**self.app_state, PLACE: place}
        super().connection_made(_Joined(transport, self.loop))  # type: ignore[arg-type]
        self._stage: tuple[Stage, RequestResponseCycle | None] = ("head", None)
        self._since_s = self._seen_s = self.loop.time()
        self._got_bytes = 0
        self._unsent: tuple[float, int] | None = None
        self._tick_s = min(TICK_S, self.settings.head_s / 4)
        self._timer = self.loop.call_later(self._tick_s, self._look)

    def data_received(self, data: bytes) -> None:
        """Count the bytes, which extend the deadline of a body; refuse a head that is too long, before it is parsed."""
        self._got_bytes += len(data)
        if self.conn.their_state is h11.IDLE and len(data) > HEAD_BYTES_MAX:
            head_end = (self.conn.trailing_data[0] + data).find(b"\r\n\r\n")
            if not 0 <= head_end <= HEAD_BYTES_MAX:
                error = BadInputError("too_large", f"the head of a request has at most {HEAD_BYTES_MAX} bytes")
                self._refuse(413, b"Content Too Large", error)
                return
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clock, and give the place back."""
        self._timer.cancel()
        if self._place is not None:
            self.places.leave(self._place)
        super().connection_lost(exc)

    def shutdown(self) -> None:
        """Finish when the server stops; a body that is on its way then has only so much time left."""
        super().shutdown()
        self.loop.call_later(STOP_S, self._cut_body)

    def _cut_body(self) -> None:
        if self._stage_now()[0] == "body":
            self.transport.abort()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no request, or has a body of unknown length, and close; what was read of it is dropped."""
        if self.conn.is_unsized:
            error = BadInputError("no_length", "send a body with Content-Length, not in chunks")
            self._refuse(411, b"Length Required", error)
        else:
            super().send_400_response(msg)

    def _refuse(self, status: int, reason: bytes, error: BadInputError) -> None:
        problem = Problem(title=error.kind.replace("_", " "), status=status, detail=error.message, kind=error.kind)
        body = json.dumps(problem.model_dump()).encode()
        length = b"content-length", str(len(body)).encode()
        headers = [(b"content-type", b"application/problem+json"), (b"connection", b"close"), length]
        for event in (
            h11.Response(status_code=status, headers=headers, reason=reason),
            h11.Data(data=body),
            h11.EndOfMessage(),
        ):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def handle_websocket_upgrade(self, event: object) -> None:
        """Hand the connection over: the WebSocket has pings of its own, and the place until it is closed."""
        self._timer.cancel()
        super().handle_websocket_upgrade(event)  # type: ignore[arg-type]
        self.loop.call_later(self.settings.head_s, self._cut_if_undecided)
        self._await_close()

    def _cut_if_undecided(self) -> None:
        """Abort a WebSocket that was neither accepted nor refused: what came of its handshake is not whole."""
        # A TLS transport that was lost knows no protocol any more.
        protocol = None if self.transport.is_closing() else self.transport.get_protocol()
        if isinstance(protocol, ListenerProtocol) and not protocol.handshake_complete:
            self.transport.abort()

    def _await_close(self) -> None:
        """Give the place of a WebSocket back at its end, of which uvicorn tells another protocol."""
        if self._place is None:
            return
        if self.transport.is_closing():
            self.places.leave(self._place)
        else:
            self.loop.call_later(self._tick_s, self._await_close)

    def _look(self) -> None:
        """Abort the connection if its time is over, else look again later."""
        now_s = self.loop.time()
        stage = self._stage_now()
        unsent_bytes = self.transport.get_write_buffer_size()
        if stage != self._stage:
            self._stage, self._since_s, self._got_bytes = stage, self._seen_s, 0
        elif unsent_bytes or self.flow.read_paused:
            # The client waits for the server: time that is not the client's moves the start of the stage along.
            self._since_s += now_s - self._seen_s
        self._seen_s = now_s
        if self._is_late(now_s) or self._is_stuck(now_s, unsent_bytes):
            log.info("%s: cut, the %s takes too long", self.client, stage[0])
            self.transport.abort()
            return
        self._timer = self.loop.call_later(self._tick_s, self._look)

    def _stage_now(self) -> tuple[Stage, RequestResponseCycle | None]:
        if self.cycle is None or self.cycle.response_complete:
            return "head", self.cycle
        return "body" if self.cycle.more_body else "answer", self.cycle

    def _is_late(self, now_s: float) -> bool:
        took_s = now_s - self._since_s
        if self._stage[0] == "head":
            return took_s > self.settings.head_s
        return self._stage[0] == "body" and took_s > self._patience_s(self._got_bytes)

    def _is_stuck(self, now_s: float, unsent_bytes: int) -> bool:
        """True if the client does not take its answer."""
        if not unsent_bytes:
            self._unsent = None
            return False
        # The largest backlog counts: a link that keeps the lowest rate drains it within this patience.
        since_s, most_bytes = self._unsent or (now_s, 0)
        self._unsent = since_s, max(most_bytes, unsent_bytes)
        return now_s - since_s > self._patience_s(self._unsent[1])

    def _patience_s(self, size_bytes: int) -> float:
        return self.settings.body_grace_s + size_bytes / self.settings.body_bytes_per_s


class ListenerProtocol(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, aborted when the client sends more than a listener has to say.

    An empty frame of six bytes takes 10 us to parse: 6 MB a second of them, and no other client is answered.
    """

    _may_send_bytes: float = HEARD_BYTES
    _seen_s = 0.0

    def data_received(self, data: bytes) -> None:
        """Parse what came, or cut the link."""
        # uvicorn hands the request on as the first data: it was parsed before, and is not counted.
        if self._seen_s:
            now_s = self.loop.time()
            grown = self._may_send_bytes + HEARD_BYTES_PER_S * (now_s - self._seen_s)
            self._may_send_bytes, self._seen_s = min(grown, HEARD_BYTES) - len(data), now_s
            if self._may_send_bytes < 0:
                log.info("%s: cut, a listener sends too much", self.client)
                self.transport.abort()
                return
        self._seen_s = self._seen_s or self.loop.time()
        super().data_received(data)

    def send_receive_event_to_app(self) -> None:
        """Cut a link whose text is none: uvicorn would write a traceback for each."""
        try:
            if self.curr_msg_data_type == "text":
                b"".join(self.frames).decode()
        except UnicodeDecodeError:
            log.info("%s: cut, a listener sends a text that is not UTF-8", self.client)
            self.transport.abort()
            return
        super().send_receive_event_to_app()


def protocol_of(settings: Settings, places: ConnectionPlaces) -> type[PunctualProtocol]:
    """Protocol class with these settings: uvicorn makes an instance of it for each connection, without arguments."""
    return type("PunctualProtocol", (PunctualProtocol,), {"settings": settings, "places": places})


def address_of(transport: asyncio.BaseTransport) -> str:
    """Address at the other end."""
    peer = transport.get_extra_info("peername")
    return str(peer[0]) if peer else ""
