"""Checks of a request's head: same origin, where the server is open, and the version of the protocol. Plain ASGI."""

from collections.abc import MutableMapping
from typing import Any
from urllib.parse import urlsplit

from cairn_server.http.middleware.body_limit import App, Receive, Send, send_problem
from cairn_server.settings import LOOPBACK

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
        if len(hosts) != 1 or _name(f"//{next(iter(hosts))}") not in self._hosts:
            return False
        page = {"ws": "http", "wss": "https"}.get(scheme, scheme)
        return origins <= {f"{page}://{host}" for host in hosts}


def _name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


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
