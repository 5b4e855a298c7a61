"""Authentication before a body is read: a request that brings one shows a known token, or is refused at its head.

Without this, any client could send 64 MiB on every connection. The caller found is noted in the request's state: what
it may take of the server's memory and threads is counted by it, and the route asks no second time. What the caller may
do is checked by the route (`routes.callers`). Plain ASGI.
"""

import base64
import binascii
import time
from collections.abc import Hashable, Iterable, MutableMapping
from dataclasses import dataclass
from typing import Any

from cairn_map.errors import CairnError, DeniedError
from cairn_server.access.auth import Caller, Role, caller_of
from cairn_server.http.middleware.asgi import App, Receive, Send, send_problem
from cairn_server.service import Service

WITHOUT_BODY = frozenset({"GET", "HEAD", "OPTIONS"})
NOTED_S = 1.0
"""Time for which a caller counts as authenticated: a body that takes longer comes under a token that may have ended."""
TOKEN_PREFIX = "cairn.token."  # noqa: S105 - what stands before one
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
        if scope["type"] in ("http", "websocket"):
            token = _token_in(scope["headers"]) or offered_token(scope.get("subprotocols", ()))
            try:
                # On the event loop, as in the routes: a look-up by key takes 40 us, a change of threads longer.
                caller = caller_of(token, None, self._service.store, self._service.settings)
            except DeniedError as exc:
                # What needs no body may need no token either: that is the route's to know.
                if scope["type"] == "http" and scope["method"] not in WITHOUT_BODY:
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


def is_known(scope: MutableMapping[str, Any]) -> bool:
    """True if a request showed a token that is somebody's own, or comes to a server that wants none.

    The enrolment token is a whole fleet's: robots show it together, and each has one of its own a moment later.
    """
    noted: _Noted | None = scope.get("state", {}).get(STATE)
    return noted is not None and noted.caller.role is not Role.ENROLLER


def caller_key(scope: MutableMapping[str, Any]) -> Hashable:
    """Holder of shares of the server: a token, or a stranger's address. Each request of an admin counts for itself."""
    noted: _Noted | None = scope.get("state", {}).get(STATE)
    if noted is None:
        return f"address {scope['client'][0]}" if scope.get("client") else "no address"
    return object() if noted.caller.role is Role.ADMIN else noted.caller.name


def offered_token(subprotocols: Iterable[str]) -> str | None:
    """Token that a WebSocket offers as a subprotocol `cairn.token.BASE64URL`, since browsers can set no header."""
    offered = next((text for text in subprotocols if text.startswith(TOKEN_PREFIX)), None)
    if offered is None:
        return None
    text = offered.removeprefix(TOKEN_PREFIX)
    try:
        return base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True).decode()
    except (binascii.Error, ValueError):
        return ""  # as wrong as any other


def _token_in(headers: list[tuple[bytes, bytes]]) -> str | None:
    """Bearer token of the first `Authorization`, as the framework reads it."""
    shown = next((value.decode("latin-1") for name, value in headers if name == b"authorization"), "")
    scheme, _, token = shown.partition(" ")
    return token.strip() if scheme.lower() == "bearer" and token.strip() else None
