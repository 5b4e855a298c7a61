"""Rights besides the matrix (`test_access_matrix`): whose commits, whose tokens; and browsers."""

import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of, raw
from tests.fixtures.server.live import Live
from tests.fixtures.server.protocol_document import ROLES_OF
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_map.commits.ids import INITIAL, Author, Incarnation
from cairn_map.errors import BadInputError
from cairn_server.access.auth import new_token, token_hash
from cairn_server.operations.serve import main
from cairn_server.settings import Settings
from cairn_server.store.store_rows import Token


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with tokens."""
    folder: Path = tmp_path_factory.mktemp("guarded")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


@pytest.mark.parametrize("route", ROLES_OF, ids=lambda route: " ".join(route))
def test_an_open_server_lets_everybody_without_a_token_do_everything(live: Live, route: tuple[str, str]) -> None:
    method, path = route
    place = {"branch": "mole", "commit": "x", "cell": "0,0,0", "voxel": "0,0,0", "token": "nobody", "file": "x.js"}
    place |= {"author": str(MOLE), "robot": "mole", "sha": "0" * 64}
    answer = live.ask(method, path.format(name=live.new_map().name, **place), content=b"{}")
    assert answer.status_code not in (401, 403)


def test_a_wrong_token_is_wrong_on_an_open_server_too(live: Live) -> None:
    answer = live.http.get("/maps", headers=bearer("x" * 43))
    assert (answer.status_code, kind_of(answer)) == (401, "bad_token")


def test_strangers_are_not_told_which_maps_exist(guarded: Live) -> None:
    row = guarded.new_map()
    robot = bearer(robot_token(guarded, row, "mole"))
    for headers in ({}, bearer("x" * 43)):
        answers = [guarded.http.get(f"/maps/{name}", headers=headers) for name in (row.name, "no-such-map")]
        assert answers[0].content == answers[1].content
    assert guarded.http.get("/maps/no-such-map", headers=robot).status_code == 401
    assert guarded.http.get("/maps/no-such-map", headers=bearer(ADMIN)).status_code == 404


def test_a_robot_pushes_its_own_commits_only(guarded: Live) -> None:
    row = guarded.new_map()
    mole = bearer(robot_token(guarded, row, "mole"))
    assert guarded.push(row, pushed(0, 0), headers=mole).status_code == 201
    assert kind_of(guarded.push(row, pushed(0, 0, WREN), headers=mole)) == "not_allowed"
    prior = pushed(0, 0, Author(INITIAL, Incarnation("0" * 16)))
    assert kind_of(guarded.push(row, prior, headers=mole)) == "not_allowed"
    assert guarded.push(row, prior, headers=bearer(ADMIN)).status_code == 201


def test_a_robot_retracts_its_own_commits_only(guarded: Live) -> None:
    row = guarded.new_map()
    mole = bearer(robot_token(guarded, row, "mole"))
    other = guarded.push(row, pushed(1, 0, retracts=[pushed(0, 0, WREN)]), headers=mole)
    assert (other.status_code, kind_of(other)) == (403, "not_allowed")
    assert guarded.push(row, pushed(1, 0, retracts=[pushed(0, 0)]), headers=mole).status_code == 201


def test_registering_again_replaces_the_token_and_deregistering_ends_it(guarded: Live) -> None:
    row = guarded.new_map()
    first, second = (bearer(robot_token(guarded, row, "mole")) for _ in range(2))
    assert guarded.http.get(f"/maps/{row.name}", headers=first).status_code == 401
    assert guarded.http.delete(f"/maps/{row.name}/branches/mole", headers=second).status_code == 204
    assert guarded.http.get(f"/maps/{row.name}", headers=second).status_code == 401
    gone = guarded.http.delete(f"/maps/{row.name}/branches/mole", headers=bearer(ADMIN))
    assert (gone.status_code, kind_of(gone)) == (404, "no_branch")


@pytest.mark.parametrize("name", ["operator", "initial", "main"])
def test_reserved_names_cannot_be_registered(live: Live, name: str) -> None:
    body = {"robot": name, "incarnation": MOLE.incarnation}
    assert kind_of(live.http.post(f"/maps/{live.new_map().name}/branches", json=body)) == "reserved_name"


def test_tokens_are_kept_as_hashes_only(guarded: Live, tmp_path_factory: pytest.TempPathFactory) -> None:
    token = robot_token(guarded, guarded.new_map(), "mole")
    files = [*guarded.service.settings.folder.glob("cairn.sqlite*")]
    assert files
    assert not any(token.encode() in path.read_bytes() for path in files)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "", "example.org"])
def test_a_server_without_a_token_refuses_to_listen_beyond_this_machine(host: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as refused:
        main(["--host", host, "--data", str(tmp_path / "data")])
    assert refused.value.kind == "open_server"
    assert not (tmp_path / "data").exists()
    Settings(host=host, admin_token=ADMIN).check_reach()


@pytest.mark.parametrize("content", [b"", b"short", b"\xff" * 32])
def test_a_secret_that_is_none_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(content)
    with pytest.raises(BadInputError) as refused:
        main(["--admin-token-file", str(tmp_path / "secret"), "--data", str(tmp_path / "data")])
    assert refused.value.kind == "bad_setting"


def ask_as_browser(live: Live, **headers: str) -> httpx.Response:
    body = {"robot": "mole", "incarnation": MOLE.incarnation}
    named = {name.replace("_", "-"): value.format(port=live.port) for name, value in headers.items()}
    return live.http.post(f"/maps/{live.new_map().name}/branches", json=body, headers=named)


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://example.org"},
        {"Origin": "null"},
        {"Origin": "http://localhost:1"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Origin": "http://localhost:{port}"},
        {"Host": "example.org:{port}"},
        {"Host": "example.org:{port}", "Origin": "http://example.org:{port}"},
        {"Host": "127.0.0.1.example.org"},
        {"Host": "127.0.0.1@example.org"},
        {"Host": "example.org@127.0.0.1"},
        {"Host": "127.0.0.1#example.org"},
        {"Host": "127.0.0.1?example.org"},
        {"Host": "127.0.0.1/example.org"},
        {"Host": "127.0.0.1:{port}@example.org"},
        {"Host": "[::1"},
        {"Host": ""},
    ],
)
def test_an_open_server_refuses_what_a_page_elsewhere_makes_a_browser_ask(live: Live, headers: dict[str, str]) -> None:
    answer = ask_as_browser(live, **headers)
    assert (answer.status_code, kind_of(answer)) == (403, "foreign_origin")


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Origin": "http://127.0.0.1:{port}"},
        {"Host": "localhost:{port}", "Origin": "http://localhost:{port}"},
        {"Host": "localhost:9000"},
        {"Host": "[::1]:{port}"},
        {"Host": "LOCALHOST"},
    ],
)
def test_an_open_server_answers_its_own_pages_and_programs(live: Live, headers: dict[str, str]) -> None:
    assert ask_as_browser(live, **headers).status_code == 201


@pytest.mark.parametrize("hosts", [b"", b"Host: 127.0.0.1\r\nHost: example.org\r\n"])
def test_an_open_server_answers_nobody_who_names_no_host_or_two(live: Live, hosts: bytes) -> None:
    answer = raw(live, b"DELETE /maps/lab/branches/mole HTTP/1.0\r\n" + hosts + b"\r\n")
    assert answer.split(b" ")[1] in (b"400", b"403")


def test_a_server_with_a_token_may_have_any_name(guarded: Live) -> None:
    headers = {"Host": "maps.example.org", "Origin": "https://example.org", **bearer(ADMIN)}
    assert guarded.http.get("/maps", headers=headers).status_code == 200


@pytest.mark.parametrize("authorization", ["", "Authorization: Bearer " + "x" * 43, "Authorization: Basic eDp4"])
@pytest.mark.parametrize("request_line", ["PUT commits/mole.0123456789abcdef.0", "POST branches/mole/missing"])
def test_a_strangers_body_is_not_waited_for(guarded: Live, request_line: str, authorization: str) -> None:
    method, path = request_line.split()
    lines = [f"{method} /maps/{guarded.new_map().name}/{path} HTTP/1.1", "Host: x", "Content-Length: 100000"]
    with socket.create_connection(("127.0.0.1", guarded.port), timeout=30) as link:
        link.sendall("\r\n".join([*lines, *([authorization] if authorization else []), "", ""]).encode())
        assert link.recv(1 << 16).startswith(b"HTTP/1.1 401")  # though none of the body came, nor will


def test_a_token_that_was_good_a_moment_ago_opens_no_door(guarded: Live) -> None:
    row = guarded.new_map()
    mole = bearer(robot_token(guarded, row, "mole"))
    assert guarded.push(row, pushed(0, 0), headers=mole).status_code == 201
    robot_token(guarded, row, "mole")
    assert guarded.push(row, pushed(1, 1), headers=mole).status_code == 401


@pytest.mark.parametrize("path", ["commits/{commit}", "retracts"])
def test_a_token_that_ends_while_a_body_comes_does_not_count(guarded: Live, path: str) -> None:
    row, commit = guarded.new_map(), pushed(0, 0)
    secret = new_token()
    token = Token(
        name=secret[:30], role="admin", map_number=None, map_name=None, robot=None, created_s=1.0, expires_s=None
    )
    guarded.service.store.tokens.add(token, token_hash(secret))
    data = commit.data if "commit" in path else b'{"commits": ["%s"]}' % str(commit.id).encode()

    def slowly() -> Iterator[bytes]:
        yield data[:5]
        assert guarded.http.get("/maps", headers=bearer(secret)).status_code == 200
        guarded.service.store.tokens.remove(token.name)
        yield data[5:]

    method, headers = ("PUT", {}) if "commit" in path else ("POST", {"Content-Type": "application/json"})
    headers |= {"Content-Length": str(len(data))}
    url = f"/maps/{row.name}/{path.format(commit=commit.id)}"
    with httpx.Client(base_url=guarded.http.base_url) as other:
        answer = other.request(method, url, content=slowly(), headers=headers | bearer(secret))
    assert (answer.status_code, kind_of(answer)) == (401, "bad_token")
    assert guarded.cells(row) == {}
