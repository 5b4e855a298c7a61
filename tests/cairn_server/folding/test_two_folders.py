"""Processes that fold one store: each map is one's at a time, nothing is folded twice, no dead one is waited for."""

from collections.abc import Callable, Iterator
from itertools import islice

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.commit_contract import bodies
from tests.fixtures.server.lease_contract import LeaseContract
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.store_contract import new_of
from tests.memory_store.leases import MemoryLeases
from tests.memory_store.store import MemoryStore

from cairn_map.errors import UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding import fold_thread
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.fold_thread import LOOK_MAX, PAGES_MAX, FoldThread
from cairn_server.folding.group_folding import Folded, LocalFolding
from cairn_server.folding.readiness import FoldHealth
from cairn_server.metrics import ServerFigures
from cairn_server.store.store import LEASE_S
from cairn_server.store.store_rows import MapRow

WAIT_S = 600.0
"""Longer than any test waits."""
COMMITS = [pushed(n, n, author) for n in range(6) for author in (MOLE, WREN)]


class Steady:
    """A clock that stands still unless it is set."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Steady:
    return Steady()


@pytest.fixture
def store(clock: Steady) -> Iterator[MemoryStore]:
    found = MemoryStore(leases=MemoryLeases(clock))
    yield found
    found.close()


class TestMemoryLeases(LeaseContract):
    """Of the store in memory."""

    def expire(self, store: MemoryStore) -> None:  # type: ignore[override]
        assert store.leases is not None and isinstance(store.leases._steady_s, Steady)
        store.leases._steady_s.now_s += LEASE_S + 1.0


def folder(store: MemoryStore, on_fold: Callable[[MapRow], None] = lambda row: None) -> FoldThread:
    """A thread as each process has one."""
    return FoldThread(
        store,
        FoldHealth(ServerFigures()),
        DamagedCells(),
        keep_evidence_s=1e9,
        on_fold=on_fold,
        may_forget_s=lambda name: 1e9,
    )


def maps_of(store: MemoryStore, count: int) -> list[MapRow]:
    return [store.create_map(f"hall{n}", SMALL, SensorModel())[0] for n in range(count)]


def test_two_that_fold_together_fold_all_once_and_never_a_map_at_the_same_time(store: MemoryStore) -> None:
    rows = maps_of(store, 40)
    folded: tuple[list[MapRow], list[MapRow]] = ([], [])
    folders = [folder(store, each.append) for each in folded]
    for commit in COMMITS:
        for row in rows:
            store.append(row, new_of(commit))
        for thread in folders:
            thread.wake()
    until(lambda: not store.waiting_maps(), "all is folded")
    for thread in folders:
        thread.close()
    assert not {row.name for row in folded[0]} & {row.name for row in folded[1]}, "the clock stands: claims last"
    for row in rows:
        assert read(bodies(store, row)) == sum_of(COMMITS)
        with store.snapshot(row) as snapshot:
            assert snapshot.head.seq == len(COMMITS)


def test_maps_of_one_that_died_are_folded_by_another_when_its_claims_are_over(
    store: MemoryStore, clock: Steady
) -> None:
    rows = maps_of(store, 2)
    assert store.leases is not None
    store.leases.claim(rows[:1], holder="dead", new_max=9)
    for row in rows:
        store.append(row, new_of(COMMITS[0]))
    thread = folder(store)
    until(lambda: store.waiting_maps() == rows[:1], "the free map is folded")
    clock.now_s += LEASE_S + 1.0
    until(lambda: not store.waiting_maps(), "the dead one's map is folded, too")
    thread.close()


def test_what_one_folded_while_it_had_lost_its_claim_is_not_folded_twice(store: MemoryStore, clock: Steady) -> None:
    [row] = maps_of(store, 1)
    folders = [folder(store) for _ in range(2)]
    for commit in COMMITS:
        store.append(row, new_of(commit))
        clock.now_s += LEASE_S + 1.0  # whoever had it has it no more
        for thread in folders:
            thread.wake()
    until(lambda: not store.waiting_maps(), "all is folded")
    for thread in folders:
        thread.close()
    assert read(bodies(store, row)) == sum_of(COMMITS)
    with store.snapshot(row) as snapshot:
        assert snapshot.head.seq == len(COMMITS)


def test_of_many_maps_that_wait_each_has_its_turn_and_no_look_lists_them_all(
    store: MemoryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, folded, looks = maps_of(store, 2 * LOOK_MAX + 3), list[int](), list[int]()
    more = {row.number: iter(COMMITS[1:4]) for row in rows[:LOOK_MAX]}
    next_waiting = store.next_waiting

    def looked(*, after: int, limit: int) -> list[MapRow]:
        found = next_waiting(after=after, limit=limit)
        looks.append(len(found))
        return found

    def pushed_again(row: MapRow) -> None:
        folded.append(row.number)
        for commit in islice(more.get(row.number, iter(())), 1):
            store.append(row, new_of(commit))

    monkeypatch.setattr(store, "next_waiting", looked)
    for row in rows:
        store.append(row, new_of(COMMITS[0]))
    thread = folder(store, on_fold=pushed_again)
    until(lambda: not store.waiting_maps(), "all is folded")
    thread.close()
    assert max(looks) == LOOK_MAX
    # Maps that robots push to all the time let each other one have its turn.
    others = [folded.index(row.number) for row in rows[LOOK_MAX:]]
    assert max(others) < min(nth(folded, row.number, 2) for row in rows[:LOOK_MAX])


def test_a_map_waits_for_none_of_those_that_cannot_be_folded(
    store: MemoryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So are all maps whose cells lie in an object store that is away."""
    monkeypatch.setattr(fold_thread, "POLL_S", WAIT_S)
    rows = sorted(maps_of(store, 3 * LOOK_MAX), key=lambda row: row.number)
    fold = LocalFolding.fold

    def held_up(self: LocalFolding, row: MapRow, *, is_news: bool = True) -> Folded:
        return fold(self, row, is_news=is_news) if row == rows[-1] else Folded(0, None)

    monkeypatch.setattr(LocalFolding, "fold", held_up)
    for row in rows:
        store.append(row, new_of(COMMITS[0]))
    thread = folder(store)
    until(lambda: store.waiting_maps() == sorted(rows[:-1], key=lambda row: row.name), "what can be folded is")
    thread.close()


