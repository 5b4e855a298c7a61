"""Flipped bits on either disk, and commits that must not be made: what is sound goes on."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import A, B, added, cells_of, flip_a_bit, seen
from tests.fixtures.client.team import Team

from cairn_client.replica.outbox import CommitFacts
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import CellKey

X, Y, Z, W = seen(1, 2, kelvin_steps=7), seen(2, 100), seen(30, 31), seen(40, 41)
FIRST_CELL, LAST_CELL = min(A, B), max(A, B)


@pytest.fixture
def team(server: LiveServer, tmp_path: Path) -> Iterator[Team]:
    team = Team(server, tmp_path)
    yield team
    team.close()


def facts_that_retract(target: CommitId) -> CommitFacts:
    return CommitFacts(retracts=(target,))


def shut(team: Team, name: str) -> None:
    team[name].close()
    team.robots.pop(name)[1].close()


def test_after_a_roll_back_an_amend_takes_out_the_renamed_commit_and_not_the_other_of_that_id(
    team: Team, tmp_path: Path
) -> None:
    team["mole"].commit({A: X})
    team.push("mole")
    team.fetch("mole")
    shut(team, "mole")
    shutil.copytree(tmp_path / "mole", tmp_path / "backup")
    good = team["mole"].commit({A: Y})
    team.push("mole")
    shut(team, "mole")
    shutil.rmtree(tmp_path / "mole")
    shutil.copytree(tmp_path / "backup", tmp_path / "mole")
    wrong = team["mole"].commit({A: Z})
    assert wrong.id == good.id
    team["mole"].commit({A: W}, facts_that_retract(wrong.id))
    for _ in range(2):
        team.push("mole")
        team.fetch("mole")
    team.fetch("fox")
    assert team["fox"].view.evidence(A) == added(X, Y, W)
    assert team["mole"].view.evidence(A) == added(X, Y, W)


@pytest.mark.parametrize("commits_behind", [1, 2])
def test_a_damaged_diff_on_the_server_costs_a_whole_cell_and_stops_nobody(
    team: Team, server: LiveServer, tmp_path: Path, commits_behind: int
) -> None:
    big = seen(*range(0, 400, 3), kelvin_steps=3)
    team["mole"].commit({A: big, B: big})
    team.push("mole")
    team.fetch("fox")
    for n in range(commits_behind):
        team["mole"].commit({A: seen(7 + n)})
    team["mole"].commit({B: seen(9)})
    team.push("mole")
    server.stop()
    (database,) = (tmp_path / "server").glob("*.sqlite")
    flip_a_bit(database, "diff", "body", "cell = ? ORDER BY number DESC", (A,))
    server.start()
    team.fetch("fox")
    assert cells_of(team["fox"].view) == cells_of(team["mole"].view)


def test_a_damaged_cell_on_the_server_is_reported_and_the_others_come(
    team: Team, server: LiveServer, tmp_path: Path
) -> None:
    team["mole"].commit({A: X, B: X})
    team.push("mole")
    server.stop()
    (database,) = (tmp_path / "server").glob("*.sqlite")
    for table in ("cell", "diff"):  # else it would be made again from the log
        flip_a_bit(database, table, "body", "cell = ?", (FIRST_CELL,))
    server.start()
    for _ in range(2):
        with pytest.raises(DamagedDataError, match="all others came"):
            team.fetch("fox")
        assert team["fox"].view.evidence(CellKey(LAST_CELL)) == X


def test_a_damaged_own_commit_does_not_hold_up_the_others(team: Team, tmp_path: Path) -> None:
    team["mole"].commit({A: X})
    team["mole"].commit({A: Y})
    shut(team, "mole")
    flip_a_bit(tmp_path / "mole" / "robot.sqlite", "commits", "data", "n = ?", (0,))
    assert team["mole"].view.evidence(A) == Y
    team.push("mole")
    team.fetch("fox")
    assert team["fox"].view.evidence(A) == Y


def test_a_robot_cannot_retract_what_is_not_its_own(team: Team) -> None:
    foreign = team["fox"].commit({A: X}).id
    with pytest.raises(BadInputError, match="not mole's own"):
        team["mole"].commit({}, facts_that_retract(foreign))
    assert team["mole"].commits == []
