"""Authentication before a body is read: a request that brings one shows a known token, or is refused at its head.

The framework reads and parses JSON before it asks a route who may call it; without this, any client could send 16 MiB
of it on every connection. The caller found is noted in the request's state, so that the route asks no second time; what
the caller may do is checked by the route (`routes.callers`). Plain ASGI.
"""

import time
from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any

from cairn_map.errors import CairnError, DeniedError
from cairn_server.access.auth import Caller, caller_of
from cairn_server.http.middleware.body_limit import App, Receive, Send, send_problem
from cairn_server.service import Service

WITHOUT_BODY = frozenset({"GET", "HEAD", "OPTIONS"})
NOTED_S = 1.0
"""Time for which a caller counts as authenticated: a body that takes longer comes under a token that may have ended."""
STATE = "caller"
"""Name of the note in the request's state."""


@dataclass(frozen=True, slots=True)
class _Noted:
    caller: Caller
    at_s: float


class TokenFirst:
    """Middleware that answers 401 to a request with a body and without a known token."""

    def __init__(self, app: App, *, service: Service) -> None:
        self._app = app
        self._service = service

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "http" and scope["method"] not in WITHOUT_BODY:
            try:
                # On the event loop, as in the routes: a look-up by key takes 40 us, a change of threads longer.
                caller = caller_of(_token_in(scope["headers"]), None, self._service.store, self._service.settings)
            except DeniedError as exc:
                await send_problem(send, 401, exc.kind, exc.message)
                return
            except CairnError:
                pass  # a store that cannot be asked is the route's to report
            else:
                scope.setdefault("state", {})[STATE] = _Noted(caller, time.monotonic())
        await self._app(scope, receive, send)


def noted_caller(scope: MutableMapping[str, Any]) -> Caller | None:
    """Caller of a request that was authenticated less than `NOTED_S` ago; None: it is to be authenticated."""
    noted: _Noted | None = scope.get("state", {}).get(STATE)
    return noted.caller if noted is not None and time.monotonic() - noted.at_s < NOTED_S else None


def _token_in(headers: list[tuple[bytes, bytes]]) -> str | None:
    """Bearer token of the first `Authorization`, as the framework reads it."""
    shown = next((value.decode("latin-1") for name, value in headers if name == b"authorization"), "")
    scheme, _, token = shown.partition(" ")
    return token.strip() if scheme.lower() == "bearer" and token.strip() else None
