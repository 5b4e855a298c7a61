"""A robot whose link answers as it likes: it raises what cairn raises, loses no commit, and has the map afterwards.

The answers are a real server's, damaged: bytes changed, cut or inserted, headers replaced, an older answer in place of
the right one, frames dropped, doubled, in another order, with parts of another one.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.client.hostile_server import END, HostileServer, forwarded
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, A, cells_of, cursor, opened, random_diff, seen
from tests.fixtures.lengths import length

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link, index_of
from cairn_client.replica.replica import Replica
from cairn_client.sync import sync
from cairn_client.sync.sync import fetch_cells, fetch_missing, push_commits
from cairn_map.commits.commit import Commit
from cairn_map.errors import CairnError, NotFoundError
from cairn_map.wire.frames import CellFrame, Frame, encode_frame, frames_of, start_of_reply
from cairn_map.wire.messages import CreateMap, Done, Register, ReplyHeader

Damage = Callable[[bytes], bytes]
NAMES = (f"r{n}" for n in count())
HEADERS = [
    b"Content-Encoding: gzip",
    b"Content-Length: 5",
    b"Transfer-Encoding: chunked",
    b"ETag: \xc3\xa9",
    b"Cairn-Cursor: x",
    b"Cairn-Coverage: {}",
    b"Cairn-Coverage-Digest: x",
    b"Cairn-Fingerprint: " + b"0" * 32,
    b"Retry-After: 99999999999",
]
STATUSES = [
    b"200 x",
    b"204 x",
    b"206 x",
    b"304 x",
    b"307 x",
    b"401 x",
    b"404 x",
    b"409 x",
    b"410 x",
    b"500 x",
    b"503 x",
]
TEXTS = [b"", b"{}", b"[]", b"null", b"[" * 9999, b"9" * 5000, b"CRNS\x01", b"\0", b'{"kind":"id_taken","detail":"x"}']


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server with commits of another robot, that robots may register with."""
    live = LiveServer(tmp_path_factory.mktemp("server"))
    folder = tmp_path_factory.mktemp("wren")
    with MapApi(live.url) as api:
        api.create_map(MAP, CreateMap(geometry=GEOMETRY))
        wren = member(api, folder, "wren")
        for seed in range(6):
            wren.commit(random_diff(seed))
        Link(api, MAP, branch="wren").hold(push_commits(wren))
        wren.close()
    live.wait_for_fold()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sync, "ROUNDS_MAX", 6)  # a round against a server that never ends takes no second
        yield live
    live.stop()


def member(api: MapApi, folder: Path, name: str) -> Replica:
    replica = opened(folder / name, name)
    api.register(MAP, Register(robot=name, incarnation=replica.author.incarnation))
    return replica


def with_frames(body: bytes, change: Callable[[list[Frame]], list[Frame]]) -> bytes:
    """A reply with other frames, each with a sound checksum; other bodies stay."""
    try:
        frames = frames_of(body)
    except CairnError:
        return body
    return start_of_reply() + b"".join(encode_frame(frame) for frame in change(frames))


@st.composite
def frame_changes(draw: st.DrawFn) -> Callable[[list[Frame]], list[Frame]]:
    way = draw(st.sampled_from(["drop", "double", "swap", "payload", "cursor", "header", "done", "fingerprint"]))
    a, b = draw(st.integers(0, 9)), draw(st.integers(0, 9))
    field = draw(st.sampled_from(["to", "vector", "stable", "pending", "tip", "wanted", "damaged", "retracts"]))
    value: Any = {
        "to": draw(st.sampled_from(["x", str(cursor(1)), str(cursor(200))])),
        "tip": (draw(st.integers(0, 1 << 40)), "0" * 64),
        "wanted": ["x"],
        "damaged": [((0, 0, 0), "0" * 32), ((1 << 30, 0, 0), "0" * 32)],
        "retracts": ["operator.0123456789abcdef.0", "x"],
    }.get(field, draw(st.sampled_from([{}, {"x": [[0, 0]]}, {"wren.0123456789abcdef": [[5, 1]]}])))

    def change(frames: list[Frame]) -> list[Frame]:
        i, j = a % len(frames), b % len(frames)
        one, other = frames[i], frames[j]
        if way == "drop":
            del frames[i]
        elif way == "double":
            frames.insert(j, one)
        elif way == "swap":
            frames[i], frames[j] = other, one
        elif isinstance(one, ReplyHeader) and way == "header":
            frames[i] = one.model_copy(update={field: value})
        elif isinstance(one, Done) and way == "done":
            frames[i] = one.model_copy(update={"rest": "1" * 32})
        elif isinstance(one, CellFrame) and isinstance(other, CellFrame):
            frames[i] = {
                "payload": replace(one, payload=other.payload[b:]),
                "cursor": replace(one, from_cursor=cursor(b), to_cursor=cursor(a)),
                "fingerprint": replace(one, fingerprint=other.fingerprint, cell=other.cell),
            }.get(way, one)
        return frames

    return change


