"""A reader's token in wrong hands, then a robot's whose reports an operator looks at: nothing is changed, nobody waits.

The attacker has secrets that an administrator gave, and the documents. Laws of the roles one by one are in
`cairn_server/access/test_auth.py`; here several features are combined.
"""

import threading
from collections import Counter
from collections.abc import Iterator
from urllib.parse import quote

import httpx
import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import JPEG, MOLE, PNG, WREN, pushed

from cairn_server.store.store_rows import MapRow

ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31mred\r\nmap: folded 9999 commits\x08\u202e\u2066"
"""A title for the terminal, an empty screen, a line of its own, and a turned direction of writing."""
ODD = [
    "",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-0",
    "-1",
    "9" * 400,
    "9223372036854775808",
    "٣",
    "1_0",
    " 1",
    "\0",
    "a",
    "1,2",
]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with Live(tmp_path_factory.mktemp("guarded"), admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        yield live


@pytest.fixture(scope="module")
def row(guarded: Live) -> MapRow:
    """A map in which one honest commit of wren is folded."""
    row = guarded.new_map()
    guarded.push(row, pushed(0, 1, WREN), headers=bearer(ADMIN)).raise_for_status()
    guarded.folded(row)
    return row


@pytest.fixture(scope="module")
def reader(guarded: Live, row: MapRow) -> str:
    return token_of(guarded, row, "eye", "reader")


def token_of(live: Live, row: MapRow, name: str, role: str) -> str:
    body = {"role": role, "map": row.name}
    return str(live.http.put(f"/tokens/{name}", json=body, headers=bearer(ADMIN)).raise_for_status().json()["token"])


def ticket_of(live: Live, row: MapRow, token: str) -> str:
    url = f"/maps/{row.name}/main/export/tickets"
    return str(live.http.post(url, json={"format": "npz"}, headers=bearer(token)).raise_for_status().json()["ticket"])


def status_of_ticket(live: Live, row: MapRow, ticket: str) -> int:
    url = f"/maps/{row.name}/main/export"
    return live.http.get(url, params={"format": "npz", "ticket": ticket}).status_code


def test_of_many_that_show_one_ticket_at_once_one_gets_the_file(guarded: Live, row: MapRow, reader: str) -> None:
    ticket, at_once, found = ticket_of(guarded, row, reader), threading.Barrier(8), Counter[int]()

    def show() -> None:
        at_once.wait()
        found[status_of_ticket(guarded, row, ticket)] += 1

    threads = [threading.Thread(target=show) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {200: 1, 401: 7}


def test_a_ticket_ends_with_the_token_that_asked_for_it(guarded: Live, row: MapRow) -> None:
    ticket = ticket_of(guarded, row, token_of(guarded, row, "lent", "reader"))
    guarded.http.delete("/tokens/lent", headers=bearer(ADMIN)).raise_for_status()
    assert status_of_ticket(guarded, row, ticket) == 401


def test_odd_numbers_in_a_readers_requests_are_refused_or_answered(guarded: Live, row: MapRow, reader: str) -> None:
    paths = [
        "log?after={0}",
        "log?limit={0}",
        "main/cells?limit={0}",
        "main/cells?after={0},0,0",
        "main/cells?box=0,0,0,{0},1,1",
        "main/cells/{0},0,0",
        "main/voxels/{0},{0},{0}",
        "main/vector?at={0}",
        "main/export?depth={0}",
        "main/export?format=ot&box={0},0,0,1,1,1",
        "main/render?x={0}&y=0&z=0&width=8&height=8",
        "main/render?x=0&y=0&z=0&width=8&height=8&qx={0}",
        "main/render?x=0&y=0&z=0&width=8&height=8&focal_px={0}",
        "main/render?x=0&y=0&z=0&width=8&height=8&layer=depth&high={0}",
    ]
    with httpx.Client(
        base_url=f"http://127.0.0.1:{guarded.port}/maps/{row.name}/", headers=bearer(reader), timeout=60
    ) as http:
        found = {http.get(path.format(quote(odd))).status_code for path in paths for odd in ODD}
    assert found <= {200, 400, 404, 422}


def test_a_reader_heals_no_cell_that_is_sound(guarded: Live, row: MapRow, reader: str) -> None:
    before, url = guarded.cells(row), f"/maps/{row.name}/main/cells/0,0,0"
    whole = guarded.http.get(url, headers=bearer(reader))
    for body in (b"", b"\0" * 100_000, whole.content[:-1], pushed(7, 5).data):
        assert guarded.http.put(url, content=body, headers=bearer(reader)).status_code in {204, 404}
    assert guarded.cells(row) == before


def test_a_seal_that_a_reader_saw_takes_nothing_out_of_another_map(guarded: Live, row: MapRow, reader: str) -> None:
    url, kept = f"/maps/{row.name}", pushed(1, 2, WREN)
    guarded.push(row, kept, headers=bearer(ADMIN)).raise_for_status()
    guarded.folded(row)
    body = {"commits": [str(kept.id)]}
    said = guarded.http.post(f"{url}/retracts", json=body, headers=bearer(ADMIN)).raise_for_status().json()
    seen = guarded.http.get(f"{url}/commits/{said['id']}", headers=bearer(reader))
    seal = {name: seen.headers[name] for name in ("Cairn-Seal", "Cairn-Signature") if name in seen.headers}
    answers = []
    for target in (row, guarded.new_map()):
        shown = bearer(robot_token(guarded, target, "mole")) | seal
        path = f"/maps/{target.name}/commits/{said['id']}"
        answers.append(guarded.http.put(path, content=seen.content, headers=shown).status_code)
    assert answers == [200, 403]


def test_a_robots_picture_is_never_a_page(guarded: Live, row: MapRow) -> None:
    url, robot = f"/maps/{row.name}/branches/evil/view", bearer(robot_token(guarded, row, "evil"))
    for first in (JPEG[:3], PNG[:8]):
        sent = robot | {"Content-Type": "text/html"}
        guarded.http.put(url, content=first + b"<script>alert(1)</script>", headers=sent).raise_for_status()
        got = guarded.http.get(url, headers=robot).headers
        assert got["Content-Type"].startswith("image/")
        assert got["X-Content-Type-Options"] == "nosniff"
        assert "sandbox" in got["Content-Security-Policy"]
    refused = guarded.http.put(url, content=b"<svg onload='alert(1)'/>", headers=robot)
    assert refused.status_code == 400


def test_escapes_in_a_robots_reports_reach_no_terminal(
    guarded: Live, row: MapRow, tmp_path_factory: pytest.TempPathFactory
) -> None:
    body = {"robot": "loud", "incarnation": MOLE.incarnation, "sensors": [ESCAPES[:64]]}
    url = f"/maps/{row.name}/branches"
    joined = guarded.http.post(url, json=body, headers=bearer(ENROLLER)).raise_for_status().json()
    status = {"time_s": 1e9, "note": ESCAPES}
    guarded.http.put(f"{url}/loud/status", json=status, headers=bearer(joined["token"])).raise_for_status()
    folder, place = tmp_path_factory.mktemp("cli"), f"http://127.0.0.1:{guarded.port}/maps/{row.name}"
    said = "".join(cairn("map", verb, place, "--token", ADMIN, folder=folder) for verb in ("branches", "info", "log"))
    assert "loud" in said
    assert not set(said) & set("\x1b\x07\x08\x9b\r\0\u202e\u2066")


def test_what_a_reader_holds_open_takes_no_place_from_others(guarded: Live, row: MapRow, reader: str) -> None:
    url = f"/maps/{row.name}/events"
    streams = [guarded.http.send(stream, stream=True) for stream in streams_of(guarded, url, reader)]
    try:
        assert Counter(answer.status_code for answer in streams) == {200: 16, 429: 2}
        answer = guarded.push(row, pushed(3, 3, WREN), headers=bearer(ADMIN))
        assert answer.status_code == 201
        with guarded.http.stream("GET", url, headers=bearer(token_of(guarded, row, "other", "reader"))) as other:
            assert other.status_code == 200
    finally:
        for answer in streams:
            answer.close()


def streams_of(live: Live, url: str, token: str) -> Iterator[httpx.Request]:
    for _ in range(18):
        yield live.http.build_request("GET", url, headers=bearer(token))
