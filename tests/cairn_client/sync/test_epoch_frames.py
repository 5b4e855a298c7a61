"""Frames, commits and retracts of a robot on a map with epochs: rows in which evidence lies (rules T1, T3 and T6)."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.made import (
    MAP,
    WITH_EPOCHS,
    A,
    cells_of,
    covering,
    cursor,
    done,
    exchanged,
    foreign,
    header,
    opened,
    seen,
)

from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import Replica
from cairn_map.codec.cell_code import Profile, encode_cell
from cairn_map.codec.layer_code import decode_layer_cell, encode_layer_cell
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.cell_history import CellHistory, cell_history, history_fingerprint, merged
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_map.wire.messages import Done

C1, C2 = cursor(1), cursor(2)
X, Y, Z = seen(1, 2, kelvin_steps=7), seen(2, 100), seen(300, kelvin_steps=9)
OLD, NOW = Epoch(5), Epoch(7)


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole", layer=WITH_EPOCHS)
    yield replica
    replica.close()


def rows(**given: Evidence) -> CellHistory:
    """A history of the rows `base`, `old` and `now`."""
    epochs = {"base": BASE, "old": OLD, "now": NOW}
    return cell_history({epochs[name]: row for name, row in given.items()})


def frame(
    kind: FrameKind, to: Cursor, whole: CellHistory, payload: CellHistory | None = None, **fields: object
) -> CellFrame:
    """A frame that leads cell A to some rows."""
    body = encode_layer_cell(A, whole if payload is None else payload, WITH_EPOCHS).data
    found = history_fingerprint(whole, A, layer_word=WITH_EPOCHS.word)
    given = {"from_cursor": None, **fields}
    return CellFrame(kind=kind, cell=A, to_cursor=to, fingerprint=found, payload=body, **given)  # type: ignore[arg-type]


def at(mole: Replica, to: Cursor, whole: CellHistory, coverage: VersionVector = EMPTY) -> None:
    """Bring cell A to a state."""
    frames = frame(FrameKind.FULL, to, whole), Done(to=str(to), rest=bytes(16).hex())
    assert exchanged(mole, header(to, coverage), *frames).is_done


def view_of(histories: Mapping[int, CellHistory]) -> HistoryMap:
    """A map of these cells."""
    view = HistoryMap(WITH_EPOCHS)
    for key, history in histories.items():
        view.replace(key, history)  # type: ignore[arg-type]
    return view


def committed(mole: Replica, evidence: Evidence, epoch: Epoch | None, *retracts: CommitId) -> CommitId:
    """A commit of cell A."""
    return mole.commit({A: evidence}, CommitFacts(epoch=epoch, retracts=retracts)).id


def test_a_full_frame_brings_all_rows_and_they_come_back_from_the_disk(mole: Replica, tmp_path: Path) -> None:
    at(mole, C1, rows(base=X, old=Y, now=Z))
    assert mole.base_history(A) == mole.view.history(A) == rows(base=X, old=Y, now=Z)
    mole.close()
    again = opened(tmp_path / "mole", layer=WITH_EPOCHS)
    assert again.view == view_of({A: rows(base=X, old=Y, now=Z)})
    again.close()


def test_a_delta_adds_each_row_to_its_own_and_own_commits_to_theirs(mole: Replica) -> None:
    own = committed(mole, Z, NOW)
    mole.acknowledge(own)
    at(mole, C1, rows(old=X))
    whole = rows(base=Y, old=X, now=Z)
    delta = frame(FrameKind.DELTA, C2, whole, rows(base=Y), from_cursor=C1, own_excluded=True)
    exchanged(mole, header(C2, covering(own, foreign(1))), delta)
    assert mole.base_history(A) == mole.view.history(A) == whole


def test_a_state_frame_replaces_its_blocks_in_all_rows(mole: Replica) -> None:
    # Voxels 1, 2 and 100 are in blocks 0 and 1; block 1 is not sent, and stays in both rows.
    at(mole, C1, rows(old=seen(1, 100), now=seen(2, 100)))
    whole = rows(base=seen(3), old=seen(100), now=seen(100))
    state = frame(FrameKind.STATE, C2, whole, rows(base=seen(3)), from_cursor=C1, blocks=np.array([0], np.uint32))
    exchanged(mole, header(C2), state, done(C2))
    assert mole.base_history(A) == whole


def test_evidence_in_the_row_of_another_epoch_is_noticed(mole: Replica) -> None:
    at(mole, C1, rows(old=X))
    wrong = frame(FrameKind.DELTA, C2, rows(old=X, now=Y), rows(old=Y), from_cursor=C1)
    exchanged(mole, header(C2), wrong)
    assert mole.base_history(A) == rows(old=X)
    assert mole.cells[A].cursor is None


def test_the_view_shows_own_commits_in_their_own_epochs(mole: Replica) -> None:
    at(mole, C1, rows(old=X))
    committed(mole, Y, NOW)
    committed(mole, Z, None)
    assert mole.view.history(A) == rows(base=Z, old=X, now=Y)


def test_a_retract_takes_evidence_out_of_the_row_of_its_target(mole: Replica) -> None:
    first = committed(mole, X, OLD)
    committed(mole, X, NOW)
    committed(mole, Y, NOW, first)
    assert mole.view.history(A) == merged([rows(now=X), rows(now=Y)], WITH_EPOCHS.geometry)
    assert mole.base_history(A) == rows()


def test_an_amend_keeps_the_epoch_of_what_it_stands_for(mole: Replica) -> None:
    first = committed(mole, X, OLD)
    amended = mole.amend(first, {A: Y}, CommitFacts(epoch=NOW), profile=Profile.FAST)
    assert amended.meta.row == OLD
    assert mole.view.history(A) == rows(old=Y)


def test_commits_state_layer_and_epoch_and_one_without_a_time_is_of_the_base(mole: Replica) -> None:
    timed, timeless = (mole.kept_commit(committed(mole, X, epoch)) for epoch in (NOW, None))
    assert timed is not None
    assert timeless is not None
    assert (timed.meta.version, timed.meta.layers, timed.meta.epoch) == (2, WITH_EPOCHS.identities, NOW)
    assert (timeless.meta.version, timeless.meta.row) == (2, BASE)
    assert timed.cells[A] == encode_cell(A, X, WITH_EPOCHS.geometry).data


def test_a_folder_belongs_to_a_map_of_one_length_of_epochs(tmp_path: Path) -> None:
    opened(tmp_path / "mole", layer=WITH_EPOCHS).close()
    with pytest.raises(BadInputError, match="another epoch_s: 120"):
        opened(tmp_path / "mole")
    opened(tmp_path / "bat").close()
    with pytest.raises(BadInputError, match="another epoch_s: none"):
        opened(tmp_path / "bat", layer=WITH_EPOCHS)


def test_two_robots_with_other_orders_of_the_same_commits_have_the_same_cells(tmp_path: Path) -> None:
    commits = [(X, OLD), (Y, NOW), (Z, None), (Y, OLD), (X, None)]
    views = []
    for name, order in (("bat", commits), ("owl", commits[::-1])):
        replica = opened(tmp_path / name, name, map_name=MAP, layer=WITH_EPOCHS)
        for evidence, epoch in order:
            committed(replica, evidence, epoch)
        views.append(cells_of(replica.view))
        body = encode_layer_cell(A, replica.view.history(A), WITH_EPOCHS).data
        assert decode_layer_cell(body, A, WITH_EPOCHS).history == replica.view.history(A)
        replica.close()
    assert views[0] == views[1]


def test_a_robot_that_began_without_a_link_goes_on_with_the_epochs_of_its_map(tmp_path: Path) -> None:
    bat = opened(tmp_path / "bat", "bat")
    first = bat.commit({A: X})
    bat.take_epochs(WITH_EPOCHS)
    committed(bat, Y, NOW)
    assert first.meta.version == 1
    assert bat.view.history(A) == rows(base=X, now=Y)
    bat.close()
    again = opened(tmp_path / "bat", "bat", layer=WITH_EPOCHS)
    assert again.view.history(A) == rows(base=X, now=Y)
    # What is of a server's map already stays what it is.
    at(again, C1, rows(old=Z))
    with pytest.raises(BadInputError, match="not voxels"):
        again.take_epochs(WITH_EPOCHS)
    again.close()
