"""The beginning of a TLS connection: it takes its place when it is accepted, not after its handshake.

asyncio's own servers tell a protocol of a connection only when the handshake is done: a thousand silent connections
would be open before one is counted. Here they are accepted in the clear, counted, and then upgraded
(`loop.start_tls`), within the time that a head has.
"""

import asyncio
import logging
import ssl
from collections.abc import Callable
from typing import Any

from cairn_server.access.connection_places import ConnectionPlace, ConnectionPlaces
from cairn_server.access.server_certificate import ServerCertificate
from cairn_server.http.middleware.deadlines import PunctualProtocol, address_of

log = logging.getLogger(__name__)


class SecureStart(asyncio.Protocol):
    """Connection until its handshake is done; then `PunctualProtocol` has it."""

    def __init__(
        self, protocol: PunctualProtocol, context: ssl.SSLContext, places: ConnectionPlaces, handshake_s: float
    ) -> None:
        self._protocol = protocol
        self._context = context
        self._places = places
        self._handshake_s = handshake_s
        self._place: ConnectionPlace | None = None
        self._early: list[bytes] = []
        self._is_lost = False
        self._task: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take a place and begin the handshake."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - of TCP
        transport.pause_reading()  # until the upgrade reads

        def cut() -> None:
            # A handshake that has not begun must not begin: the loss of its connection was reported already, so it
            # would hold its buffer of 256 kB until its time is over.
            if self._task is not None:
                self._task.cancel()
            transport.abort()

        self._place = self._places.enter(address_of(transport), cut)
        if transport.is_closing():
            return  # cut at once: there are too many of its address
        self._task = asyncio.get_running_loop().create_task(self._shake_hands(transport))

    def data_received(self, data: bytes) -> None:
        """Keep what comes before the protocol has the connection."""
        self._early.append(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the place back: the connection is lost before its first request."""
        self._is_lost = True
        if self._place is not None:
            self._places.leave(self._place)

    async def _shake_hands(self, transport: asyncio.Transport) -> None:
        loop = asyncio.get_running_loop()
        try:
            secured = await loop.start_tls(
                transport, self, self._context, server_side=True, ssl_handshake_timeout=self._handshake_s
            )
        except (OSError, asyncio.CancelledError) as exc:  # ssl.SSLError, TimeoutError, and what ends a connection
            log.debug("no handshake: %s", exc)
            _forget_frames(exc)
            secured = None
        if secured is None or self._is_lost:
            self.connection_lost(None)
            transport.abort()
            return
        secured.set_protocol(self._protocol)
        self._protocol.begin(secured, self._place)
        if self._early:
            self._protocol.data_received(b"".join(self._early))


def _forget_frames(exc: BaseException) -> None:
    """Let go of the frames of an error: one of them holds the error itself, and a buffer of 256 kB.

    Such a circle stays until the garbage is collected, which counts objects, not bytes: 6000 handshakes that strangers
    broke off took 1.5 GB.
    """
    found: BaseException | None = exc
    while found is not None:
        found.__traceback__ = None
        found = found.__cause__ or found.__context__


def secured(
    protocol: Callable[..., PunctualProtocol],
    certificate: ServerCertificate,
    places: ConnectionPlaces,
    handshake_s: float,
) -> Callable[..., SecureStart]:
    """Factory of connections that begin with a handshake, with the arguments that uvicorn gives.

    Each shows the certificate of its moment.
    """

    def make(**arguments: Any) -> SecureStart:
        return SecureStart(protocol(**arguments), certificate.context, places, handshake_s)

    return make
