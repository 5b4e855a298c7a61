"""Robots of a map with very many retracts: amends of a whole team, and the operator's."""

from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, A, B, covering, cursor, exchanged, header, opened, seen
from tests.fixtures.client.team import Team
from tests.fixtures.server.crowded_map import add_commits, long_author
from tests.fixtures.server.stores import sqlite_of

from cairn_client.replica import replica as replicas
from cairn_map.commits.ids import OPERATOR, Author, CommitId, Incarnation, RobotName
from cairn_map.wire.messages import Retract
from cairn_server.access.auth import Caller, Role

X, Y = seen(1, 2, kelvin_steps=7), seen(2, 100)
DESK = Author(RobotName(OPERATOR), Incarnation("f" * 16))
ROBOTS, AMENDS = 200, 400


def test_a_round_still_works_after_a_whole_team_amended_all_it_measured(server: LiveServer, tmp_path: Path) -> None:
    sqlite_of(server.service.store)
    server.stop()
    server.settings = server.settings.model_copy(update={"stable_after_s": 86_400})
    server.start()
    robots, row = Team(server, tmp_path), server.service.store.map(MAP)
    measured = robots["mole"].commit({A: X})
    robots["mole"].commit({A: Y})
    robots.push("mole")
    amends = [CommitId(long_author(robot), n) for robot in range(ROBOTS) for n in range(AMENDS)]
    add_commits(server.service.store, row, amends, retracts="r" * 50)
    request = Retract(commits=[str(measured.id)])
    said = server.service.sync.retracts.retract(row, request, by=Caller(Role.ADMIN)).id
    server.wait_for_fold()
    robots["fox"].commit({B: Y})
    robots.push("fox")
    for name in ("mole", "fox"):
        robots.fetch(name)
        assert (robots[name].view.evidence(A), robots[name].view.evidence(B)) == (Y, Y)
        assert [str(kept.id) for kept in robots[name].outbox if kept.seal] == [said]
    assert robots.fetch_cells("hare") == 2
    assert robots["hare"].view.evidence(A) == Y
    robots.close()


def test_the_operators_retracts_are_those_of_its_commits_that_are_not_stable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replicas, "RETRACTS_AT_ONCE", 3)
    mole = opened(tmp_path / "mole")
    assert mole.lacking_retracts() == []
    said = [CommitId(DESK, n) for n in range(6)]
    amend = CommitId(Author(RobotName("wren"), Incarnation("0" * 16)), 7)
    newest = header(cursor(1), covering(amend, *said)).model_copy(
        update={"stable": covering(said[0]).to_json(), "retracts": [str(amend)]}
    )
    exchanged(mole, newest)
    assert mole.lacking_retracts() == said[1:4]
    mole.close()
