"""Tickets for exports: a link saves exactly the file that a token asked for, once and soon, and nothing else."""

import itertools
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from tests.fixtures.server.access import ADMIN, bearer
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.damage import broken_map
from tests.fixtures.server.exports import mapped
from tests.fixtures.server.live import Live, until

from cairn_map.files.export_request import EXPORT_TYPES
from cairn_map.wire.access_messages import CreateToken
from cairn_server.access.auth import ADMIN_FILE
from cairn_server.access.tokens import create_token, revoke_token, rotate_token
from cairn_server.store.store_rows import MapRow
from cairn_server.views import export_tickets, map_exports
from cairn_server.views.export_tickets import TICKET_S, TICKETS_MAX, TICKETS_OF_TOKEN_MAX
from cairn_server.views.map_exports import Export

QUERY = {"format": "ply", "floor_m": -0.5, "p": 0.25}


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Live]:
    """A server with tokens, and a map that two robots have been to."""
    with Live(tmp_path, admin_token=ADMIN) as server:
        server.http.headers["Authorization"] = f"Bearer {ADMIN}"
        yield server


@pytest.fixture
def row(guarded: Live) -> MapRow:
    return mapped(guarded)


def ask(live: Live, row: MapRow, token: str = ADMIN, **query: Any) -> httpx.Response:
    """For a ticket."""
    return live.http.post(f"/maps/{row.name}/main/export/tickets", json=query, headers=bearer(token))


def ticket_of(answer: httpx.Response) -> str:
    assert answer.status_code == 201, answer.text
    return str(answer.json()["ticket"])


def follow(live: Live, row: MapRow | str, ticket: str, **query: Any) -> httpx.Response:
    """The link, as a browser does: without a token."""
    name = row if isinstance(row, str) else row.name
    url = f"http://127.0.0.1:{live.port}/maps/{name}/main/export"
    return httpx.get(url, params={**query, "ticket": ticket}, timeout=60)


def reader_of(live: Live, row: MapRow, name: str = "eye") -> str:
    return create_token(live.service.store, name, CreateToken(role="reader", map=row.name), by=ADMIN_FILE).token


def refused(answer: httpx.Response) -> tuple[int, str]:
    if answer.status_code == 401:
        assert answer.headers["WWW-Authenticate"] == "Bearer"
    return answer.status_code, kind_of(answer)


@pytest.mark.parametrize("form", EXPORT_TYPES)
def test_a_link_brings_what_the_token_brings(guarded: Live, row: MapRow, form: str) -> None:
    asked = {**QUERY, "format": form}
    by_token = guarded.http.get(f"/maps/{row.name}/main/export", params=asked)
    start_s = time.time()
    told = ask(guarded, row, reader_of(guarded, row), **asked).json()
    by_link = follow(guarded, row, told["ticket"], **asked)
    assert by_link.status_code == 200
    assert by_link.content == by_token.content
    same = ("Cairn-Points", "Cairn-Cursor", "Content-Disposition", "Content-Type", "Cache-Control")
    assert [by_link.headers[name] for name in same] == [by_token.headers[name] for name in same]
    assert told["points"] == int(by_token.headers["Cairn-Points"]) > 0
    assert told["size_bytes"] in (None, len(by_token.content))
    assert start_s + TICKET_S <= told["ends_s"] <= time.time() + TICKET_S
    assert len(bytes.fromhex(told["ticket"])) == 16


def test_without_a_token_or_a_ticket_nothing_is_told(guarded: Live, row: MapRow) -> None:
    for name in (row.name, "no-such-map"):
        url = f"http://127.0.0.1:{guarded.port}/maps/{name}/main/export"
        assert refused(httpx.get(url)) == (401, "no_token")
        assert refused(httpx.post(f"{url}/tickets", json={})) == (401, "no_token")


def test_a_ticket_that_nobody_gave_is_refused_and_tells_no_names_of_maps(guarded: Live, row: MapRow) -> None:
    answers = [follow(guarded, name, "0" * 32) for name in (row.name, "no-such-map")]
    assert [refused(answer) for answer in answers] == [(401, "bad_ticket")] * 2
    assert answers[0].content == answers[1].content
    assert follow(guarded, row, "../").status_code == 422
    assert follow(guarded, row, "").status_code == 422


