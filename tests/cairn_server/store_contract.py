"""What every store must do, beside a model of a few dictionaries.

Inherit `StoreContract`, and those of `commit_contract`, `crowd_contract`, `evidence_contract`, `branch_contract` and
`access_contract`, in a module that has a fixture `store` of module scope; every test makes a map of its own.
"""

import itertools
from dataclasses import dataclass, field

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.cairn_map.made import SMALL
from tests.cairn_server.sync.pushes import MOLE, WREN, Cells, pushed, read, sum_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import ENTRY_FOLD, ENTRY_UNFOLD, next_chain
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_map.evidence.sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Branch, Fold, Head, MapRow, NewCommit, Selection
from cairn_server.sync.checks.checking import new_commit

NAMES = (f"map{n}" for n in itertools.count())
COMMITS = [pushed(n, n + shift, author) for shift, author in enumerate((MOLE, WREN)) for n in range(3)]
RETRACTS = [
    pushed(3, 0, MOLE, cells={}, retracts=[COMMITS[0]]),
    pushed(4, 2, MOLE, retracts=[COMMITS[1], COMMITS[3]]),
    pushed(3, 0, WREN, cells={}, retracts=[COMMITS[4], COMMITS[0]]),
]


def new_of(commit: Commit) -> NewCommit:
    """As the service hands it to a store."""
    return new_commit(commit, (0,) * (2 + SMALL.plane_count))


@dataclass
class Model:
    """The same as dictionaries and lists."""

    arrived: list[Commit] = field(default_factory=list)
    folded: list[Commit] = field(default_factory=list)
    log: list[tuple[str, CommitId]] = field(default_factory=list)
    named: set[CommitId] = field(default_factory=set)

    def append(self, commit: Commit) -> bool:
        is_new = commit not in self.arrived
        self.arrived += [commit] * is_new
        return is_new

    def fold(self, limit: int) -> int:
        group = self.arrived[len(self.folded) :][:limit]
        for commit in group:
            self.folded.append(commit)
            self.log.append(("+", commit.id))
            if commit.id in self.named:
                self.log.append(("-", commit.id))
            for target in commit.meta.retracted_ids:
                if target not in self.named:
                    self.named.add(target)
                    self.log += [("-", c.id) for c in self.folded if c.id == target]
        return len(group)

    def cells(self) -> Cells:
        return sum_of(self.folded)

    def pending(self) -> VersionVector:
        return EMPTY.with_commits(commit.id for commit in self.arrived[len(self.folded) :])


