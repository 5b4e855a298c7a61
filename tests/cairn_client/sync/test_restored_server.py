"""A server restored by its own commands: robots notice, and bring back what it lost."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import A, B, added, seen
from tests.fixtures.client.team import Team
from tests.fixtures.server.stores import sqlite_of

from cairn_server.operations.serve import main

X, Y = seen(1, 2, kelvin_steps=7), seen(2, 100)


@pytest.fixture
def team(server: LiveServer, tmp_path: Path) -> Iterator[Team]:
    sqlite_of(server.service.store)
    server.stop()
    server.settings = server.settings.model_copy(update={"stable_after_s": 86400})
    server.start()
    robots = Team(server, tmp_path)
    yield robots
    robots.close()


@pytest.mark.slow
def test_robots_refill_a_server_that_was_restored_from_a_backup(team: Team, tmp_path: Path) -> None:
    folder, file = tmp_path / "server", tmp_path / "nightly.cairn"
    team["mole"].commit({A: X})
    team.push("mole")
    for name in ("mole", "fox"):
        team.fetch(name)
    assert main(["backup", "--data", str(folder), str(file)]) == 0
    team["mole"].commit({A: Y, B: X})
    team.push("mole")
    for name in ("mole", "fox"):
        team.fetch(name)
    team.server.stop()
    old = folder.rename(tmp_path / "old")
    assert main(["restore", str(file), "--data", str(folder), "--old", str(old)]) == 0
    team.server.start()
    team["fox"].commit({B: Y})
    for name in ("fox", "mole") * 3:
        team.push(name)
        team.fetch(name)
    for name in ("mole", "fox"):
        assert team[name].view.evidence(A) == added(X, Y)
        assert team[name].view.evidence(B) == added(X, Y)
    assert main(["check", "--data", str(folder)]) == 0
