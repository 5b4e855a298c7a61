"""Snapshots of maps with epochs: what is there now, what was there at a time, and that only the present forgets."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.made import WITH_EPOCHS, A, opened, seen

from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import Replica
from cairn_map.epochs.epoch import Epoch
from cairn_map.errors import ConflictError
from cairn_map.queries.occupancy_states import State

EDGE_M = 0.05
WALL, THERE_M = 0, [[0.5 * EDGE_M, 0.5 * EDGE_M, 0.5 * EDGE_M]]
OLD, NEW = Epoch(1000), Epoch(1030)


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole", layer=WITH_EPOCHS)
    yield replica
    replica.close()


def looks(mole: Replica, epoch: Epoch, *, kelvin_steps: int, times: int) -> None:
    """Scans of a voxel: a wall of this temperature, or the air where it was."""
    for _ in range(times):
        mole.commit({A: seen(WALL, kelvin_steps=kelvin_steps)}, CommitFacts(epoch=epoch))


def test_a_wall_that_vanished_is_free_now_and_was_there_then(mole: Replica) -> None:
    looks(mole, OLD, kelvin_steps=7, times=200)
    assert mole.snapshot().state_at(THERE_M) == State.OCCUPIED
    looks(mole, NEW, kelvin_steps=0, times=9)
    now, then = mole.snapshot(), mole.snapshot(at_s=1000 * 120.0)
    assert now.state_at(THERE_M) == State.FREE
    assert then.state_at(THERE_M) == State.OCCUPIED
    assert mole.snapshot(at_s=999 * 120.0).state_at(THERE_M) == State.UNKNOWN
    # What was taken for the wall's temperature is of nothing that is there.
    assert now.temperature_at(THERE_M).weight == 0
    assert then.temperature_at(THERE_M).weight == 200


def test_old_news_change_nothing_that_was_seen_since(mole: Replica) -> None:
    looks(mole, NEW, kelvin_steps=0, times=30)
    looks(mole, OLD, kelvin_steps=7, times=60)
    assert mole.snapshot().state_at(THERE_M) == State.FREE


def test_a_map_without_epochs_says_that_it_knows_nothing_of_earlier_times(tmp_path: Path) -> None:
    bat = opened(tmp_path / "bat")
    with pytest.raises(ConflictError, match="--epoch 120"):
        bat.snapshot(at_s=120.0)
    bat.close()