class StoreContract:
    """Tests of a `Store`."""

    def new_map(self, store: Store) -> MapRow:
        return store.create_map(next(NAMES), SMALL, SensorModel())[0]

    # Each store has this test, so that it has several executors.
    @settings(max_examples=12, suppress_health_check=[HealthCheck.too_slow, HealthCheck.differing_executors])
    @given(steps=st.lists(st.sampled_from([*COMMITS, *RETRACTS, 1, 2, 64]), max_size=16))
    def test_a_store_does_what_dictionaries_do(self, store: Store, steps: list[Commit | int]) -> None:
        row, model = self.new_map(store), Model()
        cache = CellCache(row.geometry, limit_bytes=20_000)
        for step in [*steps, 64]:
            if isinstance(step, int):
                assert fold_pending(store, row, cache, limit=step) == model.fold(step)
            else:
                assert store.append(row, new_of(step)) == model.append(step)
            self.compare(store, row, model)

    def compare(self, store: Store, row: MapRow, model: Model) -> None:
        with store.snapshot(row) as snapshot:
            assert snapshot.head.vector == EMPTY.with_commits(commit.id for commit in model.folded)
            assert snapshot.pending() == model.pending()
            entries = snapshot.log(after_seq=0, limit=1000)
            assert [(entry.kind, entry.id) for entry in entries] == [(kind, str(id_)) for kind, id_ in model.log]
            assert snapshot.head.cursor.seq == len(model.log)
            self.compare_chain(snapshot.head, [snapshot.chain_at(n) for n in range(len(model.log) + 1)], model)
            rows = list(snapshot.cells())
            assert [row.key for row in rows] == sorted({key for commit in model.folded for key in commit.cells})
            bodies = {cell.key: found.body for cell in rows if (found := snapshot.cell(cell.key)) and cell.voxels}
            assert read(bodies) == model.cells()
            for cell in rows:
                touching = [
                    (kind.encode(), commit.id.author, len(commit.cells[cell.key]))
                    for kind, id_ in model.log
                    for commit in model.folded
                    if commit.id == id_ and cell.key in commit.cells
                ]
                found_entries = snapshot.contributions(cell.key, after_seq=0)
                assert [(e.kind, e.author, e.size_bytes) for e in found_entries] == touching
                assert cell.lm == max(n for n, (_, i) in enumerate(model.log, 1) if cell.key in self.cells_of(model, i))
            for author in (MOLE, WREN):
                tips = [(c.id.n, c.sha) for c in model.folded if c.id.author == author]
                assert snapshot.tip(author) == max(tips, default=None)
                mine = [c.id for c in model.arrived if c.id.author == author and c.cells and c.id not in model.named]
                assert snapshot.commits_where(Selection(robot=author.robot)) == mine
            assert snapshot.retracting() == [commit.id for commit in model.folded if commit.meta.retracts]

    def compare_chain(self, head: Head, chain: list[bytes | None], model: Model) -> None:
        sha_of = {commit.id: commit.sha for commit in model.folded}
        for n, (kind, id_) in enumerate(model.log):
            before = chain[n]
            assert before is not None
            step = {"+": ENTRY_FOLD, "-": ENTRY_UNFOLD}[kind]
            assert chain[n + 1] == next_chain(before, step, id_, sha_of[id_])
        assert chain[-1] == head.cursor.chain

    def cells_of(self, model: Model, commit: CommitId) -> set[int]:
        return {key for c in model.folded if c.id == commit for key in c.cells}

    def test_a_map_is_made_once_and_found_by_name(self, store: Store) -> None:
        name = next(NAMES)
        row, is_new = store.create_map(name, SMALL, SensorModel())
        assert is_new
        assert store.create_map(name, SMALL, SensorModel()) == (row, False)
        assert store.map(name) == row
        assert row in store.maps()
        with pytest.raises(ConflictError):
            store.create_map(name, SMALL, SensorModel(p_hit=0.9))
        with pytest.raises(NotFoundError):
            store.map("no-such-map")

    def test_an_id_belongs_to_the_bytes_that_came_first(self, store: Store) -> None:
        row = self.new_map(store)
        store.append(row, new_of(pushed(0, 1)))
        with pytest.raises(ConflictError) as refused:
            store.append(row, new_of(pushed(0, 2)))
        assert refused.value.kind == "id_taken"
        assert [commit.sha for commit in store.pending(row, limit=9, size_bytes_max=1 << 30)] == [pushed(0, 1).sha]

    def test_maps_share_nothing(self, store: Store) -> None:
        first, second = self.new_map(store), self.new_map(store)
        store.append(first, new_of(pushed(0, 1)))
        assert store.append(second, new_of(pushed(0, 2)))
        assert fold_pending(store, second, CellCache(SMALL), limit=9) == 1
        with store.snapshot(first) as snapshot:
            assert snapshot.head.cursor.seq == 0
            assert list(snapshot.cells()) == []

    def test_pending_commits_come_in_groups_of_bounded_size_but_never_none(self, store: Store) -> None:
        row = self.new_map(store)
        for commit in COMMITS:
            store.append(row, new_of(commit))
        assert len(store.pending(row, limit=2, size_bytes_max=1 << 30)) == 2
        assert len(store.pending(row, limit=9, size_bytes_max=1)) == 1
        first, second, *_ = [commit.number for commit in store.pending(row, limit=9, size_bytes_max=1 << 30)]
        left = store.pending(row, limit=1, size_bytes_max=1 << 30, skip={first})
        assert [commit.number for commit in left] == [second]
        two = len(COMMITS[0].data) + len(COMMITS[1].data)
        assert len(store.pending(row, limit=9, size_bytes_max=two)) == 2

    def test_a_fold_on_top_of_an_older_head_writes_nothing(self, store: Store) -> None:
        row = self.new_map(store)
        with store.snapshot(row) as snapshot:
            old = snapshot.head
        store.append(row, new_of(pushed(0, 1)))
        assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
        with store.snapshot(row) as snapshot:
            head = snapshot.head
        assert not store.fold(row, Fold(base=old.cursor, head=old.cursor, vector=EMPTY, entries=(), cells=()))
        with store.snapshot(row) as snapshot:
            assert snapshot.head == head

    def test_a_snapshot_does_not_see_what_is_written_after_it_began(self, store: Store) -> None:
        row = self.new_map(store)
        store.append(row, new_of(pushed(0, 1)))
        with store.snapshot(row) as snapshot:
            assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
            assert list(snapshot.cells()) == []
            assert len(snapshot.pending()) == 1
        with store.snapshot(row) as snapshot:
            assert len(list(snapshot.cells())) == 2

    def test_an_error_inside_a_snapshot_leaves_nothing_open(self, store: Store) -> None:
        row = self.new_map(store)
        for _ in range(40):
            with pytest.raises(ZeroDivisionError), store.snapshot(row):
                raise ZeroDivisionError
        with store.snapshot(row) as snapshot:
            assert snapshot.head.cursor.seq == 0

    def test_built_commits_are_numbered_without_gaps(self, store: Store) -> None:
        row = self.new_map(store)
        numbers = [store.append_built(row, MOLE, lambda n: new_of(pushed(n, n))).id.n for _ in range(3)]
        assert numbers == [0, 1, 2]

    def test_a_refused_commit_leaves_no_trace(self, store: Store) -> None:
        row = self.new_map(store)
        store.append(row, new_of(pushed(0, 1)))
        with pytest.raises(BadInputError):
            store.append(row, new_of(pushed(20_000, 1)))
        heavy = new_commit(pushed(2, 1), (1 << 31, *[0] * (1 + SMALL.plane_count)))
        with pytest.raises(BadInputError):
            store.append(row, heavy)
        with store.snapshot(row) as snapshot:
            assert snapshot.pending().intervals == {MOLE: ((0, 0),)}
        assert store.append_built(row, MOLE, lambda n: new_of(pushed(n, n))).id.n == 1

    def test_a_branch_is_a_row_and_a_token(self, store: Store) -> None:
        row = self.new_map(store)
        for secret in (b"first", b"second"):
            store.register(row, Branch("mole", "viewer", ("tof",), None, 5.0), secret + row.name.encode())
        assert store.tokens.of_hash(b"first" + row.name.encode()) is None
        token = store.tokens.of_hash(b"second" + row.name.encode())
        assert token and (token.map_number, token.robot) == (row.number, "mole")
        with store.snapshot(row) as snapshot:
            cursor = snapshot.head.cursor
        store.seen(row, "mole", cursor)
        store.seen(row, "nobody", cursor)
        self.new_map(store)  # after which notes are written
        [branch] = store.branches(row)
        assert (branch.name, branch.mode, branch.sensors, branch.cursor) == ("mole", "viewer", ("tof",), cursor)
        store.deregister(row, "mole")
        assert store.branches(row) == []
        assert store.tokens.of_hash(b"second" + row.name.encode()) is None
        with pytest.raises(NotFoundError):
            store.deregister(row, "mole")
