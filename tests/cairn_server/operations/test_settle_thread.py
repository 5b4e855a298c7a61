"""One look of the thread that settles: a failure stops no other duty, and what is to be done is done."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.live import Live
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.pushes import WREN, pushed
from tests.fixtures.server.settled_store import ColdStore, SwitchedBucket

from cairn_server.operations.settle_thread import FAILURES_MAX, SettleThread
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.settling.dead_objects import AT_ONCE
from cairn_server.store.settling.settler import LIST_EVERY_S

pytestmark = [pytest.mark.processes, pytest.mark.slow]


class RefusingBucket(SwitchedBucket):
    """A bucket that refuses to write names with a text in them."""

    def __init__(self) -> None:
        super().__init__()
        self.refused: str | None = None
        self.listings = 0

    def put(self, name: str, data: bytes) -> None:
        """Write, or refuse."""
        if self.refused is not None and self.refused in name:
            raise AwayError(f"cannot write {name}: status code: 403 Forbidden")
        super().put(name, data)

    def names(self, prefix: str) -> Iterator[list[str]]:
        """As a bucket does."""
        self.listings += prefix == "cells"
        yield from super().names(prefix)


@dataclass
class Settling:
    """A server and its settling thread, which a test has look."""

    live: Live
    store: ColdStore
    bucket: RefusingBucket
    database: Database

    def look(self) -> None:
        """Look once, as the thread of a server that was just started."""
        SettleThread(self.live.service, self.store.settler).look()

    def warm(self) -> list[int]:
        """Numbers of the maps of which bytes are in the database."""
        return [
            int(str(number)) for (number,) in self.database.execute("SELECT DISTINCT map FROM cell WHERE body <> ''")
        ]


@pytest.fixture
def settling(newest_postgres: PostgresServer, tmp_path: Path) -> Iterator[Settling]:
    """A server whose thread settles at once, and deletes without a grace."""
    bucket, database = RefusingBucket(), new_database(newest_postgres)
    at_once = {"settle_cells_s": 0.0, "settle_evidence_s": 0.0, "objects_grace_s": 0.0}
    with closing(ColdStore(database.url, bucket)) as store, Live(tmp_path, store=store, **at_once) as live:
        yield Settling(live, store, bucket, database)


def test_a_map_that_cannot_be_settled_keeps_no_other_one_from_it(settling: Settling) -> None:
    maps = [folded_map(settling.store, pushed(0, 0), pushed(0, 1, WREN)) for _ in range(3)]
    settling.bucket.refused = f"cells/{maps[1].number}/"
    settling.look()
    assert settling.warm() == [maps[1].number]
    figures = settling.live.http.get("/metrics").text
    assert 'cairn_settle_failures_total{what="cells"} 1.0' in figures
    settling.bucket.refused = None
    settling.look()
    assert settling.warm() == []


def test_all_that_is_out_of_use_is_deleted_at_one_look(settling: Settling) -> None:
    settling.look()
    names = [f"segments/1/{n:032x}" for n in range(2 * AT_ONCE + 1)]
    settling.bucket.put_all([(name, b"") for name in names])
    settling.database.execute(
        f"INSERT INTO dead_object SELECT 1, 'segments/1/' || lpad(to_hex(n), 32, '0'), 0"
        f" FROM generate_series(0, {len(names) - 1}) AS n"
    )
    settling.look()
    assert settling.bucket.objects() == set()
    assert settling.database.execute("SELECT count(*) FROM dead_object") == [(0,)]


def test_objects_are_listed_each_day_of_the_store_however_often_servers_start(settling: Settling) -> None:
    settling.look()
    assert settling.bucket.listings == 0
    settling.database.execute(f"UPDATE object_store SET listed_age_s = -1 - {LIST_EVERY_S}")
    settling.bucket.put(f"segments/1/{'0' * 32}", b"unknown")
    for _ in range(3):
        settling.look()
    assert settling.bucket.listings == 1
    assert settling.bucket.objects() == set()


def test_a_failure_of_all_maps_is_not_found_out_map_by_map(settling: Settling) -> None:
    maps = [folded_map(settling.store, pushed(0, 0)) for _ in range(FAILURES_MAX + 4)]
    settling.bucket.refused = "cells/"
    settling.look()
    assert len(settling.warm()) == len(maps)
    figures = settling.live.http.get("/metrics").text
    assert f'cairn_settle_failures_total{{what="cells"}} {FAILURES_MAX}.0' in figures
