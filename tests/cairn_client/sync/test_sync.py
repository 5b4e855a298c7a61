"""Robots and a real server over real sockets."""

import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, A, B, added, cells_of, cursor, header, random_diff, seen
from tests.fixtures.client.team import Team

from cairn_client.http.api import MapApi
from cairn_client.sync.near_cells import within
from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import make_commit
from cairn_map.errors import (
    BadInputError,
    CairnError,
    ConflictError,
    DamagedDataError,
    DeniedError,
    NotFoundError,
    UnreachableError,
)
from cairn_map.evidence.grid import Cell, cell_of_key
from cairn_map.wire.frames import encode_frame, start_of_reply
from cairn_map.wire.messages import CreateMap, MissingRequest, Retract

X, Y = seen(1, 2, kelvin_steps=7), seen(2, 100)


@pytest.fixture
def team(server: LiveServer, tmp_path: Path) -> Iterator[Team]:
    robots = Team(server, tmp_path)
    yield robots
    robots.close()


def test_what_one_robot_pushes_another_one_gets(team: Team) -> None:
    for seed in range(5):
        team["mole"].commit(random_diff(seed))
        team.push("mole")
        team.fetch("mole")
    team.fetch("fox")
    assert cells_of(team["fox"].view) == cells_of(team["mole"].view) != {}
    assert all(cell.cursor == team["fox"].default_cursor for cell in team["fox"].cells.values())


def test_a_second_fetch_brings_only_the_beginning_and_the_end(team: Team) -> None:
    team["mole"].commit(random_diff(2))
    team.push("mole")
    assert team.fetch("fox") == 4
    assert team.fetch("fox") == 2


def test_a_retract_reaches_everybody(team: Team) -> None:
    commits = [team["mole"].commit({A: evidence}) for evidence in (X, Y)]
    team.push("mole")
    for name in ("mole", "fox"):
        team.fetch(name)
    team.robots["fox"][1].token = None  # the operator, on the server's own machine
    team.robots["fox"][1].retract(MAP, Retract(commits=[str(commits[0].id)]))
    team.register_anew()
    team.server.wait_for_fold()
    for name in ("mole", "fox"):
        team.fetch(name)
        assert team[name].view.evidence(A) == Y


def test_robots_refill_a_server_that_lost_everything(team: Team, tmp_path: Path) -> None:
    # Stable only after a day: the robots keep what they pushed.
    team.server.stop()
    team.server.settings = team.server.settings.model_copy(update={"stable_after_s": 86400})
    team.server.start()
    team["mole"].commit({A: X})
    team["fox"].commit({A: Y, B: Y})
    for name in ("mole", "fox"):
        team.push(name)
        team.fetch(name)
    team.server.stop()
    shutil.rmtree(tmp_path / "server")
    team.server.start()
    with MapApi(team.server.url) as admin:
        admin.create_map(MAP, CreateMap(geometry=GEOMETRY))
    team.register_anew()
    for name in ("mole", "fox", "mole", "fox"):
        team.fetch(name)
        team.push(name)
    for name in ("mole", "fox"):
        team.fetch(name)
        assert team[name].view.evidence(A) == added(X, Y)
        assert team[name].view.evidence(B) == Y


DAY_S = 86_400.0


@pytest.mark.parametrize(
    "jump_s", [40 * DAY_S, -400 * DAY_S, 56 * 365.25 * DAY_S], ids=["+40d", "-400d", "1970 to now"]
)
def test_a_jump_of_all_clocks_costs_a_robot_nothing(team: Team, monkeypatch: pytest.MonkeyPatch, jump_s: float) -> None:
    team.server.stop()
    team.server.settings = team.server.settings.model_copy(update={"stable_after_s": DAY_S})
    clock_s = [0.0 if jump_s < 1e9 else -jump_s]
    real_s = time.time
    monkeypatch.setattr(time, "time", lambda: real_s() + clock_s[0])
    team.server.start()
    pushed = team["mole"].commit({A: X}).id
    team.push("mole")
    waiting = team["mole"].commit({B: Y}).id
    for shift_s in (jump_s, -jump_s):
        clock_s[0] += shift_s
        team.fetch("mole")  # drops what is stable
        known = team["mole"].header
        assert known and pushed in known.coverage and pushed not in known.stable_vector
        assert team["mole"].commits == [pushed, waiting]
        assert waiting in team["mole"].push_set()
    team.push("mole")
    team.fetch("fox")
    assert cells_of(team["fox"].view) == cells_of(team["mole"].view)


