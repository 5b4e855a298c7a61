"""Whoever answers in the server's place: nothing is inflated, nothing unbounded is read, nothing poisonous is kept."""

import json
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import repeat
from pathlib import Path

import pytest
from tests.fixtures.client.hostile_server import HostileServer, answer
from tests.fixtures.client.made import MAP, A, committed, cursor, foreign, header, opened, seen

from cairn_client.http.api import ANSWER_BYTES_MAX, REPLY_BYTES_MAX
from cairn_client.http.backoff import RETRY_AFTER_MAX_S
from cairn_client.http.event_stream import EVENT_BYTES_MAX
from cairn_client.http.http_link import Link, index_of
from cairn_client.http.live_listener import events
from cairn_client.relay.link import RelayApi
from cairn_client.replica.replica import Replica
from cairn_client.sync import requests
from cairn_client.sync.requests import GetUpload
from cairn_client.sync.sync import ROUNDS_MAX, fetch_cells, fetch_missing, push_commits
from cairn_map.errors import (
    BadInputError,
    CairnError,
    DamagedDataError,
    DeniedError,
    NotFoundError,
    UnreachableError,
)
from cairn_map.evidence.grid import Cell, cell_of_key
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import (
    INDEX_PAGE,
    JSON_FIELDS_MAX,
    JSON_VALUES_MAX,
    CellEntry,
    CellIndex,
    CreateMap,
    MissingRequest,
    PushReceipt,
    Register,
    ReplyHeader,
    Retract,
)

COMMIT = foreign(0)
BOMB = zlib.compress(bytes(1 << 20))
CODINGS = ("gzip", "gzip, gzip", "deflate", "br", "zstd", "identity, gzip", "x" * 500)
Call = Callable[[RelayApi], object]

CALLS: dict[str, Call] = {
    "create_map": lambda api: api.create_map(MAP, CreateMap()),
    "maps": lambda api: api.maps(),
    "map_info": lambda api: api.map_info(MAP),
    "register": lambda api: api.register(MAP, Register(robot="mole", incarnation=COMMIT.author.incarnation)),
    "branches": lambda api: api.branches(MAP),
    "upload": lambda api: api.upload(MAP, GetUpload(COMMIT, "0" * 64)),
    "retract": lambda api: api.retract(MAP, Retract(robot="mole")),
    "create_token": lambda api: api.create_token("eye", CreateToken(role="reader")),
    "tokens": lambda api: api.tokens(),
    "log": lambda api: api.log(MAP),
    "cell_index": lambda api: api.cell_index(MAP),
    "vector_at": lambda api: api.vector_at(MAP, str(cursor(1))),
    "missing": lambda api: list(api.missing(MAP, "mole", MissingRequest())),
    "events": lambda api: list(events(api, MAP)),
    "held": lambda api: api.held(MAP),
}
"""Requests whose answers are read as messages."""
BYTES: dict[str, Call] = {
    "view": lambda api: api.view(MAP, "mole"),
    "probe": lambda api: api.probe("/healthz"),
    "commit": lambda api: api.commit(MAP, COMMIT),
    "signed_commit": lambda api: api.signed_commit(MAP, COMMIT),
    "stream": lambda api: list(api.stream("/x", at_most_bytes=ANSWER_BYTES_MAX)),
}
"""Requests whose answers are bytes."""


class Mouth:
    """What the hostile server says next."""

    def __init__(self) -> None:
        self.parts: Callable[[], Iterable[bytes]] = lambda: [answer()]

    def says(self, *parts: bytes) -> None:
        self.parts = lambda: parts


@pytest.fixture(scope="module")
def mouth() -> Mouth:
    return Mouth()


@pytest.fixture(scope="module")
def hostile(mouth: Mouth) -> Iterator[HostileServer]:
    with HostileServer(lambda head: mouth.parts()) as server:
        yield server


@pytest.fixture
def api(hostile: HostileServer) -> Iterator[RelayApi]:
    with RelayApi(hostile.url) as api:
        yield api


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


