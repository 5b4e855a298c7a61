"""Changed bytes and bombs at the binary routes of a real process: no failure, no hang, memory within a bound."""

import json
import random
import signal
from collections.abc import Callable, Iterator

import httpx
import pytest
from tests.fixtures.map.bombs import BOMBS, DEEP, commit_of
from tests.fixtures.map.made import ROBOT, SMALL
from tests.fixtures.server.live import DEADLINE_S, Live, Process
from tests.fixtures.server.pushes import pushed
from tests.fuzz.json_mutator import mutated_json
from tests.fuzz.wrapping_mutator import bytewise, mutated_commit

from cairn_map.wire.messages import CreateMap, MissingRequest, Problem

pytestmark = pytest.mark.fuzz

BODIES = 150
"""For each route."""
GROWTH_MB_MAX = 128
"""Growth of the process's largest resident memory above what it took when it had answered each route once."""
GROWTH_JSON_MB_MAX = 384
"""The framework parses 16 MB of JSON whole, at some 20 bytes for each byte of it."""
ANSWER_S = 10.0
COMMIT = pushed(0, 0)
PUSH, MISSING = f"/maps/lab/commits/{COMMIT.id}", "/maps/lab/branches/mole/missing"


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    made = Process(tmp_path_factory.mktemp("fuzzed"))
    yield made
    made.send(signal.SIGTERM)
    assert made.end()[0] == 0


@pytest.fixture(scope="module")
def http(process: Process) -> Iterator[httpx.Client]:
    assert process.url
    with httpx.Client(base_url=process.url, timeout=ANSWER_S) as client:
        as_json = {"Content-Type": "application/json"}
        # The first of each may compile and import.
        client.timeout = httpx.Timeout(DEADLINE_S)
        for name, geometry in (("lab", SMALL), ("deep", DEEP)):
            body = CreateMap(geometry=geometry).model_dump_json()
            client.put(f"/maps/{name}", content=body, headers=as_json).raise_for_status()
        client.put(PUSH, content=COMMIT.data).raise_for_status()
        client.post(MISSING, json={}).raise_for_status()
        client.timeout = httpx.Timeout(ANSWER_S)
        yield client


def mutants(seed: int, sound: list[bytes], mutated: Callable[..., bytes]) -> Iterator[bytes]:
    rng = random.Random(seed)
    for _ in range(BODIES):
        yield mutated(rng.choice(sound), rng, bytewise(rng))


def check(answer: httpx.Response) -> None:
    assert answer.status_code < 500, answer.text
    if answer.status_code >= 400:
        assert Problem.model_validate_json(answer.content).status == answer.status_code


def test_changed_bytes_are_taken_or_refused_within_a_bound_of_memory(process: Process, http: httpx.Client) -> None:
    before_mb = process.peak_mb()
    cursor = http.get("/maps/lab").json()["cursor"]
    requests = [
        MissingRequest().model_dump_json().encode(),
        json.dumps({"cursor": cursor, "cells": [{"cell": [0, 0, 0], "cursor": cursor}], "compare": True}).encode(),
    ]
    for body in mutants(1, [pushed(n, n).data for n in range(4)], mutated_commit):
        check(http.put(PUSH, content=body))
    for body in mutants(2, requests, mutated_json):
        check(http.post(MISSING, content=body, headers={"Content-Type": "application/json"}))
    assert process.peak_mb() - before_mb < GROWTH_MB_MAX


@pytest.mark.parametrize("name", [name for name in BOMBS if not name.startswith("reply")])
def test_bombs_are_refused_within_a_bound_of_memory(process: Process, http: httpx.Client, name: str) -> None:
    data = BOMBS[name][1]()
    body = commit_of([data]) if name.startswith("cell") else data
    before_mb = process.peak_mb()
    answer = http.put(f"/maps/deep/commits/{ROBOT}.0", content=body)
    assert 400 <= answer.status_code < 500
    assert process.peak_mb() - before_mb < GROWTH_MB_MAX


@pytest.mark.parametrize("path", [MISSING, "/maps/lab/branches", "/maps/lab/retracts"])
@pytest.mark.parametrize("part", [b'"%x":0', b"{}", b"0"])
def test_json_that_is_wrong_everywhere_is_refused_at_its_first_error(
    process: Process, http: httpx.Client, path: str, part: bytes
) -> None:
    size_bytes = 8_000_000 if path == MISSING else 900_000
    if b"%" in part:
        body = b"{" + b",".join(part % n for n in range(size_bytes // 12)) + b"}"
    else:
        body = b'{"commits":' * (path != MISSING) + b'{"cells":' * (path == MISSING)
        body += b"[" + (part + b",") * (size_bytes // len(part) // 2) + part + b"]}"
    before_mb = process.peak_mb()
    answer = http.post(path, content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert process.peak_mb() - before_mb < GROWTH_JSON_MB_MAX


def test_a_complaint_has_none_of_the_words_of_the_library(live: Live) -> None:
    """`body: Value error, a robot's token names ...` was answered, and shown as it was."""
    for body in ({"role": "robot"}, {"role": "admin", "robot": "mole"}):
        answer = live.http.put("/tokens/eye", json=body)
        assert answer.status_code == 422
        assert "token" in answer.json()["detail"]
        assert "Value error" not in answer.json()["detail"]
