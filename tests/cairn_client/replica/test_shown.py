"""Cells shown without what a robot's own commits take out: at once, whatever the server has of both, and only once."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.made import (
    GEOMETRY,
    WITH_EPOCHS,
    A,
    B,
    added,
    cell_frame,
    committed,
    covering,
    cursor,
    done,
    exchanged,
    header,
    opened,
    seen,
)

from cairn_client.replica import outbox
from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import Replica
from cairn_map.commits.commit import Commit, CommitMeta, make_commit, split_commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, cell_key, centres_of_voxels, voxels_in_cell
from cairn_map.queries.occupancy_states import State
from cairn_map.wire.frames import FrameKind

C1, C2, C3 = cursor(1), cursor(2), cursor(3)
X, Y, Z, W = seen(1, 2, kelvin_steps=7), seen(2, 100), seen(300, kelvin_steps=9), seen(4, 5)


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


def at(replica: Replica, to: Cursor, evidence: Evidence, coverage: VersionVector = EMPTY) -> None:
    """Bring cell A to a state."""
    frame = cell_frame(FrameKind.FULL, to, evidence, start=replica.default_cursor)
    assert exchanged(replica, header(to, coverage), frame, done(to)).is_done


def taking_out(*targets: CommitId) -> CommitFacts:
    return CommitFacts(retracts=targets)


def amended(replica: Replica, target: CommitId, diff: dict[CellKey, Evidence]) -> Commit:
    return replica.commit(diff, taking_out(target))


def is_the_same_after_a_restart(replica: Replica, folder: Path) -> bool:
    before = [replica.view.evidence(key) for key in (A, B)]
    replica.close()
    again = opened(folder / "mole")
    after = [again.view.evidence(key) for key in (A, B)]
    again.close()
    return before == after


def test_what_an_amend_names_is_not_shown_where_the_server_lacks_both(mole: Replica, tmp_path: Path) -> None:
    committed(mole, W)
    wrong = mole.commit({A: X, B: X})
    amended(mole, wrong.id, {A: Y})
    assert mole.view.evidence(A) == added(W, Y)
    assert not len(mole.view.evidence(B))
    assert is_the_same_after_a_restart(mole, tmp_path)


def test_what_an_amend_names_is_subtracted_where_the_server_has_it(mole: Replica, tmp_path: Path) -> None:
    wrong = committed(mole, X)
    mole.acknowledge(wrong.id)
    at(mole, C1, added(W, X), covering(wrong.id))
    amend = amended(mole, wrong.id, {A: Y})
    assert mole.view.evidence(A) == added(W, Y)
    at(mole, C2, added(W, X, Z), covering(wrong.id))
    assert mole.view.evidence(A) == added(W, Y, Z)
    at(mole, C3, added(W, Y, Z), covering(wrong.id, amend.id))
    assert mole.view.evidence(A) == added(W, Y, Z)
    assert is_the_same_after_a_restart(mole, tmp_path)


def test_what_the_server_took_out_is_not_taken_out_again(mole: Replica) -> None:
    wrong = committed(mole, X)
    mole.acknowledge(wrong.id)
    amend = amended(mole, wrong.id, {A: Y})
    at(mole, C1, added(W, Y), covering(wrong.id, amend.id))
    assert mole.view.evidence(A) == added(W, Y)
    mole.commit({A: Z}, taking_out(wrong.id))  # it is out already: that takes nothing out
    assert mole.view.evidence(A) == added(W, Y, Z)
    at(mole, C2, added(W, Y), covering(wrong.id, amend.id))
    assert mole.view.evidence(A) == added(W, Y, Z)


def test_of_an_amend_of_an_amend_only_the_last_is_shown(mole: Replica, tmp_path: Path) -> None:
    wrong = committed(mole, X)
    first = amended(mole, wrong.id, {A: Y})
    last = amended(mole, first.id, {A: Z})
    assert mole.view.evidence(A) == Z
    assert mole.outbox.successors.latest(wrong.id) == mole.outbox.successors.latest(first.id) == last.id
    assert is_the_same_after_a_restart(mole, tmp_path)


def test_bytes_that_the_server_never_acknowledged_are_not_subtracted(mole: Replica) -> None:
    wrong = committed(mole, X)
    at(mole, C1, W, covering(wrong.id))  # of a disk that was rolled back: the server has other bytes under this id
    amended(mole, wrong.id, {A: Y})
    assert mole.view.evidence(A) == added(W, Y)
    mole.acknowledge(wrong.id)
    at(mole, C2, added(W, X), covering(wrong.id))
    assert mole.view.evidence(A) == added(W, Y)


def test_what_an_operator_took_out_is_not_shown_before_the_server_s_cell_comes(mole: Replica) -> None:
    wrong = committed(mole, X)
    mole.acknowledge(wrong.id)
    at(mole, C1, added(W, X), covering(wrong.id))
    meta = CommitMeta(id="operator.0123456789abcdef.0", geometry=GEOMETRY.digest().hex(), retracts=(str(wrong.id),))
    mole.keep_sealed(make_commit(meta, {}, GEOMETRY), "the seal")
    assert mole.view.evidence(A) == W


def test_another_server_gets_and_shows_what_the_first_one_s_operator_took_out(mole: Replica) -> None:
    commit = committed(mole, X)
    mole.acknowledge(commit.id)
    meta = CommitMeta(id="operator.0123456789abcdef.0", geometry=GEOMETRY.digest().hex(), retracts=(str(commit.id),))
    mole.keep_sealed(make_commit(meta, {}, GEOMETRY), "the seal")
    mole.forget_server()
    assert mole.push_set() == [commit.id]
    assert mole.view.evidence(A) == X
    mole.acknowledge(commit.id)
    at(mole, C1, X, covering(commit.id))
    assert mole.view.evidence(A) == X


def test_a_commit_and_its_amend_may_both_get_new_ids(mole: Replica) -> None:
    wrong = committed(mole, X)
    amend = amended(mole, wrong.id, {A: Y})
    renamed = mole.rename(wrong.id)
    again = mole.rename(amend.id)
    assert mole.view.evidence(A) == Y
    successors = mole.outbox.successors
    assert {successors.latest(commit) for commit in (wrong.id, renamed, amend.id)} == {again}
    mole.acknowledge(renamed)
    at(mole, C1, added(W, X), covering(wrong.id, amend.id, renamed))  # the old ids are other commits on the server
    assert mole.view.evidence(A) == added(W, Y)


def test_a_folder_whose_commit_has_many_cells_is_opened_by_reading_the_commit_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cell by cell, one commit of 2132 cells took 18 s to open."""
    mole = opened(tmp_path / "mole")
    cells = [cell_key((n, 0, 0)) for n in range(60)]
    mole.commit(dict.fromkeys(cells, X))
    mole.close()
    reads = []

    def counted(data: bytes) -> tuple[CommitMeta, dict[CellKey, bytes]]:
        reads.append(len(data))
        return split_commit(data)

    monkeypatch.setattr(outbox, "split_commit", counted)
    again = opened(tmp_path / "mole")
    assert all(again.view.evidence(key) == X for key in cells)
    assert len(reads) <= 2
    # Commits that together are larger than what stays in memory are read again, and right.
    monkeypatch.setattr(outbox, "READ_LAST_BYTES_MAX", 1)
    again.commit(dict.fromkeys(cells, Y))
    again.close()
    last = opened(tmp_path / "mole")
    assert all(last.view.evidence(key) == added(X, Y) for key in cells)
    assert len(reads) > 60
    last.close()


