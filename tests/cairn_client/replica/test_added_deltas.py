"""Deltas added to a base: equal to whole cells in every order, kept next to its bytes, written with them at last."""

from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from tests.fixtures.client.made import (
    GEOMETRY,
    PLAIN,
    WITH_EPOCHS,
    A,
    B,
    added,
    cell_frame,
    cells_of,
    committed,
    covering,
    cursor,
    done,
    exchanged,
    flip_a_bit,
    foreign,
    header,
    opened,
    seen,
)

from cairn_client.replica import server_cells
from cairn_client.replica.replica import Replica
from cairn_map.codec.layer_code import encode_layer_cell
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import VersionVector
from cairn_map.epochs.cell_history import NOTHING, CellHistory, cell_history, history_fingerprint, merged, unmerged
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import UnreachableError
from cairn_map.evidence.evidence import Evidence
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_map.wire.messages import Done

C1, C2, C3 = cursor(1), cursor(2), cursor(3)
X, Y, Z = seen(1, 2, kelvin_steps=7), seen(2, 100), seen(300, kelvin_steps=9)


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


def at(replica: Replica, evidence: Evidence, coverage: VersionVector | None = None) -> None:
    """Bring cell A whole to C1."""
    assert exchanged(
        replica, header(C1, coverage or covering()), cell_frame(FrameKind.FULL, C1, evidence), done(C1)
    ).is_done


def delta(to: Cursor, whole: Evidence, payload: Evidence, start: Cursor = C1) -> CellFrame:
    """A frame that adds evidence to cell A."""
    return cell_frame(FrameKind.DELTA, to, whole, start=start, payload=payload)


def test_a_delta_leaves_the_bytes_of_the_cell_as_they_are(mole: Replica, tmp_path: Path) -> None:
    at(mole, X)
    body = mole.store.body(A)
    frame = delta(C2, added(X, Y), Y)
    assert exchanged(mole, header(C2), frame, done(C2)).is_done
    assert (mole.store.body(A), mole.store.deltas(A)) == (body, [frame.payload])
    assert mole.view.evidence(A) == mole.base_evidence(A) == added(X, Y)
    mole.close()
    again = opened(tmp_path / "mole")
    assert again.view.evidence(A) == again.base_evidence(A) == added(X, Y)
    assert again.store.cell_bytes() == {A: len(body or b"") + len(frame.payload)}
    again.close()


def test_a_delta_of_a_cell_that_is_not_held_is_the_cell(mole: Replica) -> None:
    assert exchanged(mole, header(C1), done(C1)).is_done
    assert exchanged(mole, header(C2), delta(C2, Y, Y), done(C2)).is_done
    assert mole.view.evidence(A) == mole.base_evidence(A) == Y
    assert mole.store.deltas(A) == []


def test_after_some_deltas_the_cell_is_written_with_them(mole: Replica, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_cells, "DELTAS_MAX", 2)
    at(mole, X)
    whole = X
    for n in range(2, 6):
        whole = added(whole, Y)
        assert exchanged(mole, header(cursor(n)), delta(cursor(n), whole, Y, cursor(n - 1)), done(cursor(n))).is_done
        assert len(mole.store.deltas(A)) == (n - 1) % 3
    assert mole.view.evidence(A) == mole.base_evidence(A) == whole


