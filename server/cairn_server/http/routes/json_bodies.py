"""Bodies in JSON, read and parsed only after the route has asked who the caller is.

The framework would parse a body on the event loop before anything else: megabytes of it, sent with a token that may
not even use the route, hold up everybody. Here a body is a dependency like any other, and stands after the caller's:

    def retract(row: Map, caller: Annotated[Caller, Depends(allowed(...))], body: Annotated[Retract, json_of(Retract)])
"""

import email.message
from typing import Any, TypeVar

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from cairn_map.wire.messages import CURSORS_MAX
from cairn_server.http.routes.callers import body_of

M = TypeVar("M", bound=BaseModel)

VALUES_MAX = 6 * CURSORS_MAX + 10_000
"""Commas and brackets of a body: what the longest list of cells, each with a cursor, has. They, not the bytes, are what
parsing takes time for, during which no other thread runs: 0.2 us each."""
SHORT_BYTES = 1 << 14
"""Longest body that is parsed on the event loop: a change of threads would take longer."""


def json_of(model: type[M]) -> Any:
    """Dependency of a route: its body as a message."""

    async def read(request: Request) -> M:
        data = await body_of(request)
        _check_media_type(request)
        if len(data) <= SHORT_BYTES:
            return parsed(model, data)
        return await run_in_threadpool(parsed, model, data)

    return Depends(read)


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
        raise RequestValidationError(
            [{**error, "loc": ("body", *error["loc"])} for error in exc.errors(include_url=False)]
        ) from exc


def _check_media_type(request: Request) -> None:
    """Refuse what is not called JSON: a form of another site's page, for one."""
    message = email.message.Message()
    message["content-type"] = request.headers.get("content-type", "")
    subtype = message.get_content_subtype()
    if message.get_content_maintype() != "application" or not (subtype == "json" or subtype.endswith("+json")):
        raise RequestValidationError([{"loc": ("body",), "msg": "JSON is sent with Content-Type: application/json"}])