@pytest.mark.parametrize("name", [*CALLS, *BYTES])
def test_an_answer_with_a_coding_is_refused_unread(api: RelayApi, mouth: Mouth, name: str) -> None:
    for coding in CODINGS:
        mouth.says(answer(BOMB, f"Content-Encoding: {coding}"))
        before = api.traffic.down_bytes
        with pytest.raises(DamagedDataError) as caught:
            (CALLS | BYTES)[name](api)
        assert caught.value.kind == "encoded_answer"
        assert api.traffic.down_bytes == before


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize(
    ("status", "family"), [("401 x", DeniedError), ("404 x", NotFoundError), ("503 x", UnreachableError)]
)
def test_of_an_error_with_a_coding_the_status_alone_counts(
    api: RelayApi, mouth: Mouth, coding: str, status: str, family: type[CairnError]
) -> None:
    mouth.says(answer(BOMB, f"Content-Encoding: {coding}", status=status))
    with pytest.raises(family) as caught:
        api.map_info(MAP)
    assert caught.value.kind == "http"


def test_no_coding_is_asked_for_and_none_at_all_is_taken(api: RelayApi, mouth: Mouth, hostile: HostileServer) -> None:
    for headers in ([], ["Content-Encoding: identity"], ["Content-Encoding: "]):
        mouth.says(answer(b"ok", *headers))
        assert api.probe("/healthz").body == b"ok"
    asked = [line for line in hostile.requests[-1].split(b"\r\n") if b"ncoding" in line]
    assert asked == [b"Accept-Encoding: identity"]


@pytest.mark.parametrize("name", [*CALLS, *BYTES])
def test_an_answer_that_claims_too_much_is_refused_before_it_comes(api: RelayApi, mouth: Mouth, name: str) -> None:
    if name == "events":  # they have no end, and each has a limit of its own
        return
    mouth.says(f"HTTP/1.1 200 OK\r\nContent-Length: {REPLY_BYTES_MAX + 1}\r\n\r\n".encode(), b"CRNS\x01")
    with pytest.raises(BadInputError) as caught:
        (CALLS | BYTES)[name](api)
    assert caught.value.kind == "too_large"


