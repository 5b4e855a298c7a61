"""Bound on the size of request bodies, enforced before anything reads them whole. Plain ASGI."""

import re
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from typing import Any

from cairn_map.commits.commit import COMMIT_BYTES_MAX
from cairn_map.wire.messages import Problem
from cairn_server.live.robot_reports import VIEW_BYTES_MAX

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

MISSING_BYTES_MAX = 16 << 20
"""Room for 100 000 cells with a cursor each."""
JSON_BYTES_MAX = 1 << 20
STATUS_BYTES_MAX = 1 << 14
LIMITS = (
    (re.compile(r"/maps/[^/]*/commits/[^/]*"), COMMIT_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/main/cells/[^/]*"), COMMIT_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/branches/[^/]*/missing"), MISSING_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/branches/[^/]*/status"), STATUS_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/branches/[^/]*/view"), VIEW_BYTES_MAX),
)


class _TooLargeError(Exception):
    pass


class BodyLimit:
    """Middleware that answers 413 to a body that claims to be, or grows, larger than its path allows."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on with its body counted, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit_bytes = limit_of(scope["path"])
        claimed = dict(scope["headers"]).get(b"content-length", b"0")
        if not claimed.isdigit() or len(claimed) > 18 or int(claimed) > limit_bytes:
            await _refuse(send, limit_bytes)
            return
        got_bytes = 0
        started = False

        async def counted() -> Message:
            nonlocal got_bytes
            message = await receive()
            got_bytes += len(message.get("body", b""))
            if got_bytes > limit_bytes:
                raise _TooLargeError
            return message

        async def noted(message: Message) -> None:
            nonlocal started
            # The framework turns what is raised while it reads JSON into an answer of its own: drop that one.
            if got_bytes <= limit_bytes or started:
                started = True
                await send(message)

        with suppress(_TooLargeError):
            await self._app(scope, counted, noted)
        if got_bytes > limit_bytes and not started:
            await _refuse(send, limit_bytes)


def limit_of(path: str) -> int:
    """Largest body that a path accepts, bytes."""
    return next((size for pattern, size in LIMITS if pattern.fullmatch(path)), JSON_BYTES_MAX)


async def send_problem(send: Send, status: int, kind: str, detail: str, *, answer_to: str = "http") -> None:
    """Answer a request, or a WebSocket's handshake, with a problem, and close: the body was not read."""
    problem = Problem(title=kind.replace("_", " "), status=status, detail=detail, kind=kind)
    headers = [(b"content-type", b"application/problem+json"), (b"connection", b"close")]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    prefix = "" if answer_to == "http" else "websocket."
    await send({"type": f"{prefix}http.response.start", "status": status, "headers": headers})
    await send({"type": f"{prefix}http.response.body", "body": problem.model_dump_json().encode()})


async def _refuse(send: Send, limit_bytes: int) -> None:
    await send_problem(send, 413, "too_large", f"a body has at most {limit_bytes} bytes here")