@st.composite
def damages(draw: st.DrawFn) -> Damage:
    """One way to damage an answer."""
    way = draw(st.sampled_from(["frames", "frames", "cut", "change", "insert", "header", "status", "body", "json"]))
    part, data = draw(st.floats(0, 1)), draw(st.binary(min_size=1, max_size=3))
    header, status, text = draw(st.sampled_from(HEADERS)), draw(st.sampled_from(STATUSES)), draw(st.sampled_from(TEXTS))
    number = draw(st.sampled_from([b"-1", b"9" * 20, b"9" * 5000, b"1e999", b"null", b'"x"', b"[]"]))
    change = draw(frame_changes())

    def damage(found: bytes) -> bytes:
        head, _, body = found.partition(END)
        at = int(part * len(found))
        if way == "cut":
            return found[:at]
        if way == "change":
            return found[:at] + data + found[at + len(data) :]
        if way == "insert":
            return found[:at] + data + found[at:]
        if way == "header":
            name = header.partition(b":")[0]
            lines = [line for line in head.split(b"\r\n") if not line.lower().startswith(name.lower() + b":")]
            return b"\r\n".join([*lines, header]) + END + body
        if way == "status":
            return head.replace(head[9:].partition(b"\r\n")[0], status, 1) + END + body
        bare = re.sub(rb"(?i)\r\n(content-length|transfer-encoding): [^\r]*", b"", head)
        if b"chunked" in head.lower():
            body = b"".join(re.findall(rb"[0-9a-f]+\r\n(.*?)\r\n(?=[0-9a-f]+\r\n|$)", body, re.DOTALL)) or body
        if way == "body":
            body = text
        elif way == "json":
            numbers = list(re.finditer(rb"(?<=[:,\[])-?\d+(?=[,\]}])", body))
            if numbers:
                spot = numbers[int(part * (len(numbers) - 1))]
                body = body[: spot.start()] + number + body[spot.end() :]
        else:
            body = with_frames(body, change)
        return bare + b"\r\nContent-Length: %d" % len(body) + END + body

    return damage


def all_asked(api: MapApi, replica: Replica, name: str, *, is_low_end: bool) -> None:
    """A round, and what commands ask; each may fail as cairn fails."""
    link = Link(api, MAP, branch=name)
    asks: list[Callable[[], object]] = [
        lambda: link.hold(push_commits(replica)),
        lambda: link.hold(fetch_cells(replica)) if is_low_end else link.hold(fetch_missing(replica)),
        lambda: api.map_info(MAP),
        lambda: api.branches(MAP),
        lambda: api.log(MAP),
        lambda: index_of(api, MAP),
    ]
    for ask in asks:
        with suppress(CairnError):
            ask()


@pytest.mark.slow
@settings(max_examples=length(10, long=20))
@given(
    plan=st.lists(st.one_of(st.none(), damages(), st.just("older")), min_size=1, max_size=6), is_low_end=st.booleans()
)
def test_after_any_answers_a_robot_has_all_commits_and_the_map_of_its_server(
    city: LiveServer, tmp_path_factory: pytest.TempPathFactory, plan: list[Damage | str | None], is_low_end: bool
) -> None:
    name, folder = next(NAMES), tmp_path_factory.mktemp("robot")
    turns, older = count(), [b""]

    def answer_to(request: bytes) -> list[bytes]:
        found = forwarded(city.port, request)
        damage = plan[next(turns) % len(plan)]
        before, older[0] = older[0], found
        if damage is None:
            return [found]
        return [before if isinstance(damage, str) else damage(found)]

    with MapApi(city.url) as honest, HostileServer(answer_to) as hostile, MapApi(hostile.url) as api:
        replica = member(honest, folder, name)
        api.use_token(honest.token)
        try:
            commits = [replica.commit({A: seen(n)}) for n in range(2)]
            all_asked(api, replica, name, is_low_end=is_low_end)
            lost = [commit for commit in commits if is_lost(honest, replica, commit)]
            assert lost == [], "neither here nor on the server"
            for _ in range(2):
                Link(honest, MAP, branch=name).hold(push_commits(replica))
                city.wait_for_fold()
                fetch = fetch_cells(replica) if is_low_end else fetch_missing(replica)
                Link(honest, MAP, branch=name).hold(fetch)
            assert cells_of(replica.view) == map_of(city, folder)
        finally:
            replica.close()


def is_lost(api: MapApi, replica: Replica, commit: Commit) -> bool:
    """True if a commit is neither in the robot's outbox, under whatever id, nor on the server."""
    held = [kept.cells for one in replica.commits if (kept := replica.kept_commit(one)) is not None]
    if commit.cells in held:
        return False
    try:
        return api.commit(MAP, commit.id)[0] != commit.data
    except NotFoundError:
        return True


def map_of(city: LiveServer, folder: Path) -> dict[Any, Any]:
    """The map as a robot has it that never met anything but the server."""
    name = next(NAMES)
    with MapApi(city.url) as api:
        fresh = member(api, folder, name)
        try:
            Link(api, MAP, branch=name).hold(fetch_missing(fresh))
            return cells_of(fresh.view)
        finally:
            fresh.close()
