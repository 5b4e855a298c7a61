"""The server's log: one line an event, with ids, for people or for programs; and no token, ever."""

import json
import logging
import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
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
def test_every_line_is_json_from_the_first_to_the_last(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    (tmp_path / "admin").write_text(ADMIN)
    (tmp_path / "admin").chmod(0o600)
    options = ("--admin-token-file", str(tmp_path / "admin"), "--log-format", "json")
    first = subprocess.Popen(
        [sys.executable, "-m", "cairn_client.main", "serve", "--data", str(tmp_path / "data"), "--port", "0", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    request.addfinalizer(first.kill)
    assert first.stdout is not None
    announced, started = (json.loads(first.stdout.readline()) for _ in range(2))
    assert "is new, and so is the store" in announced["message"]
    with httpx.Client(base_url=started["url"]) as http:
        assert http.get("/maps", headers={"Authorization": f"Bearer {WRONG}"}).status_code == 401
    with socket.create_connection(("127.0.0.1", int(started["url"].rpartition(":")[2])), timeout=60) as link:
        link.sendall(b"junk\r\n\r\n")
        assert b"400" in link.recv(64)
    # A second one on the same folder, which does not start.
    second = subprocess.run(
        [sys.executable, "-m", "cairn_client.main", "serve", "--data", str(tmp_path / "data"), "--port", "0", *options],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    first.send_signal(signal.SIGTERM)
    with first.stdout as rest:
        text = rest.read()  # not `communicate`: it would leave out what `readline` read ahead
    first.wait(timeout=60)
    assert (first.returncode, second.returncode) == (0, 4)
    assert ADMIN not in text + second.stdout + second.stderr
    (refused,) = (json.loads(line) for line in f"{second.stdout}{second.stderr}".splitlines())
    assert refused["message"].startswith("cairn serve: another server works on")
    lines = [json.loads(line) for line in text.splitlines()]
    memory, settings, stopped = (line for line in lines if line["logger"] == "cairn_server.life")
    assert (started["event"], memory["event"], settings["event"]) == ("started", "memory", "settings")
    assert (settings["admin_token"], settings["enrolment_token"]) == ("***", None)
    assert settings["quotas.bytes_per_day"] == 128_000_000_000
    assert "Invalid HTTP request received." in {line["message"] for line in lines}
    (wrong,) = (line for line in lines if "wrong token from 127.0.0.1" in line["message"])
    assert (wrong["level"], wrong["client"]) == ("warning", "127.0.0.1")
    assert (stopped["event"], stopped["cause"], stopped) == ("stopped", "SIGTERM", lines[-1])
    assert all(line["time"].endswith("Z") for line in lines)


UNTIDY = """
import sys, threading, warnings
from cairn_server.http.middleware.log_format import LogForm, start_logging
import logging
start_logging(LogForm.JSON, logging.WARNING)
sys.stderr.write("compiling kernels: one")
sys.stderr.write(", 1 of 2\\n\\n")
print("printed", file=sys.stderr)
warnings.warn("old")
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
raise ValueError("in the end")
"""


@pytest.mark.processes
def test_what_libraries_and_tracebacks_write_is_json_too() -> None:
    done = subprocess.run([sys.executable, "-c", UNTIDY], capture_output=True, text=True, timeout=60, check=False)
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    assert [line["message"] for line in lines[:2]] == ["compiling kernels: one, 1 of 2", "printed"]
    assert "UserWarning: old" in lines[2]["message"]
    assert [line["exception"].splitlines()[-1] for line in lines[3:]] == [
        "ZeroDivisionError: division by zero",
        "ValueError: in the end",
    ]
    assert done.returncode == 1


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
