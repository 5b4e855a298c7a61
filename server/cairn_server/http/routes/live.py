"""Live streams: Server-Sent Events for programs, a WebSocket for browsers.

A stream waits until its listener is woken, takes the events that there are, sends them, and pauses a moment, so that
events of that moment go out together. `send` waits while the client does not read; only the listener holds events back.
"""

import asyncio
import hashlib
import logging
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import APIRouter, Header, Query, Response, WebSocket, WebSocketDisconnect
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from fastapi.security import HTTPAuthorizationCredentials
from starlette.types import Receive, Scope, Send

from cairn_map.errors import BadInputError, CairnError, DeniedError, NotFoundError
from cairn_map.wire.live_events import Beat, EventPosition, LiveEvent, position_from_text
from cairn_server.access.auth import READING, require
from cairn_server.http.middleware.token_first import offered_token
from cairn_server.http.routes.callers import READERS, Asker, Asking, Map, asker_for
from cairn_server.http.routes.documentation import answers, problems
from cairn_server.http.routes.problems import answer_to
from cairn_server.live.hub import Listener
from cairn_server.store.store_rows import MapRow

log = logging.getLogger(__name__)

SPACING_S = 0.1
"""Shortest time between two sendings of one stream."""
RETRY_MS = 2000
PROTOCOL = "cairn.live.v1"
GOING_AWAY, NOT_ALLOWED = 1001, 4401
"""Codes with which a WebSocket is closed: the server stops; the token does not allow reading any more."""
After = Annotated[str | None, Query(description="id of the last event seen")]

router = APIRouter()


