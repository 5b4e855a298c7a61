"""A robot is bound to its key: it shows a stranger no secret, and after a lost disk waits for an operator's word."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.hostile_server import HostileServer, forwarded
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, cells_of
from tests.fixtures.client.robots import ADMIN, TOKEN, evidence_of, map_commit, robot_in
from tests.fixtures.client.strangers import stranger
from tests.fixtures.commands import cairn
from tests.fixtures.server.stores import one_server

from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.errors import DeniedError, UnreachableError
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import Register


@pytest.fixture
def guarded(server: LiveServer) -> Iterator[LiveServer]:
    server.stop()
    server.settings = server.settings.model_copy(update={"admin_token": ADMIN, "enrolment_token": TOKEN})
    server.start()
    yield server


@pytest.fixture
def admin(guarded: LiveServer) -> Iterator[MapApi]:
    with MapApi(guarded.url, token=ADMIN) as api:
        yield api


def refusal(robot: Robot) -> DeniedError:
    with pytest.raises(DeniedError) as refused:
        robot.sync()
    return refused.value


def test_a_stranger_who_refuses_a_token_is_never_shown_the_enrolment_token(guarded: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        robot.sync()
        own = robot.replica.state.token
        guarded.stop()
        with stranger(port=guarded.port) as found:
            for _ in range(3):
                error = refusal(robot)
                assert error.kind == "bad_token"
                assert f"robots admit {guarded.map_url} {robot.replica.author}" in error.message
        assert set(found.shown) == {f"Bearer {own}", None}
        map_commit(robot, 1)
        guarded.start()
        assert robot.sync().pushed == 1  # the token was good all the time


@one_server("a token ends at the other one within a second")
def test_a_robot_whose_token_was_ended_comes_back_by_an_operators_word_alone(
    guarded: LiveServer, admin: MapApi, tmp_path: Path
) -> None:
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        map_commit(robot, 1)
        robot.sync()
        admin.rotate_token(f"{MAP}:mole")
        map_commit(robot, 2)
        assert refusal(robot).kind == "bad_token"
        admin.admit(MAP, robot.replica.author)
        register = robot._api.register

        def no_link(name: str, request: Register, *, proof: str | None = None) -> object:
            raise UnreachableError("no_link", "gone")

        robot._api.register = no_link  # type: ignore[assignment, method-assign]
        with pytest.raises(UnreachableError):
            robot.sync()
        robot._api.register = register  # type: ignore[method-assign]
        assert robot.sync().pushed == 1
        admin.rotate_token(f"{MAP}:mole")
        assert refusal(robot).kind == "bad_token"  # the word was for one time


@one_server("its own address is one of its names")
def test_a_proof_that_another_server_hands_on_opens_nothing_and_one_under_a_public_name_does(
    guarded: LiveServer, admin: MapApi, tmp_path: Path
) -> None:
    def hand_on(request: bytes) -> Iterator[bytes]:
        yield forwarded(guarded.port, request)

    with HostileServer(hand_on) as between:
        there = f"{between.url}/maps/{MAP}"
        with robot_in(tmp_path, there, token=TOKEN, stay=True) as robot:
            map_commit(robot, 1)
            robot.sync()
            admin.rotate_token(f"{MAP}:mole")
            admin.admit(MAP, robot.replica.author)
            error = refusal(robot)
            assert error.kind == "bad_token"
            assert f"made for {between.url}" in error.message
            assert f"--public-url {between.url}" in error.message
            heads = [head for head in between.requests if b"cairn-proof" in head.lower()]
            assert len(heads) == 1
            guarded.stop()
            guarded.settings = guarded.settings.model_copy(update={"public_urls": between.url})
            guarded.start()
            map_commit(robot, 2)
            assert robot.sync().pushed == 1


def test_a_robot_that_lost_its_disk_maps_on_and_is_let_in_by_an_operator(
    guarded: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAIRN_TOKEN", ADMIN)
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        map_commit(robot, 1)
        robot.sync()
    with robot_in(tmp_path / "new disk", guarded.map_url, token=TOKEN, stay=True) as robot:
        map_commit(robot, 2)
        error = refusal(robot)
        assert error.kind == "not_admitted"
        map_commit(robot, 3)
        assert robot.waiting == 2
        author = str(robot.replica.author)
    status = cairn("robot", "status", tmp_path / "new disk" / "mole", folder=tmp_path)
    assert f"[{error.kind}]" in status
    assert f"robots admit {guarded.map_url} {author}" in status
    asking = cairn("map", "robots", "keys", guarded.map_url, folder=tmp_path).splitlines()
    assert [line.split()[:2] for line in asking if author in line] == [[author, "asks"]]
    assert author in cairn("map", "robots", "admit", guarded.map_url, "mole", folder=tmp_path)
    with robot_in(tmp_path / "new disk", guarded.map_url, token=TOKEN, stay=True) as robot:
        assert robot.sync().pushed == 2
        guarded.wait_for_fold()
        robot.sync()
        assert cells_of(robot.map) == cells_of(evidence_of(1, 2, 3))
    assert "not_admitted" not in cairn("robot", "status", tmp_path / "new disk" / "mole", folder=tmp_path)


def test_an_enrolment_token_for_one_robot_lets_in_its_new_disk_and_no_other_robot(
    guarded: LiveServer, admin: MapApi, tmp_path: Path
) -> None:
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        map_commit(robot, 1)
        robot.sync()
    named = admin.create_token("mole-again", CreateToken(role="enroller", map=MAP, robot="mole")).token
    with robot_in(tmp_path / "new disk", guarded.map_url, token=named, stay=True) as robot:
        map_commit(robot, 2)
        assert robot.sync().pushed == 1
    with robot_in(tmp_path, guarded.map_url, name="wren", token=named, stay=True) as robot:
        assert refusal(robot).kind == "not_allowed"


def test_a_robot_with_its_disk_registers_again_by_its_key(guarded: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, guarded.map_url, token=TOKEN) as robot:  # which leaves when it closes
        map_commit(robot, 1)
        robot.sync()
    with robot_in(tmp_path, guarded.map_url, token=TOKEN) as robot:
        robot.replica.outbox.new_incarnation("its disk was rolled back")
        map_commit(robot, 2)
        assert robot.sync().pushed == 1


def test_a_robot_with_a_given_token_and_a_new_key_fetches_and_says_what_it_waits_for(
    guarded: LiveServer, admin: MapApi, tmp_path: Path
) -> None:
    given = admin.create_token("mole-token", CreateToken(role="robot", map=MAP, robot="mole")).token
    for folder, refused in ((tmp_path, False), (tmp_path / "new disk", True)):
        with robot_in(folder, guarded.map_url, token=given, stay=True) as robot:
            map_commit(robot, 1)
            map_commit(robot, 2)
            report = robot.sync()
            assert (report.pushed, len(report.refused)) == ((0, 1) if refused else (2, 0))
            guarded.wait_for_fold()
            robot.sync()
            assert bool(robot.replica.cells)
            contact = robot.replica.state.contact
            assert contact is not None
            assert contact.kind == ("not_admitted" if refused else "")
            assert (contact.last_s is not None) and (contact.failed_s is not None) == refused
    admin.admit(MAP, robot.replica.author)
    with robot_in(folder, guarded.map_url, token=given, stay=True) as robot:
        assert robot.sync().pushed == 2


def test_an_administrator_closes_all_robots_that_one_token_made(
    guarded: LiveServer, admin: MapApi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAIRN_TOKEN", ADMIN)
    gate = admin.create_token("gate", CreateToken(role="enroller", map=MAP)).token
    for name, token in (("mole", TOKEN), ("wren", gate), ("dove", gate)):
        with robot_in(tmp_path, guarded.map_url, name=name, token=token, stay=True) as robot:
            map_commit(robot, 1)
            robot.sync()
    closed = cairn("map", "robots", "close", guarded.map_url, "--by", "gate", folder=tmp_path).splitlines()
    assert [line.split(":")[0] for line in closed] == ["dove", "wren"]
    assert {use.robot for use in admin.robot_uses(MAP)} == {None, "mole"}
