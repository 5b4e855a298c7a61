"""Cells that the server's disk damaged, sent back by robots that still have them: a real server, a real disk."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import A, B, cells_of, flip_a_bit, seen
from tests.fixtures.client.robots import evidence_of, map_commit, robot_in
from tests.fixtures.client.team import Team
from tests.fixtures.server.stores import sqlite_of

from cairn_client.cli.robots import replay as replay_command
from cairn_client.http.api import MapApi
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.messages import Mode

MAP = "lab"
X, Y = seen(1, 2, kelvin_steps=7), seen(2, 100)
FIRST, LAST = min(A, B), max(A, B)


@pytest.fixture
def team(server: LiveServer, tmp_path: Path) -> Iterator[Team]:
    team = Team(server, tmp_path)
    yield team
    team.close()


def damage(server: LiveServer, key: CellKey, tables: tuple[str, ...] = ("cell", "diff")) -> None:
    """The disk flips a bit of a cell and of what it was made from, while the server is off."""
    sqlite_of(server.service.store)
    server.stop()
    (database,) = server.settings.folder.glob("*.sqlite")
    for table in tables:
        flip_a_bit(database, table, "body", "cell = ?", (key,))
    server.start()


def change(server: LiveServer, statement: str) -> None:
    """The same for a whole column."""
    sqlite_of(server.service.store)
    server.stop()
    (database,) = server.settings.folder.glob("*.sqlite")
    connection = sqlite3.connect(database)
    connection.execute(statement)
    connection.commit()
    connection.close()
    server.start()


def cell_on(server: LiveServer, key: CellKey) -> bytes:
    """Answer of the server."""
    with MapApi(server.url) as api:
        return api.cell(MAP, cell_of_key(key)).body or b""


def is_damaged(server: LiveServer, key: CellKey) -> bool:
    try:
        cell_on(server, key)
    except DamagedDataError as exc:
        assert exc.kind == "damaged_store"
        return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["high-end", "low-end", "viewer"])
def test_a_robot_that_has_a_damaged_cell_heals_the_server_as_it_syncs(
    server: LiveServer, tmp_path: Path, mode: Mode
) -> None:
    with robot_in(tmp_path, server.map_url, name="mole") as mole:
        map_commit(mole, 1, 2)
        mole.sync()
    server.wait_for_fold()
    key = min(evidence_of(1, 2).packed())
    before = cell_on(server, key)
    with robot_in(tmp_path, server.map_url, name="bat", mode=mode) as bat:
        bat.sync()
        damage(server, key)
        assert bat.sync().healed == 0  # no robot has asked the server for the cell yet
        assert is_damaged(server, key)
        assert bat.sync().healed == 1
        assert cell_on(server, key) == before
        assert bat.sync().healed == 0
    with robot_in(tmp_path, server.map_url, name="owl") as owl:
        owl.sync()
        assert cells_of(owl.map) == cells_of(evidence_of(1, 2))


@pytest.mark.slow
@pytest.mark.parametrize("newcomer", ["high-end", "low-end"])
def test_who_fetches_a_damaged_cell_gets_all_others_and_whoever_has_it_is_told(
    team: Team, server: LiveServer, newcomer: str
) -> None:
    team["mole"].commit({A: X, B: X})
    team.push("mole")
    team.fetch("mole")
    damage(server, FIRST)
    with pytest.raises(DamagedDataError, match="all others came"):
        team.fetch_cells("fox") if newcomer == "low-end" else team.fetch("fox")
    assert team["fox"].view.evidence(LAST) == X
    team.fetch("mole")
    assert not is_damaged(server, FIRST)


def test_folding_goes_on_once_a_robot_has_healed_the_cell(team: Team, server: LiveServer) -> None:
    team["mole"].commit({FIRST: X})
    team.push("mole")
    team.fetch("mole")
    damage(server, FIRST)
    assert is_damaged(server, FIRST)
    team["mole"].commit({FIRST: Y})
    for _ in range(2):
        try:
            team.fetch("mole")
            team.push("mole")
        except CairnError:
            continue
    team.fetch("fox")
    assert cells_of(team["fox"].view) == cells_of(team["mole"].view)


def test_an_older_state_of_a_damaged_cell_is_not_sent(team: Team, server: LiveServer) -> None:
    team["mole"].commit({FIRST: X})
    team.push("mole")
    team.fetch("fox")
    team["mole"].commit({FIRST: Y})
    team.push("mole")
    damage(server, FIRST)
    change(server, "UPDATE diff SET body = NULL")  # else fox would come to the newest state by it
    assert is_damaged(server, FIRST)
    sent_bytes = team.robots["fox"][1].traffic.up_bytes
    with pytest.raises(DamagedDataError):
        team.fetch("fox")
    assert is_damaged(server, FIRST)
    assert team.robots["fox"][1].traffic.up_bytes - sent_bytes < 1000


def test_what_the_robots_own_disk_damaged_is_not_sent(team: Team, server: LiveServer, tmp_path: Path) -> None:
    team["mole"].commit({FIRST: X})
    team.push("mole")
    team.fetch("mole")
    damage(server, FIRST)
    assert is_damaged(server, FIRST)
    with team["mole"].store.transaction():
        other = encode_cell(FIRST, Y, team["mole"].geometry).data
        team["mole"].store.put_cell(FIRST, team["mole"].cells[FIRST], body=other)
    team.fetch("mole")
    assert not team["mole"].refusals.cells
    assert is_damaged(server, FIRST)


def test_a_cell_that_the_server_refuses_is_sent_once(team: Team, server: LiveServer) -> None:
    big = seen(*range(500), kelvin_steps=3)
    team["mole"].commit({FIRST: big})
    team.push("mole")
    team.fetch("mole")
    damage(server, FIRST)
    change(server, "UPDATE cell SET digest = zeroblob(32)")
    assert is_damaged(server, FIRST)
    traffic, size_bytes = team.robots["mole"][1].traffic, len(encode_cell(FIRST, big, team["mole"].geometry).data)
    sent_bytes = []
    for _ in range(2):
        before_bytes = traffic.up_bytes
        team.fetch("mole")
        sent_bytes.append(traffic.up_bytes - before_bytes)
    assert sent_bytes[0] - sent_bytes[1] >= size_bytes


def test_a_replay_goes_on_though_a_cell_of_the_server_is_damaged(
    server: LiveServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with robot_in(tmp_path, server.map_url) as mole:
        map_commit(mole, 1)
        mole.sync()
    server.wait_for_fold()
    damage(server, min(evidence_of(1).packed()))
    with robot_in(tmp_path, server.map_url, name="owl") as owl:
        map_commit(owl, 2)
        assert replay_command._missed_sync(owl) is None
        assert owl.waiting == 0
    assert "all others came" in caplog.text
