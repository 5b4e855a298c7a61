"""OpenAPI entries for what the framework cannot find out from a route's types: bytes, headers, refusals, examples.

@router.get(PATH, response_class=Response, responses=answers({200: ("image/png",), 304: ()}) | problems(413))
@router.put(PATH, openapi_extra=body("image/jpeg", "image/png"))
@router.put(PATH, openapi_extra=json_body(RobotStatus, example={...}))
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from cairn_server.http.routes.problems import MEDIA_TYPE as PROBLEM_MEDIA_TYPE

Json = dict[str, Any]
Entries = dict[int | str, Json]

SCHEMAS_AT = "#/components/schemas/"
BYTES: Json = {"schema": {"type": "string", "format": "binary"}}
TEXT: Json = {"schema": {"type": "string"}}
SCHEMAS: dict[str, Json] = {"application/json": {"schema": {}}, "text/event-stream": TEXT}
"""Schemas of media types that are not bytes."""
DESCRIPTIONS = {101: "Switching to the WebSocket", 206: "Part", 304: "Still the same"}


def answers(media_types: Mapping[int, Sequence[str]], *, headers: Sequence[str] = ()) -> Entries:
    """Answers by status, each with its media types (none: no body); all carry the same headers."""
    found: Entries = {}
    for status, names in media_types.items():
        found[status] = {"description": DESCRIPTIONS.get(status, "Done")}
        if names:
            found[status]["content"] = {name: dict(SCHEMAS.get(name, BYTES)) for name in names}
        if headers:
            found[status]["headers"] = {name: dict(TEXT) for name in headers}
    return found


def also(status: int, model: type[BaseModel]) -> Entries:
    """Second status of success with a body of this model."""
    return {status: {"model": model}}


def problems(*statuses: int | str) -> Entries:
    """Refusals with these statuses, in addition to those of every route of the same form."""
    content = {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": "Problem (RFC 9457)", "content": content} for status in statuses}


def body(*media_types: str) -> Json:
    """Request body of bytes, in one of these media types."""
    return {"requestBody": {"required": True, "content": {name: dict(BYTES) for name in media_types}}}


JSON_BODIES: dict[str, type[BaseModel]] = {}
"""Messages that are bodies of requests, by name: `openapi` adds their schemas to the document."""


TAKES_TOKEN: Json = {"security": [{"HTTPBearer": []}]}
"""Entry of a route that reads the token itself, by no dependency."""


def json_body(model: type[BaseModel], *, example: Json | None = None) -> Json:
    """Request body of JSON; an example must be one that the server takes."""
    JSON_BODIES[model.__name__] = model
    content: Json = {"schema": {"$ref": f"{SCHEMAS_AT}{model.__name__}"}}
    if example is not None:
        content["example"] = example
    return {"requestBody": {"required": True, "content": {"application/json": content}}}