def test_a_base_that_the_disk_damaged_is_found_when_it_is_written_with_its_deltas(
    mole: Replica, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at(mole, X)
    monkeypatch.setattr(server_cells, "DELTAS_MAX", 0)
    with mole.store.transaction():
        mole.store.put_body(A, encode_layer_cell(A, cell_history({BASE: Z}), PLAIN).data)
    exchanged(mole, header(C2), delta(C2, added(X, Y), Y), done(C2))
    assert mole.cells[A].cursor is None
    exchanged(mole, header(C3), cell_frame(FrameKind.FULL, C3, added(X, Y)), done(C3))
    assert mole.view.evidence(A) == mole.base_evidence(A) == added(X, Y)


def test_a_delta_that_the_disk_damaged_is_found_when_the_folder_is_opened(mole: Replica, tmp_path: Path) -> None:
    at(mole, X)
    exchanged(mole, header(C2), delta(C2, added(X, Y), Y), done(C2))
    mole.close()
    flip_a_bit(tmp_path / "mole" / "robot.sqlite", "delta", "body", "cell = ?", (A,))
    again = opened(tmp_path / "mole")
    assert again.cells[A].cursor is None
    again.close()


def test_a_delta_that_the_disk_does_not_take_changes_nothing(mole: Replica, monkeypatch: pytest.MonkeyPatch) -> None:
    at(mole, X)
    before = mole.cells[A]

    def full(*_: object) -> None:
        raise UnreachableError("store_failed", "the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(mole.store, "put_deltas", full)
        with pytest.raises(UnreachableError):
            exchanged(mole, header(C2), delta(C2, added(X, Y), Y))
    assert (mole.cells[A], mole.store.deltas(A)) == (before, [])
    assert mole.view.evidence(A) == mole.base_evidence(A) == X
    assert exchanged(mole, header(C2), delta(C2, added(X, Y), Y), done(C2)).is_done
    assert mole.view.evidence(A) == added(X, Y)


def test_own_commits_that_a_delta_leaves_out_are_shown_once(mole: Replica) -> None:
    at(mole, X)
    ours, waiting = committed(mole, Y), committed(mole, seen(5))
    frame = cell_frame(FrameKind.DELTA, C2, added(X, Y, Z), start=C1, payload=Z, own_excluded=True)
    assert exchanged(mole, header(C2, covering(ours.id)), frame, done(C2)).is_done
    assert mole.base_evidence(A) == added(X, Y, Z)
    assert mole.view.evidence(A) == added(X, Y, Z, seen(5))
    assert waiting.id in mole.push_set()


@pytest.mark.parametrize("layer", [PLAIN, WITH_EPOCHS], ids=["plain", "epochs"])
@pytest.mark.parametrize("seed", range(12))
def test_deltas_in_any_order_give_what_whole_cells_give(
    tmp_path: Path, layer: MapLayer, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_cells, "DELTAS_MAX", 3)
    chance, by_delta, by_whole = Random(seed), tmp_path / "delta", tmp_path / "whole"
    ant, bee = opened(by_delta, "mole", layer=layer), opened(by_whole, "mole", layer=layer)
    sums: dict[int, CellHistory] = {A: NOTHING, B: NOTHING}
    taken: list[tuple[int, CellHistory]] = []
    known: list[CommitId] = []
    try:
        for seq in range(1, 14):
            key, start, to = chance.choice([A, B]), cursor(seq - 1) if seq > 1 else None, cursor(seq)
            evidence = seen(*sorted(chance.sample(range(60), 4)), kelvin_steps=chance.randrange(3))
            news = cell_history({Epoch(chance.randrange(3)) if layer.has_epochs else BASE: evidence})
            if taken and chance.random() < 0.3:  # somebody takes a commit out
                key, gone = taken.pop(chance.randrange(len(taken)))  # type: ignore[assignment]
                news = unmerged(NOTHING, gone, GEOMETRY)
            else:
                taken.append((key, news))
            sums[key] = merged([sums[key], news], GEOMETRY)
            known.append(foreign(seq))
            if chance.random() < 0.3:
                for replica in (ant, bee):
                    replica.commit({key: seen(7, 8)})
            for replica, kind, payload in ((ant, FrameKind.DELTA, news), (bee, FrameKind.FULL, sums[key])):
                frame = CellFrame(
                    kind=kind,
                    cell=key,
                    from_cursor=start,
                    to_cursor=to,
                    fingerprint=history_fingerprint(sums[key], key, layer_word=layer.word),
                    payload=encode_layer_cell(key, payload, layer).data,
                )
                others = sum(
                    (history_fingerprint(sums[each], each, layer_word=layer.word) for each in (A, B) if each != key),  # type: ignore[misc]
                    history_fingerprint(NOTHING, A, layer_word=layer.word),
                )
                assert exchanged(
                    replica, header(to, covering(*known)), frame, Done(to=str(to), rest=others.hex())
                ).is_done
            assert cells_of(ant.view) == cells_of(bee.view)
            assert {key: ant.base_history(key) for key in (A, B)} == sums
            if chance.random() < 0.2:
                ant.close()
                ant = opened(by_delta, "mole", layer=layer)
                assert cells_of(ant.view) == cells_of(bee.view)
    finally:
        ant.close()
        bee.close()
