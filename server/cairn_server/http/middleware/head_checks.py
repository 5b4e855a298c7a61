"""Heads of requests: checks of same origin, where the server is open, of protocol and path; HEAD itself. Plain ASGI."""

import re
from collections.abc import MutableMapping
from typing import Any

from uvicorn.protocols.utils import ClientDisconnected

from cairn_server.http.middleware.asgi import App, Message, Receive, Send, send_problem
from cairn_server.settings import LOOPBACK

HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{0,5})?", re.IGNORECASE)
"""`Host` as RFC 9110 has it: a name or address, and a port; no user, no fragment, which a parser of URLs would skip."""
VERSION = b"1"
HEADER = b"cairn-protocol"


class SameOrigin:
    """Middleware that answers 403 to requests from pages of other sites, and to requests for other host names.

    Without an admin token the server trusts every client on this machine, and a browser on this machine sends requests
    on behalf of every page that it shows. Two headers reveal this: `Origin` names the page (cross-site requests), and
    `Host` the name that the page used for the server (DNS rebinding).
    """

    def __init__(self, app: App, *, host: str) -> None:
        self._app = app
        self._hosts = LOOPBACK | {host}

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan" or self._is_own(scope["scheme"], scope["headers"]):
            await self._app(scope, receive, send)
            return
        await send_problem(
            send,
            403,
            "foreign_origin",
            "without --admin-token-file this server answers only requests of its own pages and of programs, sent to "
            "127.0.0.1, [::1] or localhost",
            answer_to=scope["type"],
        )

    def _is_own(self, scheme: str, headers: list[tuple[bytes, bytes]]) -> bool:
        hosts = {value.decode("latin-1") for name, value in headers if name == b"host"}
        origins = {value.decode("latin-1") for name, value in headers if name == b"origin"}
        if len(hosts) != 1 or _name(next(iter(hosts))) not in self._hosts:
            return False
        page = {"ws": "http", "wss": "https"}.get(scheme, scheme)
        return origins <= {f"{page}://{host}" for host in hosts}


def _name(host: str) -> str | None:
    found = HOST.fullmatch(host)
    return found[1].strip("[]").lower() if found else None


class ProtocolVersion:
    """Middleware that answers 400 `unknown_protocol` to another version; a request without the header is accepted."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        stated = {value for name, value in scope.get("headers", ()) if name == HEADER}
        if stated <= {VERSION}:
            await self._app(scope, receive, send)
            return
        await send_problem(
            send,
            400,
            "unknown_protocol",
            f"this server speaks version {VERSION.decode()} of the protocol; update the older of the two",
            answer_to=scope["type"],
        )


class PlainPath:
    """Middleware that answers 400 `bad_path` to a path with an encoded slash.

    No name has a slash, and the framework decodes a path before it looks for a route: `/maps/lab%2flog` would be
    `/maps/lab/log` here, and another page for a proxy with rules by path.
    """

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if b"%2f" not in scope.get("raw_path", b"").lower():
            await self._app(scope, receive, send)
            return
        await send_problem(
            send,
            400,
            "bad_path",
            "the path has an encoded slash (%2F); no name has one: send / between the parts of a path",
            answer_to=scope["type"],
        )


class DeniedHandshakes:
    """Middleware that ends a WebSocket whose handshake was refused as uvicorn expects of one that the client left.

    uvicorn takes an app that answered a handshake with a problem, and returned, for a broken one, and writes an error
    to the log: any stranger could fill it.
    """

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            ClientDisconnected: for uvicorn, once a handshake was refused and the answer is sent.
        """
        if scope["type"] != "websocket":
            await self._app(scope, receive, send)
            return
        is_denied = False

        async def noted(message: Message) -> None:
            nonlocal is_denied
            await send(message)
            is_denied |= message["type"] == "websocket.http.response.body" and not message.get("more_body", False)

        await self._app(scope, receive, noted)
        if is_denied:
            raise ClientDisconnected


class _HeadSentError(Exception):
    """The answer is whole, and its body need not be made."""


class HeadRequests:
    """Middleware that hands HEAD on as GET, and sends nothing of the body that comes (RFC 9110, 9.3.2); the innermost.

    Probes, link checkers and `curl --head` ask so. A route does not know of it: its answer is cut off behind the head,
    so that a stream of events, which has no end, ends, too.
    """

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            if message["type"] != "http.response.body":
                await send(message)
                return
            await send({**message, "body": b"", "more_body": False})
            if message.get("more_body", False):
                raise _HeadSentError

        # In place, and put back: those around share the scope, and note in it which route was found. A part of a body
        # is asked for by GET alone (RFC 9110, 14.2).
        headers = scope["headers"]
        scope["method"] = "GET"
        scope["headers"] = [field for field in headers if field[0] != b"range"]
        try:
            await self._app(scope, receive, send_head)
        except _HeadSentError:
            pass
        finally:
            scope["method"], scope["headers"] = "HEAD", headers