def test_what_is_no_http_is_no_link(api: RelayApi, mouth: Mouth) -> None:
    start = b"HTTP/1.1 200 OK\r\n"
    chunked = start + b"Transfer-Encoding: chunked\r\n\r\n"
    endless: list[Iterable[bytes]] = [
        [start, *repeat(b"x: y\r\n", 40_000)],
        [start + b"x: ", *repeat(b"x" * 1000, 400)],
        [chunked + b"ffffffffffffffff\r\n", b"xyz"],
        [chunked, *repeat(b"0" * 1000, 400)],
        [chunked + b"5\r\nabc"],
        [chunked + b"0\r\n", *repeat(b"x: y\r\n", 40_000)],
        [start + b"Content-Length: 5\r\n\r\nabc"],
        [start + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\nabcdef"],
        [b"HTTP/1.1 2000 OK\r\n\r\n"],
        [b"\0" * 300_000],
        [b""],
    ]
    for parts in endless:
        mouth.says(*parts)
        with pytest.raises(UnreachableError):
            api.map_info(MAP)


@pytest.mark.parametrize("status", ["301 x", "302 x", "307 x", "308 x", "300 x"])
def test_a_redirect_is_an_error_and_is_not_followed(
    api: RelayApi, mouth: Mouth, hostile: HostileServer, mole: Replica, status: str
) -> None:
    mouth.says(answer(b"", f"Location: {hostile.url}/other", status=status))
    before = len(hostile.requests)
    with pytest.raises(BadInputError):
        api.push(MAP, committed(mole, seen(1)))
    assert len(hostile.requests) == before + 1


@pytest.mark.parametrize(
    ("said", "wait_s"),
    [
        ("5", 5),
        ("31536000", RETRY_AFTER_MAX_S),
        ("9" * 5000, RETRY_AFTER_MAX_S),
        ("-1", None),
        ("1e9", None),
        ("", None),
    ],
)
def test_no_server_sends_a_robot_away_for_more_than_an_hour(
    api: RelayApi, mouth: Mouth, said: str, wait_s: float | None
) -> None:
    mouth.says(answer(b"", f"Retry-After: {said}", status="503 x"))
    with pytest.raises(UnreachableError) as caught:
        api.map_info(MAP)
    assert caught.value.retry_after_s == wait_s


UNSOUND = {
    "nested": b"[" * 100_000,
    "nested objects": b'{"a":' * 100_000,
    "long integer": b"1" * 100_000,
    "integers": b"[" + b"9" * 4000 + b"]",
    "many lists": b"[" + b"[]," * JSON_VALUES_MAX + b"[]]",
    "many objects": b"[" + b"{}," * 200_000 + b"{}]",
    "many fields": b"{" + b",".join(b'"%x":0' % n for n in range(JSON_FIELDS_MAX + 1)) + b"}",
    "surrogate": b'{"name":"\\ud800"}',
    "not UTF-8": b'{"name":"\xff"}',
    "cut": b'{"name":',
    "nothing": b"",
    "nan": b"NaN",
    "null": b"null",
}


@pytest.mark.parametrize("name", CALLS)
def test_json_that_no_server_sends_is_damaged(api: RelayApi, mouth: Mouth, name: str) -> None:
    for text in UNSOUND.values():
        body = b"id: 1.aaaaaaaa.1\nevent: hello\ndata: " + text + b"\n\n" if name == "events" else text
        mouth.says(answer(body))
        try:
            CALLS[name](api)
        except (DamagedDataError, UnreachableError):
            continue
        assert name == "events", "it was taken for an answer"


@pytest.mark.parametrize("name", [name for name in CALLS if name != "missing"])
@pytest.mark.parametrize("text", ["many lists", "many fields"])
def test_json_of_too_many_values_is_refused_before_one_is_made(
    api: RelayApi, mouth: Mouth, name: str, text: str
) -> None:
    start, end = (b"event: hello\ndata: ", b"\n\n") if name == "events" else (b"", b"")
    mouth.says(answer(start + UNSOUND[text] + end))
    with pytest.raises(DamagedDataError) as caught:
        CALLS[name](api)
    assert caught.value.kind == (
        "too_many_values" if len(UNSOUND[text]) < EVENT_BYTES_MAX or not end else "bad_message"
    )


POISON = ["", " ", "é", "x\x7f", "\x01", "x" * 5000]


@pytest.mark.parametrize("text", POISON, ids=repr)
def test_a_header_that_could_not_be_sent_again_is_not_kept(api: RelayApi, mouth: Mouth, text: str) -> None:
    of_cell = (f"Cairn-Cursor: {cursor(1)}", "Cairn-Coverage: {}", f"Cairn-Fingerprint: {'0' * 32}")
    for call, headers in (
        (lambda: api.cell(MAP, Cell(0, 0, 0)), [f"ETag: {text}", *of_cell]),
        (lambda: api.commit(MAP, COMMIT), [f"Cairn-Seal: {text}"]),
        (lambda: api.signed_commit(MAP, COMMIT), [f"Cairn-Signature: {text}"]),
    ):
        mouth.says(answer(b"", *headers))
        with pytest.raises((DamagedDataError, UnreachableError)):
            call()


@pytest.mark.parametrize("text", [*POISON, "a\nb"], ids=repr)
def test_a_token_or_an_event_id_that_could_not_be_sent_again_is_refused(api: RelayApi, mouth: Mouth, text: str) -> None:
    if text:
        with pytest.raises(BadInputError):
            api.use_token(text)
    info = {"name": MAP, "geometry": {}, "sensor_model": {}, "cursor": str(cursor(0)), "cells": 0, "size_bytes": 0}
    info |= {"commits": 0, "branches": 0, "box_m": None}
    mouth.says(answer(json.dumps({"branch": "mole", "token": text, "map": info}).encode()))
    with pytest.raises(DamagedDataError, match="token"):
        CALLS["register"](api)
    if text and "\n" not in text and text != " ":
        mouth.says(answer(f'id: {text}\nevent: beat\ndata: {{"time_s":1}}\n\n'.encode()))
        with pytest.raises(DamagedDataError, match="id"):
            CALLS["events"](api)


UNREADABLE = {
    "to": "x",
    "vector": {"x": [[0, 0]]},
    "stable": {str(COMMIT.author): [[5, 1]]},
    "pending": {str(COMMIT.author): [[0, 1], [1, 2]]},
    "retracts": ["x"],
    "wanted": ["x"],
    "damaged": [((1 << 40, 0, 0), "0" * 32)],
}


@pytest.mark.parametrize("field", UNREADABLE)
def test_of_a_header_that_cannot_be_read_nothing_is_kept(mole: Replica, field: str) -> None:
    """Kept, it ended every later round before it could fetch another one."""
    mole.take_header(header(cursor(1)), asked_by=mole.author)
    texts = header(cursor(2)).model_dump() | {field: UNREADABLE[field]}
    with pytest.raises(BadInputError):
        mole.take_header(ReplyHeader.model_validate(texts), asked_by=mole.author)
    assert mole.header == mole.state.header == header(cursor(1))


def test_a_server_that_is_another_one_each_time_ends_the_round_and_takes_no_commit(
    api: RelayApi, mouth: Mouth, hostile: HostileServer, mole: Replica
) -> None:
    commit = committed(mole, seen(1))
    mouth.says(answer(b'{"kind":"other_log","detail":"gone"}', status="410 x"))
    before = len(hostile.requests)
    with pytest.raises(UnreachableError) as caught:
        Link(api, MAP, branch="mole").hold(fetch_missing(mole))
    assert caught.value.kind == "no_end"
    assert len(hostile.requests) - before == ROUNDS_MAX
    assert mole.push_set() == [commit.id]


def page_of(cells: Iterable[Cell]) -> bytes:
    entries = [
        CellEntry(cell=cell, size_bytes=1, digest="0" * 64, lm=1, fingerprint="0" * 32, voxels=1) for cell in cells
    ]
    return answer(CellIndex(header=header(cursor(1)), cells=entries).model_dump_json().encode())


def test_an_index_whose_pages_do_not_rise_is_refused(api: RelayApi, mouth: Mouth, hostile: HostileServer) -> None:
    cells = [cell_of_key(A + n) for n in range(INDEX_PAGE)]
    for page, asked in ((page_of(cells), 2), (page_of(cells[::-1]), 1), (page_of([cells[0]] * 2), 1)):
        mouth.says(page)
        before = len(hostile.requests)
        with pytest.raises(DamagedDataError, match="rise"):
            index_of(api, MAP)
        assert len(hostile.requests) - before == asked


def test_an_index_without_end_is_refused(
    api: RelayApi, mouth: Mouth, mole: Replica, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "INDEX_CELLS_MAX", 3 * INDEX_PAGE)
    pages = iter(range(100))

    def page() -> Generator[bytes, None, None]:
        first = next(pages) * INDEX_PAGE
        yield page_of(cell_of_key(A + first + n) for n in range(INDEX_PAGE))

    mouth.parts = page
    with pytest.raises(BadInputError) as caught:
        Link(api, MAP, branch="mole").hold(fetch_cells(mole))
    assert caught.value.kind == "too_large"
    assert next(pages) == 4


def test_an_answer_to_a_push_that_is_no_receipt_acknowledges_nothing(
    api: RelayApi, mouth: Mouth, mole: Replica
) -> None:
    commit = committed(mole, seen(1))
    other = PushReceipt(id=str(foreign(0)), state="new").model_dump_json().encode()
    for said in (answer(b"<html>"), answer(BOMB, "Content-Encoding: gzip"), answer(b"{}"), answer(other)):
        mouth.says(said)
        report = Link(api, MAP, branch="mole").hold(push_commits(mole))
        assert (report.pushed, list(report.refused)) == (0, [commit.id])
        assert mole.push_set() == [commit.id]
