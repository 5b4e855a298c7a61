"""Live events: the same by SSE and by WebSocket, put together, resumed, bounded, and not for everybody."""

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.crowded_map import add_commits, long_author
from tests.fixtures.server.listening import by_socket, by_sse, hello_of, socket_url, up_to_head
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.fixtures.server.stores import one_server
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from cairn_client.http.event_stream import EVENT_BYTES_MAX
from cairn_map.commits.commit import RETRACTS_MAX
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.commits.ids import NUMBER_LIMIT, CommitId
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import cell_key, cell_of_key
from cairn_map.wire.live_events import (
    ENTRIES_MAX,
    CellsEvent,
    HeadMoved,
    Hello,
    LiveEvent,
    LogGrew,
    RobotHeard,
    position_from_text,
)
from cairn_map.wire.messages import MissingRequest, Register
from cairn_server.http.routes import live as live_routes
from cairn_server.http.routes.live import NOT_ALLOWED, SPACING_S
from cairn_server.live import live_map
from cairn_server.live.hub import LISTENERS_OF_TOKEN_MAX, Listener
from cairn_server.store.store_rows import MapRow

Listen = Callable[..., AbstractContextManager[Iterator[LiveEvent]]]
WAYS = pytest.mark.parametrize("listen", [by_sse, by_socket])
COMMITS = [pushed(n, n + shift, author) for shift, author in enumerate((MOLE, WREN)) for n in range(4)]
REGISTRATION = Register(robot="mole", incarnation=MOLE.incarnation)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder: Path = tmp_path_factory.mktemp("guarded-live")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


JOINED: list[Listener] = []


def joined(live: Live, row: MapRow, *, after: str = "", token: bytes = b"t") -> Listener:
    JOINED.append(live.service.live.join(row, token, lambda: None, after=position_from_text(after)))
    return JOINED[-1]


@pytest.fixture(autouse=True)
def _all_leave() -> Iterator[None]:
    yield
    while JOINED:
        JOINED.pop().leave()


def push(live: Live, row: MapRow, *commits: int) -> None:
    for n in commits:
        live.push(row, COMMITS[n])
    live.folded(row)
    live.service.live.folded(row)  # the folding thread tells listeners a moment after


def changed(events: list[LiveEvent]) -> set[int]:
    """Numbers of the cells that events name."""
    found: set[int] = set()
    for event in events:
        if isinstance(event, CellsEvent):
            assert event.cells != "many"
            found |= {cell_key(cell[:3]) for cell in event.cells}
    return found


def logged(events: list[LiveEvent]) -> list[str]:
    return [entry.id for event in events if isinstance(event, LogGrew) for entry in event.entries]


def rank(event: LiveEvent) -> tuple[int, int]:
    seen = position_from_text(event.id)
    assert seen is not None
    return seen.seq, seen.tick


@WAYS
def test_who_listens_hears_of_the_head_the_cells_and_the_log(live: Live, listen: Listen) -> None:
    row = live.new_map()
    with listen(live, row) as events:
        hello = hello_of(events)
        assert (hello.map, hello.resumed, cursor_from_text(hello.cursor).seq) == (row.name, False, 0)
        live.push(row, COMMITS[0])
        found = up_to_head(events, 1)
    assert [event.type for event in found] == ["cells", "log", "head"]
    assert logged(found) == [str(COMMITS[0].id)]
    with live.service.store.snapshot(row) as snapshot:
        assert isinstance(found[2], HeadMoved) and found[2].cursor == str(snapshot.head)
        lms = {(*cell_of_key(cell.key), cell.lm) for cell in snapshot.cells()}
    assert isinstance(found[0], CellsEvent) and set(found[0].cells) == lms


@WAYS
def test_who_comes_back_hears_what_was_folded_meanwhile(live: Live, listen: Listen) -> None:
    row = live.new_map()
    with listen(live, row) as events:
        hello_of(events)
        push(live, row, 0)
        last = up_to_head(events, 1)[-1].id
    push(live, row, 1)
    with listen(live, row, after=last) as events:
        assert hello_of(events).resumed
        found = up_to_head(events, 2)
    assert changed(found) == set(COMMITS[1].cells)
    assert logged(found) == [str(COMMITS[1].id)]


