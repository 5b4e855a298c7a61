"""HTTP server of an MJPEG stream, which any browser shows.

    GET /              a page with the stream in it
    GET /stream.mjpg   multipart/x-mixed-replace: each picture as it comes; a slow client misses some
    GET /view.jpg      the last picture

It listens on loopback unless another host is given. There is no access control: beyond loopback every client that
reaches the port sees the pictures. Starlette and uvicorn come with the extra `[server]`.
"""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from cairn_fusion.view.mjpeg import BOUNDARY, Latest
from cairn_map.errors import BadInputError

CLIENTS_MAX = 8
"""Streams at the same time; further clients get 503."""
CONNECTIONS_MAX = 32
"""Connections at the same time; further ones are closed unread."""
TIMEOUT_S = 10.0
"""Time for a client to send its request, and to acknowledge what it was sent."""
PAGE = b"""<!doctype html><html lang="en"><meta charset="utf-8"><title>cairn telepresence</title>
<style>html,body{margin:0;height:100%;background:#18191c}img{display:block;width:100%;height:100%;object-fit:contain}</style>
<img src="/stream.mjpg" alt="live view of the robot"></html>
"""


@contextmanager
def stream_pictures(
    latest: Latest, *, host: str = "127.0.0.1", port: int = 0, clients_max: int = CLIENTS_MAX
) -> Iterator[str]:
    """Serve a stream of pictures while the context is open; gives its address.

    Args:
        latest: source of the pictures; closed at the end.
        host: to listen on.
        port: 0 for any that is free.
        clients_max: streams at the same time.

    Raises:
        BadInputError: the address cannot be listened on.
    """
    with _listening(host, port) as listener:
        # An operator's terminal shows the command's own lines, so nothing is logged. One request a connection: none
        # waits in silence for the next.
        config = uvicorn.Config(
            _app(latest, clients_max),
            http=_BoundedConnection,
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            headers=[("Connection", "close")],
            timeout_graceful_shutdown=1,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listener],), name="mjpeg", daemon=True)
        thread.start()
        try:
            yield f"http://{host}:{listener.getsockname()[1]}/"
        finally:
            latest.close()
            server.should_exit = True
            thread.join()


def _app(latest: Latest, clients_max: int) -> Starlette:
    streams = threading.BoundedSemaphore(clients_max)
    fresh = {"Cache-Control": "no-store"}

    def answer(request: Request) -> Response:
        match request.path_params["path"]:
            case "":
                return Response(PAGE, media_type="text/html", headers=fresh)
            case "view.jpg" if latest.jpeg:
                return Response(latest.jpeg, media_type="image/jpeg", headers=fresh)
            case "view.jpg":
                return PlainTextResponse("no picture yet", 503)
            case "stream.mjpg" if streams.acquire(blocking=False):
                return _Stream(latest, streams)
            case "stream.mjpg":
                return PlainTextResponse("too many clients are connected; come later", 503)
            case _:
                return PlainTextResponse("there are /, /stream.mjpg and /view.jpg", 404)

    return Starlette(routes=[Route("/{path:path}", answer, methods=["GET"])])


class _Stream(StreamingResponse):
    """Stream that releases its place when it ends, whichever side ended it."""

    def __init__(self, latest: Latest, places: threading.Semaphore) -> None:
        kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
        super().__init__(latest.parts(), media_type=kind, headers={"Cache-Control": "no-store"})
        self._places = places

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._places.release()


class _BoundedConnection(H11Protocol):
    """Connection that is closed if there are too many, or if it has sent no request after `TIMEOUT_S`."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock."""
        super().connection_made(transport)
        self.loop.call_later(TIMEOUT_S, lambda: None if self.cycle else transport.abort())
        if len(self.connections) > CONNECTIONS_MAX:
            transport.abort()


@contextmanager
def _listening(host: str, port: int) -> Iterator[socket.socket]:
    """A listening socket; a connection of it ends when its client acknowledges nothing for `TIMEOUT_S`.

    Raises:
        BadInputError: kind `bad_address`.
    """
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # uvicorn waits for ever for a client that does not read; the kernel does not.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * TIMEOUT_S))
        try:
            listener.bind((host, port))
        except OSError as exc:
            raise BadInputError(
                "bad_address", f"cannot listen on {host}:{port}: {exc.strerror or exc}; choose another"
            ) from exc
        listener.listen(CONNECTIONS_MAX)
        yield listener
