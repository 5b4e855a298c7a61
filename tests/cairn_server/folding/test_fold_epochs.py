"""Folding of maps with epochs: each commit into the row of its epoch, in any order, out of it again, and rebuilt."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.histories import LAYER
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.epoch_pushes import pushed_in, read_rows, rows_of
from tests.fixtures.server.evidence_contract import SOON
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.fixtures.server.store_contract import NAMES, new_of
from tests.memory_store.store import MemoryStore

from cairn_map.codec.cell_code import decode_cell, encode_cell
from cairn_map.codec.layer_code import encode_layer_cell, write_cell
from cairn_map.commits.commit import Commit
from cairn_map.epochs.cell_history import history_fingerprint
from cairn_map.epochs.epoch import Epoch
from cairn_map.errors import CairnError
from cairn_map.evidence.grid import CellKey
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding import store_check
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.cells_at_rest import cell_to_change, rebuilt_cell, stored_history
from cairn_server.folding.damaged_cells import DamagedCells, heal_cell
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.folding import fold_pending
from cairn_server.folding.group_folding import LocalFolding
from cairn_server.store.store_rows import CellRow, MapRow

EPOCHS = st.sampled_from([None, Epoch(-1), Epoch(3), Epoch(4), Epoch(900)])
STEPS = st.lists(st.tuples(EPOCHS, st.integers(0, 5)), min_size=1, max_size=7)
"""Epoch and seed of each commit."""


def commits_of(steps: Sequence[tuple[Epoch | None, int]]) -> list[Commit]:
    """Commits of these steps; half of those without a time are of version 1."""
    return [
        pushed(n, seed, WREN) if epoch is None and n % 2 else pushed_in(epoch, n, seed)
        for n, (epoch, seed) in enumerate(steps)
    ]


def folded_map(store: MemoryStore, commits: Sequence[Commit], *, group: int = 64, limit_bytes: int = 1 << 30) -> MapRow:
    """A map with epochs into which these are folded, so many at once."""
    row, _ = store.create_map(next(NAMES), SMALL, SensorModel(), LAYER.epoch_s)
    cache = CellCache(SMALL, FoldMemory(limit_bytes))
    for commit in commits:
        store.append(row, new_of(commit))
    while fold_pending(store, row, cache, limit=group):
        pass
    return row


def stored_cells(store: MemoryStore, row: MapRow) -> dict[CellKey, CellRow]:
    """Cells with evidence."""
    with store.snapshot(row) as snapshot:
        found = [snapshot.cell(cell.key) for cell in snapshot.cells() if cell.voxels]
    return {cell.key: cell for cell in found if cell}


def bodies(store: MemoryStore, row: MapRow) -> dict[CellKey, bytes]:
    return {key: cell.body for key, cell in stored_cells(store, row).items()}


@settings(max_examples=15)
@given(STEPS, st.randoms(use_true_random=False), st.integers(1, 3), st.sampled_from([0, 1 << 30]))
def test_any_order_of_commits_of_mixed_epochs_gives_their_rows_and_the_same_bytes(
    steps: Sequence[tuple[Epoch | None, int]],
    random,  # type: ignore[no-untyped-def]
    group: int,
    limit_bytes: int,
) -> None:
    commits, store = commits_of(steps), MemoryStore()
    taken_out = pushed_in(None, 99, 0, cells={}, retracts=commits[: len(commits) // 2])
    there = [*commits, taken_out]
    row = folded_map(store, there, group=group, limit_bytes=limit_bytes)
    other = folded_map(store, random.sample(there, len(there)))
    assert bodies(store, row) == bodies(store, other)
    assert read_rows(bodies(store, row)) == rows_of(there)
    for key, cell in stored_cells(store, row).items():
        history = stored_history(cell, LAYER)
        encoded = encode_layer_cell(key, history, LAYER)
        assert (cell.body, cell.digest) == (encoded.data, encoded.digest)
        assert cell.fingerprint == history_fingerprint(history, key, layer_word=LAYER.word)
        assert cell.voxels == sum(map(len, history.rows.values()))
        assert (cell.history_bytes > 0) == (len(history) > 1)


def test_a_retract_takes_out_of_the_target_s_own_epoch_whatever_came_since() -> None:
    store = MemoryStore()
    early, late, again = pushed_in(Epoch(3), 0, 1), pushed_in(Epoch(9), 1, 1), pushed_in(Epoch(3), 2, 1)
    row = folded_map(store, [early, late, again, pushed_in(Epoch(12), 3, 0, cells={}, retracts=[again])])
    assert read_rows(bodies(store, row)) == rows_of([early, late])
    for history in rows_of([early, late]).values():
        assert set(history) == {3, 9}


def test_a_map_with_epochs_has_the_totals_of_one_without() -> None:
    """Rule T5, by the fingerprint of the sums."""
    store, commits = MemoryStore(), [pushed(n, n) for n in range(4)]
    cells = [{key: decode_cell(body).evidence for key, body in commit.cells.items()} for commit in commits]
    row = folded_map(store, [pushed_in(Epoch(n % 3), n, 0, cells=cells[n]) for n in range(4)])
    plain, _ = store.create_map(next(NAMES), SMALL, SensorModel())
    for commit in commits:
        store.append(plain, new_of(commit))
    fold_pending(store, plain, CellCache(SMALL), limit=64)
    for key, cell in stored_cells(store, row).items():
        total = stored_history(cell, LAYER).total(SMALL)
        assert total == decode_cell(stored_cells(store, plain)[key].body).evidence


def test_a_damaged_cell_is_rebuilt_by_epoch_and_what_is_folded_into_it_goes_on() -> None:
    store = MemoryStore()
    commits = [pushed_in(Epoch(n), n, 1) for n in range(3)]
    row = folded_map(store, commits[:2])
    with store.snapshot(row) as snapshot:
        for cell in stored_cells(store, row).values():
            assert rebuilt_cell(snapshot, replace(cell, body=b"torn"), LAYER) == cell
            opened, _ = cell_to_change(snapshot, cell.key, replace(cell, body=b"torn"), LAYER)
            assert write_cell(opened).data == cell.body
            moved = replace(cell, body=bodies(store, folded_map(store, [pushed_in(Epoch(5), 0, 1)]))[cell.key])
            assert rebuilt_cell(snapshot, moved, LAYER) == cell


def test_a_store_that_has_evidence_in_the_wrong_epoch_is_found_out_and_repaired() -> None:
    """The sums are right, and so is the digest of what is there: only the log tells that a row moved."""
    store = MemoryStore()
    commits = [pushed_in(Epoch(n), n, 1) for n in range(2)]
    row = folded_map(store, commits)
    assert store_check.check_map(store, row, lambda *_: None).findings == []
    wrong = folded_map(store, [pushed_in(Epoch(0), 0, 1), pushed_in(Epoch(2), 1, 1)])
    key, sound = next(iter(stored_cells(store, row).items()))
    assert store.health.heal(row, replace(stored_cells(store, wrong)[key], lm=sound.lm))
    (finding,) = store_check.check_map(store, row, lambda *_: None).findings
    assert "not the sum of its commits" in finding.what
    assert finding.sound is not None
    assert (finding.sound.body, finding.sound.digest) == (sound.body, sound.digest)
    assert store.health.heal(row, finding.sound)
    assert store_check.check_map(store, row, lambda *_: None).findings == []


def test_a_damaged_cell_whose_commits_are_gone_is_healed_by_exactly_its_rows() -> None:
    store, commits = MemoryStore(), [pushed_in(Epoch(n), n, 1) for n in range(2)]
    row = folded_map(store, commits)
    other = bodies(store, folded_map(store, [pushed_in(Epoch(0), 0, 1), pushed_in(Epoch(2), 1, 1)]))
    key, sound = next(iter(stored_cells(store, row).items()))
    assert store.forget_evidence(row, before_s=SOON, limit=99) == len(commits)
    sound = stored_cells(store, row)[key]
    assert store.health.heal(row, replace(sound, body=sound.body[:-1]))
    one_row = encode_cell(key, stored_history(sound, LAYER).total(SMALL), SMALL).data
    for wrong in (other[key], one_row, sound.body[:-1], next(body for k, body in other.items() if k != key)):
        with pytest.raises(CairnError):
            heal_cell(store, row, key, wrong, by="mole")
    assert heal_cell(store, row, key, sound.body, by="mole")
    assert stored_cells(store, row)[key] == sound


def test_costly_commits_of_a_map_with_epochs_are_planned_aside_with_the_same_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in ("commit_work", "fold_lanes"):
        monkeypatch.setattr(f"cairn_server.folding.{module}.SLICE_S", 0.0)
    store, commits = MemoryStore(), [pushed_in(Epoch(n // 2), n, n % 2, (MOLE, WREN)[n % 2]) for n in range(6)]
    expected = bodies(store, folded_map(store, commits))
    row, _ = store.create_map(next(NAMES), SMALL, SensorModel(), LAYER.epoch_s)
    folding = LocalFolding(store, DamagedCells())
    for commit in commits:
        store.append(row, new_of(commit))
    while store.pending(row, limit=1, size_bytes_max=1 << 26):
        folding.close()
        folding.fold(row)
    assert bodies(store, row) == expected
