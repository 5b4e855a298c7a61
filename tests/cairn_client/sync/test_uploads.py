"""A robot's large commits over a link that breaks: real transfers, counted by a proxy."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, HEAD_BYTES, MAP, A, large_commit, opened, seen
from tests.fixtures.server.stores import one_server
from tests.links.proxy import Cut, Fault, FaultProxy

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.replica.replica import Replica
from cairn_client.robot.robot import Robot
from cairn_client.sync.sync import push_commits
from cairn_client.sync.uploads import Parts
from cairn_map.commits.commit import make_commit
from cairn_map.errors import UnreachableError
from cairn_map.wire.messages import Register

PARTS = Parts(above_bytes=4000, part_bytes=2000)


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


def push(replica: Replica, link: FaultProxy, server: LiveServer, *, parts: Parts = PARTS) -> int:
    """Push until all is acknowledged; how many tries broke."""
    with MapApi(server.url) as api:
        token = api.register(MAP, Register(robot="mole", incarnation=replica.author.incarnation)).token
    broken = 0
    with MapApi(f"http://127.0.0.1:{link.port}", token=token) as api:
        while True:
            try:
                report = Link(api, MAP, branch="mole").hold(push_commits(replica, parts=parts))
            except UnreachableError:
                broken += 1
                continue
            assert not report.refused
            return broken


@one_server("it counts connections, of which each request has its own before two")
@pytest.mark.parametrize("cut", ["close", "half", "reset"])
def test_a_commit_that_no_connection_can_carry_whole_arrives_and_is_paid_once(
    server: LiveServer, mole: Replica, cut: Cut
) -> None:
    commit = large_commit(mole)
    size = len(commit.data)
    assert size > 15_000
    random = Random(2)
    with FaultProxy(server.port, fault=lambda: Fault(up_bytes=random.randint(3500, 7000), cut=cut)) as link:
        broken = push(mole, link, server)
        paid = link.up.size_bytes
    assert broken >= 3
    assert paid <= size + broken * (PARTS.part_bytes + HEAD_BYTES) + len(link.requests) * HEAD_BYTES
    server.wait_for_fold()
    assert mole.push_set() == []
    with MapApi(server.url) as api:
        assert api.commit(MAP, commit.id)[0] == commit.data


@one_server("it counts connections, of which each request has its own before two")
def test_an_answer_that_is_lost_after_the_last_part_costs_one_question(server: LiveServer, mole: Replica) -> None:
    commit = large_commit(mole)
    parts = -(-len(commit.data) // PARTS.part_bytes)
    with FaultProxy(server.port) as link:
        answers = iter([1 + parts])
        link.fault = lambda: Fault(answers=next(answers, float("inf")))
        push(mole, link, server)
        assert link.cuts == 1
        assert [line.split()[0] for line in link.requests] == [b"GET", *[b"PATCH"] * parts, b"GET"]


def test_a_small_commit_goes_whole(server: LiveServer, mole: Replica) -> None:
    mole.commit({A: seen(1)})
    with FaultProxy(server.port) as link:
        push(mole, link, server)
        assert [line.split()[0] for line in link.requests] == [b"PUT"]


def test_an_id_that_is_taken_is_heard_of_before_the_bytes_are_sent(server: LiveServer, mole: Replica) -> None:
    commit = large_commit(mole)
    taken = make_commit(commit.meta.model_copy(update={"scans": ()}), {A: seen(5)}, GEOMETRY)
    with MapApi(server.url) as api:
        api.push(MAP, taken)
    with FaultProxy(server.port) as link:
        push(mole, link, server)
        assert link.up.size_bytes < 1.5 * len(commit.data)
    assert mole.push_set() == []
    assert commit.id not in mole.commits


def test_where_a_push_broke_the_next_one_goes_in_parts(server: LiveServer, tmp_path: Path) -> None:
    with FaultProxy(server.port, fault=lambda: Fault(up_bytes=9000)) as link:
        url = f"http://127.0.0.1:{link.port}/maps/{MAP}"
        with Robot(None, url, directory=tmp_path / "mole", name="mole", geometry=GEOMETRY) as robot:
            robot._rounds._parts = Parts(above_bytes=1 << 18, part_bytes=2000)
            commit = large_commit(robot.replica)
            assert len(commit.data) > 9000
            with pytest.raises(UnreachableError):
                robot.sync()
            while robot.waiting:
                with suppress(UnreachableError):
                    robot.sync()
        assert [line.split()[0] for line in link.requests].count(b"PATCH") >= len(commit.data) // 2000