def test_a_wrong_ticket_is_wrong_on_an_open_server_and_beside_a_token_too(
    live: Live, guarded: Live, row: MapRow
) -> None:
    assert refused(follow(live, mapped(live), "0" * 32)) == (401, "bad_ticket")
    beside = guarded.http.get(f"/maps/{row.name}/main/export", params={"ticket": "0" * 32})
    assert refused(beside) == (401, "bad_ticket")


def test_an_open_server_gives_tickets_and_wants_none(live: Live) -> None:
    row = mapped(live)
    answer = live.http.post(f"/maps/{row.name}/main/export/tickets", json=QUERY)
    by_link = follow(live, row, ticket_of(answer), **QUERY)
    assert by_link.content == live.http.get(f"/maps/{row.name}/main/export", params=QUERY).content


def test_a_ticket_is_good_once(guarded: Live, row: MapRow) -> None:
    ticket = ticket_of(ask(guarded, row, **QUERY))
    assert follow(guarded, row, ticket, **QUERY).status_code == 200
    assert refused(follow(guarded, row, ticket, **QUERY)) == (401, "bad_ticket")


def test_a_ticket_is_good_for_its_map_only_and_void_when_it_was_shown_elsewhere(guarded: Live, row: MapRow) -> None:
    other = mapped(guarded)
    ticket = ticket_of(ask(guarded, row, **QUERY))
    assert refused(follow(guarded, other, ticket, **QUERY)) == (401, "bad_ticket")
    assert refused(follow(guarded, row, ticket, **QUERY)) == (401, "bad_ticket")


@pytest.mark.parametrize("other", [{"p": 0.2}, {"format": "pcd"}, {"box": "-1,-1,-1,1,1,1"}, {"depth": 1}])
def test_a_ticket_is_good_for_its_file_only(guarded: Live, row: MapRow, other: dict[str, Any]) -> None:
    ticket = ticket_of(ask(guarded, row, **QUERY))
    assert refused(follow(guarded, row, ticket, **{**QUERY, **other})) == (401, "bad_ticket")


