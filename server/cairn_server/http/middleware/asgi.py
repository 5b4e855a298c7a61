"""Types of ASGI, and answers that middleware gives without the framework."""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from cairn_map.errors import CairnError
from cairn_map.wire.messages import Problem

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]


async def send_problem(send: Send, status: int, kind: str, detail: str, *, answer_to: str = "http") -> None:
    """Answer a request, or a WebSocket's handshake, with a problem, and close: the body was not read."""
    await _send(send, status, Problem(title=kind.replace("_", " "), status=status, detail=detail, kind=kind), answer_to)


async def send_error(send: Send, status: int, error: CairnError, *, answer_to: str = "http") -> None:
    """`send_problem` for an error, with the time after which to try again."""
    title = error.kind.replace("_", " ")
    problem = Problem(title=title, status=status, detail=error.message, kind=error.kind)
    await _send(send, status, problem, answer_to, getattr(error, "retry_after_s", None))


async def _send(send: Send, status: int, problem: Problem, answer_to: str, retry_after_s: float | None = None) -> None:
    headers = [(b"content-type", b"application/problem+json"), (b"connection", b"close")]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    if retry_after_s is not None:
        headers.append((b"retry-after", b"%.0f" % retry_after_s))
    prefix = "" if answer_to == "http" else "websocket."
    await send({"type": f"{prefix}http.response.start", "status": status, "headers": headers})
    await send({"type": f"{prefix}http.response.body", "body": problem.model_dump_json().encode()})