def test_a_plan_whose_fold_fails_once_is_tried_again(store: MemoryStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk may be full for a moment."""
    [row], calls = maps_of(store, 1), list[MapRow]()
    fold = LocalFolding.fold

    def planned(self: LocalFolding, row: MapRow, *, is_news: bool = True) -> Folded:
        calls.append(row)
        if len(calls) == 1:
            return Folded(0, None, is_planning=True)
        if len(calls) == 2:
            raise UnreachableError("store_failed", "the disk is full")
        return fold(self, row, is_news=is_news)

    monkeypatch.setattr(LocalFolding, "fold", planned)
    store.append(row, new_of(COMMITS[0]))
    thread = folder(store)
    until(lambda: not store.waiting_maps(), "it is folded after a pause")
    thread.close()


def test_a_look_is_short_where_another_process_folds_all(store: MemoryStore, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, looks = maps_of(store, 8 * LOOK_MAX), list[int]()
    assert store.leases is not None
    store.leases.claim(rows, holder="other", new_max=len(rows))
    for row in rows:
        store.append(row, new_of(COMMITS[0]))
    thread = folder(store)
    thread.close()
    next_waiting = store.next_waiting

    def looked(*, after: int, limit: int) -> list[MapRow]:
        looks.append(after)
        return next_waiting(after=after, limit=limit)

    monkeypatch.setattr(store, "next_waiting", looked)
    thread._claimed_to = -1
    assert thread._claimed(store.leases) == [] and len(looks) == PAGES_MAX


def nth(found: list[int], wanted: int, n: int) -> int:
    """Place of the n-th repetition of a number."""
    return [place for place, each in enumerate(found) if each == wanted][n - 1]
