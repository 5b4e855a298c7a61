"""A short run of `tests.replicas`: each kind of fault against two servers and two that fold, and the verdict."""

from pathlib import Path

import pytest
from tests.fixtures.server.postgres import SYSTEM, WHEEL, programs_of
from tests.replicas.fault_run import SILENCE_MAX_S, fault_run

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.mark.parametrize(("kind", "seed"), [(WHEEL, 1), (SYSTEM, 4)])
def test_nothing_that_was_acknowledged_is_lost_or_folded_twice(kind: str, seed: int, tmp_path: Path) -> None:
    found = fault_run(tmp_path, programs_of(kind), seconds=8.0, robots=3, seed=seed)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.verdict.is_sound and not found.pushed.wrong, said
    assert len(found.pushed.acked) > 50, said
    assert found.pushed.silence_s < SILENCE_MAX_S, said
