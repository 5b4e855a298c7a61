"""`cairn map copy`: a map with all that it is goes to another server, of another store, while robots go on."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.joined import ADMIN, Server, mapped
from tests.fixtures.client.made import MAP
from tests.fixtures.server.live import until
from tests.fixtures.server.postgres import WHEEL, new_database, programs_of
from tests.fixtures.server.pushes import pushed
from tests.replicas.fault_run import postgres_in

from cairn_client.cli.maps.command import main
from cairn_map.errors import BadInputError, ConflictError
from cairn_map.wire.messages import CreateMap
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.sqlite.store import SqliteStore


@pytest.fixture
def source(tmp_path: Path) -> Iterator[Server]:
    """A server with SQLite and a map of two robots, one of which took a commit back."""
    folder = tmp_path / "source"
    folder.mkdir()
    with Server(folder, store=SqliteStore(folder)) as server:
        server.create_map()
        mapped(server, tmp_path / "mole", "mole", 1, 2, 3)
        mapped(server, tmp_path / "wren", "wren", 4)
        server.folded(server.row)
        server.retract(sorted(server.ids())[0])
        server.folded(server.row)
        yield server


@pytest.fixture
def target(tmp_path: Path) -> Iterator[Server]:
    """A server without a map."""
    with Server(tmp_path / "target") as server:
        yield server


def copy(source: Server, target: Server, *options: str, token: str = ADMIN, name: str = MAP) -> int:
    """Exit code of the command."""
    tokens = ["--token", ADMIN, "--token", f"{target.url}={token}"]
    return main(["copy", f"{source.url}/maps/{MAP}", f"{target.url}/maps/{name}", *tokens, *options])


def is_same(source: Server, target: Server) -> bool:
    """True if both have the same commits and the same cells, byte for byte."""
    return source.ids() == target.ids() and source.digests() == target.digests()


def test_a_copy_has_all_commits_and_the_same_cells(
    source: Server, target: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    assert copy(source, target) == 0
    assert is_same(source, target)
    said = capsys.readouterr().out
    assert said.startswith(f"{len(source.ids())} commits copied, ")
    assert f"equal: {len(source.digests())} cells" in said and said.endswith("by digest\n")
    assert copy(source, target) == 0
    assert capsys.readouterr().out.startswith("0 commits copied, 0 B")


def test_robots_go_on_at_the_copy_by_their_keys(
    source: Server, target: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert copy(source, target) == 0
    mapped(target, tmp_path / "mole", "mole", 7)
    assert len(target.ids()) == len(source.ids()) + 1
    target.folded(target.row)
    capsys.readouterr()
    assert copy(source, target) == 0  # nothing is taken back
    assert f"all there: {len(source.ids())} commits, and 1 more that came there" in capsys.readouterr().out
    assert len(target.ids()) == len(source.ids()) + 1


def test_what_no_robot_signed_travels_with_an_admin_s_token_alone(
    source: Server, target: Server, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    plain = pushed(0, 0, geometry=source.row.geometry)
    with source.api() as api:
        api.push(MAP, plain)
    source.folded(source.row)
    with target.api() as api, source.api() as old:
        info = old.map_info(MAP)
        api.create_map(MAP, CreateMap(geometry=info.geometry, sensor_model=info.sensor_model))
    assert copy(source, target, token=target.token("old", role="relay")) == 1
    assert "refused" in caplog.text
    assert "commits only in" in capsys.readouterr().out
    assert copy(source, target) == 0
    assert is_same(source, target)


def test_another_name_and_another_grid_are_refused(source: Server, target: Server) -> None:
    with pytest.raises(BadInputError, match="signed for that name"):
        copy(source, target, name="other")
    with target.api() as api:
        api.create_map(MAP, CreateMap())
    with pytest.raises((BadInputError, ConflictError)) as refused:
        copy(source, target)
    assert refused.value.kind in ("other_geometry", "map_exists")
    assert target.ids() == set()


@pytest.mark.processes
@pytest.mark.slow
def test_a_map_moves_from_sqlite_to_postgresql_while_robots_push(source: Server, tmp_path: Path) -> None:
    with (
        postgres_in(programs_of(WHEEL)) as postgres,
        Server(tmp_path / "target", store=PgStore(new_database(postgres).url)) as target,
    ):
        tokens = ["--token", ADMIN, "--token", f"{target.url}={ADMIN}"]
        places = [f"{source.url}/maps/{MAP}", f"{target.url}/maps/{MAP}"]
        command = [sys.executable, "-m", "cairn_client.main", "map", "copy", *places, *tokens]
        with subprocess.Popen([*command, "--follow", "--every", "0.2"], stdout=subprocess.PIPE, text=True) as follower:
            try:
                assert follower.stdout is not None
                assert follower.stdout.readline().startswith("equal: ")
                assert is_same(source, target)
                mapped(source, tmp_path / "owl", "owl", 8, 9)
                source.retract(sorted(source.ids())[1])
                until(lambda: is_same(source, target), "what came later is there")
                mapped(target, tmp_path / "mole", "mole", 10)  # a robot that has the new address already
                target.folded(target.row)
            finally:
                follower.send_signal(signal.SIGINT)
                said = follower.stdout.read() if follower.stdout else ""
        assert "1 more that came there" in said.splitlines()[-1]
        assert follower.returncode == 0
        assert source.ids() < target.ids()
