"""Without a token: a stranger on the server's network, and whoever answers a command in a server's place."""

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.fixtures.client.hostile_server import HostileServer, answer
from tests.fixtures.commands import cairn
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer
from tests.fixtures.server.live import DEADLINE_S, Live
from tests.fixtures.server.pushes import MOLE
from tests.fixtures.server.signatures import KEYS

from cairn_map.commits.ids import Author, RobotName
from cairn_map.commits.key_proof import KeyProof, proof_bytes

PROXY = "127.0.0.1"
THERE, NOT_THERE = "map0", "map9"
TICKET = "0" * 32
STRANGE_TEXT = "\x1b]0;mine\x07\x1b[2J\x9b31m\u202e\b"
PATHS = (
    ("GET", ""),
    ("GET", "/log?limit=-1"),
    ("GET", "/events"),
    ("GET", "/live"),
    ("GET", "/main/cells/x.exe"),
    ("GET", "/main/render"),
    ("GET", f"/main/export?ticket={TICKET}"),
    ("GET", f"/main/export?ticket={TICKET}&depth=3&box=0,0,0,1,1,1"),
    ("GET", f"/main/export?ticket={TICKET}&depth=99"),
    ("POST", "/branches"),
    ("POST", "/retracts"),
    ("PUT", "/branches/mole/status"),
    ("PATCH", "/commits/x/upload?digest=1&total=-1&offset=a"),
    ("DELETE", "/branches/mole"),
)
FORWARDED = (
    "junk",
    "",
    ",,,,",
    "1.2.3.4, 5.6.7.8",
    "fe80::1%eth0",
    "[::1]:99",
    "0/0",
    "unknown",
    "9" * 5000,
    "1.1.1.1," * 500,
    "::ffff:127.0.0.1",
)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder = tmp_path_factory.mktemp("guarded")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER, trusted_proxies=PROXY) as server:
        assert server.new_map().name == THERE
        yield server


def status_and_body(answered: httpx.Response) -> tuple[int, Any]:
    return answered.status_code, answered.json()


@pytest.mark.parametrize(("method", "path"), PATHS)
def test_an_answer_without_a_token_is_the_same_whether_the_map_is_there_or_not(
    guarded: Live, method: str, path: str
) -> None:
    there, not_there = (status_and_body(guarded.ask(method, f"/maps/{name}{path}")) for name in (THERE, NOT_THERE))
    assert there == not_there
    assert there[0] in {401, 422}


def test_a_proof_by_a_strangers_key_opens_nothing_and_is_not_shown_to_operators(guarded: Live) -> None:
    known = {"robot": "mole", "incarnation": KEYS[0].incarnation}
    guarded.http.post(f"/maps/{THERE}/branches", json=known, headers=bearer(ENROLLER)).raise_for_status()
    answers = []
    for name, map_name in (("mole", THERE), ("nobody", THERE), ("mole", NOT_THERE)):
        author = Author(RobotName(name), KEYS[3].incarnation)
        challenge = guarded.http.get("/challenge").json()["challenge"]
        mark = KEYS[3].sign_bytes(proof_bytes(f"http://127.0.0.1:{guarded.port}", map_name, author, challenge))
        answers.append(
            guarded.http.post(
                f"/maps/{map_name}/branches",
                json={"robot": name, "incarnation": author.incarnation},
                headers={
                    "Cairn-Proof": KeyProof(author, challenge, f"http://127.0.0.1:{guarded.port}", (mark,)).to_text()
                },
            )
        )
    assert {status_and_body(each)[0] for each in answers} == {401}
    assert len({each.text for each in answers}) == 1
    assert guarded.http.get(f"/maps/{THERE}/keys", headers=bearer(ADMIN)).json()["asking"] == []


@pytest.mark.parametrize("text", ["", "x", "a b c", "mole.0 0 0", "x" * 30_000, "mole\xe9 0 0"])
def test_a_header_that_is_no_proof_is_refused_like_no_token(guarded: Live, text: str) -> None:
    body = {"robot": "mole", "incarnation": MOLE.incarnation}
    headers = {b"Cairn-Proof": text.encode("latin-1")}
    assert guarded.http.post(f"/maps/{THERE}/branches", json=body, headers=headers).status_code in {400, 401, 413}


