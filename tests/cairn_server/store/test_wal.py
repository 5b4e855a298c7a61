"""The write-ahead log stays short, even while somebody always reads."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.store_contract import new_of

from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.store.sqlite import writer as sqlite_writer
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow

COMMITS = [new_of(pushed(n, n % 5)) for n in range(60)]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqliteStore]:
    """A store of its own."""
    made = SqliteStore(tmp_path)
    yield made
    made.close()


@pytest.fixture
def row(store: SqliteStore) -> MapRow:
    return store.create_map("lab", SMALL, SensorModel())[0]


@contextmanager
def readers(store: SqliteStore, row: MapRow) -> Iterator[None]:
    """At any time at least one of these reads."""
    stop, all_read = threading.Event(), threading.Barrier(4)

    def read(turn: int) -> None:
        pause_s = 0.01 * (turn + 1)
        with store.snapshot(row):
            all_read.wait()
            stop.wait(pause_s)
        while not stop.is_set():
            with store.snapshot(row):
                stop.wait(pause_s)

    threads = [threading.Thread(target=read, args=(turn,)) for turn in range(3)]
    for thread in threads:
        thread.start()
    all_read.wait()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def longest_bytes(store: SqliteStore, row: MapRow) -> int:
    """The longest that the log was, while everything was pushed."""
    longest = 0
    for commit in COMMITS:
        store.append(row, commit)
        longest = max(longest, store.health.figures().ahead_bytes)
    return longest


def test_a_log_that_became_long_is_emptied_though_somebody_always_reads(
    store: SqliteStore, row: MapRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    with readers(store, row):
        unbounded_bytes = longest_bytes(store, row)
    monkeypatch.setattr(sqlite_writer, "LONG_BYTES", 400_000)
    monkeypatch.setattr(sqlite_writer, "RETRY_S", -1.0)
    again = SqliteStore(store.health._path.parent / "again")
    other = again.create_map("lab", SMALL, SensorModel())[0]
    with readers(again, other):
        bounded_bytes = longest_bytes(again, other)
        figures = again.health.figures()
    again.close()
    assert bounded_bytes < 2_000_000
    assert unbounded_bytes > 2 * bounded_bytes
    assert figures.emptied > 1
    assert figures.failures == {}


def test_an_idle_store_empties_its_log(store: SqliteStore, row: MapRow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_writer, "IDLE_BYTES", 100_000)
    assert longest_bytes(store, row) > 100_000
    until(lambda: store.health.figures().ahead_bytes == 0, "the log is emptied")
    assert len(store.pending(row, limit=99, size_bytes_max=1 << 30)) == len(COMMITS)


def test_a_reader_who_stays_does_not_stop_the_writer(
    store: SqliteStore, row: MapRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_writer, "LONG_BYTES", 100_000)
    monkeypatch.setattr(sqlite_writer, "TOO_LONG_FACTOR", 1 << 30)
    with store.snapshot(row) as snapshot:
        assert longest_bytes(store, row) > 400_000
        assert len(snapshot.pending()) == 0
    assert store.health.figures().failures == {}
