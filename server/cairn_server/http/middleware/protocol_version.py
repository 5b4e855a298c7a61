"""Which version of PROTOCOL.md a request speaks: stated in a header, and refused where it is not ours."""

from collections.abc import MutableMapping
from typing import Any

from cairn_server.http.middleware.body_limit import App, Receive, Send, send_problem

VERSION = b"1"
HEADER = b"cairn-protocol"


class ProtocolVersion:
    """Answers 400 `unknown_protocol` to a request of another version; one that states none speaks this one."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """One request."""
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