@pytest.mark.parametrize("text", FORWARDED)
def test_no_address_that_a_proxy_names_is_an_error_of_the_server(guarded: Live, text: str) -> None:
    headers = {"X-Forwarded-For": text, "X-Forwarded-Proto": text}
    assert guarded.http.get("/maps", headers=headers).status_code == 401
    assert guarded.http.get("/maps", headers=headers | bearer(ADMIN)).status_code == 200


def test_a_body_without_a_token_is_refused_before_it_comes(guarded: Live) -> None:
    head = f"PUT /maps/{THERE}/commits/{MOLE}.0 HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n"
    with socket.create_connection(("127.0.0.1", guarded.port), timeout=DEADLINE_S) as link:
        link.sendall(head.encode())
        assert link.recv(12) == b"HTTP/1.1 401"


def test_methods_that_a_stranger_invents_are_one_series_of_figures(guarded: Live) -> None:
    for number in range(20):
        guarded.http.request(f"BREW{number}", "/maps")
    figures = guarded.http.get("/metrics", headers=bearer(ADMIN)).text
    assert "BREW" not in figures
    assert 'method="other"' in figures


@pytest.mark.parametrize("path", ["..%2f..%2fetc", "../../etc/passwd", "%2e%2e/%2e%2e/etc/passwd", "\\..\\x", "%00"])
def test_no_path_leaves_the_consoles_folder(guarded: Live, path: str) -> None:
    with socket.create_connection(("127.0.0.1", guarded.port), timeout=DEADLINE_S) as link:
        link.sendall(f"GET /assets/{path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n".encode())
        assert link.recv(12) in {b"HTTP/1.1 400", b"HTTP/1.1 404"}


@pytest.mark.parametrize("command", [("map", "info"), ("map", "branches"), ("map", "robots", "keys"), ("map", "log")])
def test_no_control_character_of_a_server_reaches_the_terminal(
    guarded: Live, tmp_path: Path, command: tuple[str, ...]
) -> None:
    info = guarded.http.get(f"/maps/{THERE}", headers=bearer(ADMIN)).json()
    status = {"time_s": 1.0, "note": STRANGE_TEXT}
    unknown = dict.fromkeys(("cursor", "behind", "behind_bytes", "view_s"))
    robot = {"branch": "mole", "mode": "high-end", "incarnation": MOLE.incarnation, "last_seen_s": 1.0}
    entry = {"seq": 1, "kind": "+", "id": f"{MOLE}.0", "sha": "0" * 64, "size_bytes": 1, "cells": 1}
    asking = {"author": str(MOLE), "since_s": 1.0, "asked_s": 1.0, "by": STRANGE_TEXT}
    key = {"author": str(MOLE), "since_s": 1.0, "by": STRANGE_TEXT, "may_return": False}
    answers = {
        "branches": [robot | unknown | {"sensors": [STRANGE_TEXT], "status": status}],
        "keys": {"admitted": [key], "asking": [asking]},
        "log": [entry | {"captured_s": None, "via": STRANGE_TEXT, "retracts": []}],
        "sizes": guarded.http.get(f"/maps/{THERE}/sizes", headers=bearer(ADMIN)).json(),
        THERE: info,
    }

    def say(request: bytes) -> list[bytes]:
        name = request.split(b" ")[1].partition(b"?")[0].rpartition(b"/")[2].decode()
        return [answer(json.dumps(answers[name]).encode(), "Content-Type: application/json")]

    with HostileServer(say) as hostile:
        shown = cairn(*command, f"{hostile.url}/maps/{THERE}", folder=tmp_path)
    assert not set(shown) & set(STRANGE_TEXT.replace("]0;mine", "").replace("[2J", "").replace("31m", ""))


def test_what_a_server_bids_keep_for_it_is_not_sent_to_another(guarded: Live, tmp_path: Path) -> None:
    maps = guarded.http.get("/maps", headers=bearer(ADMIN)).content
    with HostileServer(lambda _: [answer(maps, "Content-Type: application/json", "Set-Cookie: a=b")]) as hostile:
        cairn("map", "ls", hostile.url, folder=tmp_path)
        cairn("map", "branches", f"{hostile.url}/maps/{THERE}", folder=tmp_path, code=6)
    assert not any(b"cookie" in request.lower() for request in hostile.requests)
