"""Turns of requests at the server's threads, taken before a thread is: no caller keeps the others from being served.

Each kind of work has a lane with places of its own, and each caller a share of them (`access.turns`); all lanes
together have fewer places than there are threads, so none waits in a thread for another. A turn begins once a request
is whole, and ends with the first byte of its answer: slow links hold none. Work that may take long ends with its
connection (`access.cancellation`). Plain ASGI.

    missing 8, pictures 2, exports 2, searches 2, files of cells 1, all others 24  <  40 threads (anyio's default)
"""

import asyncio
import re
from collections.abc import Hashable, MutableMapping
from dataclasses import dataclass, field
from typing import Any

from cairn_map.errors import UnreachableError
from cairn_server.access.cancellation import CANCELLATION, Cancellation, StopTime
from cairn_server.access.turns import Turns
from cairn_server.http.middleware.asgi import App, Message, Receive, Send, send_error
from cairn_server.http.middleware.token_first import caller_key
from cairn_server.views.map_changes import SEARCHES_AT_ONCE
from cairn_server.views.map_exports import COUNTS_AT_ONCE
from cairn_server.views.map_views import RENDERS_AT_ONCE

WITHOUT_BODY = frozenset({"GET", "HEAD", "DELETE", "OPTIONS"})
FREE = frozenset({"/healthz"})
"""Paths that take no turn: they need no thread."""
WAIT_S = 30.0
PICTURE_WAIT_S = 5.0
MISSING = re.compile(r"/maps/[^/]*/branches/[^/]*/missing")
PICTURES = re.compile(r"/maps/[^/]*/main/render")
SEARCHES = re.compile(r"/maps/[^/]*/main/(changes|hottest|hotspots)")
CELL_FILES = re.compile(r"/maps/[^/]*/main/cells/[^/]*\.(npz|ply)")
EXPORTS = re.compile(r"/maps/[^/]*/main/export(/tickets)?")


@dataclass(slots=True)
class Lane:
    """Turns that requests of one kind share."""

    turns: Turns
    is_long: bool = True
    """True if the work looks for its cancellation: then the connection is watched meanwhile."""


class Lanes:
    """Lanes of a server, by path."""

    def __init__(self) -> None:
        self._by_path = {
            MISSING: Lane(Turns(places=8, share=1, wait_s=WAIT_S)),
            PICTURES: Lane(Turns(places=RENDERS_AT_ONCE, share=1, wait_s=PICTURE_WAIT_S)),
            SEARCHES: Lane(Turns(places=SEARCHES_AT_ONCE, share=1, wait_s=PICTURE_WAIT_S)),
            CELL_FILES: Lane(Turns(places=1, share=1, wait_s=PICTURE_WAIT_S)),
            EXPORTS: Lane(Turns(places=COUNTS_AT_ONCE, share=1, wait_s=PICTURE_WAIT_S)),
        }
        self._rest = Lane(Turns(places=24, share=8, wait_s=WAIT_S), is_long=False)

    def close(self) -> None:
        """Refuse requests that wait; to be called when the server stops."""
        for lane in (*self._by_path.values(), self._rest):
            lane.turns.close()

    def of(self, path: str) -> Lane:
        """Lane of the requests of a path."""
        return next((lane for pattern, lane in self._by_path.items() if pattern.fullmatch(path)), self._rest)


@dataclass(slots=True)
class _Visit:
    """One request in its lane."""

    lane: Lane
    caller: Hashable
    cancellation: Cancellation
    asgi_receive: Receive
    asgi_send: Send
    has_turn: bool = False
    had_turn: bool = False
    watch: "asyncio.Task[None] | None" = field(default=None)

    async def begin(self) -> None:
        """Take the turn, once.

        Raises:
            UnreachableError: kind `busy`.
        """
        if self.had_turn:
            return
        self.had_turn = True
        if self.lane.is_long:
            self.watch = asyncio.create_task(self._watch())
        await self.lane.turns.take(self.caller)
        self.has_turn = True

    def end(self) -> None:
        """Give the turn back; may be called twice."""
        if self.watch is not None:
            self.watch.cancel()
            self.watch = None
        if self.has_turn:
            self.has_turn = False
            self.lane.turns.give_back(self.caller)

    async def receive(self) -> Message:
        """The next part of the request; with the last one its turn begins."""
        message = await self.asgi_receive()
        if message["type"] == "http.request" and not message.get("more_body", False):
            await self.begin()
        return message

    async def send(self, message: Message) -> None:
        """Pass a part of the answer on; with the first one the turn ends."""
        if message["type"] == "http.response.start":
            self.end()
        await self.asgi_send(message)

    async def _watch(self) -> None:
        """Cancel the work when the connection is lost."""
        while (await self.asgi_receive())["type"] != "http.disconnect":
            pass
        self.cancellation.cancel()


class WorkTurns:
    """Middleware that lets each request work in its turn, and answers 503 `busy` to one that waits too long."""

    def __init__(self, app: App, *, lanes: Lanes, stop: StopTime) -> None:
        self._app = app
        self._stop = stop
        self._lanes = lanes

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on in its turn."""
        if scope["type"] != "http" or scope["path"] in FREE:
            await self._app(scope, receive, send)
            return
        visit = _Visit(self._lanes.of(scope["path"]), caller_key(scope), Cancellation(self._stop), receive, send)
        reset = CANCELLATION.set(visit.cancellation)
        try:
            if scope["method"] in WITHOUT_BODY:
                await visit.begin()
            await self._app(scope, visit.receive, visit.send)
        except UnreachableError as exc:  # of `begin`: the app turns errors of its own into answers
            await send_error(send, 503, exc)
        finally:
            visit.end()
            CANCELLATION.reset(reset)
