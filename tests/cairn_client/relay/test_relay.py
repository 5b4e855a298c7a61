"""Field servers, a base, and robots that carry: whatever way a commit takes, all maps end equal, byte for byte."""

from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from tests.fixtures.client.joined import ADMIN, Server, mapped, opened, settled
from tests.fixtures.client.made import GEOMETRY, HEAD_BYTES, MAP, cells_of, large_commit, random_diff
from tests.fixtures.server.live import until
from tests.fixtures.server.stores import one_server
from tests.links.proxy import Cut, Fault, FaultProxy

from cairn_client.cli import relay as relay_command
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.relay import link as relay_link
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import RelaySide, Undelivered, relay_round
from cairn_client.robot.robot import Robot
from cairn_client.sync.sync import push_commits
from cairn_client.sync.uploads import Parts
from cairn_map.commits.commit import renamed_commit
from cairn_map.commits.ids import OPERATOR
from cairn_map.commits.signature import SigningKey
from cairn_map.errors import BadInputError, CairnError
from cairn_map.wire.messages import Retract
from cairn_map.wire.relay_peer import SignedCommit


@pytest.fixture
def base(tmp_path: Path) -> Iterator[Server]:
    with Server(tmp_path / "base") as server:
        server.create_map()
        yield server


@pytest.fixture
def fields(tmp_path: Path, base: Server) -> Iterator[list[Server]]:
    """Two field servers, joined to the base."""
    with (
        Server(tmp_path / "field0", trusted_servers=base.key) as one,
        Server(tmp_path / "field1", trusted_servers=base.key) as two,
    ):
        for server in (one, two):
            server.join(base)
            until(lambda server=server: server.service.store.maps() != [], "the map is made")  # type: ignore[misc]
        yield [one, two]


def test_what_robots_map_at_one_server_is_on_all(base: Server, fields: list[Server], tmp_path: Path) -> None:
    for n, server in enumerate((*fields, base)):
        mapped(server, tmp_path / f"robot{n}", f"robot{n}", n, n + 10)
    settled(base, *fields)
    assert len(base.ids()) == 6
    vias = base.vias()
    assert vias["robot2"] is None
    assert vias["robot0"] and vias["robot1"] and vias["robot0"] != vias["robot1"]
    assert fields[0].vias() == {"robot0": None, "robot1": "upstream", "robot2": "upstream"}


def test_a_robot_of_a_field_server_gets_what_others_mapped_at_the_base(
    base: Server, fields: list[Server], tmp_path: Path
) -> None:
    mapped(base, tmp_path / "far", "far", 1)
    settled(base, *fields)
    with opened(fields[0], tmp_path / "near", "near") as near:
        near.sync()
        assert cells_of(near.map).keys() == base.digests().keys()
        assert near.map.packed()


def test_a_server_without_its_upstream_goes_on_and_catches_up(
    base: Server, fields: list[Server], tmp_path: Path
) -> None:
    for server in fields:
        server.leave()
    for n, server in enumerate((*fields, base)):
        mapped(server, tmp_path / f"robot{n}", f"robot{n}", n)
    assert [len(server.ids()) for server in (base, *fields)] == [1, 1, 1]
    for server in fields:
        server.join(base)
    settled(base, *fields)
    assert len(base.ids()) == 3


def test_circles_are_harmless(base: Server, fields: list[Server], tmp_path: Path) -> None:
    base.join(fields[0])
    fields[0].join(fields[1])
    fields[1].join(fields[0])
    for n, server in enumerate(fields):
        mapped(server, tmp_path / f"robot{n}", f"robot{n}", n, n + 1)
    settled(base, *fields)
    assert [len(server.ids()) for server in (base, *fields)] == [4, 4, 4]


@one_server("one of them is given other settings")
@pytest.mark.parametrize("at", [0, 1])
def test_an_operator_s_retract_at_base_or_field_reaches_all_that_trust_the_server(
    tmp_path: Path, base: Server, fields: list[Server], at: int
) -> None:
    mapped(fields[1], tmp_path / "robot", "robot", 1, 2)
    settled(base, *fields)
    base.service.settings = base.service.settings.model_copy(
        update={"trusted_servers": " ".join(server.key for server in fields)}
    )
    base.service.sync.pushes._settings = base.service.settings
    [target, kept] = sorted(base.ids())
    (base, fields[0])[at].retract(target)
    settled(base, *fields)
    assert {commit.author.robot for commit in fields[1].ids()} == {"robot", OPERATOR}
    with fields[1].service.store.snapshot(fields[1].row) as snapshot:
        assert [entry.id for entry in snapshot.log(after_seq=0, limit=9) if entry.kind == "-"] == [str(target)]
    assert fields[1].digests().keys() == set(random_diff(2))
    assert kept in fields[1].ids()


