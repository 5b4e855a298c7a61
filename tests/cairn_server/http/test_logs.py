"""The server's log: one line an event, with ids, for people or for programs; and no token, ever."""

import json
import logging
import signal
import socket
import sys
from pathlib import Path

import pytest
from tests.fixtures.server.live import Live, Process
from tests.fixtures.server.processes import client, make_map
from tests.fixtures.server.pushes import MOLE, pushed

from cairn_server.http.middleware.log_format import REQUEST_ID, JsonFormatter, JunkFilter, TextFormatter, fields

ADMIN, ENROLLER, WRONG = "admin-secret-1234567", "enroller-secret-1234567", "wrong-secret-1234567"


def run(tmp_path: Path, *options: str) -> tuple[list[str], set[str]]:
    """Log lines of a server that was asked all kinds of things, and the tokens and the ticket that were shown to it."""
    for name, secret in (("admin", ADMIN), ("enroller", ENROLLER)):
        (tmp_path / name).write_text(secret)
    files = ("--admin-token-file", str(tmp_path / "admin"), "--enrolment-token-file", str(tmp_path / "enroller"))
    process = Process(tmp_path / "data", *files, *options)
    with client(process) as http:
        http.headers["Authorization"] = f"Bearer {ADMIN}"
        make_map(http)
        body = {"robot": "mole", "incarnation": MOLE.incarnation}
        enroller = {"Authorization": f"Bearer {ENROLLER}"}
        token = http.post("/maps/lab/branches", json=body, headers=enroller).json()["token"]
        commit = pushed(0, 0)
        robot = {"Authorization": f"Bearer {token}", "X-Request-Id": "push-1"}
        answer = http.put(f"/maps/lab/commits/{commit.id}", content=commit.data, headers=robot)
        assert answer.headers["X-Request-Id"] == "push-1"
        http.post("/maps/lab/branches/mole/missing", json={}, headers=robot)
        for secret in (ADMIN, ENROLLER, WRONG, token):
            for headers in (
                {"Authorization": f"Bearer {secret}"},
                {"Authorization": secret},
                {"X-Request-Id": "o d d"},
            ):
                http.get("/maps", params={"token": secret}, headers=headers)
                http.post("/maps/lab/branches", content=json.dumps({"robot": secret}), headers=headers)
                http.post("/maps/lab/retracts", content=secret, headers=headers)
        export = "/maps/lab/main/export"
        ticket = http.post(f"{export}/tickets", json={}, headers={"Authorization": f"Bearer {ADMIN}"}).json()["ticket"]
        assert [http.get(export, params={"ticket": ticket}).status_code for _ in range(2)] == [200, 401]
        http.get("/maps/lab/nothing%0a2026-01-01 forged")
        http.get("/healthz")
    process.send(signal.SIGTERM)
    code, log = process.end()
    assert code == 0
    return log.splitlines(), {ADMIN, ENROLLER, WRONG, token, ticket}


@pytest.mark.processes
def test_every_request_is_one_line_with_its_ids_and_no_line_has_a_token(tmp_path: Path) -> None:
    lines, tokens = run(tmp_path, "-v", "--log-format", "json")
    assert [line for line in lines for token in tokens if token in line] == []
    entries = [json.loads(line) for line in lines]
    (push,) = [entry for entry in entries if entry.get("route", "").endswith("/commits/{commit}")]
    commit = pushed(0, 0)
    assert (push["message"], push["request"], push["level"]) == ("request", "push-1", "info")
    assert (push["map"], push["commit"], push["status"]) == ("lab", str(commit.id), 201)
    assert push["received_bytes"] == len(commit.data)
    assert 0 < push["seconds"] < 60
    assert {entry.get("kind") for entry in entries} >= {"bad_token", "bad_message", "no_route"}
    assert any(entry["message"].startswith("map lab: folded 1") for entry in entries)
    assert any("forged" in entry.get("path", "") for entry in entries)
    assert not any("healthz" in line for line in lines)


def test_a_request_id_that_makes_no_sense_is_replaced(live: Live) -> None:
    for asked in ("a b", "x" * 65, "id=1", ""):
        given = live.http.get("/healthz", headers={"X-Request-Id": asked}).headers["X-Request-Id"]
        assert given != asked and len(given) == 16
    assert live.http.get("/healthz", headers={"X-Request-Id": "a.B-1_"}).headers["X-Request-Id"] == "a.B-1_"


def test_a_line_stays_one_line_whatever_is_in_it() -> None:
    record = logging.LogRecord("cairn", logging.INFO, __file__, 1, "two\nlines %s", ("\r\x1b[0m",), None)
    record.__dict__.update(fields(name='a "b"\n', none=None, number=0.25))
    reset = REQUEST_ID.set("r1")
    text, line = TextFormatter().format(record), json.loads(JsonFormatter().format(record))
    REQUEST_ID.reset(reset)
    assert text.endswith(r'two\nlines \r\u001b[0m name="a \"b\"\n" none=None number=0.25 request=r1')
    assert line["message"] == "two\nlines \r\x1b[0m"
    assert (line["name"], line["none"], line["number"], line["request"]) == ('a "b"\n', None, 0.25, "r1")
    assert line["time"].endswith("Z")


def test_an_exception_is_told_in_either_form() -> None:
    try:
        raise ValueError("why")
    except ValueError:
        record = logging.LogRecord("cairn", logging.ERROR, __file__, 1, "failed", (), sys.exc_info())
    assert "ValueError: why" in TextFormatter().format(record)
    assert "ValueError: why" in json.loads(JsonFormatter().format(record))["exception"]


@pytest.mark.processes
def test_strangers_do_not_fill_the_log_with_requests_that_are_no_http(tmp_path: Path) -> None:
    process = Process(tmp_path / "data")
    with client(process) as http:
        for _ in range(30):
            with socket.create_connection((http.base_url.host, http.base_url.port or 0), timeout=60) as link:
                link.sendall(b"junk\r\n\r\n")
                assert b"400" in link.recv(64)
    process.send(signal.SIGTERM)
    code, log = process.end()
    assert (code, log.count("Invalid HTTP request")) == (0, 1)


def test_a_line_of_junk_comes_once_a_minute_with_the_count_of_the_others() -> None:
    now_s = iter((0.0, 1.0, 2.0, 30.0, 61.0, 62.0))
    junk = JunkFilter(steady_s=lambda: next(now_s))

    def written(message: str, *, name: str = "uvicorn.error", level: int = logging.WARNING) -> str | None:
        record = logging.LogRecord(name, level, __file__, 1, message, None, None)
        return TextFormatter().format(record).split(" ", 2)[2] if junk.filter(record) else None

    assert [written("junk") for _ in range(3)] == ["junk", None, None]
    assert written("other junk") == "other junk"
    assert written("junk") == "junk more=2"
    assert written("junk") is None
    assert [written("ours", name="cairn_server") for _ in range(2)] == ["ours"] * 2
    assert [written("broken", level=logging.ERROR) for _ in range(2)] == ["broken"] * 2
