"""A server's word alone drops nothing at once: acknowledged bytes stay for a least time of the robot's own running."""

from contextlib import closing
from pathlib import Path

import apsw
import pytest
from tests.fixtures.client.made import GEOMETRY, MAP, A, covering, cursor, header, seen

from cairn_client.replica.replica import FORGET_AT_ONCE, Replica
from cairn_client.replica.replica_store import FILE_NAME, BaseCell, ReplicaStore
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import RobotName
from cairn_map.evidence.fingerprint import ZERO

DAY_S = 86_400.0


class Clock:
    """Steady clock that a test moves."""

    def __init__(self) -> None:
        self.now_s = 5.0

    def __call__(self) -> float:
        return self.now_s


def opened(folder: Path, clock: Clock) -> Replica:
    store = ReplicaStore(folder, steady_s=clock)
    return Replica(store, robot=RobotName("mole"), map_name=MAP, geometry=GEOMETRY, keep_acked_s=DAY_S)


def all_stable(mole: Replica, commit: Commit) -> None:
    """The server says that it has the commit for good, and shows the cell with it."""
    known = covering(commit.id)
    mole.take_header(header(cursor(1), known, stable=known), asked_by=mole.author)
    with mole.changing() as base:
        base.hold_nothing(A, BaseCell(cursor(1), known, ZERO))


def test_bytes_of_a_commit_that_is_called_stable_at_once_stay_for_a_day_of_running(tmp_path: Path) -> None:
    clock = Clock()
    mole = opened(tmp_path, clock)
    commit = mole.commit({A: seen(1)})
    mole.acknowledge(commit.id)
    all_stable(mole, commit)
    assert mole.forget_stable_commits() == 0
    clock.now_s += DAY_S / 2
    all_stable(mole, commit)
    assert mole.forget_stable_commits() == 0
    mole.close()
    # Off for however long: a start counts on from what was kept, and the machine's clock begins anywhere.
    clock.now_s = 1e9
    mole = opened(tmp_path, clock)
    assert mole.forget_stable_commits() == 0 and mole.kept_commit(commit.id) is not None
    clock.now_s += DAY_S / 2 + 1
    assert mole.forget_stable_commits() == 1
    mole.close()


@pytest.mark.parametrize("version", [1, 2])
def test_a_folder_from_before_ages_opens_and_its_commits_count_from_then(tmp_path: Path, version: int) -> None:
    clock = Clock()
    mole = opened(tmp_path, clock)
    commit = mole.commit({A: seen(1)})
    mole.acknowledge(commit.id)
    mole.close()
    with closing(apsw.Connection(str(tmp_path / FILE_NAME))) as old:
        old.execute("ALTER TABLE commits DROP COLUMN acked_age_s; ALTER TABLE commits DROP COLUMN epoch")
        old.execute("DROP TABLE delta; DELETE FROM meta WHERE key = 'age_s'")
        old.execute("ALTER TABLE commits DROP COLUMN seal" if version == 1 else "")
        old.execute(f"PRAGMA user_version = {version}")
    mole = opened(tmp_path, clock)
    kept = mole.kept_commit(commit.id)
    assert kept is not None and kept.data == commit.data and mole.outbox.kept(commit.id).acked  # type: ignore[union-attr]
    all_stable(mole, commit)
    assert mole.forget_stable_commits() == 0
    clock.now_s += DAY_S
    assert mole.forget_stable_commits() == 1
    mole.close()


def test_room_for_a_commit_goes_before_the_least_time_a_few_of_the_oldest_at_once(tmp_path: Path) -> None:
    mole = opened(tmp_path, Clock())
    commits = [mole.commit({A: seen(n)}) for n in range(FORGET_AT_ONCE + 2)]
    for commit in commits:
        mole.acknowledge(commit.id)
    known = covering(*(commit.id for commit in commits))
    mole.take_header(header(cursor(1), known, stable=known), asked_by=mole.author)
    with mole.changing() as base:
        base.hold_nothing(A, BaseCell(cursor(1), known, ZERO))
    assert mole.forget_stable_commits() == 0
    assert mole.make_room_of_stable_commits(wanted=lambda cell: True) == FORGET_AT_ONCE
    assert mole.commits == [commit.id for commit in commits[-2:]]
    mole.close()
