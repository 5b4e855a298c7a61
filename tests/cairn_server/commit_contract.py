"""What every store must do with commits beyond the model of `store_contract`: limits, damage, time."""

import time

import pytest
from tests.cairn_map.made import SMALL
from tests.cairn_server.store_contract import NAMES, new_of
from tests.cairn_server.sync.pushes import MOLE, WREN, pushed, read, sum_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import ENTRY_FOLD, Cursor
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX
from cairn_map.evidence.sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Entry, Fold, MapRow, NewCommit, StoredCommit, Totals
from cairn_server.sync.checks import push_policy
from cairn_server.sync.checks.checking import new_commit


def new_map(store: Store, *commits: Commit) -> MapRow:
    """A map with these commits, not folded."""
    row, _ = store.create_map(next(NAMES), SMALL, SensorModel())
    for commit in commits:
        store.append(row, new_of(commit))
    return row


def folded_map(store: Store, *commits: Commit) -> MapRow:
    """A map with these commits folded."""
    row = new_map(store, *commits)
    fold_pending(store, row, CellCache(SMALL), limit=64)
    return row


def bodies(store: Store, row: MapRow) -> dict[int, bytes]:
    """All cells with evidence."""
    with store.snapshot(row) as snapshot:
        found = [snapshot.cell(cell.key) for cell in snapshot.cells() if cell.voxels]
    return {cell.key: cell.body for cell in found if cell}


