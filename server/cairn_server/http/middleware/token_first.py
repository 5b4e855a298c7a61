"""Authentication before a body is read: a request that brings one shows a known token, or is refused at its head.

Without this, any client could send 64 MiB on every connection. The caller found is noted in the request's state: what
it may take of the server's memory and threads is counted by it. Who the caller is, and what it may do, the route finds
out by itself (`routes.callers`), so that a token that ended while the request waited does not count. Plain ASGI.
"""

import base64
import binascii
import re
from collections.abc import Hashable, Iterable, MutableMapping
from typing import Any

from starlette.concurrency import run_in_threadpool

from cairn_map.errors import BadInputError, CairnError, DeniedError
from cairn_server.access.auth import Caller, Role
from cairn_server.access.own_names import OwnNames
from cairn_server.http.middleware.asgi import App, Receive, Send, send_problem
from cairn_server.service import Service

WITHOUT_BODY = frozenset({"GET", "HEAD", "OPTIONS"})
REGISTRATION = re.compile(r"/maps/([^/]*)/branches")
"""Path where the proof of a robot's key may stand for a token."""
DROPPED_BYTES_MAX = 1 << 14
"""Largest body that is read of a request which is refused at its head."""
TOKEN_PREFIX = "cairn.token."  # noqa: S105 - what stands before one
WRONG = frozenset({"bad_token", "unconfirmed_token"})
"""Kinds of the refusals that are about a token which was shown."""
STATE = "caller"
"""Name of the caller's note in the request's state."""


class TokenFirst:
    """Middleware that answers 401 to a request with a body and without a known token, 400 to a proof that is none."""

    def __init__(self, app: App, *, service: Service, own_names: OwnNames) -> None:
        self._app = app
        self._own_names = own_names
        self._service = service

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] in ("http", "websocket"):
            try:
                caller = self._caller(scope)
            except (DeniedError, BadInputError) as exc:
                await self._note(scope, exc)
                # What needs no body may need no token either: that is the route's to know.
                if scope["type"] == "http" and scope["method"] not in WITHOUT_BODY:
                    await _drop_small_body(scope, receive)
                    await send_problem(send, 401 if isinstance(exc, DeniedError) else 400, exc.kind, exc.message)
                    return
            except CairnError:
                pass  # a store that cannot be asked is the route's to report
            else:
                scope.setdefault("state", {})[STATE] = caller
        await self._app(scope, receive, send)

    async def _note(self, scope: MutableMapping[str, Any], exc: CairnError) -> None:
        """Write a line about a wrong token, if it is one and worth a line."""
        if exc.kind not in WRONG:
            return
        address = scope["client"][0] if scope.get("client") else ""
        left_out = self._service.wrong_tokens.turn(address)
        if left_out is not None:
            await run_in_threadpool(self._service.wrong_tokens.write, address, exc.kind, left_out)

    def _caller(self, scope: MutableMapping[str, Any]) -> Caller:
        """Caller of a request, by its token, or where it registers a robot by the proof of the robot's key."""
        token = _token_in(scope["headers"]) or offered_token(scope.get("subprotocols", ()))
        try:
            # On the event loop, as in the routes: a look-up by key takes 40 us, a change of threads longer.
            return self._service.holders.of(token, None)
        except DeniedError:
            proof, path = _first(scope["headers"], b"cairn-proof"), REGISTRATION.fullmatch(scope["path"])
            if token is not None or not proof or path is None:
                raise
            return self._service.sync.admissions.returning(
                path[1], proof, own=self._own_names.origins(scope["scheme"], scope["server"])
            )


async def _drop_small_body(scope: MutableMapping[str, Any], receive: Receive) -> None:
    """Read what is on its way, if it is little: a connection that closes before would take the answer with it."""
    length = _first(scope["headers"], b"content-length")
    while length.isdigit() and int(length) <= DROPPED_BYTES_MAX:
        message = await receive()
        if message["type"] != "http.request" or not message.get("more_body", False):
            return


def is_known(scope: MutableMapping[str, Any]) -> bool:
    """True if a request showed a token that is somebody's own, or comes to a server that wants none.

    The enrolment token is a whole fleet's: robots show it together, and each has one of its own a moment later.
    """
    noted: Caller | None = scope.get("state", {}).get(STATE)
    return noted is not None and noted.role is not Role.ENROLLER


def caller_key(scope: MutableMapping[str, Any]) -> Hashable:
    """Holder of shares of the server: a token, or a stranger's address. Each request of an admin counts for itself."""
    noted: Caller | None = scope.get("state", {}).get(STATE)
    if noted is None:
        return f"address {scope['client'][0]}" if scope.get("client") else "no address"
    return object() if noted.role is Role.ADMIN else noted.name


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
    scheme, _, token = _first(headers, b"authorization").partition(" ")
    return token.strip() if scheme.lower() == "bearer" and token.strip() else None


def _first(headers: list[tuple[bytes, bytes]], name: bytes) -> str:
    return next((value.decode("latin-1") for key, value in headers if key == name), "")
