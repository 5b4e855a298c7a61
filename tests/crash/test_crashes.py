"""Some of `make soak`'s crashes: no acknowledged commit is ever lost, and no store is ever damaged."""

import logging

import pytest
from tests.crash.kills import killed_servers
from tests.crash.lives import trial

pytestmark = pytest.mark.slow

TRIALS = 40
KILLS = 10
OTHER_LEVELS_TRIALS = 16


@pytest.fixture(autouse=True)
def without_complaints() -> object:
    """Stores say of each failed write that they could not; that is the point here."""
    logging.disable(logging.ERROR)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("seeds", [range(start, start + 10) for start in range(0, TRIALS, 10)])
def test_no_power_cut_loses_what_was_acknowledged(seeds: range) -> None:
    for seed in seeds:
        done = trial(seed)
        assert done.verdict.is_sound, f"seed {seed}: {done.verdict}"


@pytest.mark.parametrize("level", ["NORMAL", "OFF"])
def test_these_trials_notice_a_store_that_does_not_flush(level: str) -> None:
    assert any(trial(seed, level=level).verdict.lost for seed in range(OTHER_LEVELS_TRIALS))


@pytest.mark.processes
def test_no_kill_loses_what_was_acknowledged() -> None:
    done = killed_servers(1, kills=KILLS)
    assert [verdict for verdict in done.verdicts if not verdict.is_sound] == []
    assert done.answers <= {200, 201}
    assert len(done.acked) > KILLS
