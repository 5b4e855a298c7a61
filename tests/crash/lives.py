"""A store on a disk whose power goes: lives, each pushed to and folded by threads until its cut, then a verdict."""

import math
import random
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import apsw
from tests.crash.power_cut import Disk, PowerVfs
from tests.crash.verdict import Verdict, verdict_on
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.fixtures.server.store_contract import new_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.errors import CairnError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow

NAME = "lab"
AUTHORS = (MOLE, WREN)
LIVES_MAX = 3
STEPS_MIN, STEPS_MAX = 10, 1500
"""Writes and syncs of one life."""
COMMITS_MAX = 40
"""Of one author in one life."""
FAILURES_MAX = 200
"""Of one commit, before the power is gone: more than the disk fails."""


@dataclass(slots=True)
class Trial:
    """What was done to one store, and what is left of it."""

    seed: int
    level: str
    lives: int = 0
    steps: int = 0
    acked: set[CommitId] = field(default_factory=set)
    offered: dict[CommitId, Commit] = field(default_factory=dict)
    next_n: dict[Author, int] = field(default_factory=dict)
    folds: int = 0
    verdict: Verdict = field(default_factory=Verdict)


def trial(seed: int, *, level: str = "FULL") -> Trial:
    """Let a store live a few times, and look at what is left.

    Args:
        seed: of everything but the order of the threads.
        level: SQLite's `synchronous`, of which only FULL keeps what was acknowledged.
    """
    rng = random.Random(seed)
    done = Trial(seed, level)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "0"
        folder.mkdir()
        for life in range(1, rng.randint(1, LIVES_MAX) + 1):
            disk = Disk(
                steps=round(math.exp(rng.uniform(math.log(STEPS_MIN), math.log(STEPS_MAX)))),
                failing=rng.sample(range(STEPS_MAX), rng.choice([0, 0, 0, 3, 30])),
            )
            disk.adopt(folder)
            with PowerVfs(disk), suppress(CairnError, apsw.Error):  # that it cannot go on is the disk's fault
                _live(folder, disk, rng, done)
            done.lives += 1
            done.steps += disk.step
            disk.is_cut = True
            folder = Path(name) / str(life)
            folder.mkdir()
            disk.leave(folder, rng)
        wrong_before = done.verdict.wrong
        done.verdict = verdict_on(folder, NAME, acked=done.acked, offered=done.offered)
        done.verdict.wrong += wrong_before
    return done


def _live(folder: Path, disk: Disk, rng: random.Random, done: Trial) -> None:
    """Push and fold until the cut, or until there is nothing more to push."""
    with _opened(folder, rng, level=done.level) as store:
        row, _ = store.create_map(NAME, SMALL, SensorModel())
        ended = threading.Event()
        folding = threading.Thread(target=_fold, args=(store, row, disk, done, ended))
        pushing = [threading.Thread(target=_push, args=(store, row, disk, done, author)) for author in AUTHORS]
        for thread in (folding, *pushing):
            thread.start()
        for thread in pushing:
            thread.join()
        ended.set()
        folding.join()


@contextmanager
def _opened(folder: Path, rng: random.Random, *, level: str) -> Iterator[SqliteStore]:
    """A store that flushes as told, and starts its WAL anew so often that this falls into short lives, too."""
    store = SqliteStore(folder)
    try:
        connection = store._writer._connection
        connection.execute(f"PRAGMA synchronous = {level}")
        connection.execute(f"PRAGMA wal_autocheckpoint = {rng.choice([3, 10, 40, 1000])}")  # pages
        connection.execute(f"PRAGMA journal_size_limit = {rng.choice([0, 1 << 17, 64 << 20])}")
        yield store
    finally:
        store.close()


def _push(store: SqliteStore, row: MapRow, disk: Disk, done: Trial, author: Author) -> None:
    for _ in range(COMMITS_MAX):
        n = done.next_n.get(author, 0)
        commit = commit_of(author, n)
        done.offered[commit.id] = commit
        for _ in range(FAILURES_MAX):
            if disk.is_cut:
                return
            with suppress(CairnError, apsw.Error):
                store.append(row, new_of(commit))
                done.acked.add(commit.id)
                break
        else:
            done.verdict.wrong.append("it takes no commits any more")
            return
        done.next_n[author] = n + 1


def _fold(store: SqliteStore, row: MapRow, disk: Disk, done: Trial, ended: threading.Event) -> None:
    cache = CellCache(row.geometry)
    while not ended.is_set() and not disk.is_cut:
        with suppress(CairnError, apsw.Error):
            done.folds += fold_pending(store, row, cache, limit=8) > 0


@lru_cache(maxsize=1024)
def commit_of(author: Author, n: int) -> Commit:
    """A robot's n-th commit: of five kinds, and every tenth takes an older one out."""
    targets = [commit_of(author, n - 3)] if n % 10 == 9 else []
    return pushed(n, n % 5, author, retracts=targets)
