"""The server stays reachable while one token asks for as much as it can: acceptance tests 8 and 10 at a small size."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import head, kind_of
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_map.codec.cell_code import encode_cell
from cairn_map.evidence.evidence import empty_evidence
from cairn_map.wire.frames import CellFrame, frames_of
from cairn_map.wire.messages import CURSORS_MAX, Done, More
from cairn_server.http.middleware.body_limit import LONG_AT_ONCE, LONG_BYTES
from cairn_server.http.routes.json_bodies import VALUES_MAX
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.missing import EMPTY_CELLS_MAX

HEALTHY_S = 1.0
"""Contract: /healthz answers within it, whatever goes on."""
BODIES_BYTES = 4 << 20


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with tokens, and with little room for bodies."""
    folder = tmp_path_factory.mktemp("guarded")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER, body_memory_bytes=BODIES_BYTES) as server:
        yield server


def unknown_cells(count: int, *, first: int = 0) -> list[list[int]]:
    return [[n % 1000, n // 1000, 7] for n in range(first, first + count)]


def long_request(row: MapRow, robot: str, cells: int, **fields: object) -> tuple[str, bytes]:
    """Path and body of a `missing` that names cells that nobody ever saw."""
    body = {"groups": [[None, unknown_cells(cells)]], **fields}
    return f"/maps/{row.name}/branches/{robot}/missing", json.dumps(body).encode()


def sent(live: Live, path: str, body: bytes, token: str) -> socket.socket:
    """A link over which a request went that nobody waits for."""
    link = socket.create_connection(("127.0.0.1", live.port), timeout=60)
    fields = (f"Authorization: Bearer {token}", "Content-Type: application/json", f"Content-Length: {len(body)}")
    link.sendall(head(live, "POST", path, *fields) + body)
    return link


def test_cells_that_nobody_saw_come_empty_as_they_always_did_and_many_in_several_replies(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.folded(row)
    asked, got = unknown_cells(2 * EMPTY_CELLS_MAX + 10), dict[int, bytes]()
    ends = []
    while asked:
        answer = live.http.post(f"/maps/{row.name}/branches/mole/missing", json={"groups": [[None, asked]]})
        frames = list(frames_of(answer.content))
        ends.append(type(frames[-1]))
        found = {frame.cell: frame.payload for frame in frames if isinstance(frame, CellFrame)}
        unknown = found.keys() - pushed(0, 0).cells.keys()
        assert unknown and not unknown & got.keys()
        got |= {key: found[key] for key in unknown}
        asked = asked[len(unknown) :]
    assert ends == [More, More, Done]
    for key in list(got)[:: len(got) // 7]:
        assert got[key] == encode_cell(key, empty_evidence(row.geometry), row.geometry).data  # type: ignore[arg-type]


def test_whoever_asks_for_much_waits_behind_itself_and_others_are_served(guarded: Live) -> None:
    row = guarded.new_map()
    mole, wren = (robot_token(guarded, row, name) for name in ("mole", "wren"))
    path, body = long_request(row, "mole", 20_000)
    with ExitStack() as links:
        for _ in range(12):
            links.enter_context(sent(guarded, path, body, mole))
        turns = guarded.app.state.lanes.of(path).turns
        until(lambda: turns.taken == 1, "one of them is at work")
        for n in range(5):
            assert guarded.http.get("/healthz", timeout=HEALTHY_S).status_code == 200
            assert guarded.push(row, pushed(n, 1, WREN), headers=bearer(wren)).status_code == 201
            asked = guarded.http.post(f"/maps/{row.name}/branches/wren/missing", json={}, headers=bearer(wren))
            assert asked.status_code == 200
            assert turns.taken <= 1
    until(lambda: turns.taken == 0, "the work ends with its connections")


def test_work_ends_with_its_connection(guarded: Live) -> None:
    row = guarded.new_map()
    path, body = long_request(row, "mole", CURSORS_MAX, compare=True)
    turns, errors = guarded.app.state.lanes.of(path).turns, guarded.service.figures.errors.labels("cut_off")
    before = errors._value.get()
    with sent(guarded, path, body, robot_token(guarded, row, "mole")):
        until(lambda: turns.taken == 1, "it is at work")
    until(lambda: errors._value.get() == before + 1, "it ended, unfinished")
    assert turns.taken == 0


def test_a_role_is_asked_before_a_body_is_read(guarded: Live) -> None:
    row = guarded.new_map()
    body = {"role": "reader", "map": row.name}
    reader = guarded.http.put(f"/tokens/{row.name}-eyes", json=body, headers=bearer(ADMIN)).json()["token"]
    places = {"name": row.name, "branch": "mole", "commit": str(pushed(0, 0).id), "cell": "0,0,0", "token": "new"}
    places |= {"sha": "0" * 64, "robot": "mole"}
    document = guarded.http.get("/openapi.json").json()["paths"]
    routes = [(method, path) for path, at in document.items() for method, told in at.items() if "requestBody" in told]
    assert len(routes) == 16
    for method, path in routes:
        # Two of them are for readers: an enroller may not use them.
        token = ENROLLER if "tickets" in path or "/main/cells/" in path else reader
        fields = f"Authorization: Bearer {token}", "Content-Type: application/json", "Content-Length: 1000"
        with socket.create_connection(("127.0.0.1", guarded.port), timeout=30) as link:
            query = f"?digest={'0' * 64}&total=1000&offset=0" if path.endswith(("upload", "{sha}")) else ""
            link.sendall(head(guarded, method.upper(), path.format(**places) + query, *fields))
            assert link.recv(1 << 16).startswith(b"HTTP/1.1 403"), (method, path)


def test_a_message_has_only_so_many_values(live: Live) -> None:
    row = live.new_map()
    fields = {"Content-Type": "application/json"}
    path = f"/maps/{row.name}/branches/mole/missing"
    answer = live.http.post(path, content=b"[" + b"0," * VALUES_MAX + b"0]", headers=fields)
    assert (answer.status_code, kind_of(answer)) == (422, "bad_message")
    whole = [{"cell": cell, "cursor": None} for cell in unknown_cells(CURSORS_MAX)]
    answer = live.http.post(path, json={"cells": whole, "near": [0, 0, 0]})
    assert answer.status_code == 200


def test_open_bodies_of_one_token_leave_room_for_others_and_are_forgotten_with_their_links(guarded: Live) -> None:
    row = guarded.new_map()
    mole, wren = (robot_token(guarded, row, name) for name in ("mole", "wren"))
    bodies, size = guarded.app.state.bodies, BODIES_BYTES // 5
    with ExitStack() as links:
        for n in range(24):
            link = links.enter_context(socket.create_connection(("127.0.0.1", guarded.port), timeout=60))
            path = f"/maps/{row.name}/commits/mole.{MOLE.incarnation}.{n}"
            fields = f"Authorization: Bearer {mole}", f"Content-Length: {size}"
            threading.Thread(target=_send, args=(link, head(guarded, "PUT", path, *fields) + bytes(size - 1))).start()
        until(lambda: bodies.held_bytes > BODIES_BYTES // 3, "some of them are here")
        for n in range(3):
            assert guarded.push(row, pushed(n, 1, WREN), headers=bearer(wren)).status_code == 201
            assert guarded.http.get("/healthz", timeout=HEALTHY_S).status_code == 200
            assert bodies.held_bytes <= BODIES_BYTES // 2
        # Refused by what it announces, before it comes: it would fit if its token held nothing yet. How much that is
        # depends on the order in which the bodies came; it is more than nothing.
        path, alone = f"/maps/{row.name}/commits/mole.{MOLE.incarnation}.99", BODIES_BYTES // 2 - 1
        link = links.enter_context(socket.create_connection(("127.0.0.1", guarded.port), timeout=60))
        link.sendall(head(guarded, "PUT", path, f"Authorization: Bearer {mole}", f"Content-Length: {alone}"))
        answer = link.makefile("rb").read()
        assert answer.startswith(b"HTTP/1.1 503") and b"retry-after: 2" in answer and b'"busy"' in answer
    until(lambda: bodies.held_bytes == 0, "all is given back")


def test_few_long_bodies_of_one_token_are_read_at_once_and_others_do_not_wait(tmp_path: Path) -> None:
    with ExitStack() as links:
        server = links.enter_context(Live(tmp_path, admin_token=ADMIN, enrolment_token=ENROLLER))
        row = server.new_map()
        mole, wren = (robot_token(server, row, name) for name in ("mole", "wren"))
        bodies, reading, size = server.app.state.bodies, server.app.state.reading, 1 << 20
        ours = links.enter_context(ExitStack())
        for n in range(12):
            link = ours.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=60))
            path = f"/maps/{row.name}/commits/mole.{MOLE.incarnation}.{n}"
            fields = f"Authorization: Bearer {mole}", f"Content-Length: {size}"
            threading.Thread(target=_send, args=(link, head(server, "PUT", path, *fields) + bytes(size - 1))).start()
        until(lambda: (reading.taken, reading.waiting) == (LONG_AT_ONCE, 12 - LONG_AT_ONCE), "four are read")
        until(lambda: bodies.held_bytes >= LONG_AT_ONCE * (size - 1), "all of them that came")
        path, body = long_request(row, "wren", 10_000)
        assert len(body) > LONG_BYTES
        headers = {**bearer(wren), "Content-Type": "application/json"}
        assert server.http.post(path, content=body, headers=headers).status_code == 200
        ours.close()
        until(lambda: (reading.taken, reading.waiting, bodies.held_bytes) == (0, 0, 0), "all ends with its link")


def _send(link: socket.socket, data: bytes) -> None:
    with suppress(OSError):  # refused, or closed at the end
        link.sendall(data)
