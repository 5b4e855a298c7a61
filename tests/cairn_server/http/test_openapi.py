"""The OpenAPI document says what the routes do, and the page for people is made of nothing else."""

import json
import re
from typing import Any

import httpx
import pytest
from tests.fixtures.server.access import register
from tests.fixtures.server.answers import first_cell_path
from tests.fixtures.server.live import Live
from tests.fixtures.server.protocol_document import routes_of
from tests.fixtures.server.pushes import JPEG, PNG, pushed

from cairn_server.http.openapi import operations
from cairn_server.store.store_rows import MapRow

UNDOCUMENTED = {("GET", "/openapi.json")}
PROBLEM = "application/problem+json"
EXAMPLES = (
    ("put", "/maps/{name}"),
    ("post", "/maps/{name}/branches"),
    ("post", "/maps/{name}/branches/{branch}/missing"),
    ("post", "/maps/{name}/retracts"),
    ("post", "/maps/{name}/main/export/tickets"),
    ("put", "/maps/{name}/branches/{branch}/status"),
)
"""Routes whose entries have an example of a body."""


@pytest.fixture(scope="module")
def document(live: Live) -> dict[str, Any]:
    found: dict[str, Any] = live.http.get("/openapi.json").json()
    return found


@pytest.fixture(scope="module")
def row(live: Live) -> MapRow:
    """A map with a robot and a commit."""
    made = live.new_map()
    register(live, made)
    live.push(made, pushed(0, 0))
    live.folded(made)
    return made


def check(document: dict[str, Any], method: str, path: str, answer: httpx.Response) -> None:
    """An answer is one that the document names."""
    told = document["paths"][path][method.lower()]["responses"]
    assert str(answer.status_code) in told, (method, path, answer.status_code)
    media_type = answer.headers.get("Content-Type", "").partition(";")[0]
    content = told[str(answer.status_code)].get("content", {})
    is_bare = answer.status_code in (204, 304) or not media_type
    assert (not content) if is_bare else media_type in content, (method, path, answer.status_code, media_type)


def test_every_route_is_in_the_document_and_no_other(live: Live, document: dict[str, Any]) -> None:
    told = {(method.upper(), path) for (method, path), _ in operations(document)}
    assert told == routes_of(live) - UNDOCUMENTED
    assert {(method.upper(), path) for method, path in EXAMPLES} <= told


def test_every_error_is_a_problem(document: dict[str, Any]) -> None:
    for (method, path), operation in operations(document):
        assert operation["summary"]
        for status, answer in operation["responses"].items():
            if status == "default" or int(status) >= 400:
                assert list(answer["content"]) == [PROBLEM], (method, path, status)
        assert {"500", "default"} <= operation["responses"].keys()
        is_open = path in ("/", "/assets/{file}", "/healthz", "/readyz", "/docs", "/challenge")
        assert ("401" in operation["responses"]) != is_open
        assert bool(operation.get("security")) != is_open
    assert document["components"]["schemas"]["Problem"]["properties"]["kind"]
    assert "HTTPValidationError" not in json.dumps(document)
    (scheme,) = document["components"]["securitySchemes"].values()
    assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")


def test_all_references_lead_somewhere(document: dict[str, Any]) -> None:
    for name in set(re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(document))):
        assert name in document["components"]["schemas"]


def test_whatever_a_route_answers_to_a_bare_request_is_documented(live: Live, document: dict[str, Any]) -> None:
    place = {"name": live.new_map().name, "branch": "mole", "commit": str(pushed(0, 0).id), "cell": "0,0,0"}
    place |= dict.fromkeys(re.findall(r"{(\w+)}", json.dumps(list(document["paths"]))), "x") | place
    for (method, path), operation in operations(document):
        body = b"{}" if operation.get("requestBody") else b""
        headers = {"Content-Type": "application/json"} if body else {}
        answer = live.ask(method.upper(), path.format(**place), content=body, headers=headers)
        if method != "head":
            check(document, method, path, answer)
        absent = live.ask(method.upper(), path.format(**place | {"name": "no-such-map"}), content=body, headers=headers)
        if method != "head" and "{name}" in path and absent.status_code >= 400:
            check(document, method, path, absent)


def test_answers_of_bytes_are_what_the_document_says(live: Live, row: MapRow, document: dict[str, Any]) -> None:
    cell, cells = "/maps/{name}/main/cells/{cell}", first_cell_path(row)
    etag = live.http.get(cells).headers["ETag"]
    for suffix in ("", ".npz", ".ply", ".view", "?depth=1"):
        check(document, "GET", cell, live.http.get(cells + suffix))
        check(document, "GET", cell, live.http.head(cells + suffix))
    for headers in ({"Range": "bytes=0-1"}, {"Range": "bytes=999999999-"}, {"If-None-Match": etag}):
        check(document, "GET", cell, live.http.get(cells, headers=headers))
    commit = "/maps/{name}/commits/{commit}"
    for number, seed, status in ((1, 1, 201), (1, 1, 200), (1, 2, 409)):
        answer = live.push(row, pushed(number, seed))
        assert answer.status_code == status
        check(document, "PUT", commit, answer)
    for number in (1, 9):
        check(document, "GET", commit, live.http.get(f"/maps/{row.name}/commits/{pushed(number, 1).id}"))
    check(document, "PUT", cell, live.http.put(cells, content=live.http.get(cells).content))
    check(document, "GET", "/metrics", live.http.get("/metrics"))
    view = "/maps/{name}/branches/{branch}/view"
    for picture in (JPEG, PNG, b"neither"):
        check(document, "PUT", view, live.http.put(view.format(name=row.name, branch="mole"), content=picture))
        check(document, "GET", view, live.http.get(view.format(name=row.name, branch="mole")))
    cursor = live.http.get(f"/maps/{row.name}").json()["cursor"]
    check(document, "GET", "/maps/{name}/main/vector", live.http.get(f"/maps/{row.name}/main/vector?at={cursor}"))
    check(document, "GET", "/maps/{name}/events", live.ask("GET", f"/maps/{row.name}/events"))
    assert list(document["paths"][commit]["put"]["requestBody"]["content"]) == ["application/vnd.cairn.commit"]
    assert list(document["paths"][view]["put"]["requestBody"]["content"]) == ["image/jpeg", "image/png"]


@pytest.mark.parametrize("route", EXAMPLES, ids=lambda route: " ".join(route))
def test_every_example_is_taken(live: Live, row: MapRow, document: dict[str, Any], route: tuple[str, str]) -> None:
    method, path = route
    content = document["paths"][path][method]["requestBody"]["content"]
    example = content["application/json"]["example"]
    name = row.name if path != "/maps/{name}" else "example"
    answer = live.http.request(method.upper(), path.format(name=name, branch="mole"), json=example)
    assert answer.is_success, answer.text


def test_the_page_for_people_names_every_route_and_asks_nobody_else(live: Live, document: dict[str, Any]) -> None:
    answer = live.http.get("/docs")
    assert answer.headers["Content-Type"].startswith("text/html")
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    for (method, path), _ in operations(document):
        assert f"<h2>{method.upper()} {path}</h2>" in answer.text
    assert re.findall(r"(?:https?:)?//\w|<script|<link|<img|@import|url\(", answer.text) == []
    anchors = re.findall(r'href="#([^"]+)"', answer.text)
    assert len(set(anchors)) == len(anchors)
    assert set(anchors) == set(re.findall(r'id="([^"]+)"', answer.text))
    assert live.http.get("/").text.count('href="docs"') == 1
