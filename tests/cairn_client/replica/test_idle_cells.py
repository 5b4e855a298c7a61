"""Cells that did not change for a minute or two are held as bytes, and show the same."""

from pathlib import Path

from tests.fixtures.client.made import GEOMETRY, MAP, A, cells_of, seen

from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import IDLE_S, Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.commits.ids import RobotName
from cairn_map.epochs.epoch import Epoch


def test_cells_rest_once_they_did_not_change_for_a_minute(tmp_path: Path) -> None:
    now_s = [5.0]
    store = ReplicaStore(tmp_path, steady_s=lambda: now_s[0])
    mole = Replica(store, robot=RobotName("mole"), map_name=MAP, geometry=GEOMETRY, epoch_s=120)
    mole.commit({A: seen(*range(40), kelvin_steps=3)}, CommitFacts(epoch=Epoch(7)))
    shown = mole.snapshot()
    open_bytes, before = mole.memory_bytes(), cells_of(mole.view)
    sizes = []
    for step_s in (IDLE_S - 1, 1, IDLE_S - 1, 1):
        now_s[0] += step_s
        mole.rest()
        sizes.append(mole.memory_bytes())
    assert sizes[:3] == [open_bytes] * 3 and sizes[3] < open_bytes
    assert cells_of(mole.view) == before
    points = shown.voxels_in().centres_m
    assert (mole.snapshot().log_odds_at(points) == shown.log_odds_at(points)).all()
    mole.close()
