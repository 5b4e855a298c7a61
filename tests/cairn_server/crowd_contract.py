"""What every store must do with many maps, and with many threads at once."""

import threading
from collections.abc import Callable, Sequence
from functools import partial

from tests.cairn_map.made import SMALL
from tests.cairn_server.commit_contract import bodies, new_map
from tests.cairn_server.store_contract import new_of
from tests.cairn_server.sync.pushes import MOLE, pushed, read, sum_of

from cairn_map.commits.ids import Author, RobotName
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.store import Store


def all_at_once(jobs: Sequence[Callable[[], None]]) -> None:
    """Run each in a thread of its own; what one raises is raised here."""
    failures: list[BaseException] = []

    def guarded(job: Callable[[], None]) -> None:
        try:
            job()
        except BaseException as exc:  # noqa: BLE001 - raised below
            failures.append(exc)

    threads = [threading.Thread(target=guarded, args=(job,)) for job in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


class CrowdContract:
    """Tests of a `Store`."""

    def test_many_maps_of_the_same_ids_stay_apart(self, store: Store) -> None:
        rows = [new_map(store, *(pushed(n, m + n) for n in range(2))) for m in range(12)]
        for row in reversed(rows):
            fold_pending(store, row, CellCache(SMALL), limit=9)
        for m, row in enumerate(rows):
            assert read(bodies(store, row)) == sum_of(pushed(n, m + n) for n in range(2))
            with store.snapshot(row) as snapshot:
                assert snapshot.head.cursor.seq == 2
        logs = set()
        for row in rows:
            with store.snapshot(row) as snapshot:
                logs.add(snapshot.head.cursor.log_id)
        assert len(logs) == len({row.seal_key for row in rows}) == len(rows)
        names = [row.name for row in store.maps()]
        assert names == sorted(names)

    def test_pushes_of_many_threads_are_all_kept_while_two_fold_and_one_reads(self, store: Store) -> None:
        row = new_map(store)
        authors = [Author(RobotName(f"r{a}"), MOLE.incarnation) for a in range(4)]
        commits = {author: [pushed(n, n % 5, author) for n in range(12)] for author in authors}
        first_of = {author: [pushed(0, 0, MOLE), *commits[author]] for author in authors}
        news: list[bool] = []
        ended: list[Author] = []

        def push(author: Author) -> None:
            try:
                news.extend([store.append(row, new_of(commit)) for commit in first_of[author]])
            finally:
                ended.append(author)

        def fold() -> None:
            cache = CellCache(SMALL)
            while len(ended) < len(authors):
                fold_pending(store, row, cache, limit=5)

        def look() -> None:
            while len(ended) < len(authors):
                with store.snapshot(row) as snapshot:
                    seen, entries = snapshot.head, snapshot.log(after_seq=0, limit=1000)
                    assert seen.cursor.seq == len(entries) == len(seen.vector)
                    assert snapshot.chain_at(seen.cursor.seq) == seen.cursor.chain
                    assert not any(commit in seen.vector for commit in snapshot.pending())

        all_at_once([*(partial(push, author) for author in authors), fold, fold, look])
        while fold_pending(store, row, CellCache(SMALL), limit=64):
            pass
        expected = [pushed(0, 0, MOLE), *(commit for found in commits.values() for commit in found)]
        assert sum(news) == len(expected)
        assert read(bodies(store, row)) == sum_of(expected)

    def test_built_commits_of_many_threads_have_numbers_of_their_own(self, store: Store) -> None:
        row = new_map(store)
        numbers: list[int] = []

        def build() -> None:
            made = [store.append_built(row, MOLE, lambda n: new_of(pushed(n, n % 5))) for _ in range(5)]
            numbers.extend(commit.id.n for commit in made)

        all_at_once([build] * 4)
        assert sorted(numbers) == list(range(20))
