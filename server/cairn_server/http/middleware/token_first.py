"""Strangers' bodies are not read: a request that brings one shows a token that is known, or is refused at its head.

The framework reads and parses JSON before it asks a route who may call it; 16 MiB of it, on every connection, would be
anybody's to send. What the token is for is still checked by the routes (`http_access`). Plain ASGI but for the thread.
"""

import time
from collections.abc import MutableMapping
from typing import Any

from starlette.concurrency import run_in_threadpool

from cairn_map.errors import CairnError, DeniedError
from cairn_server.access.auth import caller_of, token_hash
from cairn_server.http.middleware.body_limit import App, Receive, Send, send_problem
from cairn_server.service import Service

WITHOUT_BODY = frozenset({"GET", "HEAD", "OPTIONS"})
KNOWN_S = 10.0
"""A token that was good is taken for good so long here, and asked for again in the route in any case."""
KNOWN_MAX = 10_000


class TokenFirst:
    """Answers 401 to whoever would send a body without a token that is known."""

    def __init__(self, app: App, *, service: Service) -> None:
        self._app = app
        self._service = service
        self._known: dict[bytes, float] = {}

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] == "http" and scope["method"] not in WITHOUT_BODY:
            refusal = await self._refusal(_token_in(scope["headers"]))
            if refusal:
                await send_problem(send, 401, refusal.kind, refusal.message)
                return
        await self._app(scope, receive, send)

    async def _refusal(self, token: str | None) -> DeniedError | None:
        key = token_hash(token or "")
        if time.monotonic() - self._known.get(key, float("-inf")) < KNOWN_S:
            return None
        asked = token, None, self._service.store, self._service.settings
        try:
            if token is None:
                caller_of(*asked)  # asks no store
            else:
                await run_in_threadpool(caller_of, *asked)
        except DeniedError as exc:
            return exc
        except CairnError:
            return None  # a store that cannot be asked is the route's to report
        if len(self._known) >= KNOWN_MAX:
            self._known.clear()
        self._known[key] = time.monotonic()
        return None


def _token_in(headers: list[tuple[bytes, bytes]]) -> str | None:
    """The bearer token of the first `Authorization`, as the framework reads it."""
    shown = next((value.decode("latin-1") for name, value in headers if name == b"authorization"), "")
    scheme, _, token = shown.partition(" ")
    return token.strip() if scheme.lower() == "bearer" and token.strip() else None