@pytest.mark.slow
def test_robots_refill_a_server_that_was_restored(team: Team, tmp_path: Path) -> None:
    team.server.stop()
    team.server.settings = team.server.settings.model_copy(update={"stable_after_s": 86400})
    team.server.start()
    team["mole"].commit({A: X})
    team.push("mole")
    for name in ("mole", "fox"):
        team.fetch(name)
    team.server.stop()
    shutil.copytree(tmp_path / "server", tmp_path / "backup")
    team.server.start()
    team["mole"].commit({A: Y, B: X})
    team.push("mole")
    for name in ("mole", "fox"):
        team.fetch(name)
    team.server.stop()
    shutil.rmtree(tmp_path / "server")
    (tmp_path / "backup").rename(tmp_path / "server")
    team.server.start()
    team["fox"].commit({B: Y})
    for name in ("fox", "mole", "fox", "mole", "fox", "mole"):
        team.push(name)
        team.fetch(name)
    for name in ("mole", "fox"):
        assert team[name].view.evidence(A) == added(X, Y)
        assert team[name].view.evidence(B) == added(X, Y)


def test_a_low_end_robot_fetches_the_cells_around_it_and_only_once(team: Team) -> None:
    team["mole"].commit({A: X, B: Y})
    team.push("mole")
    team["bat"]
    near_b = within((-0.1, 0.1, 0.9), radius_m=0.2, cell_edges_m=GEOMETRY.cell_edges_m)
    assert team.fetch_cells("bat", wanted=near_b) == 1
    assert list(team["bat"].cells) == [B]
    assert team.fetch_cells("bat") == 1
    assert team.fetch_cells("bat") == 0
    assert cells_of(team["bat"].view) == cells_of(team["mole"].view)


def test_a_cell_comes_with_its_state_and_not_again_if_it_is_the_same(team: Team) -> None:
    team["mole"].commit({A: X})
    team.push("mole")
    api = team.robots["mole"][1]
    fetched = api.cell(MAP, cell_of_key(A))
    assert fetched.body is not None
    assert decode_cell(fetched.body).evidence == X
    again = api.cell(MAP, cell_of_key(A), etag=fetched.etag)
    assert again.body is None
    assert (again.cursor, again.coverage, again.fingerprint) == (fetched.cursor, fetched.coverage, fetched.fingerprint)


def test_the_servers_errors_come_out_as_they_were(team: Team) -> None:
    commit = team["mole"].commit({A: X})
    team.push("mole")
    api = team.robots["mole"][1]
    admin = MapApi(team.server.url)
    other = make_commit(commit.meta, {A: Y}, GEOMETRY)
    cases: list[tuple[type[CairnError], str, Callable[[], object]]] = [
        (NotFoundError, "no_map", lambda: admin.map_info("nowhere")),
        (NotFoundError, "no_cell", lambda: api.cell(MAP, Cell(9, 9, 9))),
        (ConflictError, "id_taken", lambda: api.push(MAP, other)),
        (DeniedError, "not_allowed", lambda: api.retract(MAP, Retract(robot="mole"))),
        (BadInputError, "bad_id", lambda: list(api.missing(MAP, "mole", MissingRequest(author="?")))),
    ]
    for family, kind, call in cases:
        with pytest.raises(family) as caught:
            call()
        assert caught.value.kind == kind
    api.token = "nobody's"
    with pytest.raises(DeniedError) as caught:
        api.map_info(MAP)
    assert caught.value.kind == "bad_token"
    admin.close()


def test_traffic_counts_what_bodies_cost(team: Team) -> None:
    commit = team["mole"].commit({A: X})
    traffic = team.robots["mole"][1].traffic
    up, down = traffic.up_bytes, traffic.down_bytes
    team.push("mole")
    assert traffic.up_bytes - up == len(commit.data)
    assert traffic.down_bytes > down


