"""Trail of every request: an id, the server's time, a line in the log, and counts. Plain ASGI, around everything else.

The id is the caller's own `X-Request-Id` if it is a sensible one, else a new one; the answer has it, and so has every
line that is logged meanwhile.
"""

import json
import logging
import random
import re
import time
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

from cairn_server.access.auth import Caller
from cairn_server.http.middleware.asgi import App, Message, Receive, Send
from cairn_server.http.middleware.log_format import REQUEST_ID, Field, fields
from cairn_server.http.middleware.token_first import STATE
from cairn_server.metrics import ServerFigures

log = logging.getLogger(__name__)

HEADER = b"x-request-id"
TIME_HEADER, FORMAT_HEADER = b"cairn-time", b"cairn-format"
"""UTC seconds since 1970 at the beginning of an answer, by which robots learn the lead of the server's clock."""
SENSIBLE = re.compile(rb"[A-Za-z0-9._-]{1,64}")
METHODS = frozenset({"GET", "PUT", "POST", "DELETE", "HEAD", "OPTIONS", "PATCH"})
PUSH = "/maps/{name}/commits/{commit}"
CHANGING = frozenset({"PUT", "POST", "DELETE", "PATCH"})
QUIET = frozenset({"/healthz", "/readyz", "/metrics"})
"""Routes that machines ask every few seconds: logged at level DEBUG, also while the server is not ready, since it says
itself when it ceases to be (`readiness`)."""
NOT_READY = 503
OUTCOMES = {201: "new", 200: "known"}
TEXT_MAX = 96


@dataclass(slots=True)
class Trail:
    """State of one request so far."""

    status: int = 0
    kind: str = ""
    received_bytes: int = 0
    sent_bytes: int = 0
    is_problem: bool = False


class RequestTrail:
    """Middleware that counts and logs each request once it is answered."""

    def __init__(self, app: App, *, figures: ServerFigures, time_s: Callable[[], float | None]) -> None:
        """`time_s` returns the server's time; None while its clock is not trusted."""
        self._app = app
        self._figures = figures
        self._time_s = time_s

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Pass a request on, and count what comes and goes."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # A jump is noticed before anything is done for this request.
        self._time_s()
        trail, start_s = Trail(), time.perf_counter()
        # A client of maps with epochs; to others the time would be bytes for nothing.
        asks_time = any(name == FORMAT_HEADER for name, _ in scope["headers"])
        request_id = _request_id(scope["headers"])
        reset = REQUEST_ID.set(request_id)

        async def counted() -> Message:
            message = await receive()
            trail.received_bytes += len(message.get("body", b""))
            return message

        async def noted(message: Message) -> None:
            if message["type"] == "http.response.start":
                trail.status = message["status"]
                headers = list(message.get("headers", ()))
                trail.is_problem = (b"content-type", b"application/problem+json") in headers
                headers.append((HEADER, request_id.encode()))
                now_s = self._time_s() if asks_time else None
                if now_s is not None:
                    headers.append((TIME_HEADER, b"%.3f" % now_s))
                message = {**message, "headers": headers}
            elif message["type"] == "http.response.body":
                body = message.get("body", b"")
                trail.sent_bytes += len(body)
                if trail.is_problem and body:
                    trail.kind = json.loads(body)["kind"]
            await send(message)

        try:
            await self._app(scope, counted, noted)
        except Exception:
            trail.status, trail.kind = trail.status or 500, "internal"
            raise
        finally:
            self._finish(scope, trail, time.perf_counter() - start_s)
            REQUEST_ID.reset(reset)

    def _finish(self, scope: MutableMapping[str, Any], trail: Trail, seconds: float) -> None:
        figures = self._figures
        method = scope["method"] if scope["method"] in METHODS else "other"
        route: str = getattr(scope.get("route"), "path", "none")
        figures.requests.labels(method, route, str(trail.status)).inc()
        figures.request_seconds.labels(method, route).observe(seconds)
        figures.received_bytes.labels(method, route).inc(trail.received_bytes)
        figures.sent_bytes.labels(method, route).inc(trail.sent_bytes)
        if trail.kind:
            figures.errors.labels(trail.kind).inc()
        if route == PUSH and method == "PUT":
            self._note_push(scope["path_params"].get("name", ""), trail)
        if method in CHANGING:
            self._note_robot(scope, route, trail)
        level = logging.INFO if trail.status < 500 else logging.WARNING
        if route in QUIET and (trail.status < 500 or trail.status == NOT_READY):
            level = logging.DEBUG
        if log.isEnabledFor(level):
            log.log(level, "request", extra=fields(**_line(scope, method, route, trail, seconds)))

    def _note_push(self, name: str, trail: Trail) -> None:
        outcome = OUTCOMES.get(trail.status)
        # Only with an outcome does a map of this name exist for certain: names that a client guesses are no labels.
        self._figures.pushes.labels(name if outcome else "", outcome or trail.kind or "cut_off").inc()
        if outcome == "new":
            self._figures.push_bytes.labels(name).inc(trail.received_bytes)

    def _note_robot(self, scope: MutableMapping[str, Any], route: str, trail: Trail) -> None:
        """Count what a robot's token brought, or was refused."""
        caller: Caller | None = scope.get("state", {}).get(STATE)
        # A token of another map is answered 401, and so no name of a map that a client guesses is a label.
        if caller is None or caller.robot is None or trail.status == 401:
            return
        of = scope.get("path_params", {}).get("name", ""), caller.robot
        if trail.kind:
            self._figures.robot_refusals.labels(*of, trail.kind).inc()
        elif route == PUSH and OUTCOMES.get(trail.status) == "new":
            self._figures.robot_commits.labels(*of).inc()
            self._figures.robot_bytes.labels(*of).inc(trail.received_bytes)


def _request_id(headers: list[tuple[bytes, bytes]]) -> str:
    asked = next((value for name, value in headers if name == HEADER), b"")
    return asked.decode() if SENSIBLE.fullmatch(asked) else f"{random.getrandbits(64):016x}"


def _line(scope: MutableMapping[str, Any], method: str, route: str, trail: Trail, seconds: float) -> dict[str, Field]:
    """Fields of a request's line: of the path its route and ids; nothing of query and headers, where tokens are."""
    line: dict[str, Field] = {"method": method, "route": route}
    if route == "none":
        line["path"] = scope["path"][:TEXT_MAX]
    for name, value in scope.get("path_params", {}).items():
        line["map" if name == "name" else name] = str(value)[:TEXT_MAX]
    line |= {"status": trail.status, "received_bytes": trail.received_bytes, "sent_bytes": trail.sent_bytes}
    line["seconds"] = round(seconds, 6)
    if trail.kind:
        line["kind"] = trail.kind
    client = scope.get("client")
    return line | ({"client": client[0]} if client else {})