@one_server("ids of two do not fall, and may be equal")
@pytest.mark.slow
def test_who_comes_back_after_a_restart_goes_on_and_ids_still_rise(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row = live.new_map()
        live.service.maps.register(row, REGISTRATION)
        with by_sse(live, row) as events:
            first = hello_of(events)
            live.service.maps.register(row, REGISTRATION)
            robot = next(events)
            push(live, row, 0)
            last = up_to_head(events, 1)[-1]
        push(live, row, 1)
    with Live(tmp_path) as live, by_socket(live, row, after=last.id) as events:
        hello = hello_of(events)
        assert hello.resumed
        found = up_to_head(events, 2)
        live.service.maps.register(row, REGISTRATION)
        heard = next(events)
    assert changed(found) == set(COMMITS[1].cells)
    order = [rank(event) for event in (first, robot, last, hello, found[-1], heard)]
    assert order == sorted(order) and len(set(order)) == len(order)


@pytest.mark.parametrize(
    "after", ["7.00000000.1", "1.00000000.1", "x", "1.2", "-1.00000000.1", "9" * 70, f"{10**40}.00000000.1", "²."]
)
def test_a_place_of_another_log_is_not_resumed(live: Live, after: str) -> None:
    row = live.new_map()
    push(live, row, 0)
    with by_socket(live, row, after=after) as events:
        hello = hello_of(events)
        assert not hello.resumed
        assert cursor_from_text(hello.cursor).seq == 1
        push(live, row, 1)
        assert logged(up_to_head(events, 2)) == [str(COMMITS[1].id)]  # the head itself was in `hello`


@settings(max_examples=12)
@given(steps=st.lists(st.sampled_from([*range(len(COMMITS)), "take", "leave"]), max_size=14))
def test_whatever_a_listener_misses_it_hears_of_every_cell_and_of_the_newest_head(
    live: Live, steps: list[int | str]
) -> None:
    row = live.new_map()
    listener = joined(live, row)
    heard: list[LiveEvent] = []
    pushes: dict[int, None] = {}
    for step in [*steps, "take"]:
        if isinstance(step, int):
            push(live, row, step)
            pushes[step] = None
        elif step == "take":
            heard += listener.take()
            assert listener.take() == []
        else:
            heard += listener.take()
            listener.leave()
            listener = joined(live, row, after=str(heard[-1].id))
    listener.leave()
    assert changed(heard) == {key for n in pushes for key in COMMITS[n].cells}
    assert logged(heard) == [str(COMMITS[n].id) for n in pushes]
    heads = [event for event in heard if isinstance(event, HeadMoved)]
    assert [rank(event) for event in heads] == sorted({rank(event) for event in heads})
    assert not heads or cursor_from_text(heads[-1].cursor).seq == len(pushes)


def test_who_does_not_read_is_told_once_and_costs_no_more(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    live.service.maps.register(row, REGISTRATION)
    slow = joined(live, row)
    slow.take()
    for n in range(len(COMMITS)):
        push(live, row, n)
        live.service.live.robot_heard(row, "mole")
    events = slow.take()
    slow.leave()
    assert [event.type for event in events] == ["cells", "log", "head", "robot"]


def test_more_cells_than_are_remembered_are_many(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_map, "CELLS_KEPT", 2)
    row = live.new_map()
    listener, late = joined(live, row), joined(live, row)
    listener.take()
    push(live, row, 0)
    assert changed(listener.take()) == set(COMMITS[0].cells)
    push(live, row, 1)  # the third cell pushes the first one out
    assert changed(listener.take()) == set(COMMITS[1].cells)
    assert [event.cells for event in late.take() if isinstance(event, CellsEvent)] == ["many"]


def test_who_was_away_for_too_many_entries_is_told_many_and_how_many(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_map, "PAST_ENTRIES", 1)
    row = live.new_map()
    listener = joined(live, row)
    start = listener.take()[0].id
    listener.leave()
    push(live, row, 0, 1, 2)
    _, cells, log, _ = joined(live, row, after=start).take()
    assert isinstance(cells, CellsEvent) and cells.cells == "many"
    assert isinstance(log, LogGrew)
    assert ([entry.seq for entry in log.entries], log.left_out) == ([3], 2)


def test_an_event_lists_the_newest_entries_that_name_few_commits_together(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_map, "NAMES_MAX", 5)
    row = live.new_map()
    listener = joined(live, row)
    listener.take()
    for n in range(1, 6):
        names = [pushed(100 + 3 * n + m, 0) for m in range(3)] if n < 5 else []
        live.push(row, pushed(n, 0, retracts=names))
    live.folded(row)
    live.service.live.folded(row)
    (grown,) = (event for event in listener.take() if isinstance(event, LogGrew))
    assert ([entry.seq for entry in grown.entries], grown.left_out) == ([4, 5], 3)


def test_an_event_as_long_as_one_robot_can_make_it_is_read_by_every_client(live: Live) -> None:
    row, author = live.new_map(), long_author(1)
    listener = joined(live, row)
    listener.take()
    last = NUMBER_LIMIT - 1 - RETRACTS_MAX
    names = " ".join(str(CommitId(author, last + n)) for n in range(RETRACTS_MAX))
    add_commits(live.service.store, row, [CommitId(author, last - n) for n in range(2 * ENTRIES_MAX)], retracts=names)
    live.service.live.folded(row)
    (grown,) = (event for event in listener.take() if isinstance(event, LogGrew))
    assert (len(grown.entries), grown.left_out) == (4, 2 * ENTRIES_MAX - 4)
    assert len(grown.model_dump_json()) <= EVENT_BYTES_MAX // 2
    seqs: list[int] = []
    while page := live.http.get(f"/maps/{row.name}/log?limit=1000&after={len(seqs)}").json():
        assert 0 < len(page) <= 4
        seqs += [entry["seq"] for entry in page]
    assert seqs == list(range(1, 2 * ENTRIES_MAX + 1))


def test_hello_lists_some_robots_and_events_of_their_own_tell_of_the_others(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_map, "SIGNS_MAX", 2)
    row = live.new_map()
    for n in range(5):
        register = Register(robot=f"r{n}", incarnation=f"{n:016x}")
        live.http.post(f"/maps/{row.name}/branches", json=register.model_dump()).raise_for_status()
    hello, *others = joined(live, row).take()
    assert isinstance(hello, Hello) and len(hello.robots) == 2
    heard = [event.robot.branch for event in others if isinstance(event, RobotHeard)]
    assert sorted([*heard, *(sign.branch for sign in hello.robots)]) == [f"r{n}" for n in range(5)]
    ticks = [position_from_text(event.id).tick for event in (hello, *others)]
    assert ticks == sorted(ticks)


@one_server("of another one each tells the news of some seconds")
@WAYS
def test_robots_are_heard_of_when_they_come_push_fetch_and_leave(guarded: Live, listen: Listen) -> None:
    row = guarded.new_map()
    shown = {"headers": bearer(ADMIN)} if listen is by_sse else {"token": ADMIN}
    with listen(guarded, row, **shown) as events:
        assert hello_of(events).robots == []
        mole = bearer(robot_token(guarded, row, "mole"))
        came = next(events)
        assert isinstance(came, RobotHeard) and (came.robot.branch, came.robot.cursor) == ("mole", None)
        guarded.push(row, COMMITS[0], headers=mole)
        while not isinstance(heard := next(events), RobotHeard):
            pass
        assert heard.robot.time_s > came.robot.time_s
        guarded.folded(row)
        cursor = guarded.http.get(f"/maps/{row.name}", headers=mole).json()["cursor"]
        body = MissingRequest(cursor=cursor).model_dump(mode="json")
        guarded.http.post(f"/maps/{row.name}/branches/mole/missing", json=body, headers=mole)
        while not isinstance(heard := next(events), RobotHeard) or heard.robot.cursor is None:
            pass
        assert heard.robot.cursor == cursor
        with listen(guarded, row, **shown) as others:
            assert hello_of(others).robots == [heard.robot]
        guarded.http.delete(f"/maps/{row.name}/branches/mole", headers=mole)
        assert isinstance(left := next(events), RobotHeard) and left.robot.gone
    with listen(guarded, row, **shown) as events:
        assert hello_of(events).robots == []


@WAYS
def test_what_a_robot_pushed_does_not_wait_behind_the_sign_of_the_robot(
    live: Live, listen: Listen, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = live.new_map()
    live.service.maps.register(row, REGISTRATION)
    with listen(live, row) as events:
        hello_of(events)
        time.sleep(3 * SPACING_S)  # streams pause so long after what they sent
        monkeypatch.setattr(live_routes, "SPACING_S", 100.0)
        live.service.live.robot_heard(row, "mole")
        time.sleep(3 * SPACING_S)  # the stream was woken, and waits for more
        push(live, row, 0)
        assert changed(up_to_head(events, 1))


def test_a_stream_beats_while_nothing_happens(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    monkeypatch.setattr(live.service.live, "beat_s", 0.02)
    for listen in (by_sse, by_socket):
        with listen(live, row) as events:
            assert hello_of(events).beat_s == 0.02
            assert [next(events).type for _ in range(2)] == ["beat", "beat"]


def test_a_token_that_is_not_good_any_more_ends_its_streams(guarded: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = guarded.new_map()
    monkeypatch.setattr(guarded.service.live, "beat_s", 0.02)
    token = robot_token(guarded, row, "mole")
    with by_sse(guarded, row, headers=bearer(token)) as events, by_socket(guarded, row, token=token) as others:
        hello_of(events), hello_of(others)
        robot_token(guarded, row, "mole")  # takes the place of the first
        assert {event.type for event in events} <= {"beat", "robot"}
        with pytest.raises(ConnectionClosed) as closed:
            list(others)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == NOT_ALLOWED
    until(lambda: not guarded.service.live.listeners, "both streams have ended")


@pytest.mark.parametrize(
    ("token", "header", "status", "kind"),
    [
        (None, None, 401, "no_token"),
        ("x" * 43, None, 401, "bad_token"),
        (None, "Bearer " + "x" * 43, 401, "bad_token"),
        (ENROLLER, None, 403, "not_allowed"),
    ],
)
def test_a_socket_without_the_right_token_is_refused_with_a_problem(
    guarded: Live, token: str | None, header: str | None, status: int, kind: str
) -> None:
    row = guarded.new_map()
    sent = {"Authorization": header} if header else {}
    with pytest.raises(InvalidStatus) as refused, by_socket(guarded, row, token=token, additional_headers=sent):
        pass
    assert refused.value.response.status_code == status
    assert kind.encode() in (refused.value.response.body or b"")


def test_a_socket_of_an_unknown_map_is_refused_and_strangers_are_not_told(guarded: Live) -> None:
    url = f"ws://127.0.0.1:{guarded.port}/maps/no-such-map/live"
    for headers, status in (({}, 401), (bearer(ADMIN), 404)):
        with pytest.raises(InvalidStatus) as refused, connect(url, additional_headers=headers):
            pass
        assert refused.value.response.status_code == status


@pytest.mark.parametrize("token", ["!", "=", "%C3%A9", "_w", "AAAA" * 20])
def test_a_subprotocol_that_is_no_token_is_a_wrong_one(live: Live, token: str) -> None:
    offered = ["cairn.live.v1", f"cairn.token.{token.replace('=', '')}"]
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(
            socket_url(live, live.new_map()),
            subprotocols=offered,  # type: ignore[arg-type]
        ),
    ):
        pass
    assert refused.value.response.status_code == 401


def test_pages_of_other_sites_may_not_listen(live: Live, guarded: Live) -> None:
    for server, token in ((live, None), (guarded, ADMIN)):
        row, own = server.new_map(), f"127.0.0.1:{server.port}"
        for origin in ("http://evil.example", f"http://{own}.evil.example", "null", "http://127.0.0.1:1"):
            with pytest.raises(InvalidStatus) as refused, by_socket(server, row, token=token, origin=origin):
                pass
            assert refused.value.response.status_code == 403
            assert b"foreign_origin" in (refused.value.response.body or b"")
        with by_socket(server, row, token=token, origin=f"http://{own}") as events:
            hello_of(events)


def test_refused_sockets_leave_no_error_in_the_log(live: Live, guarded: Live, caplog: pytest.LogCaptureFixture) -> None:
    row, known = guarded.new_map(), live.new_map()
    refusals = (
        (guarded, row.name, 401),  # by the route, and below by the checks of a head
        (live, "nothing", 404),
        (live, f"{known.name}%2flive", 400),
        (live, known.name, 403),
    )
    with caplog.at_level(logging.DEBUG, logger="uvicorn.error"):
        for server, name, status in refusals:
            origin = "http://evil.example" if status == 403 else None
            url = f"ws://127.0.0.1:{server.port}/maps/{name}/live"
            with pytest.raises(InvalidStatus) as refused, connect(url, origin=origin):  # type: ignore[arg-type]
                pass
            assert refused.value.response.status_code == status
        with by_socket(live, known) as events:
            hello_of(events)
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.mark.parametrize("origin", [None, "http://evil.example"])
def test_an_open_server_takes_no_socket_for_another_host(live: Live, origin: str | None) -> None:
    url = f"ws://evil.example/maps/{live.new_map().name}/live"  # a name that somebody made lead here
    reached = socket.create_connection(("127.0.0.1", live.port))
    with pytest.raises(InvalidStatus) as refused, connect(url, sock=reached, origin=origin):  # type: ignore[arg-type]
        pass
    assert refused.value.response.status_code == 403
    assert b"foreign_origin" in (refused.value.response.body or b"")


def test_plain_http_on_the_socket_is_told_to_upgrade(live: Live) -> None:
    answer = live.http.get(f"/maps/{live.new_map().name}/live")
    assert (answer.status_code, kind_of(answer), answer.headers["Upgrade"]) == (426, "upgrade_required", "websocket")


def test_a_token_has_so_many_streams_and_gets_them_back(live: Live) -> None:
    row = live.new_map()
    listeners = [joined(live, row) for _ in range(LISTENERS_OF_TOKEN_MAX)]
    with pytest.raises(UnreachableError) as refused:
        joined(live, row)
    assert refused.value.kind == "too_many_streams"
    joined(live, row, token=b"another").leave()
    for listener in listeners * 2:
        listener.leave()
    joined(live, row).leave()
    assert live.service.live.listeners == 0


@one_server("each has its own bound of streams")
def test_all_tokens_together_have_so_many_streams(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cairn_server.live.hub.LISTENERS_MAX", 1)
    row = live.new_map()
    with by_sse(live, row) as events:
        hello_of(events)
        answer = live.http.get(f"/maps/{row.name}/events", headers={"X": "y"})
        assert (answer.status_code, kind_of(answer)) == (429, "too_many_streams")
        assert int(answer.headers["Retry-After"]) > 0


@WAYS
def test_who_goes_away_frees_its_place(live: Live, listen: Listen) -> None:
    row = live.new_map()
    for _ in range(3):
        with listen(live, row) as events:
            hello_of(events)
    until(lambda: live.service.live.listeners == 0, "nobody listens")


@one_server("the other one goes on")
def test_a_server_that_shuts_down_ends_its_streams(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row = live.new_map()
        ended = threading.Event()
        with by_socket(live, row) as events, by_sse(live, row) as others:
            hello_of(events), hello_of(others)
            live.service.live.close()
            assert list(others) == []
            assert list(events) == []
            ended.set()
        assert ended.is_set()
        assert live.http.get(f"/maps/{row.name}/events").status_code == 503


def test_what_a_listener_sends_is_ignored_but_not_if_it_is_long(live: Live) -> None:
    row = live.new_map()
    with connect(socket_url(live, row)) as stream:
        stream.recv()
        stream.send("hello")
        push(live, row, 0)
        assert '"cells"' in stream.recv()
        stream.send("x" * 5000)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                stream.recv()
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


def test_a_listener_that_sends_more_than_it_has_to_say_is_cut(live: Live) -> None:
    # An empty frame takes as long to parse as one of kilobytes: sixteen sockets full of them stopped all others.
    row = live.new_map()
    with connect(socket_url(live, row)) as listener:
        listener.recv()
        listener.socket.sendall(bytes.fromhex("818000000000") * 2000)
        with pytest.raises(ConnectionClosed):
            while True:
                listener.recv()
    assert live.http.get("/healthz").status_code == 200
