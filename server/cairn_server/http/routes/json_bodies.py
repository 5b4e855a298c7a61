"""Bodies in JSON, read and parsed only after the route has asked who the caller is.

The framework would parse a body on the event loop before anything else: megabytes of it, sent with a token that may
not even use the route, hold up everybody. Here a body is a dependency like any other, and stands after the caller's:

    def retract(row: Map, caller: Annotated[Caller, Depends(allowed(...))], body: Annotated[Retract, json_of(Retract)])
"""

import email.message
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from cairn_map.wire.messages import CURSORS_MAX
from cairn_server.http.routes.callers import body_of
from cairn_server.http.routes.long_bodies import LongBodies

M = TypeVar("M", bound=BaseModel)

VALUES_MAX = 6 * CURSORS_MAX + 10_000
"""Commas and brackets of a body: what the longest list of cells, each with a cursor, has. They, not the bytes, are what
parsing takes time for, during which no other thread runs: 0.2 us each."""
SHORT_BYTES = 1 << 14
"""Longest body that is parsed on the event loop: a change of threads would take longer. Longer ones are parsed in a
process of their own."""


def json_of(model: type[M], made_into: Callable[[M], Any] | None = None) -> Any:
    """Dependency of a route: its body as a message, or what a function makes of it."""
    parse = partial(_made, model, made_into) if made_into else partial(parsed, model)

    async def read(request: Request) -> Any:
        data = await body_of(request)
        _check_media_type(request)
        if len(data) <= SHORT_BYTES:
            return parse(data)
        bodies: LongBodies = request.app.state.long_bodies
        return await run_in_threadpool(bodies.read, parse, data)

    return Depends(read)


def _made(model: type[M], made_into: Callable[[M], Any], data: bytes) -> Any:
    return made_into(parsed(model, data))


def parsed(model: type[M], data: bytes) -> M:
    """Message in a body.

    Raises:
        RequestValidationError: it is no such message, or has more values than any has.
    """
    values = sum(map(data.count, (b",", b"[", b"{")))
    if values > VALUES_MAX:
        text = f"a message has at most {VALUES_MAX} commas and brackets, got {values}"
        raise RequestValidationError([{"loc": ("body",), "msg": text}])
    try:
        return model.model_validate_json(data)
    except ValidationError as exc:
        complaints = exc.errors(include_url=False, include_context=False, include_input=False)
        raise RequestValidationError([{**each, "loc": ("body", *each["loc"])} for each in complaints]) from exc


def _check_media_type(request: Request) -> None:
    """Refuse what is not called JSON: a form of another site's page, for one."""
    message = email.message.Message()
    message["content-type"] = request.headers.get("content-type", "")
    subtype = message.get_content_subtype()
    if message.get_content_maintype() != "application" or not (subtype == "json" or subtype.endswith("+json")):
        raise RequestValidationError([{"loc": ("body",), "msg": "JSON is sent with Content-Type: application/json"}])
