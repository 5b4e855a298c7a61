"""Bounds on request bodies, of each and of all in memory, enforced before anything reads them whole; of one caller only
a few long ones are read at once. Plain ASGI.
"""

import re
import sys
from collections.abc import Hashable, MutableMapping
from dataclasses import dataclass
from typing import Any

from cairn_map.commits.commit import COMMIT_BYTES_MAX
from cairn_map.errors import BadInputError, UnreachableError
from cairn_server.access.body_budget import BodyBudget
from cairn_server.access.turns import Turns
from cairn_server.http.middleware.asgi import App, Message, Receive, Send, send_error
from cairn_server.http.middleware.token_first import caller_key
from cairn_server.live.robot_reports import VIEW_BYTES_MAX

MISSING_BYTES_MAX = 16 << 20
"""Room for 100 000 cells with a cursor each."""
JSON_BYTES_MAX = 1 << 20
STATUS_BYTES_MAX = 1 << 14
LONG_BYTES = 1 << 16
"""Bytes of a body that come without a turn."""
LONG_AT_ONCE = 4
"""Long bodies of one caller that are read at once: the event loop reads in turn from all links, and 44 of one caller
would have forty times the share of it that a robot has."""
LONG_WAIT_S = 30.0
LIMITS = (
    (re.compile(r"/maps/[^/]*/commits/[^/]*"), COMMIT_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/main/cells/[^/]*"), COMMIT_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/branches/[^/]*/missing"), MISSING_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/branches/[^/]*/status"), STATUS_BYTES_MAX),
    (re.compile(r"/maps/[^/]*/branches/[^/]*/view"), VIEW_BYTES_MAX),
)


def turns_of_long_bodies() -> Turns:
    """Turns at which long bodies are read: as many as there are callers, a few of each."""
    return Turns(places=sys.maxsize, share=LONG_AT_ONCE, wait_s=LONG_WAIT_S)


class BodyLimit:
    """Middleware that answers 413 to a body larger than its path allows, and 503 to one for which there is no room.

    What a body claims is looked at first; its connection brings no more (`deadlines`). Then what comes is counted.
    """

    def __init__(self, app: App, *, budget: BodyBudget, turns: Turns) -> None:
        self._app = app
        self._budget = budget
        self._turns = turns

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on with its body counted, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit_bytes, caller = limit_of(scope["path"]), caller_key(scope)
        claimed = dict(scope["headers"]).get(b"content-length", b"0")
        if not claimed.isdigit() or len(claimed) > 18 or int(claimed) > limit_bytes:
            await send_error(send, 413, _too_large(limit_bytes))
            return
        try:
            self._budget.check(caller, int(claimed))
        except UnreachableError as exc:
            await send_error(send, 503, exc)
            return
        body = _Body(self._budget, self._turns, caller, receive, send)
        try:
            await self._app(scope, body.receive, body.send)
        except UnreachableError:
            if body.refusal is None:
                raise
        finally:
            body.end_turn()
            self._budget.give_back(caller, body.held_bytes)
        if body.refusal is not None and not body.is_answered:
            await send_error(send, 503, body.refusal)


@dataclass(slots=True)
class _Body:
    """Body of one request: counted, and kept within the budget."""

    budget: BodyBudget
    turns: Turns
    caller: Hashable
    asgi_receive: Receive
    asgi_send: Send
    held_bytes: int = 0
    refusal: UnreachableError | None = None
    """Once there was no room for the body."""
    is_answered: bool = False
    has_turn: bool = False
    is_whole: bool = False

    async def receive(self) -> Message:
        """The next part.

        Raises:
            UnreachableError: kind `busy`.
        """
        await self._take_turn()
        message = await self.asgi_receive()
        if not message.get("more_body", False):
            self.is_whole = True
            self.end_turn()
        size_bytes = len(message.get("body", b""))
        try:
            self.budget.take(self.caller, size_bytes)
        except UnreachableError as exc:
            self.refusal = exc
            raise
        self.held_bytes += size_bytes
        return message

    def end_turn(self) -> None:
        """Let another body be read; may be called twice."""
        if self.has_turn:
            self.has_turn = False
            self.turns.give_back(self.caller)

    async def _take_turn(self) -> None:
        """Wait before a body goes on that has become long; what was not read yet waits in the sender's machine."""
        if self.has_turn or self.is_whole or self.held_bytes < LONG_BYTES:
            return
        try:
            await self.turns.take(self.caller)
        except UnreachableError as exc:
            self.refusal = exc
            raise
        self.has_turn = True

    async def send(self, message: Message) -> None:
        """Pass the answer on; what the framework makes of a refused body is dropped: another answer follows."""
        if self.refusal is None or self.is_answered:
            self.is_answered = True
            await self.asgi_send(message)


def limit_of(path: str) -> int:
    """Largest body that a path accepts, bytes."""
    return next((size for pattern, size in LIMITS if pattern.fullmatch(path)), JSON_BYTES_MAX)


def _too_large(limit_bytes: int) -> BadInputError:
    return BadInputError("too_large", f"a body has at most {limit_bytes} bytes here")