def test_a_ticket_is_good_for_half_a_minute(guarded: Live, row: MapRow, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = time.monotonic()
    monkeypatch.setattr(export_tickets, "time", SimpleNamespace(monotonic=lambda: now_s, time=time.time))
    first, second = (ticket_of(ask(guarded, row, **QUERY)) for _ in range(2))
    now_s += TICKET_S - 0.01
    assert follow(guarded, row, first, **QUERY).status_code == 200
    now_s += 0.01
    assert refused(follow(guarded, row, second, **QUERY)) == (401, "bad_ticket")


def kept(live: Live) -> list[Export]:
    return [ticket.export for ticket in live.service.views.tickets._kept.values()]


@pytest.mark.slow
def test_a_file_that_nobody_comes_for_goes_by_itself(
    guarded: Live, row: MapRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export_tickets, "TICKET_S", 1.0)
    for _ in range(TICKETS_OF_TOKEN_MAX):
        ticket_of(ask(guarded, row, **QUERY))
    exports = kept(guarded)
    assert exports
    until(lambda: all(export.aside.closed for export in exports), "the cells that were laid aside are gone")
    assert kept(guarded) == []
    ticket_of(ask(guarded, row, **QUERY))


@pytest.mark.parametrize("end", [revoke_token, rotate_token])
def test_a_ticket_ends_with_the_token_that_asked_for_it(guarded: Live, row: MapRow, end: Any) -> None:
    ticket = ticket_of(ask(guarded, row, reader_of(guarded, row), **QUERY))
    (export,) = kept(guarded)
    end(guarded.service.store, "eye", by=ADMIN_FILE)
    assert refused(follow(guarded, row, ticket, **QUERY)) == (401, "bad_token")
    assert export.aside.closed


def test_a_token_has_so_many_tickets_at_once_and_another_its_own(guarded: Live, row: MapRow) -> None:
    eye, ear = reader_of(guarded, row), reader_of(guarded, row, "ear")
    tickets = [ticket_of(ask(guarded, row, eye, **QUERY)) for _ in range(TICKETS_OF_TOKEN_MAX)]
    answer = ask(guarded, row, eye, **QUERY)
    assert refused(answer) == (429, "too_many_tickets")
    assert float(answer.headers["Retry-After"]) == TICKET_S
    ticket_of(ask(guarded, row, ear, **QUERY))
    assert follow(guarded, row, tickets[0], **QUERY).status_code == 200
    ticket_of(ask(guarded, row, eye, **QUERY))


def test_all_tokens_together_have_so_many_tickets(guarded: Live, row: MapRow) -> None:
    readers = [reader_of(guarded, row, f"eye{n}") for n in range(TICKETS_MAX // TICKETS_OF_TOKEN_MAX + 1)]
    asked = [ask(guarded, row, token, **QUERY) for token in readers for _ in range(TICKETS_OF_TOKEN_MAX)]
    # Who comes last takes of those that have more, up to one less than they have.
    assert [answer.status_code for answer in asked] == [201] * (TICKETS_MAX + TICKETS_OF_TOKEN_MAX - 1) + [429]
    assert kind_of(asked[-1]) == "too_many_tickets"
    followed = [follow(guarded, row, ticket_of(answer), **QUERY).status_code for answer in asked[:-1]]
    assert followed.count(200) == TICKETS_MAX
    assert followed[TICKETS_MAX:] == [200] * (TICKETS_OF_TOKEN_MAX - 1)


@pytest.mark.parametrize(
    ("query", "refusal"),
    [
        ({"box": "1,0,0,0,1,1"}, (400, "bad_box")),
        ({"depth": 60}, (400, "bad_style")),
        ({"format": "las"}, (422, "bad_message")),
        ({"ticket": "0" * 32}, (422, "bad_message")),
    ],
)
def test_what_the_export_would_refuse_its_ticket_is_refused_for(
    guarded: Live, row: MapRow, query: dict[str, Any], refusal: tuple[int, str]
) -> None:
    for _ in range(TICKETS_OF_TOKEN_MAX + 1):  # none of which takes a place
        assert refused(ask(guarded, row, **query)) == refusal


def test_an_export_that_is_too_large_or_damaged_gets_no_ticket(
    guarded: Live, row: MapRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert refused(ask(guarded, broken_map(guarded, keep_diffs=False))) == (500, "damaged_store")
    monkeypatch.setattr("cairn_server.views.map_exports.VOXELS_EXPORTED_MAX", 1)
    assert refused(ask(guarded, row, **QUERY)) == (413, "too_large")


def test_a_link_brings_the_map_as_it_was_when_the_ticket_was_given(guarded: Live, row: MapRow) -> None:
    before = guarded.http.get(f"/maps/{row.name}/main/export", params=QUERY)
    ticket = ticket_of(ask(guarded, row, **QUERY))
    guarded.http.post(f"/maps/{row.name}/retracts", json={"robot": "mole"}).raise_for_status()
    guarded.folded(row)
    assert guarded.http.get(f"/maps/{row.name}/main/export", params=QUERY).headers["Cairn-Points"] == "0"
    assert follow(guarded, row, ticket, **QUERY).content == before.content


def test_a_server_that_stops_lets_all_files_go(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row = mapped(live)
        ticket_of(live.http.post(f"/maps/{row.name}/main/export/tickets", json=QUERY))
        (export,) = kept(live)
    assert export.aside.closed


@pytest.mark.parametrize("way", ["token", "link"])
def test_an_export_on_its_way_is_cut_when_its_token_ends(
    guarded: Live, row: MapRow, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, way: str
) -> None:
    caplog.set_level(logging.ERROR, "uvicorn.error")
    whole = 64 << 20  # far more than the sockets hold

    def zeros(*about: object) -> Iterator[bytes]:
        yield from itertools.repeat(bytes(1 << 20), whole >> 20)

    monkeypatch.setattr(map_exports, "point_file", zeros)
    token = reader_of(guarded, row)
    ticket = ticket_of(ask(guarded, row, token, format="laz")) if way == "link" else None
    query = {"format": "laz", **({"ticket": ticket} if ticket else {})}
    url = f"http://127.0.0.1:{guarded.port}/maps/{row.name}/main/export"
    came = 0
    with (
        httpx.stream("GET", url, params=query, headers={} if ticket else bearer(token), timeout=60) as answer,
        pytest.raises((httpx.RemoteProtocolError, httpx.ReadError)),
    ):
        assert answer.status_code == 200
        revoke_token(guarded.service.store, "eye", by=ADMIN_FILE)
        for part in answer.iter_bytes():
            came += len(part)
    assert came < whole // 2
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []
