"""Attempts with one robot's token, and with a relay's, on a map where another robot works."""

import hashlib
import json
import socket
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.signatures import KEYS, MOLE, OLD_MOLE, WREN, signed

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.commits.signature import SigningKey
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_server.store.store_rows import MapRow

SCANS, TOP = 4096, (1 << 20) - 1
"""The most scans of a commit, and the largest number of one sample."""
ORIGIN = cell_key((0, 0, 0))


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with tokens and an administrator's limits."""
    with Live(tmp_path_factory.mktemp("robot_token"), admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


@pytest.fixture
def row(live: Live) -> MapRow:
    """A map of its own for each test."""
    return live.new_map()


def registered(live: Live, row: MapRow, author: Author) -> str:
    """A robot's token, from its registration."""
    body = {"robot": author.robot, "incarnation": author.incarnation}
    answer = live.http.post(f"/maps/{row.name}/branches", json=body, headers=bearer(ENROLLER))
    return str(answer.raise_for_status().json()["token"])


def relay(live: Live, row: MapRow) -> str:
    """A relay's token for this map."""
    body = {"role": "relay", "map": row.name}
    answer = live.http.put(f"/tokens/relay-{row.name}", json=body, headers=bearer(ADMIN))
    return str(answer.raise_for_status().json()["token"])


def push(live: Live, row: MapRow, token: str, commit: Commit, *keys: SigningKey) -> httpx.Response:
    """Push with a token and signatures: those of these keys, else the author's own."""
    return live.push(row, commit, headers=bearer(token) | signed(row, commit, *keys))


def part(live: Live, row: MapRow, token: str, commit: Commit, begin: int, data: bytes) -> httpx.Response:
    """Bring a part of a commit's body."""
    query: dict[str, str | int] = {
        "digest": hashlib.sha256(commit.data).hexdigest(),
        "total": len(commit.data),
        "offset": begin,
    }
    path = f"/maps/{row.name}/commits/{commit.id}/upload"
    return live.http.patch(path, params=query, content=data, headers=bearer(token))


def one_voxel(place: int, counts: tuple[int, int], planes: Mapping[int, int]) -> Evidence:
    """Evidence of one voxel; planes go by their number in `SMALL`."""
    samples = np.zeros((1, SMALL.plane_count), np.int64)
    for plane, number in planes.items():
        samples[0, plane] = number
    return packed_evidence(np.array([place], np.uint32), np.array([counts], np.int64), samples, SMALL)


def heavy(n: int, *retracts: Commit) -> Commit:
    """A commit of mole's that takes half of its share of a sum."""
    temperature: dict[int, int] = {6: TOP * SCANS, 7: TOP * TOP * SCANS, 8: SCANS}
    return pushed(n, 0, MOLE, cells={ORIGIN: one_voxel(5, (1, 0), temperature)}, scans=SCANS, retracts=retracts)


def test_a_robot_pushes_retracts_and_uploads_in_no_other_robots_name(live: Live, row: MapRow) -> None:
    wren, mole = registered(live, row, WREN), registered(live, row, MOLE)
    hers = pushed(0, 1, WREN)
    assert push(live, row, wren, hers).status_code == 201
    forged, own = pushed(1, 2, WREN), pushed(0, 3, MOLE)
    attempts = [
        push(live, row, mole, forged, KEYS[0]),
        push(live, row, mole, pushed(0, 3, MOLE, cells={}, retracts=[hers])),
        push(live, row, mole, pushed(0, 3, MOLE, retracts=[hers])),
        part(live, row, mole, forged, 0, forged.data),
        live.http.get(f"/maps/{row.name}/commits/{forged.id}/upload?digest={'0' * 64}", headers=bearer(mole)),
        live.http.post(f"/maps/{row.name}/branches/wren/missing", json={}, headers=bearer(mole)),
        live.http.put(f"/maps/{row.name}/branches/wren/status", json={"time_s": 1}, headers=bearer(mole)),
        live.http.delete(f"/maps/{row.name}/branches/wren", headers=bearer(mole)),
    ]
    assert [(answer.status_code, kind_of(answer)) for answer in attempts] == [(403, "not_allowed")] * len(attempts)
    path = f"/maps/{row.name}/commits/{own.id}"
    under_own_name = live.http.put(path, content=forged.data, headers=bearer(mole))
    assert (under_own_name.status_code, kind_of(under_own_name)) == (400, "other_id")


def test_a_new_key_of_a_robots_token_needs_the_older_keys_signature(live: Live, row: MapRow) -> None:
    mole = registered(live, row, MOLE)
    assert push(live, row, mole, pushed(0, 1, MOLE)).status_code == 201
    other = pushed(0, 2, OLD_MOLE)
    for keys in ([KEYS[1]], [KEYS[1], KEYS[2]]):
        answer = push(live, row, mole, other, *keys)
        assert (answer.status_code, kind_of(answer)) == (403, "not_admitted")
    assert push(live, row, mole, other, KEYS[1], KEYS[0]).status_code == 201


def test_pushes_that_race_get_no_more_than_the_share(live: Live, row: MapRow) -> None:
    mole = registered(live, row, MOLE)
    commits = [heavy(n) for n in range(6)]
    with ThreadPoolExecutor(6) as racers:
        answers = list(racers.map(lambda commit: push(live, row, mole, commit), commits))
    assert sorted(answer.status_code for answer in answers) == [201, 201, 400, 400, 400, 400]
    assert {kind_of(answer) for answer in answers if answer.status_code == 400} == {"evidence_overflow"}


def test_a_commit_that_is_retracted_three_times_gives_its_share_back_once(live: Live, row: MapRow) -> None:
    mole = registered(live, row, MOLE)
    first, second = heavy(0), heavy(1)
    retracts = [pushed(n, 0, MOLE, cells={}, retracts=[first]) for n in (2, 3, 4)]
    for commit in (first, second, *retracts):
        assert push(live, row, mole, commit).status_code == 201
    live.folded(row)
    answers = [push(live, row, mole, heavy(n)) for n in (5, 6)]
    assert [answer.status_code for answer in answers] == [201, 400]
    assert kind_of(answers[1]) == "evidence_overflow"


def test_extreme_numbers_break_no_view_export_or_picture_of_others(live: Live, row: MapRow) -> None:
    mole = registered(live, row, MOLE)
    extremes: list[tuple[tuple[int, int], dict[int, int]]] = [
        ((5, 0), {0: TOP, 1: TOP, 2: TOP, 3: 1}),
        ((5, 0), {6: TOP, 7: 0, 8: 1}),
        ((5, 0), {6: 0, 7: TOP * TOP, 8: 1}),
        ((0, SCANS), {6: SCANS, 7: TOP * TOP * SCANS, 8: SCANS}),
        ((SCANS, 0), {0: 1, 3: SCANS, 4: TOP * SCANS, 5: SCANS, 6: 1, 8: SCANS}),
    ]
    cells: dict[CellKey, Evidence] = {}
    for i, (counts, planes) in enumerate(extremes):
        cells[cell_key((i, 0, 0))] = one_voxel(100, counts, planes)
    assert push(live, row, mole, pushed(0, 0, MOLE, cells=cells, scans=SCANS)).status_code == 201
    live.folded(row)
    paths = [f"main/cells/{i},0,0{suffix}" for i in range(len(cells)) for suffix in ("", ".npz", ".ply", ".view")]
    paths += [f"main/export?format={form}" for form in ("ply", "pcd", "laz", "npz", "ot", "bt")]
    look = "x=0.5&y=-1&z=0.2&qx=-0.7071068&qw=0.7071068&width=64&height=48&focal_px=30"
    paths += [f"main/render?{look}&layer={layer}" for layer in ("temperature", "colour", "probability", "age")]
    paths += ["main/views", "main/cells?hottest=true&held=true"]
    answers = {path: live.http.get(f"/maps/{row.name}/{path}", headers=bearer(mole)).status_code for path in paths}
    assert set(answers.values()) == {200}, answers


def test_what_any_status_says_is_json_for_all_readers(live: Live, row: MapRow) -> None:
    mole = registered(live, row, MOLE)

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    odd = [
        '{"time_s": 1e999}',
        '{"time_s": NaN}',
        '{"time_s": 1, "note": "\\ud800"}',
        '{"time_s": 1, "waiting": 1e400}',
    ]
    extreme = {"time_s": 1, "t_map_rig": [1e308, -1e308, 1e308], "q_map_rig": [0, 0, 0, 0], "sigma_m": 1e308}
    for text in (*odd, json.dumps({"time_s": 1, "pose": extreme, "note": "\x1b]0;x\x07\u202e\x00"})):
        headers = bearer(mole) | {"Content-Type": "application/json"}
        answer = live.http.put(f"/maps/{row.name}/branches/mole/status", content=text, headers=headers)
        assert answer.status_code in (204, 422)
        branches = live.http.get(f"/maps/{row.name}/branches", headers=bearer(mole))
        assert json.loads(branches.raise_for_status().text, parse_constant=refuse)


def rotated(live: Live, row: MapRow, _token: str) -> httpx.Response:
    return live.http.post(f"/tokens/{row.name}:mole/rotate", headers=bearer(ADMIN))


def deregistered(live: Live, row: MapRow, token: str) -> httpx.Response:
    return live.http.delete(f"/maps/{row.name}/branches/mole", headers=bearer(token))


@pytest.mark.parametrize("end", [rotated, deregistered])
def test_a_token_that_ends_while_a_body_is_on_its_way_brings_nothing(
    live: Live, row: MapRow, end: Callable[[Live, MapRow, str], httpx.Response]
) -> None:
    mole, commit = registered(live, row, MOLE), pushed(0, 1, MOLE)
    head = f"PUT /maps/{row.name}/commits/{commit.id} HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    head += f"Authorization: Bearer {mole}\r\nContent-Length: {len(commit.data)}\r\nExpect: 100-continue\r\n\r\n"
    with socket.create_connection(("127.0.0.1", live.port), timeout=60) as link:
        link.sendall(head.encode())
        # The server asks for the body once it has taken the token for good.
        assert link.recv(4096).startswith(b"HTTP/1.1 100")
        link.sendall(commit.data[:-1])
        end(live, row, mole).raise_for_status()
        link.sendall(commit.data[-1:])
        assert link.recv(4096).startswith(b"HTTP/1.1 401")
    assert live.http.get(f"/maps/{row.name}/commits/{commit.id}", headers=bearer(ADMIN)).status_code == 404


def test_of_two_bodies_that_race_for_one_id_one_is_kept(live: Live, row: MapRow) -> None:
    mole = registered(live, row, MOLE)
    bodies = [pushed(0, 1, MOLE), pushed(0, 2, MOLE)]
    with ThreadPoolExecutor(8) as racers:
        answers = list(racers.map(lambda n: (n % 2, push(live, row, mole, bodies[n % 2]).status_code), range(16)))
    kept = [n for n, status in answers if status == 201]
    assert len(kept) == 1
    assert {status for n, status in answers if n == kept[0]} == {200, 201}
    assert {status for n, status in answers if n != kept[0]} == {409}
    served = live.http.get(f"/maps/{row.name}/commits/{bodies[0].id}", headers=bearer(mole))
    assert served.content == bodies[kept[0]].data


def test_a_relays_garbage_does_not_touch_a_robots_upload_of_the_same_id(live: Live, row: MapRow) -> None:
    wren, carrier = registered(live, row, WREN), relay(live, row)
    commit = pushed(0, 1, WREN)
    half, size = len(commit.data) // 2, len(commit.data)
    assert part(live, row, wren, commit, 0, commit.data[:half]).json()["size_bytes"] == half
    assert part(live, row, carrier, commit, 0, bytes(half)).json()["size_bytes"] == half
    assert part(live, row, carrier, commit, half, bytes(size - half)).json() == {"size_bytes": 0, "sha": None}
    assert part(live, row, wren, commit, half, commit.data[half:]).status_code == 201


def test_a_relay_speaks_for_no_known_name_and_for_no_server(live: Live, row: MapRow) -> None:
    wren, carrier = registered(live, row, WREN), relay(live, row)
    hers = pushed(0, 1, WREN)
    assert push(live, row, wren, hers).status_code == 201
    stranger = KEYS[3]
    as_wren = pushed(0, 2, Author(WREN.robot, stranger.incarnation))
    as_server = pushed(0, 2, Author(RobotName("operator"), Incarnation(stranger.incarnation)))
    own = pushed(0, 2, Author(RobotName("ghost"), stranger.incarnation), retracts=[hers])
    answers = [push(live, row, carrier, commit, stranger) for commit in (as_wren, as_server, own)]
    assert [kind_of(answer) for answer in answers] == ["not_admitted", "not_allowed", "not_allowed"]
