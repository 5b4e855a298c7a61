"""What every store must do with evidence as time goes by: stamps, which commits are meant, and what is not kept."""

import time
from dataclasses import replace

import numpy as np
import pytest
from tests.cairn_map.made import SMALL, random_evidence
from tests.cairn_server.commit_contract import bodies, folded_map, new_map
from tests.cairn_server.store_contract import new_of
from tests.cairn_server.sync.pushes import KEYS, MOLE, WREN, pushed, read, sum_of

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import Commit, make_commit
from cairn_map.commits.cursor import ENTRY_UNFOLD
from cairn_map.commits.ids import CommitId
from cairn_map.errors import ConflictError
from cairn_map.evidence.blocks import blocks_of
from cairn_map.evidence.cell_order import hottest_k
from cairn_map.evidence.grid import CellKey
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.stamps import decode_stamps
from cairn_server.store.store import Store
from cairn_server.store.store_rows import CellRow, MapRow, NewCommit, Selection

SOON = float("inf")
"""Before this, everything was folded."""


def fold(store: Store, row: MapRow, *commits: Commit) -> None:
    """Push and fold, one by one."""
    for commit in commits:
        store.append(row, new_of(commit))
        fold_pending(store, row, CellCache(SMALL), limit=64)


def cells_of(store: Store, row: MapRow) -> dict[CellKey, CellRow]:
    """All cells, whole."""
    with store.snapshot(row) as snapshot:
        found = [snapshot.cell(cell.key) for cell in snapshot.cells()]
    return {cell.key: cell for cell in found if cell}


def kept_bytes(store: Store, row: MapRow, key: CellKey) -> list[bytes | None]:
    """The contributions to a cell that are still there."""
    with store.snapshot(row) as snapshot:
        return [snapshot.diff(entry.diff) for entry in snapshot.contributions(key, after_seq=0)]


