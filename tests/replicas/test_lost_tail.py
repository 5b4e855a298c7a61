"""Short runs of `tests.replicas lost-tail` and `restore`: robots bring back what an older database lacks."""

from pathlib import Path

import pytest
from tests.fixtures.server.object_store import object_server_in
from tests.fixtures.server.postgres import SYSTEM, WHEEL, programs_of
from tests.replicas.lost_tail import lost_tail_run
from tests.replicas.point_in_time import restore_run

pytestmark = [pytest.mark.processes, pytest.mark.slow]


def test_servers_and_robots_go_on_when_the_newest_commits_are_lost(tmp_path: Path) -> None:
    found = lost_tail_run(tmp_path, programs_of(WHEEL), seeds=range(1, 3))
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
    assert found.frames["delta"] > 20 and found.frames["reset"] > 0, said


def test_robots_bring_back_what_a_restore_to_a_point_in_time_takes_away(tmp_path: Path) -> None:
    with object_server_in() as objects:
        found = restore_run(tmp_path, programs_of(SYSTEM), seconds=0.7, objects=objects)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
