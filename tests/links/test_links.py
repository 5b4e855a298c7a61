"""Some of `make soak`'s bad links and kills: all robots and the server end with the same map, and nothing is lost."""

from pathlib import Path

import pytest
from tests.crowd.building import SCANS, survey
from tests.links.life import Building
from tests.links.soak import Plan, Soak

pytestmark = pytest.mark.processes

SECONDS = 5.0


@pytest.fixture(scope="module")
def building() -> Building:
    seen = survey(robot="tof", voxel_m=0.16, stops=3)
    return Building(seen.geometry, seen.stops, SCANS[0] * SCANS[1])


@pytest.mark.parametrize("kill_every_s", [None, 0.4], ids=["links", "kills"])
def test_robots_on_links_that_fail_all_end_with_the_sum_of_all_commits(
    building: Building, tmp_path: Path, kill_every_s: float | None
) -> None:
    seconds = 2 * SECONDS if kill_every_s else SECONDS  # what was killed takes a second to start again
    plan = Plan(seconds=seconds, commit_every_s=0.3, cut_bytes=20_000, kill_every_s=kill_every_s, seed=1)
    soak = Soak(tmp_path, building, plan)
    try:
        outcome = soak.run()
    finally:
        soak.close()
    assert outcome.verdict.wrong == []
    assert outcome.verdict.commits > 3
    kills = outcome.server_kills + outcome.robot_kills
    assert kills > 3 if kill_every_s else outcome.cuts > 1
