"""A bound on request bodies, before anything reads them whole (plain ASGI, no framework)."""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from cairn_map.commit import COMMIT_BYTES_MAX
from cairn_map.messages import Problem

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

JSON_BYTES_MAX = 8 << 20


class _TooLargeError(Exception):
    pass


class BodyLimit:
    """Answers 413 to a body that claims to be, or grows, larger than its path allows."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = COMMIT_BYTES_MAX if "/commits/" in scope["path"] else JSON_BYTES_MAX
        claimed = dict(scope["headers"]).get(b"content-length", b"0")
        if not claimed.isdigit() or len(claimed) > 18 or int(claimed) > limit:
            await _refuse(send, limit)
            return
        got = 0
        started = False

        async def counted() -> Message:
            nonlocal got
            message = await receive()
            got += len(message.get("body", b""))
            if got > limit:
                raise _TooLargeError
            return message

        async def noted(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self._app(scope, counted, noted)
        except _TooLargeError:
            if not started:
                await _refuse(send, limit)


async def _refuse(send: Send, limit: int) -> None:
    problem = Problem(title="too large", status=413, detail=f"a body has at most {limit} bytes here", kind="too_large")
    headers = [(b"content-type", b"application/problem+json"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": 413, "headers": headers})
    await send({"type": "http.response.body", "body": problem.model_dump_json().encode()})
