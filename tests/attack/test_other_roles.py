"""Tokens of an operator and of reserved names in wrong hands, and links that are none: nothing of others is lost."""

import logging
import socket
from collections.abc import Iterator

import pytest
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, pushed
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from cairn_map.commits.ids import Author, RobotName
from cairn_map.errors import UnreachableError
from cairn_server.access.rate_limits import HOUR_S, ActLimit
from cairn_server.settings import Quotas
from cairn_server.store.store_rows import MapRow

KEY = "0000000000000001"
ACTS = 5


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    quotas = Quotas(acts_per_hour=ACTS)
    with Live(tmp_path_factory.mktemp("guarded"), admin_token=ADMIN, enrolment_token=ENROLLER, quotas=quotas) as live:
        yield live


def operator(live: Live, row: MapRow, name: str) -> dict[str, str]:
    body = {"role": "operator", "map": row.name}
    answer = live.http.put(f"/tokens/{name}", json=body, headers=bearer(ADMIN)).raise_for_status()
    return bearer(answer.json()["token"])


def test_an_operator_cannot_push_lines_out_of_the_audit_log_by_acts(guarded: Live) -> None:
    """One admission, repeated a hundred thousand times, left no line of what came before."""
    row = guarded.new_map()
    mole, wren = operator(guarded, row, "mallory"), operator(guarded, row, "alice")

    def admit(headers: dict[str, str]) -> int:
        return guarded.http.put(f"/maps/{row.name}/keys/ghost.{KEY}", headers=headers).status_code

    assert [admit(mole) for _ in range(ACTS + 2)] == [204] * ACTS + [429] * 2
    body = {"commits": [f"ghost.{KEY}.0"], "note": ""}
    refused = guarded.http.post(f"/maps/{row.name}/retracts", json=body, headers=mole)
    assert (refused.status_code, kind_of(refused)) == (429, "quota")
    assert int(refused.headers["Retry-After"]) > 60
    # Another operator, and an admin, go on.
    assert admit(wren) == 204
    assert [admit(bearer(ADMIN)) for _ in range(ACTS + 2)] == [204] * (ACTS + 2)


def test_acts_come_back_with_the_time() -> None:
    now_s = [0.0]
    limit = ActLimit(10, steady_s=lambda: now_s[0])
    for _ in range(10):
        limit.take("x", is_admin=False)
    with pytest.raises(UnreachableError, match="10 times an hour"):
        limit.take("x", is_admin=False)
    now_s[0] += HOUR_S / 10
    limit.take("x", is_admin=False)
    limit.take("y", is_admin=False)
    ActLimit(None).take("x", is_admin=False)


@pytest.mark.parametrize("name", ["operator", "initial", "main"])
def test_no_token_and_no_key_is_of_a_name_that_servers_speak_in(guarded: Live, name: str) -> None:
    row = guarded.new_map()
    for role in ("robot", "relay", "enroller"):
        body = {"role": role, "map": row.name, "robot": name}
        answer = guarded.http.put(f"/tokens/{role}-{name}", json=body, headers=bearer(ADMIN))
        assert (answer.status_code, kind_of(answer)) == (400, "reserved_name")
    answer = guarded.http.put(f"/maps/{row.name}/keys/{name}.{KEY}", headers=bearer(ADMIN))
    assert (answer.status_code, kind_of(answer)) == (400, "reserved_name")


def test_a_token_from_before_that_names_a_server_pushes_nothing(guarded: Live) -> None:
    row = guarded.new_map()
    body = {"role": "robot", "map": row.name, "robot": "digger"}
    token = guarded.http.put("/tokens/old", json=body, headers=bearer(ADMIN)).raise_for_status().json()["token"]
    statement = "UPDATE token SET robot = 'operator' WHERE name = 'old'"
    guarded.service.store._writer.run(lambda connection: connection.execute(statement))  # type: ignore[attr-defined]
    commit = pushed(0, 0, Author(RobotName("operator"), MOLE.incarnation))
    answer = guarded.push(row, commit, headers=bearer(token))
    assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")


@pytest.mark.parametrize("origin", ["https://[", "http://[x]", "//[", "http://\u00e4.example"])
def test_an_origin_that_is_none_is_another_sites(guarded: Live, origin: str, caplog: pytest.LogCaptureFixture) -> None:
    row = guarded.new_map()
    head = (
        f"GET /maps/{row.name}/live HTTP/1.1\r\nHost: 127.0.0.1:{guarded.port}\r\nOrigin: {origin}\r\n"
        f"Authorization: Bearer {ADMIN}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    with caplog.at_level(logging.ERROR, "uvicorn.error"), socket.create_connection(("127.0.0.1", guarded.port)) as link:
        link.settimeout(30)
        link.sendall(head.encode("latin-1"))
        assert link.recv(64).startswith(b"HTTP/1.1 403")
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


def test_a_text_that_is_none_cuts_the_link_without_an_error(guarded: Live, caplog: pytest.LogCaptureFixture) -> None:
    row = guarded.new_map()
    url = f"ws://127.0.0.1:{guarded.port}/maps/{row.name}/live"
    caplog.set_level(logging.ERROR, "uvicorn.error")
    with caplog.at_level(logging.INFO), connect(url, additional_headers=bearer(ADMIN)) as link:
        link.recv()
        link.socket.sendall(b"\x81\x82\0\0\0\0\xff\xfe")
        with pytest.raises(ConnectionClosed):
            while True:
                link.recv(timeout=30)
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []
    assert any("a text that is not UTF-8" in record.getMessage() for record in caplog.records)


def test_the_documents_of_the_routes_are_made_once(guarded: Live) -> None:
    """300 strangers, who asked twenty times each and read slowly, held everyone up for three seconds."""
    app = guarded.app
    assert app.document_bytes is app.document_bytes
    assert guarded.http.get("/openapi.json").content == app.document_bytes
    assert guarded.http.get("/docs").content == app.page_bytes
