"""The routes for machines (OpenAPI 3.1): what the framework finds out by itself, set right where it cannot know.

It knows JSON. Bodies of bytes, answers of several kinds and problems are said here, by route; a test asks every route
and compares.
"""

from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from cairn_map.files.cell_files import CELL_MEDIA_TYPE, MEDIA_TYPES
from cairn_map.files.export_request import EXPORT_TYPES
from cairn_map.wire.messages import Problem
from cairn_server.http.openapi_examples import EXAMPLES
from cairn_server.http.routes.problems import MEDIA_TYPE as PROBLEM_MEDIA_TYPE
from cairn_server.http.routes.sync import REPLY_MEDIA_TYPE
from cairn_server.views.view_bundle import MEDIA_TYPE as VIEWS_MEDIA_TYPE

Json = dict[str, Any]
Route = tuple[str, str]

MAP = "/maps/{name}"
UPLOAD = f"{MAP}/commits/{{commit}}/upload"
CELL = f"{MAP}/main/cells/{{cell}}"
VIEWS = f"{MAP}/main/views"
RENDER = f"{MAP}/main/render"
EXPORT = f"{MAP}/main/export"
TICKETS = f"{EXPORT}/tickets"
VIEW = f"{MAP}/branches/{{branch}}/view"
COMMIT_MEDIA_TYPE = "application/vnd.cairn.commit"
CELL_TYPES = (CELL_MEDIA_TYPE, *MEDIA_TYPES.values())
CONSOLE_TYPES = ("text/javascript", "text/css", "image/svg+xml")
PICTURES = ("image/jpeg", "image/png")
BODIES: dict[Route, tuple[str, ...]] = {
    ("put", f"{MAP}/commits/{{commit}}"): (COMMIT_MEDIA_TYPE,),
    ("patch", UPLOAD): ("application/octet-stream",),
    ("put", VIEW): PICTURES,
    ("put", CELL): (CELL_MEDIA_TYPE,),
}
ANSWERS: dict[Route, dict[int, tuple[str, ...]]] = {
    ("post", f"{MAP}/branches/{{branch}}/missing"): {200: (REPLY_MEDIA_TYPE,), 204: ()},
    ("get", f"{MAP}/commits/{{commit}}"): {200: (COMMIT_MEDIA_TYPE,)},
    ("get", "/"): {200: ("text/html",), 304: ()},
    ("get", "/assets/{file}"): {200: CONSOLE_TYPES, 304: ()},
    ("get", "/metrics"): {200: ("text/plain",)},
    ("get", CELL): {200: CELL_TYPES, 206: CELL_TYPES, 304: ()},
    ("head", CELL): {200: CELL_TYPES, 304: ()},
    ("get", f"{MAP}/main/vector"): {200: ("application/json",)},
    ("get", VIEWS): {200: (VIEWS_MEDIA_TYPE,)},
    ("get", VIEW): {200: PICTURES, 304: ()},
    ("get", RENDER): {200: ("image/png", "application/x-npz"), 304: ()},
    ("get", EXPORT): {200: tuple(EXPORT_TYPES.values())},
    ("get", f"{MAP}/events"): {200: ("text/event-stream",)},
    ("get", f"{MAP}/live"): {101: ()},
}
"""Media types by status, of answers that the framework takes for JSON; () for none."""
ALSO: dict[Route, int] = {("put", MAP): 200, ("put", f"{MAP}/commits/{{commit}}"): 201, ("patch", UPLOAD): 201}
"""A second status of success with the same body: what was there already, or is new."""
PROBLEMS: dict[Route, tuple[int, ...]] = {
    ("put", MAP): (409,),
    ("put", f"{MAP}/commits/{{commit}}"): (409, 429, 507),
    ("patch", UPLOAD): (409, 429, 507),
    ("get", f"{MAP}/commits/{{commit}}"): (409,),
    ("post", f"{MAP}/retracts"): (409,),
    ("put", "/tokens/{token}"): (409,),
    ("put", CELL): (409,),
    ("post", f"{MAP}/branches/{{branch}}/missing"): (410,),
    ("get", f"{MAP}/main/vector"): (410,),
    ("get", CELL): (416,),
    ("get", RENDER): (413,),
    ("get", EXPORT): (413,),
    ("post", TICKETS): (429,),
    ("get", f"{MAP}/events"): (429,),
    ("get", f"{MAP}/live"): (426,),
}
"""Statuses of problems beside those that every route of its kind may answer."""
CELL_HEADERS = ("ETag", "Cairn-Cursor", "Cairn-Coverage", "Cairn-Coverage-Digest", "Cairn-Fingerprint")
HEADERS: dict[Route, tuple[str, ...]] = {
    ("get", CELL): CELL_HEADERS,
    ("head", CELL): CELL_HEADERS,
    ("get", VIEW): ("ETag", "Last-Modified"),
    ("get", VIEWS): ("Cairn-View-Depth",),
    ("get", RENDER): ("ETag", "Cairn-Cursor"),
    ("get", EXPORT): ("Cairn-Cursor", "Cairn-Points"),
    ("get", f"{MAP}/commits/{{commit}}"): ("ETag", "Cairn-Seal"),
}
BYTES: Json = {"schema": {"type": "string", "format": "binary"}}
TEXT: Json = {"schema": {"type": "string"}}
JSON: Json = {"schema": {}}


