"""How long a connection may take to say what it wants, and to take what it asked for.

uvicorn waits for ever for a head or a body that comes a byte a minute, so a few thousand such connections would take
the place of all robots. Here each has its time: a head a fixed one, a body some seconds and then a least rate, an
answer the same. A slow radio link is served, a dribbling one is cut; a robot then simply asks again.

    accepted -- head_s --> head -- body_grace_s + bytes / body_bytes_per_s --> body --> handled --> answer, as a body

What the server itself delays (it reads no faster than it works) does not count against the other side.
"""

import asyncio
import logging
from typing import Any, Literal

from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from cairn_server.settings import Settings

log = logging.getLogger(__name__)

TICK_S = 1.0
"""How often a connection is looked at."""
JOINED_BYTES_MAX = 1 << 14
Stage = Literal["head", "body", "answer"]


class _Joined:
    """A transport that sends at once what is written in one turn of the event loop: an answer's head and its body.

    A system call less, and the other side is woken once; for a small answer that is a tenth of its cost.
    """

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._loop = loop
        self._parts: list[bytes] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send it soon, or at once if it is so large that copying it would cost more."""
        if len(data) > JOINED_BYTES_MAX:
            self._flush()
            self._transport.write(data)
        elif data:
            if not self._parts:
                self._loop.call_soon(self._flush)
            self._parts.append(data)

    def get_write_buffer_size(self) -> int:
        """Bytes that wait."""
        return self._transport.get_write_buffer_size() + sum(map(len, self._parts))

    def close(self) -> None:
        """Send what was written, and close."""
        self._flush()
        self._transport.close()

    def _flush(self) -> None:
        parts, self._parts = self._parts, []
        if parts and not self._transport.is_closing():
            self._transport.write(b"".join(parts))


class PunctualProtocol(H11Protocol):
    """uvicorn's connection, closed when it takes too long."""

    settings = Settings()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """The other side connected; there are only so many places to wait in."""
        super().connection_made(_Joined(transport, self.loop))  # type: ignore[arg-type]
        self._stage: tuple[Stage, RequestResponseCycle | None] = ("head", None)
        self._since_s = self._seen_s = self.loop.time()
        self._got_bytes = 0
        self._unsent: tuple[float, int] | None = None
        self._tick_s = min(TICK_S, self.settings.head_s / 4)
        self._timer = self.loop.call_later(self._tick_s, self._look)
        # Up to `limit_concurrency` are served, some more are told so (503), the rest is cut before it costs anything.
        if len(self.connections) > self.settings.limit_concurrency * 5 // 4 + 1:
            transport.abort()

    def data_received(self, data: bytes) -> None:
        """Bytes came."""
        self._got_bytes += len(data)
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is over."""
        self._timer.cancel()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: object) -> None:
        """From here on it is another protocol's, which has its own pings."""
        self._timer.cancel()
        super().handle_websocket_upgrade(event)  # type: ignore[arg-type]

    def _look(self) -> None:
        """Close it if its time is over, else look again later."""
        now_s = self.loop.time()
        stage = self._stage_now()
        unsent_bytes = self.transport.get_write_buffer_size()
        if stage != self._stage:
            self._stage, self._since_s, self._got_bytes = stage, self._seen_s, 0
        elif unsent_bytes or self.flow.read_paused:
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
        """Whether the other side does not take its answer."""
        if not unsent_bytes:
            self._unsent = None
            return False
        since_s, most_bytes = self._unsent or (now_s, 0)
        self._unsent = since_s, max(most_bytes, unsent_bytes)
        return now_s - since_s > self._patience_s(self._unsent[1])

    def _patience_s(self, size_bytes: int) -> float:
        return self.settings.body_grace_s + size_bytes / self.settings.body_bytes_per_s


def protocol_of(settings: Settings) -> type[PunctualProtocol]:
    """The protocol with these settings, as uvicorn wants it: a class."""
    return type("PunctualProtocol", (PunctualProtocol,), {"settings": settings})
