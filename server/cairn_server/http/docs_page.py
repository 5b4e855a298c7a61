"""The routes for people: one page of plain HTML made from the OpenAPI document, without anything from elsewhere."""

import json
from html import escape
from typing import Any

Json = dict[str, Any]

STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}
body{color:#222;background:#fff}
h2{font:600 1rem ui-monospace,monospace;margin:2.5rem 0 .5rem;padding-top:.5rem;border-top:1px solid #ccc}
table{border-collapse:collapse;width:100%}td,th{text-align:left;vertical-align:top;padding:.15rem .75rem .15rem 0}
code,pre{font:.9em ui-monospace,monospace}pre{background:#f4f4f4;padding:.75rem;overflow:auto}nav a{display:block}
@media(prefers-color-scheme:dark){body{color:#ddd;background:#1b1b1b}pre{background:#2a2a2a}a{color:#8bf}}"""


def docs_page(document: Json) -> str:
    """The page."""
    routes = [
        (method.upper(), path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
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