def test_a_retract_of_a_server_that_is_not_trusted_stays_there_and_the_log_says_how_to_trust_it(
    tmp_path: Path, base: Server, fields: list[Server], caplog: pytest.LogCaptureFixture
) -> None:
    mapped(fields[0], tmp_path / "robot", "robot", 1)
    settled(base, *fields)
    [target] = base.ids()
    fields[0].retract(target)
    until(lambda: f"--trust-server {fields[0].key}" in caplog.text, "the relay says what to do")
    assert base.digests()
    assert not fields[0].digests()


def test_a_robot_takes_back_what_an_older_incarnation_of_it_said_on_every_server(
    base: Server, fields: list[Server], tmp_path: Path
) -> None:
    with opened(fields[0], tmp_path / "robot", "robot") as robot:
        first = robot.replica.commit(random_diff(1))
        robot.sync()
        robot.replica.outbox.new_incarnation("its disk was rolled back")
        robot.commit(retracts=(first.id,))
        robot.sync()
    settled(base, *fields)
    assert base.digests() == {}
    assert len(base.ids()) == 2


@one_server("of two a mark of the relay counts two minutes later")
def test_a_field_server_forgets_nothing_that_its_upstream_has_not_got(base: Server, tmp_path: Path) -> None:
    settings = {"keep_evidence_s": 0.0, "upstream": base.url}
    with Server(tmp_path / "field", **settings) as field:
        field.create_map()
        mapped(field, tmp_path / "robot", "robot", 1)
        field.folded(field.row)
        [commit] = field.ids()

        def is_gone() -> bool:
            assert field.service._fold_thread is not None
            field.service._fold_thread.upkeep._forget()
            found = field.service.store.commit(field.row, commit)
            return found is not None and found.gone

        assert not is_gone()
        field.join(base)
        until(is_gone, "the evidence is forgotten")
        until(lambda: commit in base.ids(), "the base has it")