@pytest.mark.parametrize("edge", ["touches", "misses"])
def test_a_cell_is_near_if_some_point_of_it_is(edge: str) -> None:
    is_near = within((0.5, 0.5, 0.5), radius_m=1.0 if edge == "touches" else 0.999, cell_edges_m=(0.5, 0.5, 0.5))
    assert is_near(Cell(3, 0, 0)) == (edge == "touches")
    assert is_near(Cell(0, 1, 1))
    assert not is_near(Cell(-4, 0, 0))


# Answers that no server of ours gives


class Canned(BaseHTTPRequestHandler):
    answer: tuple[int, dict[str, str], bytes] = (200, {}, b"")

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        status, headers, body = self.answer
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_PUT = do_POST

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def canned() -> Iterator[Callable[..., MapApi]]:
    server = HTTPServer(("127.0.0.1", 0), Canned)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    apis: list[MapApi] = []

    def api(status: int, body: bytes, **headers: str) -> MapApi:
        Canned.answer = (status, {name.replace("_", "-"): value for name, value in headers.items()}, body)
        apis.append(MapApi(f"http://127.0.0.1:{server.server_port}"))
        return apis[-1]

    yield api
    for one in apis:
        one.close()
    server.shutdown()
    thread.join()
    server.server_close()


REPLY = start_of_reply() + encode_frame(header(cursor(1)))


def missing(api: MapApi) -> list[object]:
    return list(api.missing(MAP, "mole", MissingRequest()))


@pytest.mark.parametrize("size", [0, 3, 5, 20, len(REPLY) - 1])
def test_a_reply_that_ends_in_the_middle_of_a_frame_is_cut_off(canned: Callable[..., MapApi], size: int) -> None:
    if size == 5:
        assert missing(canned(200, REPLY[:size])) == []  # no frames at all: the exchange is not done
        return
    with pytest.raises(UnreachableError):
        missing(canned(200, REPLY[:size]))


def test_a_link_that_breaks_within_a_body_is_no_link(canned: Callable[..., MapApi]) -> None:
    with pytest.raises(UnreachableError):
        missing(canned(200, REPLY, Content_Length=str(len(REPLY) + 10), Connection="close"))


def test_a_flipped_byte_is_damage(canned: Callable[..., MapApi]) -> None:
    flipped = bytearray(REPLY)
    flipped[30] ^= 1
    with pytest.raises(DamagedDataError):
        missing(canned(200, bytes(flipped)))


@pytest.mark.parametrize(("wish", "wait_s"), [("7", 7.0), ("soon", None), ("", None)])
def test_a_busy_server_is_asked_again_when_it_wishes(
    canned: Callable[..., MapApi], wish: str, wait_s: float | None
) -> None:
    with pytest.raises(UnreachableError) as caught:
        canned(503, b"", Retry_After=wish).maps()
    assert caught.value.retry_after_s == wait_s


@pytest.mark.parametrize(
    ("status", "family"),
    [
        (200, DamagedDataError),
        (307, BadInputError),
        (400, BadInputError),
        (404, NotFoundError),
        (500, DamagedDataError),
    ],
)
def test_an_answer_of_something_else_than_a_map_server_is_an_error(
    canned: Callable[..., MapApi], status: int, family: type[CairnError]
) -> None:
    with pytest.raises(family):
        canned(status, b"<html>hello</html>").map_info(MAP)


def test_a_body_that_is_not_what_its_header_says_is_damage(canned: Callable[..., MapApi]) -> None:
    with pytest.raises(DamagedDataError):
        canned(200, b"not gzip", Content_Encoding="gzip").maps()


def test_a_cell_without_its_headers_is_damage(canned: Callable[..., MapApi]) -> None:
    with pytest.raises(DamagedDataError):
        canned(200, b"cell").cell(MAP, Cell(0, 0, 0))


def test_an_answer_without_end_is_not_read_to_the_end(
    canned: Callable[..., MapApi], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_client.http.api.ANSWER_BYTES_MAX", 1000)
    with pytest.raises(BadInputError):
        canned(200, bytes(2000)).maps()


def test_nobody_there_is_no_link() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with MapApi(f"http://127.0.0.1:{port}") as api, pytest.raises(UnreachableError, match="cairn serve"):
        api.maps()


def test_evidence_is_not_invented_by_fetching_an_empty_map(team: Team) -> None:
    assert team.fetch("mole") == 2
    assert len(team["mole"].view) == 0
    assert np.array_equal(team["mole"].push_set(), [])
