"""The routes' document: for machines as OpenAPI 3.1, for people as one page of plain HTML made from it.

The framework and the routes' decorators say most of it; what all routes of one form may answer is added here. The
framework's own page loads its scripts from another host, which a robot in the field does not reach.
"""

import json
from collections.abc import Iterator
from functools import cached_property
from html import escape

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema

from cairn_map.wire.messages import Problem
from cairn_server.http.routes.documentation import JSON_BODIES, SCHEMAS_AT, Json, problems

Route = tuple[str, str]
STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}
body{color:#222;background:#fff}
h2{font:600 1rem ui-monospace,monospace;margin:2.5rem 0 .5rem;padding-top:.5rem;border-top:1px solid #ccc}
table{border-collapse:collapse;width:100%}td,th{text-align:left;vertical-align:top;padding:.15rem .75rem .15rem 0}
code,pre{font:.9em ui-monospace,monospace}pre{background:#f4f4f4;padding:.75rem;overflow:auto}nav a{display:block}
@media(prefers-color-scheme:dark){body{color:#ddd;background:#1b1b1b}pre{background:#2a2a2a}a{color:#8bf}}"""


class DocumentedApp(FastAPI):
    """FastAPI application whose document names problems (RFC 9457) for errors."""

    @cached_property
    def document_bytes(self) -> bytes:
        """The document as JSON; encoded once, since strangers ask for it, too."""
        return json.dumps(self.openapi(), ensure_ascii=False, separators=(",", ":")).encode()

    @cached_property
    def page_bytes(self) -> bytes:
        """The document as a page."""
        return docs_page(self.openapi()).encode()

    def openapi(self) -> Json:
        """The document; made once."""
        if self.openapi_schema is None:
            document = get_openapi(
                title=self.title, version=self.version, description=self.description, routes=self.routes
            )
            for (_, path), operation in operations(document):
                _add_problems(path, operation)
            parts = document.setdefault("components", {})
            schemas = parts.setdefault("schemas", {})
            schemas["Problem"] = Problem.model_json_schema()
            _add_bodies(schemas)
            for name in ("HTTPValidationError", "ValidationError"):
                schemas.pop(name, None)
            for scheme in parts.get("securitySchemes", {}).values():
                scheme["description"] = "A token, as PROTOCOL.md section 2 says; a server without tokens takes none."
            self.openapi_schema = document
        return self.openapi_schema


def _add_bodies(schemas: Json) -> None:
    """Add the messages that requests bring, and those in them; of what answers bring, too, the request's form counts.

    The two forms differ in one way: an answer has all fields, and of a request those with a default may be left out.
    """
    _, found = models_json_schema(
        [(model, "validation") for model in JSON_BODIES.values()], ref_template=SCHEMAS_AT + "{model}"
    )
    schemas.update(found["$defs"])


def operations(document: Json) -> Iterator[tuple[Route, Json]]:
    """Method, path and entry of every route."""
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield (method, path), operation


def _add_problems(path: str, operation: Json) -> None:
    """Add the problems that every route of this form may answer."""
    statuses = {500, 503}
    if operation.get("security"):
        statuses |= {401, 403}
    if "{" in path:
        statuses |= {400, 404}
    if operation.get("parameters") or operation.get("requestBody"):
        statuses |= {400, 422}
    if operation.get("requestBody"):
        statuses |= {413}
    found = {str(status): entry for status, entry in problems(*statuses).items()}
    answers = dict(sorted((operation["responses"] | found).items()))
    operation["responses"] = answers | {"default": problems("default")["default"]}


def docs_page(document: Json) -> str:
    """HTML page of a document, without anything from another host."""
    routes = [(method.upper(), path, operation) for (method, path), operation in operations(document)]
    contents = "".join(f'<a href="#{_anchor(m, p)}"><code>{m} {escape(p)}</code></a>' for m, p, _ in routes)
    parts = "".join(_route(method, path, operation) for method, path, operation in routes)
    title = escape(document["info"]["title"])
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}: routes</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style><h1>{title}: routes</h1>'
        "<p>For machines: <a href='openapi.json'>openapi.json</a>. What the routes promise is in PROTOCOL.md, what the "
        f"bytes are in FORMAT.md.</p><nav>{contents}</nav>{parts}</html>"
    )


def _route(method: str, path: str, operation: Json) -> str:
    words = escape(operation.get("description") or operation.get("summary", ""))
    closed = "<p>Takes a token, where the server has tokens.</p>" if operation.get("security") else ""
    return (
        f'<section id="{_anchor(method, path)}"><h2>{method} {escape(path)}</h2><p>{words}</p>{closed}'
        f"{_parameters(operation)}{_body(operation)}{_answers(operation)}</section>"
    )


def _parameters(operation: Json) -> str:
    rows = [
        f"<tr><td><code>{escape(parameter['name'])}</code><td>{escape(parameter['in'])}"
        f"<td>{escape(parameter.get('description', ''))}"
        for parameter in operation.get("parameters", [])
    ]
    return f"<table><tr><th>parameter<th>in<th>{''.join(rows)}</table>" if rows else ""


def _body(operation: Json) -> str:
    content = operation.get("requestBody", {}).get("content", {})
    text = "".join(
        f"<p>Body: <code>{escape(media_type)}</code> {_schema(kind)}</p>" for media_type, kind in content.items()
    )
    example = next((kind["example"] for kind in content.values() if "example" in kind), None)
    return text + (f"<pre>{escape(json.dumps(example, indent=2))}</pre>" if example is not None else "")


def _answers(operation: Json) -> str:
    rows = []
    for status, answer in operation["responses"].items():
        kinds = "<br>".join(
            f"<code>{escape(media_type)}</code> {_schema(kind)}"
            for media_type, kind in answer.get("content", {}).items()
        )
        rows.append(f"<tr><td>{escape(status)}<td>{escape(answer['description'])}<td>{kinds}")
    return f"<table><tr><th>status<th>answer<th>{''.join(rows)}</table>"


def _schema(kind: Json) -> str:
    """The name of a message, if it is one."""
    schema = kind.get("schema", {})
    name = schema.get("$ref") or schema.get("items", {}).get("$ref", "")
    return escape(name.rpartition("/")[2])


def _anchor(method: str, path: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in f"{method}{path}").lower()