class CommitContract:
    """Tests of a `Store`."""

    # What is read of commits

    def test_a_commit_comes_back_as_it_was_pushed_before_and_after_it_is_folded(self, store: Store) -> None:
        commit = pushed(0, 1)
        row = new_map(store, commit)
        [waiting] = store.pending(row, limit=9, size_bytes_max=0)
        assert store.folded(row, commit.id) is None
        fold_pending(store, row, CellCache(SMALL), limit=9)
        folded = store.folded(row, commit.id)
        assert folded == waiting
        assert (waiting.id, waiting.sha, waiting.text) == (commit.id, commit.sha, commit.text)
        assert waiting.diff == dict(commit.cells)
        assert list(waiting.diff) == sorted(commit.cells)
        assert store.pending(row, limit=9, size_bytes_max=1 << 30) == []
        assert store.folded(row, CommitId(MOLE, 7)) is None

    def test_the_log_tells_of_each_commit_and_comes_in_pages(self, store: Store) -> None:
        first, second = pushed(0, 1), pushed(1, 0, cells={}, retracts=[pushed(0, 1)])
        row = folded_map(store, first, second)
        with store.snapshot(row) as snapshot:
            entries = snapshot.log(after_seq=0, limit=9)
            assert [(e.seq, e.kind, e.id) for e in entries] == [
                (1, "+", str(first.id)),
                (2, "+", str(second.id)),
                (3, "-", str(first.id)),
            ]
            assert (entries[0].sha, entries[0].size_bytes, entries[0].cells) == (first.sha.hex(), len(first.data), 2)
            assert (entries[0].captured_s, entries[0].retracts) == (first.meta.captured_s, [])
            assert (entries[1].cells, entries[1].retracts) == (0, [str(first.id)])
            assert snapshot.log(after_seq=1, limit=1) == entries[1:2]
            assert snapshot.log(after_seq=3, limit=9) == []
            assert [snapshot.chain_at(n) for n in (4, 10**9)] == [None, None]

    def test_contributions_have_their_bytes_and_may_be_limited(self, store: Store) -> None:
        commits = [pushed(n, 1) for n in range(3)]
        row = folded_map(store, *commits)
        with store.snapshot(row) as snapshot:
            for key in commits[0].cells:
                found = snapshot.contributions(key, after_seq=0)
                assert [snapshot.diff(entry.diff) for entry in found] == [commit.cells[key] for commit in commits]
                assert [entry.seq for entry in found] == [1, 2, 3]
                assert snapshot.contributions(key, after_seq=0, newest=2) == found[1:]
                assert snapshot.contributions(key, after_seq=2) == found[2:]

    def test_only_cells_that_changed_later_are_listed(self, store: Store) -> None:
        row = folded_map(store, pushed(0, 0))
        store.append(row, new_of(pushed(1, 1)))
        fold_pending(store, row, CellCache(SMALL), limit=9)
        with store.snapshot(row) as snapshot:
            assert {cell.key for cell in snapshot.cells(after_seq=1)} == set(pushed(1, 1).cells)
            assert [cell.key for cell in snapshot.cells(after_seq=2)] == []
            assert {cell.body for cell in snapshot.cells()} == {b""}
            listed = [cell.key for cell in snapshot.cells()]
            assert listed == sorted(listed)
            assert [cell.key for cell in snapshot.cells(after_key=listed[0])] == listed[1:]
            assert [cell.key for cell in snapshot.cells(after_key=listed[0], limit=1)] == listed[1:2]

    def test_what_was_folded_before_a_time(self, store: Store) -> None:
        before_s = time.time()
        row = folded_map(store, pushed(0, 0))
        store.append(row, new_of(pushed(1, 1)))
        with store.snapshot(row) as snapshot:
            assert snapshot.folded_before(before_s) == EMPTY
            assert snapshot.folded_before(time.time() + 1) == EMPTY.with_commits([pushed(0, 0).id])

    def test_totals_count_cells_with_evidence_and_all_commits(self, store: Store) -> None:
        row = new_map(store)
        with store.snapshot(row) as snapshot:
            assert snapshot.totals() == Totals()
        row = folded_map(store, pushed(0, 0), pushed(1, 0, cells={}, retracts=[pushed(0, 0)]), pushed(2, 1))
        store.append(row, new_of(pushed(3, 2)))
        found = bodies(store, row)
        with store.snapshot(row) as snapshot:
            totals = snapshot.totals()
        assert (totals.cells, totals.commits, totals.branches) == (2, 4, 0)
        assert totals.size_bytes == sum(map(len, found.values()))
        assert totals.corner_cells == ((-1, 0, 0), (1, 0, 2))

    # Folds

    @pytest.mark.parametrize("wrong", ["seq", "chain"])
    def test_a_fold_on_another_base_is_refused_and_writes_nothing(self, store: Store, wrong: str) -> None:
        row = folded_map(store, pushed(0, 1))
        store.append(row, new_of(pushed(1, 1)))
        [waiting] = store.pending(row, limit=9, size_bytes_max=0)
        with store.snapshot(row) as snapshot:
            head, cells = snapshot.head, list(snapshot.cells())
        true = head.cursor
        base = Cursor(true.log_id, true.seq - (wrong == "seq"), bytes(16) if wrong == "chain" else true.chain)
        fold = Fold(
            base=base,
            head=Cursor(true.log_id, base.seq + 1, b"x" * 16),
            vector=EMPTY,
            entries=(Entry(kind=ENTRY_FOLD, commit=waiting.number, chain=b"x" * 16),),
            cells=tuple(cells),
            retracted=(waiting.id,),
            damaged=((waiting.number, "for fun"),),
        )
        assert not store.fold(row, fold)
        with store.snapshot(row) as snapshot:
            assert (snapshot.head, list(snapshot.cells())) == (head, cells)
            assert len(snapshot.log(after_seq=0, limit=9)) == 1
            assert waiting.id in snapshot.pending()
        assert not store.is_retracted(row, waiting.id)

    def test_what_another_folder_folded_meanwhile_is_not_folded_twice(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        commits = [pushed(n, 1) for n in range(3)]
        row, look = new_map(store, *commits), store.pending

        def overtaken(row: MapRow, *, limit: int, size_bytes_max: int) -> list[StoredCommit]:
            found = look(row, limit=limit, size_bytes_max=size_bytes_max)
            monkeypatch.undo()
            assert fold_pending(store, row, CellCache(SMALL), limit=2) == 2
            return found

        monkeypatch.setattr(store, "pending", overtaken)
        assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
        assert read(bodies(store, row)) == sum_of(commits)
        with store.snapshot(row) as snapshot:
            assert snapshot.head.cursor.seq == 3

    def test_a_retract_is_remembered_before_its_target_comes(self, store: Store) -> None:
        row = folded_map(store, pushed(1, 0, cells={}, retracts=[pushed(0, 0)]))
        assert store.is_retracted(row, pushed(0, 0).id)
        assert not store.is_retracted(row, pushed(1, 0).id)
        assert not store.is_retracted(new_map(store), pushed(0, 0).id)

    def test_a_damaged_commit_is_set_aside_until_it_is_pushed_again(self, store: Store) -> None:
        bad, good = pushed(0, 1), pushed(0, 1, WREN)
        row = new_map(store, bad, good)
        numbers = {commit.id: commit.number for commit in store.pending(row, limit=9, size_bytes_max=1 << 30)}
        with store.snapshot(row) as snapshot:
            head = snapshot.head
        aside = Fold(
            base=head.cursor,
            head=head.cursor,
            vector=EMPTY,
            entries=(),
            cells=(),
            damaged=((numbers[bad.id], "torn"),),
        )
        assert store.fold(row, aside)
        with store.snapshot(row) as snapshot:
            assert snapshot.pending() == EMPTY.with_commits([good.id])
        assert [commit.id for commit in store.pending(row, limit=9, size_bytes_max=1 << 30)] == [good.id]
        assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
        assert store.append(row, new_of(bad))
        assert not store.append(row, new_of(bad))
        with store.snapshot(row) as snapshot:
            assert snapshot.pending() == EMPTY.with_commits([bad.id])
        assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
        assert read(bodies(store, row)) == sum_of([bad, good])

    # What is refused

    def test_a_number_too_far_ahead_is_refused_and_an_author_s_first_may_be_any(self, store: Store) -> None:
        row = new_map(store, pushed(5_000_000, 0))
        top = 5_000_000 + push_policy.AHEAD_MAX
        with pytest.raises(BadInputError) as refused:
            store.append(row, new_of(pushed(top + 1, 0)))
        assert refused.value.kind == "number_gap"
        assert store.append(row, new_of(pushed(top, 0)))
        assert store.append_built(row, MOLE, lambda n: new_of(pushed(n, 0))).id.n == top + 1

    def test_many_gaps_are_refused_until_some_are_filled(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(push_policy, "AUTHOR_INTERVALS_MAX", 3)
        row = new_map(store, *(pushed(n, 0) for n in (0, 2, 4)))
        with pytest.raises(BadInputError) as refused:
            store.append(row, new_of(pushed(6, 0)))
        assert refused.value.kind == "number_gap"
        assert store.append(row, new_of(pushed(5, 0)))  # beside another, so that no gap opens
        assert store.append(row, new_of(pushed(3, 0)))  # and one is filled
        assert store.append(row, new_of(pushed(7, 0)))

    @pytest.mark.parametrize("limit", ["INCARNATIONS_MAX", "AUTHORS_MAX", "INTERVALS_MAX"])
    def test_many_authors_are_refused(self, store: Store, monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
        monkeypatch.setattr(push_policy, limit, 2 if limit == "INCARNATIONS_MAX" else 4)
        authors = [Author(RobotName("mole"), Incarnation(f"{n:016x}")) for n in range(3)]
        row = new_map(store, *(pushed(0, 0, author) for author in authors[:2]))
        with pytest.raises(BadInputError) as refused:
            store.append(row, new_of(pushed(0, 0, authors[2])))
        assert refused.value.kind == "too_many_authors"
        assert store.append(row, new_of(pushed(1, 0, authors[0])))
        assert store.append(new_map(store), new_of(pushed(0, 0, authors[2])))

    @pytest.mark.parametrize(("plane", "most"), [(0, COUNT_MAX), (1, COUNT_MAX), (2, SUM_MAX)])
    def test_evidence_is_refused_before_a_sum_can_overflow(self, store: Store, plane: int, most: int) -> None:
        def heavy(n: int, top: int) -> NewCommit:
            tops = [0] * (2 + SMALL.plane_count)
            tops[plane] = top
            return new_commit(pushed(n, 1), tuple(tops))

        row = new_map(store)
        assert store.append(row, heavy(0, most - 1))
        with pytest.raises(BadInputError) as refused:
            store.append(row, heavy(1, 2))
        assert refused.value.kind == "evidence_overflow"
        assert store.append(row, heavy(1, 1))
        assert not store.append(row, heavy(0, most - 1))  # known, so it counts no second time

    def test_a_built_commit_that_is_refused_takes_no_number(self, store: Store) -> None:
        row = new_map(store, pushed(0, 0))

        def broken(n: int) -> NewCommit:
            raise NotFoundError("no_evidence", f"nothing for {n}")

        with pytest.raises(NotFoundError):
            store.append_built(row, MOLE, broken)
        assert store.append_built(row, MOLE, lambda n: new_of(pushed(n, 0))).id.n == 1