def test_what_the_base_does_not_keep_any_more_is_missed_aloud(
    base: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mapped(base, tmp_path / "robot", "robot", 1)
    base.folded(base.row)
    base.service.store.forget_evidence(base.row, before_s=float("inf"), limit=9)
    mapped(base, tmp_path / "other", "other", 2)
    with Server(tmp_path / "late") as late:
        late.join(base)
        until(lambda: late.service.store.maps() != [] and len(late.ids()) == 1, "what is kept came")
        until(lambda: "cairn serve backup" in caplog.text, "the relay says what to do")
        assert set(late.ids()) < set(base.ids())


def test_two_servers_with_other_bytes_under_one_id_are_told_apart_and_a_retract_makes_them_equal(
    base: Server, fields: list[Server], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fields[0].leave()
    with opened(fields[0], tmp_path / "robot", "robot") as robot:
        seed = robot.replica.store.get(f"signing_key.{robot.replica.author.incarnation}")
        commit = robot.replica.commit(random_diff(1))
        robot.sync()
    with opened(base, tmp_path / "copy", "robot") as copy:
        with copy.replica.store.transaction():
            copy.replica.store.put("incarnation", commit.id.author.incarnation)
            copy.replica.store.put(f"signing_key.{commit.id.author.incarnation}", seed)
        copy.replica.outbox._incarnation = commit.id.author.incarnation
        other = copy.replica.commit(random_diff(5))
        copy.sync()
    assert other.id == commit.id
    fields[0].join(base)
    until(lambda: "other commits under the same ids" in caplog.text, "the relay notices")
    assert base.digests() != fields[0].digests()
    base.retract(commit.id)
    settled(base, *fields)


def test_the_api_retracts_for_an_operator_through_http_too(base: Server, fields: list[Server], tmp_path: Path) -> None:
    mapped(fields[0], tmp_path / "robot", "robot", 1)
    settled(base, *fields)
    with base.api() as api:
        api.retract(MAP, Retract(robot="robot"))
    settled(base, *fields)
    assert fields[0].digests() == {}


def test_a_robot_carries_what_others_mapped_between_servers_that_do_not_reach_each_other(tmp_path: Path) -> None:
    with Server(tmp_path / "a") as a, Server(tmp_path / "b") as b:
        for server in (a, b):
            server.create_map()
        mapped(a, tmp_path / "x", "x", 1, 2)
        mapped(b, tmp_path / "y", "y", 3)
        for server in (a, b, a):
            token = server.token(f"mule{len(server.vias())}", role="relay", map=MAP, robot="mule")
            with Robot(
                None,
                f"{server.url}/maps/{MAP}",
                directory=tmp_path / "mule",
                name="mule",
                token=token,
                geometry=GEOMETRY,
                carry_bytes_max=1 << 20,
            ) as mule:
                if server is a and len(a.ids()) == 2:
                    mule.replica.commit(random_diff(4))
                mule.sync()
                server.folded(server.row)
                mule.sync()
        settled(a, b)
        assert {commit.author.robot for commit in b.ids()} == {"x", "y", "mule"}
        assert b.vias()["x"] == "mule1"


def test_a_robot_without_the_right_carries_nothing_to_a_server_and_syncs_all_the_same(
    base: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Server(tmp_path / "a") as a:
        a.create_map()
        mapped(a, tmp_path / "x", "x", 1)
        for server in (a, base):
            token = server.token("mule", role="robot", map=MAP, robot="mule")
            with Robot(
                None,
                f"{server.url}/maps/{MAP}",
                directory=tmp_path / "mule",
                name="mule",
                token=token,
                geometry=GEOMETRY,
                carry_bytes_max=1 << 20,
            ) as mule:
                mule.sync()
        assert "1 commits refused" in caplog.text
        assert base.ids() == set()


def test_a_folder_is_a_place_between_two_servers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], base: Server
) -> None:
    with Server(tmp_path / "field") as field:
        field.create_map()
        mapped(field, tmp_path / "x", "x", 1, 2)
        folder, there = str(tmp_path / "on-the-way"), f"{base.url}/maps/{MAP}"
        take = [f"{field.url}/maps/{MAP}", folder, "--token", field.token("taker", role="reader")]
        give = [folder, there, "--token-there", base.token("giver", role="relay")]
        assert [relay_command.main(arguments) for arguments in (take, take, give, give)] == [0] * 4
        assert capsys.readouterr().out.splitlines() == [
            f"map {MAP}: 2 commits to {folder}, 0 from there",
            f"map {MAP}: 0 commits to {folder}, 0 from there",
            f"map {MAP}: 2 commits to {there}, 0 from there",
            f"map {MAP}: 0 commits to {there}, 0 from there",
        ]
        settled(base, field)


def test_a_relay_between_two_folders_has_no_map(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="map's URL"):
        relay_command.main([str(tmp_path / "a"), str(tmp_path / "b")])


def test_a_commit_that_comes_in_parts_is_signed_as_well(base: Server, fields: list[Server], tmp_path: Path) -> None:
    with opened(fields[0], tmp_path / "robot", "robot") as robot:
        commit = robot.replica.commit(random_diff(1))
        with MapApi(fields[0].url, token=robot.replica.state.token or robot._api.token) as api:
            small = Parts(above_bytes=1, part_bytes=len(commit.data) // 2)
            Link(api, MAP, branch="robot").hold(push_commits(robot.replica, parts=small))
    settled(base, *fields)
    assert base.ids() == {commit.id}


@one_server("it counts connections, of which each request has its own before two")
@pytest.mark.parametrize("cut", ["close", "half", "reset"])
def test_a_commit_that_no_connection_carries_whole_goes_from_server_to_server_in_parts(
    base: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut: Cut
) -> None:
    monkeypatch.setattr(relay_link, "PARTS", Parts(above_bytes=1000, part_bytes=1000))
    random, resting, broken = Random(2), Undelivered(), 0
    with Server(tmp_path / "field") as field:
        field.create_map()
        with opened(field, tmp_path / "robot", "robot") as robot:
            commit = large_commit(robot.replica)
            robot.sync()
        field.folded(field.row)
        with (
            FaultProxy(base.port, fault=lambda: Fault(up_bytes=random.randint(3500, 7000), cut=cut)) as link,
            RelayApi(field.url, token=ADMIN) as here,
            RelayApi(f"http://127.0.0.1:{link.port}", token=base.token("field", role="relay")) as there,
        ):
            for _ in range(100):
                report = hold_between(relay_round(resting), ServerEnd(here, MAP), ServerEnd(there, MAP))
                broken += report.cut is not None
                assert not report.refused
                if report.moved[RelaySide.THERE]:
                    break
            paid = link.up.size_bytes
        assert broken >= 3
        assert report.moved[RelaySide.THERE] == 1
        assert not resting.may_come_later(RelaySide.THERE)
        heads = len(link.requests) * HEAD_BYTES
        assert paid <= len(commit.data) + broken * (1000 + HEAD_BYTES) + heads
        settled(base, field)


def test_what_is_there_under_other_bytes_is_refused_though_it_would_go_in_parts(
    base: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay_link, "PARTS", Parts(above_bytes=1, part_bytes=1000))
    mapped(base, tmp_path / "x", "x", 1)
    [commit] = base.ids()
    with RelayApi(base.url, token=base.token("field", role="relay")) as api:
        kept = api.signed_commit(MAP, commit)
        end = ServerEnd(api, MAP)
        end.push(kept)
        other = renamed_commit(kept.data, commit=commit, parent="ab" * 32, retracts=())
        key = SigningKey.drawn()
        with pytest.raises(CairnError) as caught:
            end.push(SignedCommit(commit, other.data, str(key.sign(MAP, other.sha))))
        assert caught.value.kind in ("id_taken", "not_allowed")
