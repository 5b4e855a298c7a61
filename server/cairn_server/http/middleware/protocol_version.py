"""Protocol version: a request of another version than the server's (header `Cairn-Protocol`) is refused."""

from collections.abc import MutableMapping
from typing import Any

from cairn_server.http.middleware.body_limit import App, Receive, Send, send_problem

VERSION = b"1"
HEADER = b"cairn-protocol"


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
