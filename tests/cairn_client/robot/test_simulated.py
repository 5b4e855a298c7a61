"""The law: whatever happens to links, disks, clocks and servers, all maps end equal and no commit is lost.

`python -m tests.sync_sim --seed N` tells what happens in a seed.
"""

import pytest
from tests.fixtures.lengths import length
from tests.sync_sim.history import failures, run_seed

pytestmark = pytest.mark.slow

SEEDS, PART = length(300, long=800), 50
"""The next 1700 seeds are simulated by .ci/run, and 100 000 by `make soak`."""


@pytest.mark.parametrize("first", range(0, SEEDS, PART))
def test_no_seed_diverges(first: int) -> None:
    assert failures(range(first, first + PART)) == []


def test_the_same_seed_is_the_same_history() -> None:
    told: list[list[str]] = [[], []]
    for lines in told:
        run_seed(11, log=lines.append)
    assert told[0] == told[1]
    assert len(told[0]) > 5