class EvidenceContract:
    """Tests of a `Store`."""

    # Stamps

    def test_a_cell_comes_with_the_entry_that_last_changed_each_block(self, store: Store) -> None:
        commits = [pushed(n, n % 2) for n in range(3)]
        row = new_map(store)
        fold(store, row, *commits)
        for key, cell in cells_of(store, row).items():
            expected = np.zeros(8 ** (SMALL.depth - 2), np.int64)
            for seq, commit in enumerate(commits, start=1):
                if key in commit.cells:
                    expected[blocks_of(decode_cell(commit.cells[key]).evidence)] = seq
            assert decode_stamps(cell.stamps, depth=SMALL.depth, lm=cell.lm).tolist() == expected.tolist()
            assert (cell.lm, cell.gone_seq) == (expected.max(), 0)
            assert cell.hottest_k == hottest_k(decode_cell(cell.body).evidence, SMALL) is not None
        with store.snapshot(row) as snapshot:
            assert {(cell.stamps, cell.body) for cell in snapshot.cells()} == {(b"", b"")}

    def test_a_cell_is_healed_if_it_is_as_it_was_and_keeps_its_stamps(self, store: Store) -> None:
        row = folded_map(store, pushed(0, 0))
        store.forget_evidence(row, before_s=SOON, limit=9)
        key, cell = next(iter(cells_of(store, row).items()))
        other = replace(cell, body=b"sound", size_bytes=5, digest=bytes(32), voxels=1, stamps=b"")
        other = replace(other, gone_seq=0, hottest_k=5.5)
        assert not store.health.heal(row, replace(other, lm=cell.lm + 1))
        assert cells_of(store, row)[key] == cell
        assert store.health.heal(row, other)
        assert cells_of(store, row)[key] == replace(other, stamps=cell.stamps, gone_seq=cell.gone_seq)

    # Which commits

    def test_commits_are_selected_by_each_part_and_by_all_of_them(self, store: Store) -> None:
        rig = bytes(range(32))
        commits = [pushed(0, 0, rig=rig.hex()), pushed(1, 1), pushed(2, 2, WREN), pushed(3, 0, WREN, cells={})]
        row = folded_map(store, *commits[:2])
        timeless = replace(new_of(pushed(4, 1, WREN)), captured_s=None)
        between_s = time.time()
        for commit in (*map(new_of, commits[2:]), timeless):
            store.append(row, commit)
        a, b, c, d = commits[0].id, commits[1].id, commits[2].id, timeless.id

        def found(**parts: object) -> list[CommitId]:
            with store.snapshot(row) as snapshot:
                return snapshot.commits_where(Selection(**parts))  # type: ignore[arg-type]

        assert found() == [a, b, c, d]  # all with evidence
        assert (found(robot="mole"), found(robot="wren"), found(robot="newt")) == ([a, b], [c, d], [])
        assert (found(rig=rig), found(rig=bytes(32))) == ([a], [])
        assert found(pushed_s=(float("-inf"), between_s)) == [a, b]
        assert found(pushed_s=(between_s, float("inf"))) == [c, d]
        assert found(pushed_s=(0.0, 1.0)) == []
        assert found(captured_s=(1.5e9 + 1, float("inf"))) == [b, c]
        assert found(captured_s=(1.5e9 + 2, 2e9)) == [c]
        assert found(captured_s=(0.0, 1.5e9 - 1)) == []
        assert found(robot="mole", captured_s=(1.5e9 + 1, 2e9)) == [b]
        fold(store, row, pushed(5, 0, cells={}, retracts=[commits[1]]))
        assert found() == [a, c, d]

    # What is not kept

    def test_what_is_forgotten_leaves_its_line_in_the_log_and_the_cells_as_they_are(self, store: Store) -> None:
        commits = [pushed(n, 1) for n in range(3)]
        row = new_map(store)
        fold(store, row, *commits)
        before = cells_of(store, row)
        assert store.forget_evidence(row, before_s=0.0, limit=9) == 0
        assert store.forget_evidence(row, before_s=SOON, limit=2) == 2
        after = cells_of(store, row)
        assert after == {key: replace(cell, gone_seq=2) for key, cell in before.items()}
        for key in before:
            assert kept_bytes(store, row, key) == [commits[2].cells[key]]
        gone = store.folded(row, commits[0].id)
        assert gone is not None and gone == store.commit(row, commits[0].id)
        assert (gone.gone, gone.text, gone.diff, gone.sha) == (True, b"", {}, commits[0].sha)
        kept = store.commit(row, commits[2].id)
        assert kept is not None and (kept.gone, kept.text) == (False, commits[2].text)
        with store.snapshot(row) as snapshot:
            entries = snapshot.log(after_seq=0, limit=9)
            assert snapshot.commits_where(Selection()) == [commit.id for commit in commits]
        assert [(e.id, e.sha, e.size_bytes, e.cells, e.captured_s) for e in entries] == [
            (str(c.id), c.sha.hex(), len(c.data), len(c.cells), c.meta.captured_s) for c in commits
        ]
        assert store.forget_evidence(row, before_s=SOON, limit=9) == 1
        assert store.forget_evidence(row, before_s=SOON, limit=9) == 0
        assert {cell.gone_seq for cell in cells_of(store, row).values()} == {3}

    def test_a_fold_changes_nothing_of_how_far_evidence_is_gone(self, store: Store) -> None:
        row = folded_map(store, pushed(0, 0))
        store.forget_evidence(row, before_s=SOON, limit=9)
        fold(store, row, pushed(1, 0), pushed(2, 1))
        gone = {cell.key: cell.gone_seq for cell in cells_of(store, row).values()}
        assert gone == {key: int(key in pushed(0, 0).cells) for key in gone}
        assert read(bodies(store, row)) == sum_of([pushed(0, 0), pushed(1, 0), pushed(2, 1)])

    def test_evidence_that_came_in_and_went_out_is_gone_up_to_where_it_went_out(self, store: Store) -> None:
        first, out = pushed(0, 0), pushed(1, 0, cells={}, retracts=[pushed(0, 0)])
        row = folded_map(store, first, out)
        with store.snapshot(row) as snapshot:
            key = next(iter(first.cells))
            assert [entry.kind for entry in snapshot.contributions(key, after_seq=0)][1:] == [ENTRY_UNFOLD]
        assert store.forget_evidence(row, before_s=SOON, limit=9) == 1
        assert {cell.gone_seq for cell in cells_of(store, row).values()} == {3}
        assert kept_bytes(store, row, key) == []

    def test_what_is_not_folded_or_waits_to_be_taken_out_is_kept(self, store: Store) -> None:
        first, out = pushed(0, 0), pushed(1, 1, retracts=[pushed(0, 0)])
        row = folded_map(store, first)
        store.append(row, new_of(out))
        assert store.forget_evidence(row, before_s=SOON, limit=9) == 0
        fold_pending(store, row, CellCache(SMALL), limit=9)
        assert read(bodies(store, row)) == sum_of([first, out])
        assert store.forget_evidence(row, before_s=SOON, limit=9) == 2

    def test_what_is_gone_is_taken_out_only_once_it_is_pushed_again(self, store: Store) -> None:
        first, second, out = pushed(0, 0), pushed(1, 0), pushed(2, 0, cells={}, retracts=[pushed(0, 0)])
        row = folded_map(store, first, second)
        store.forget_evidence(row, before_s=SOON, limit=9)
        with pytest.raises(ConflictError) as refused:
            store.append(row, new_of(out))
        assert refused.value.kind == "evidence_gone" and str(first.id) in refused.value.message

        def build(n: int) -> NewCommit:
            return new_of(pushed(n, 0, cells={}, retracts=[first]))

        with pytest.raises(ConflictError) as refused:
            store.append_built(row, MOLE, build)
        assert refused.value.kind == "evidence_gone"
        assert store.commit(row, out.id) is None
        pushed_again_s = time.time()
        assert not store.append(row, new_of(first))
        kept = store.commit(row, first.id)
        assert kept is not None and (kept.gone, kept.text, kept.diff) == (False, first.text, dict(first.cells))
        assert store.forget_evidence(row, before_s=pushed_again_s, limit=9) == 0  # as long as after a first push
        fold(store, row, out)
        assert read(bodies(store, row)) == sum_of([first, second, out])
        assert store.forget_evidence(row, before_s=SOON, limit=9) == 1
        assert not store.append(row, new_of(first))
        gone = store.commit(row, first.id)
        assert gone is not None and gone.gone, "what is out already is not kept again"
        fold(store, row, pushed(3, 0, cells={}, retracts=[first]))
        assert read(bodies(store, row)) == sum_of([first, second, out])

    def test_the_log_tells_what_a_commit_was_made_on_and_where_while_its_meta_is_kept(self, store: Store) -> None:
        row = new_map(store)
        parent, cursor = "ab" * 32, f"{'0' * 32}.0.{'0' * 32}"
        meta = pushed(1, 0).meta
        last = meta.scans[-1].model_copy(update={"t_map_rig": (1.5, -2.25, 0.4)})
        meta = meta.model_copy(update={"parent": parent, "seen": cursor, "scans": (*meta.scans[:-1], last)})
        fold(store, row, make_commit(meta, {KEYS[0]: random_evidence(1, SMALL)}, SMALL))
        found = []
        for _ in range(2):
            with store.snapshot(row) as snapshot:
                found += [(entry.parent, entry.seen, entry.place_m) for entry in snapshot.log(after_seq=0, limit=9)]
            store.forget_evidence(row, before_s=SOON, limit=9)
        assert found == [(parent, cursor, last.t_map_rig), (None, None, None)]
