"""Places of connections, by what is seen on them: with a good token it is the token's, until then a stranger's.

`access.connection_places` has the rules; the place itself is taken by the protocol, when the connection is accepted
(`deadlines`, `secure_start`). What comes through a trusted proxy shares the proxy's few connections, so there each
request has a place, of its token or of the address that the proxy forwards:

    robots of a team -- radio, NAT --> server      a place for each connection, from the first good token on
    browsers -- trusted proxy --> server           a place for each request under way

Plain ASGI.
"""

from collections.abc import MutableMapping
from typing import Any

from cairn_map.errors import UnreachableError
from cairn_server.access.connection_places import ConnectionPlace, ConnectionPlaces
from cairn_server.http.middleware.asgi import App, Receive, Send, send_error
from cairn_server.http.middleware.deadlines import PLACE
from cairn_server.http.middleware.token_first import caller_key, is_known


class ConnectionShares:
    """Middleware that answers 503 `busy` to a token that has too many connections."""

    def __init__(self, app: App, *, places: ConnectionPlaces) -> None:
        self._app = app
        self._places = places

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, its connection counted."""
        place: ConnectionPlace | None = scope.get("state", {}).get(PLACE)
        own: ConnectionPlace | None = None
        try:
            if place is None:
                # Through a proxy: this request has a place, from here until its answer is sent or its stream ends.
                own = self._places.begin(caller_key(scope))
            elif is_known(scope):
                # From its first good token on the connection is the token's, as long as it is open; with another one
                # it is that one's.
                self._places.note(place, caller_key(scope))
        except UnreachableError as exc:
            await send_error(send, 503, exc, answer_to=scope["type"])
            return
        # The place of a connection itself is given back by the protocol, when the connection is lost.
        try:
            await self._app(scope, receive, send)
        finally:
            if own is not None:
                self._places.leave(own)
