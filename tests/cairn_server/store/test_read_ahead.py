"""Cold cells read ahead: several at a time, within a bound, and no error of theirs is any but the reader's own."""

import threading
from contextlib import closing

import pytest
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.deadline import DEADLINE_S
from tests.fixtures.server.postgres import PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, WREN, pushed
from tests.fixtures.server.settled_store import ColdStore, SwitchedBucket
from tests.fixtures.server.store_contract import new_of

from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.objects.read_ahead import NamedSize, ReadAhead
from cairn_server.store.postgres.connections import Connections
from cairn_server.store.postgres.reads import PgReads


class MeetingBucket(SwitchedBucket):
    """A bucket that gives objects only to readers that come together."""

    def __init__(self, *, readers: int) -> None:
        super().__init__()
        self._barrier = threading.Barrier(readers)

    def get(self, name: str) -> bytes | None:
        """As a bucket does."""
        self._barrier.wait(DEADLINE_S)
        return super().get(name)


def names_of(bucket: SwitchedBucket, count: int) -> list[NamedSize]:
    """Objects of 10 bytes in a bucket."""
    for n in range(count):
        bucket.put(f"cells/{n}", bytes(10))
    return [NamedSize(f"cells/{n}", 10) for n in range(count)]


def is_kept(ahead: ReadAhead, bucket: SwitchedBucket, name: str) -> bool:
    """True if an object is there while the store is away."""
    bucket.is_away = True
    try:
        return ahead.get(name) == bytes(10)
    except AwayError:
        return False
    finally:
        bucket.is_away = False


def test_objects_are_read_at_the_same_time() -> None:
    bucket = MeetingBucket(readers=8)
    ahead = ReadAhead(bucket)
    ahead.read(names_of(bucket, 8))
    assert is_kept(ahead, bucket, "cells/7")


def test_no_more_is_kept_than_the_bound_and_the_newest_of_it() -> None:
    bucket = SwitchedBucket()
    ahead = ReadAhead(bucket, limit_bytes=50)
    first, second = names_of(bucket, 12)[:7], names_of(bucket, 12)[7:10]
    ahead.read(first)
    assert [is_kept(ahead, bucket, name) for name, _ in first] == [True] * 5 + [False] * 2
    ahead.read(second)
    assert all(is_kept(ahead, bucket, name) for name, _ in second)
    assert sum(is_kept(ahead, bucket, name) for name, _ in first) == 2


def test_a_store_that_is_away_fails_who_needs_the_object_and_not_who_reads_ahead() -> None:
    bucket = SwitchedBucket()
    ahead, names = ReadAhead(bucket), names_of(bucket, 2)
    bucket.is_away = True
    ahead.read(names)
    with pytest.raises(AwayError):
        ahead.get("cells/0")


@pytest.mark.processes
@pytest.mark.slow
def test_the_cells_of_pending_commits_are_there_when_they_are_folded(newest_postgres: PostgresServer) -> None:
    bucket = SwitchedBucket()
    url = new_database(newest_postgres).url
    with closing(ColdStore(url, bucket)) as store, closing(Connections(url, limit=1)) as connections:
        row = folded_map(store, pushed(0, 0), pushed(0, 1, WREN))
        store.settle(row)
        store.append(row, new_of(pushed(1, 0)))
        reads = PgReads(connections, ahead=ReadAhead(bucket))
        (commit,) = reads.pending(row, limit=9, size_bytes_max=1 << 20)
        bucket.is_away = True
        with reads.snapshot(row) as snapshot:
            for key in commit.diff:
                found = snapshot.cell(key)
                assert found is not None
                assert found.body
            for key in set(KEYS) - set(commit.diff):
                with pytest.raises(AwayError):
                    snapshot.cell(key)