class _Stream:
    """Listener of one client in the event loop, where other threads wake it."""

    def __init__(self, asker: Asker, row: MapRow) -> None:
        self._asker = asker  # asked again with each beat: the token may have ended
        self._row = row
        self._loop = asyncio.get_running_loop()
        self._woken = asyncio.Event()
        self._listener: Listener | None = None

    async def join(self, after: EventPosition | None) -> None:
        """Begin to listen, after a position or from now on."""
        shown = self._asker.credentials.credentials if self._asker.credentials else ""
        token = hashlib.sha256(shown.encode(errors="replace")).digest()
        self._listener = await run_in_threadpool(
            lambda: self._asker.service.live.join(self._row, token, self._wake, after=after)
        )

    async def pump(self, send: Callable[[LiveEvent], Awaitable[None]]) -> int:
        """Send events until the server stops or the token ends; returns the code to close with."""
        listener = self._listener
        assert listener is not None, "join first"  # noqa: S101 - by its callers
        beat_at_s = time.monotonic() + listener.beat_s
        while not listener.is_over:
            # Cleared before events are taken: one that comes in between wakes the stream again.
            self._woken.clear()
            if events := listener.take():
                for event in events:
                    await send(event)
                await asyncio.sleep(SPACING_S)
            # Sleep until there is something new or a beat is due; with each beat the token is checked again.
            await self._wait(beat_at_s - time.monotonic())
            if time.monotonic() >= beat_at_s:
                if not await run_in_threadpool(self._may_listen):
                    return NOT_ALLOWED
                await send(listener.beat())
                beat_at_s = time.monotonic() + listener.beat_s
            elif not (listener.is_behind or listener.is_over):
                # A robot pushed: its commit is folded in a moment, and that event goes out with this one.
                self._woken.clear()
                await self._wait(SPACING_S)
        return GOING_AWAY

    async def _wait(self, seconds: float) -> None:
        """Return when woken, or after so long."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._woken.wait(), max(0.0, seconds))

    def leave(self) -> None:
        """Stop listening."""
        if self._listener is not None:
            self._listener.leave()

    def _may_listen(self) -> bool:
        """True if the token still allows reading, or if that cannot be found out."""
        try:
            require(self._asker.caller(self._row), *READING)
        except (DeniedError, NotFoundError):  # the token ended, perhaps with its map
            return False
        except CairnError as exc:  # an unreadable store is no reason to cut a listener off
            log.warning("cannot look a listener's token up: %s", exc.message)
        return True

    def _wake(self) -> None:
        if self._woken.is_set():  # `pump` clears it before it takes events
            return
        with suppress(RuntimeError):  # the loop is closed, and the stream with it
            self._loop.call_soon_threadsafe(self._woken.set)


class ServerSentEvents(StreamingResponse):
    """Events in the format of Server-Sent Events (HTML, section 9.2)."""

    def __init__(self, stream: _Stream) -> None:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(iter(()), media_type="text/event-stream", headers=headers)
        self._stream = stream

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, and stop listening however the answer ends."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._stream.leave()

    async def stream_response(self, send: Send) -> None:
        """Send until the stream ends; Starlette cancels this when the client is gone."""

        async def send_text(text: str) -> None:
            await send({"type": "http.response.body", "body": text.encode(), "more_body": True})

        await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
        await send_text(f"retry: {RETRY_MS}\n\n")
        await self._stream.pump(lambda event: send_text(_as_text(event)))
        await send({"type": "http.response.body", "body": b"", "more_body": False})


@router.get(
    "/maps/{name}/events",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: ("text/event-stream",)}) | problems(429),
)
async def events(
    asker: Asking,
    row: Map,
    after: After = None,
    last_event_id: Annotated[str | None, Header()] = None,
) -> Response:
    """Live changes as Server-Sent Events; `Last-Event-ID`, or `after`, goes on from there."""
    stream = _Stream(asker, row)
    await stream.join(position_from_text(last_event_id or after or ""))
    return ServerSentEvents(stream)


@router.get("/maps/{name}/live", dependencies=READERS, status_code=101, responses=answers({101: ()}) | problems(426))
def live_without_upgrade() -> None:
    """Live changes by WebSocket (RFC 6455): ask for `Upgrade: websocket`."""
    raise BadInputError("upgrade_required", "this is a WebSocket; for plain HTTP there is .../events")


@router.websocket("/maps/{name}/live")
async def live(socket: WebSocket, name: str, after: After = None) -> None:
    """The same events as JSON texts."""
    try:
        _check_origin(socket)
        asker = asker_for(socket, _credentials(socket))
        row = await run_in_threadpool(asker.reader, name)
        stream = _Stream(asker, row)
        await stream.join(position_from_text(after or ""))
    except CairnError as exc:
        await socket.send_denial_response(answer_to(exc))
        return
    try:
        await socket.accept(subprotocol=PROTOCOL if PROTOCOL in socket.scope["subprotocols"] else None)
        await _converse(socket, stream)
    finally:
        stream.leave()


async def _converse(socket: WebSocket, stream: _Stream) -> None:
    """Send events until one side ends the conversation."""
    pumping = asyncio.create_task(stream.pump(lambda event: socket.send_text(event.model_dump_json())))
    leaving = asyncio.create_task(_until_left(socket))
    try:
        await asyncio.wait({pumping, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if pumping.done() and not pumping.cancelled() and pumping.exception() is None:
            with suppress(RuntimeError, WebSocketDisconnect):
                await socket.close(pumping.result())
    finally:
        for task in (pumping, leaving):
            task.cancel()
        await asyncio.gather(pumping, leaving, return_exceptions=True)


async def _until_left(socket: WebSocket) -> None:
    """Read until the client is gone; whatever it sends is ignored."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


def _credentials(socket: WebSocket) -> HTTPAuthorizationCredentials | None:
    """Token of the header or, since browsers cannot set one, of a subprotocol `cairn.token.BASE64URL`."""
    scheme, _, token = socket.headers.get("Authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return HTTPAuthorizationCredentials(scheme=scheme, credentials=token)
    offered = offered_token(socket.scope["subprotocols"])
    return None if offered is None else HTTPAuthorizationCredentials(scheme="Bearer", credentials=offered)


def _check_origin(socket: WebSocket) -> None:
    """Refuse pages of other sites: for WebSockets browsers ask no permission first, as they do for other requests.

    Raises:
        DeniedError: kind `foreign_origin`.
    """
    for origin in socket.headers.getlist("Origin"):
        if not origin.isascii() or _host_of(origin) != socket.headers.get("Host"):
            raise DeniedError("foreign_origin", "a page of another site asks; only this server's own pages may listen")


def _host_of(origin: str) -> str | None:
    """Host and port of an origin; None if it is none."""
    try:
        return urlsplit(origin).netloc or None
    except ValueError:
        return None


def _as_text(event: LiveEvent) -> str:
    """Text of one event; only the last event of a step moves the id that a browser returns after a cut."""
    id_line = "" if isinstance(event, Beat) or event.type in ("cells", "marks", "log") else f"id: {event.id}\n"
    return f"{id_line}event: {event.type}\ndata: {event.model_dump_json(exclude={'type'})}\n\n"