def test_what_was_taken_out_of_a_cell_that_is_empty_then_stays_out_when_the_retract_is_forgotten(
    mole: Replica, tmp_path: Path
) -> None:
    wrong = committed(mole, X)
    mole.acknowledge(wrong.id)
    meta = CommitMeta(id="operator.0123456789abcdef.0", geometry=GEOMETRY.digest().hex(), retracts=(str(wrong.id),))
    retract = make_commit(meta, {}, GEOMETRY)
    mole.keep_sealed(retract, "the seal")
    # Of a cell from which all was taken out, who holds nothing gets no frame.
    both = covering(wrong.id, retract.id)
    assert exchanged(mole, header(C1, both, stable=both), done(C1)).is_done
    assert mole.forget_stable_commits() == 1
    assert mole.commits == []
    assert len(mole.view.evidence(A)) == 0
    assert is_the_same_after_a_restart(mole, tmp_path)


def test_a_snapshot_of_a_map_with_epochs_shows_what_is_there_now(tmp_path: Path) -> None:
    replica = opened(tmp_path, layer=WITH_EPOCHS)
    wall, air = (
        packed_evidence(np.zeros(1, np.uint32), np.array([counts]), np.zeros((1, GEOMETRY.plane_count)), GEOMETRY)
        for counts in ((200, 0), (0, 9))
    )
    point = centres_of_voxels(voxels_in_cell(wall.voxels, A, GEOMETRY), GEOMETRY)
    replica.commit({A: wall}, CommitFacts(epoch=Epoch(3)))
    before = replica.snapshot()
    replica.commit({A: air}, CommitFacts(epoch=Epoch(5)))
    now = replica.snapshot()
    replica.close()
    assert (before.state_at(point)[0], now.state_at(point)[0]) == (State.OCCUPIED, State.FREE)
    assert now.counts_at(point).tolist() == [[200, 9]]
    assert (before.seen_at(point)[0], now.seen_at(point)[0]) == (3 * 120, 5 * 120)