def openapi_of(app: FastAPI) -> Json:
    """The document; made once."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        for route, operation in operations(document):
            _correct(route, operation)
        parts = document.setdefault("components", {})
        schemas = parts.setdefault("schemas", {})
        schemas["Problem"] = Problem.model_json_schema()
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        for scheme in parts.get("securitySchemes", {}).values():
            scheme["description"] = "A token, as PROTOCOL.md section 2 says; a server without tokens takes none."
        app.openapi_schema = document
    return app.openapi_schema


def operations(document: Json) -> Iterator[tuple[Route, Json]]:
    """Method, path and entry of every route."""
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield (method, path), operation


def _correct(route: Route, operation: Json) -> None:
    answers: Json = operation["responses"]
    if route in BODIES:
        content = {media_type: dict(BYTES) for media_type in BODIES[route]}
        operation["requestBody"] = {"required": True, "content": content}
    if route in ANSWERS:
        answers.clear()
        for status, media_types in ANSWERS[route].items():
            answers[str(status)] = _answer(route, status, media_types)
    if route in ALSO:
        (known,) = (answer for status, answer in answers.items() if status in ("200", "201"))
        answers[str(ALSO[route])] = known
    for refused in _problems(route, operation):
        content = {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
        answers[str(refused)] = {"description": "Problem (RFC 9457)", "content": content}
    if route in EXAMPLES:
        operation["requestBody"]["content"]["application/json"]["example"] = EXAMPLES[route]


def _answer(route: Route, status: int, media_types: tuple[str, ...]) -> Json:
    kinds = {"application/json": JSON, "text/event-stream": TEXT, "text/plain": TEXT}
    words = {101: "Switching to the WebSocket", 206: "Part", 304: "Still the same"}
    answer: Json = {"description": words.get(status, "Done")}
    if media_types:
        answer["content"] = {media_type: dict(kinds.get(media_type, BYTES)) for media_type in media_types}
    if route in HEADERS:
        answer["headers"] = {name: dict(TEXT) for name in HEADERS[route]}
    return answer


def _problems(route: Route, operation: Json) -> list[int | str]:
    """Statuses of the problems that a route may answer."""
    found: set[int] = {500, 503, *PROBLEMS.get(route, ())}
    if operation.get("security"):
        found |= {401, 403}
    if "{" in route[1]:
        found |= {400, 404}
    if operation.get("parameters") or operation.get("requestBody"):
        found |= {400, 422}
    if operation.get("requestBody"):
        found |= {413}
    return [*sorted(found), "default"]
