"""Whatever is sent to whatever route: never 5xx, every error a problem of a documented kind, and the server goes on."""

import json
import urllib.parse

import httpx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.server.live import Live
from tests.fixtures.server.protocol_document import ROUTES, documented_kinds
from tests.fixtures.server.pushes import pushed

from cairn_map.wire.messages import MissingRequest, Problem

KINDS = documented_kinds()
COMMIT = pushed(0, 0)
CURSOR = f"{'0' * 32}.1.{'0' * 32}"
SOUND: dict[str, list[bytes]] = {
    "PUT /maps/{name}": [b"{}", b'{"geometry":{"voxel_edge_um":50000,"depth":3,"channels":[]}}'],
    "PUT /tokens/{token}": [b'{"role":"reader","lifetime_s":9}', b'{"role":"robot","robot":"mole","map":"lab"}'],
    "POST /maps/{name}/branches": [b'{"robot":"mole","incarnation":"0123456789abcdef"}'],
    "PUT /maps/{name}/commits/{commit}": [COMMIT.data],
    "POST /maps/{name}/retracts": [b'{"robot":"mole"}', json.dumps({"commits": [str(COMMIT.id)]}).encode()],
    "POST /maps/{name}/main/export/tickets": [b'{"format":"npz","box":"0,0,0,1,1,1","p":0.5}'],
    "PUT /maps/{name}/branches/{branch}/status": [b'{"time_s":1,"battery":0.5,"note":"x"}'],
    "PUT /maps/{name}/branches/{branch}/view": [b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"],
    "POST /maps/{name}/branches/{branch}/missing": [
        MissingRequest().model_dump_json().encode(),
        json.dumps({"cursor": CURSOR, "cells": [{"cell": [0, 0, 0], "cursor": None}]}).encode(),
    ],
}
HOSTILE = [
    "..",
    "%2e%2e",
    "%2e%2e%2f",
    "%00",
    "a%00b",
    "x" * 10_000,
    "%F0%9F%A6%AB",
    "%ff%fe",
    "-",
    "%",
    "%0d%0aX:1",
    "*",
]
SEGMENTS = {
    "name": ["lab", "lab", "lab", "LAB", "la"],
    "branch": ["mole", "operator"],
    "commit": [str(COMMIT.id), str(COMMIT.id), "mole.0123456789abcdef.999999999999999", "mole"],
    "token": ["eye", "eye", "lab:mole", "admin"],
    "cell": ["0,0,0", "-1,0,2", "0,0,0.ply", "0,0,0.npz", "1e3,0,0", "9999999,0,0"],
}


@st.composite
def segments(draw: st.DrawFn, name: str) -> str:
    """A value in a path, mostly a sensible one."""
    if draw(st.integers(0, 3)):
        return draw(st.sampled_from(SEGMENTS[name]))
    return draw(st.one_of(st.sampled_from(HOSTILE), st.text(max_size=20).map(_quoted)))


def _quoted(text: str) -> str:
    return urllib.parse.quote(text, safe="", errors="replace")


@st.composite
def bodies(draw: st.DrawFn, route: str) -> bytes:
    """A sound body, a damaged one, other JSON, or noise."""
    sound = draw(st.sampled_from([b"", *SOUND.get(route, [])]))
    way = draw(st.sampled_from(["sound", "cut", "flip", "json", "noise", "other"]))
    if way == "cut" and sound:
        return sound[: draw(st.integers(0, len(sound) - 1))]
    if way == "flip" and sound:
        at = draw(st.integers(0, len(sound) - 1))
        return sound[:at] + draw(st.binary(min_size=1, max_size=4)) + sound[at + 1 :]
    if way == "json":
        value = st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(
                    st.sampled_from(["cells", "cell", "cursor", "robot", "geometry", "commits", "é"]), inner
                )
            ),
            max_leaves=8,
        )
        return json.dumps(draw(value)).encode()
    if way == "noise":
        return draw(st.binary(max_size=200))
    if way == "other":
        return draw(st.sampled_from([body for sound in SOUND.values() for body in sound]))
    return sound


HEADERS = st.fixed_dictionaries(
    {
        "Content-Type": st.sampled_from(
            ["application/json", "application/octet-stream", "text/plain", "multipart/x", ""]
        )
    },
    optional={
        "If-None-Match": st.sampled_from(["*", '"x"', "W/", ",,,", "é", "\x7f"]),
        "Authorization": st.sampled_from(["", "Bearer", "Bearer x", "Bearer é", "Basic eDp4", "Bearer " + "x" * 9000]),
        "Range": st.just("bytes=0-1," * 500),
        "Expect": st.just("100-continue"),
        "Accept-Encoding": st.just("gzip;q=9"),
    },
)
QUERIES = st.dictionaries(
    st.sampled_from(["after", "limit", "author", "box", "depth", "at", "é"]),
    st.sampled_from(
        ["", "0", "-1", "1e9", str(10**30), "mole.0123456789abcdef", "\0", "x" * 5000, "NaN", "0,0,0,1,1,1", CURSOR]
    ),
    max_size=3,
)


