"""A token is sent to its own server only, by every command that meets two; a second listener writes down what came."""

import argparse
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP
from tests.fixtures.client.robots import ADMIN, TOKEN, map_commit, robot_in
from tests.fixtures.client.strangers import Stranger, stranger
from tests.fixtures.commands import cairn

from cairn_client.cli.arguments import AddTokens, CommandParser
from cairn_client.http.api import MapApi
from cairn_client.http.origin_tokens import NO_TOKENS
from cairn_map.errors import BadInputError, CairnError, DeniedError
from cairn_map.wire.origins import origin_of

OTHER = "token-of-the-other-server"


@pytest.fixture
def other() -> Iterator[Stranger]:
    with stranger() as found:
        yield found


@pytest.fixture
def guarded(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> LiveServer:
    monkeypatch.setenv("CAIRN_TOKEN", ADMIN)
    server.stop()
    server.settings = server.settings.model_copy(update={"admin_token": ADMIN, "enrolment_token": TOKEN})
    server.start()
    return server


def test_another_servers_url_gets_no_token_unless_it_has_one_of_its_own(
    guarded: LiveServer, other: Stranger, tmp_path: Path
) -> None:
    own, its = guarded.map_url, other.map_url
    copy = tmp_path / "copy"
    cairn("clone", own, copy, folder=tmp_path)
    # Commands with two URLs, by their names, and the exit code with which they complain.
    found = {
        "map create": [("map", "create", own.replace(MAP, "new"), "--from", its)],
        "diff": [("diff", own, its), ("diff", copy, own, "--token", f"{other.url}=x"), ("diff", copy)],
        "relay": [("relay", own, its), ("relay", its, tmp_path / "bag", "--token-there", "x")],
        "map copy": [("map", "copy", own, its)],
        "map publish": [("map", "publish", own, "--through", other.url.replace("http", "ws"))],
        "doctor": [("doctor", own, other.url)],
    }
    assert found.keys() == commands_with_two_places()
    for command in [found[name][0] for name in ("map create", "diff", "relay", "map copy")]:
        said = cairn(*command, folder=tmp_path, code=1)
        assert f"no token for {other.url}" in said, said
        assert f"--token {other.url}=TOKEN" in said, said
    cairn(*found["doctor"][0], folder=tmp_path, code=1)  # it names the address, and sends it no token either
    cairn(*found["map publish"][0], folder=tmp_path, code=1)  # a bridge has no tokens
    assert other.shown
    assert set(other.shown) == {None}
    for command in found["diff"][1:]:
        cairn(*command, folder=tmp_path)
    assert set(other.shown) == {None}


def test_a_token_that_names_its_server_is_sent_there(guarded: LiveServer, other: Stranger, tmp_path: Path) -> None:
    named, own, its = f"{other.url}={OTHER}", guarded.map_url, other.map_url
    for command in (
        ("map", "create", own.replace(MAP, "new"), "--from", its, "--token", named),
        ("diff", own, its, "--token", named),
        ("diff", its, own, "--token", OTHER, "--token", f"{guarded.url}={ADMIN}"),
        ("relay", own, its, "--token", named),
        ("relay", own, its, "--token-there", OTHER),
    ):
        other.shown.clear()
        cairn(*command, folder=tmp_path, code=1)
        assert set(other.shown) == {f"Bearer {OTHER}"}, command


def test_a_robots_own_token_stays_with_the_server_that_gave_it(
    guarded: LiveServer, other: Stranger, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CAIRN_TOKEN")
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        map_commit(robot, 1)
        robot.sync()
    with robot_in(tmp_path, other.map_url, stay=True) as robot, pytest.raises(DeniedError, match="no token for"):
        robot.sync()
    cairn("doctor", tmp_path / "mole", folder=tmp_path, code=1)
    assert len(other.shown) > 1
    assert set(other.shown) == {None}
    with robot_in(tmp_path, guarded.map_url, stay=True) as robot:  # back at its own server, by its own token
        assert robot.sync().pushed == 0


def test_a_folder_of_an_earlier_version_keeps_its_token_for_the_server_of_its_last_use(
    guarded: LiveServer, other: Stranger, tmp_path: Path
) -> None:
    with robot_in(tmp_path, guarded.map_url, token=TOKEN, stay=True) as robot:
        robot.sync()
        robot.replica.state.token_origin = None
    with robot_in(tmp_path, other.map_url, stay=True) as robot, pytest.raises(DeniedError, match="no token for"):
        robot.sync()
    assert set(other.shown) == {None}
    with robot_in(tmp_path, guarded.map_url, stay=True) as robot:
        robot.sync()


def test_no_redirect_carries_a_token_on(other: Stranger) -> None:
    with stranger(redirects_to=other.url) as first, MapApi(first.url, token=OTHER) as api:
        for call in (lambda: api.map_info(MAP), api.tokens, lambda: api.revoke_token("x")):
            with pytest.raises(CairnError):
                call()
    assert set(first.shown) == {f"Bearer {OTHER}"}
    assert other.shown == []


@pytest.mark.parametrize(
    ("url", "origin"),
    [
        ("http://Base:8750/maps/lab", "http://base:8750"),
        ("https://base/maps/lab", "https://base:443"),
        ("https://base:443", "https://base:443"),
        ("http://[::1]:8750/maps/lab", "http://[::1]:8750"),
        ("http://user@base:1/maps/lab", "http://base:1"),
        ("http://bücher:80", "http://xn--bcher-kva:80"),
    ],
)
def test_an_origin_is_scheme_host_and_port(url: str, origin: str) -> None:
    assert origin_of(url) == origin
    tokens = NO_TOKENS.with_text(f"{origin}=a").bound_to("http://elsewhere:1")
    assert tokens.of(url) == "a"
    assert tokens.of(url.replace("http", "https", 1).replace("httpss", "http", 1)) is None


@pytest.mark.parametrize("url", ["base:8750", "ftp://base", "http://", "http://base:99999"])
def test_what_is_no_servers_url_has_no_origin(url: str) -> None:
    with pytest.raises(BadInputError, match="URL"):
        origin_of(url)


def test_tokens_are_not_shown_where_options_are_printed() -> None:
    assert "secret" not in repr(NO_TOKENS.with_text("secret http://base:1=secret"))


class _FoundParserError(Exception):
    pass


def commands_with_two_places() -> set[str]:
    """Names of the robots' commands that take a token, and whose arguments may name two servers."""
    found: set[str] = set()
    with pytest.MonkeyPatch.context() as patch:

        def stop(parser: CommandParser, *_: object) -> None:
            raise _FoundParserError(parser)

        patch.setattr(CommandParser, "parse_args", stop)
        for point in entry_points(group="cairn.commands"):
            if not point.value.startswith("cairn_client."):
                continue
            with suppress(SystemExit, CairnError):
                try:
                    import_module(point.module).main([])
                except _FoundParserError as exc:
                    found |= set(_with_two_places(exc.args[0], point.name))
    return found


def _with_two_places(parser: argparse.ArgumentParser, name: str) -> Iterator[str]:
    places = 0
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, below in action.choices.items():
                yield from _with_two_places(below, f"{name} {word}")
        elif not isinstance(action, AddTokens):
            text = f"{action.metavar} {action.help}"
            places += any(word in text for word in ("URL", "http://", "PLACE", "another one"))
    if places > 1 and any(isinstance(action, AddTokens) for action in parser._actions):
        yield name
