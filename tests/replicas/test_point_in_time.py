"""A short run of `tests.replicas restore`: the commands of docs/scale.md, with robots and servers that go on."""

from pathlib import Path

import pytest
from tests.fixtures.server.postgres import SYSTEM, programs_of
from tests.replicas.point_in_time import restore_run

pytestmark = [pytest.mark.processes, pytest.mark.slow]


def test_robots_bring_back_what_a_restore_to_a_point_in_time_takes_away(tmp_path: Path) -> None:
    found = restore_run(tmp_path, programs_of(SYSTEM), seconds=0.7)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