@pytest.mark.slow
@settings(max_examples=150)
@given(st.data())
def test_nothing_that_is_sent_makes_the_server_fail(live: Live, data: st.DataObject) -> None:
    method, path = data.draw(st.sampled_from(ROUTES))
    body = data.draw(bodies(f"{method} {path}"))
    if data.draw(st.integers(0, 9)) == 0:
        method = data.draw(
            st.sampled_from(["GET", "PUT", "POST", "DELETE", "PATCH", "HEAD", "OPTIONS", "TRACE", "BREW"])
        )
    for name in SEGMENTS:
        if f"{{{name}}}" in path:
            path = path.replace(f"{{{name}}}", data.draw(segments(name)))
    query = urllib.parse.urlencode(data.draw(QUERIES))
    check(live, method, f"{path}?{query}" if query else path, body, data.draw(HEADERS))


def check(live: Live, method: str, target: str, body: bytes, headers: dict[str, str]) -> httpx.Response:
    """Send it as it is; the answer is no failure, and a problem if it is an error."""
    raw_headers = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    url = live.http.base_url.copy_with(raw_path=target.encode("ascii"))
    answer = live.answer_to(live.http.build_request(method, url, content=body, headers=raw_headers))
    assert answer.status_code < 500, answer.text
    if answer.status_code >= 400 and method != "HEAD":
        assert answer.headers["Content-Type"] == "application/problem+json", answer.text
        problem = Problem.model_validate_json(answer.content)
        assert problem.kind in KINDS
        assert problem.status == answer.status_code
        assert problem.detail
    return answer


@pytest.mark.parametrize("hostile", HOSTILE)
@pytest.mark.parametrize(
    "place", ["/maps/{}", "/maps/lab/branches/{}", "/maps/lab/main/cells/{}", "/{}", "/maps/{}/log"]
)
def test_hostile_names_in_paths_are_refused(live: Live, place: str, hostile: str) -> None:
    for method in ("GET", "DELETE"):
        answer = check(live, method, place.format(hostile), b"", {})
        assert answer.status_code in (400, 404, 405) or (answer.status_code, hostile) == (200, "..")


@pytest.mark.parametrize(
    "path", ["/maps/{}%2flog", "/maps/{}%2Flog", "/maps/{}/main%2fcells", "/maps%2f{}/log", "/%2f"]
)
@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE"])
def test_an_encoded_slash_is_no_slash(live: Live, method: str, path: str) -> None:
    name = live.new_map().name
    answer = check(live, method, path.format(name), b"", {})
    assert (answer.status_code, answer.json()["kind"]) == (400, "bad_path")
    assert check(live, "GET", f"/maps/{name}/log", b"", {}).status_code == 200


@pytest.mark.parametrize(
    "body",
    [
        b'{"\\ud800":1}',
        b'{"note":"\\ud800","robot":"mole"}',
        b'{"note":"\\u0000","robot":"mole"}',
        b'{"' + b"x" * 100_000 + b'":1}',
        b"[" * 100_000,
        b'{"commits":[' + b"0," * 200_000 + b"0]}",
        b'{"commits":' + b"1" * 5000 + b"}",
        b"\xff\xfe{",
        b"NaN",
        b'{"robot":1e999}',
    ],
    ids=lambda body: repr(body[:20]),
)
@pytest.mark.parametrize("path", ["/maps/lab/retracts", "/maps/lab/branches", "/maps/lab/branches/mole/missing"])
def test_hostile_json_is_refused(live: Live, path: str, body: bytes) -> None:
    live.http.put("/maps/lab", content=b"{}", headers={"Content-Type": "application/json"})
    assert check(live, "POST", path, body, {"Content-Type": "application/json"}).status_code in (400, 404, 413, 422)


def test_the_server_still_serves_and_folds_afterwards(live: Live) -> None:
    row = live.new_map()
    assert live.http.get("/healthz").json() == {"status": "ok"}
    assert live.push(row, COMMIT).status_code == 201
    assert live.cells(row).keys() == COMMIT.cells.keys()


def test_a_request_of_another_version_of_the_protocol_is_refused_by_a_kind_of_its_own(live: Live) -> None:
    for version, status in (("1", 200), ("2", 400), ("", 400)):
        answer = live.http.get("/maps", headers={"Cairn-Protocol": version})
        assert (answer.status_code, answer.json()["kind"] if status == 400 else "") == (
            status,
            "unknown_protocol" if status == 400 else "",
        )
