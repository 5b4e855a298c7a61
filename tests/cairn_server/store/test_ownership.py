"""Ownership of a bucket: the database that owns it settles and deletes; none of its copies does."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.live import Live
from tests.fixtures.server.postgres import WHEEL, Database, PostgresServer, new_database, programs_of
from tests.fixtures.server.pushes import WREN, pushed
from tests.fixtures.server.settled_store import ColdStore, SwitchedBucket

from cairn_map.errors import BadInputError
from cairn_server.operations.settle_thread import SettleThread
from cairn_server.store.objects.cold_bytes import OWNER
from cairn_server.store.postgres.connections import Connections
from cairn_server.store.settling.ownership import STILL_TURNS, TAIL_S, TURN_S, Ownership, adopt

pytestmark = [pytest.mark.processes, pytest.mark.slow]

COMMITS = [pushed(0, 0), pushed(0, 1, WREN)]


@dataclass
class SteadyClock:
    """A clock that a test moves."""

    now_s: float = field(default=0.0)

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> SteadyClock:
    """The clock of all processes."""
    return SteadyClock()


@pytest.fixture
def database(newest_postgres: PostgresServer) -> Database:
    """A database for one test."""
    return new_database(newest_postgres)


@pytest.fixture
def store(database: Database) -> Iterator[ColdStore]:
    """A store of one test."""
    with closing(ColdStore(database.url, SwitchedBucket())) as made:
        yield made


class Processes:
    """Processes that work on one bucket, each over a database of its own or shared."""

    def __init__(self, bucket: SwitchedBucket, clock: SteadyClock) -> None:
        self._bucket, self._clock = bucket, clock
        self._connections: list[Connections] = []

    def start(self, database: Database) -> Ownership:
        """A process that begins."""
        connections = Connections(database.url, limit=1)
        self._connections.append(connections)
        holder = str(len(self._connections))
        return Ownership(connections, self._bucket, holder=holder, steady_s=self._clock)

    def adopt(self, database: Database) -> None:
        """Run the administrator's command."""
        with closing(Connections(database.url, limit=1)) as connections:
            adopt(connections, self._bucket)

    def close(self) -> None:
        """End all."""
        for connections in self._connections:
            connections.close()


@pytest.fixture
def processes(store: ColdStore, clock: SteadyClock) -> Iterator[Processes]:
    """The processes of a test."""
    assert isinstance(store.bucket, SwitchedBucket)
    with closing(Processes(store.bucket, clock)) as made:
        yield made


def age(database: Database, by_s: float) -> None:
    """Make a database one whose newest turns are lost."""
    database.execute(f"UPDATE object_store SET turned_s = turned_s - {by_s}")


def refusal_of(process: Ownership, clock: SteadyClock) -> str:
    """Message of a process that may not work."""
    clock.now_s += TURN_S
    with pytest.raises(BadInputError) as caught:
        process.holds()
    return caught.value.message


def holds_after_a_wait(process: Ownership, clock: SteadyClock) -> bool:
    """True if a process may work only once the object stood still."""
    first = process.holds()
    clock.now_s += STILL_TURNS * TURN_S
    return not first and process.holds()


def dumped(database: Database) -> Database:
    """A copy of a database as a restored dump is: with all its rows, and of another number."""
    copy = Database(database.server, f"{database.name}_copy")
    copy.server.execute(f"CREATE DATABASE {copy.name} TEMPLATE template0")
    copy.server.shell(f"pg_dump '{database.url}' | psql --quiet --set=ON_ERROR_STOP=1 '{copy.url}'")
    return copy


def test_the_first_process_works_at_once_and_goes_on(
    processes: Processes, database: Database, clock: SteadyClock
) -> None:
    process = processes.start(database)
    for _ in range(5):
        assert process.holds()
        clock.now_s += TURN_S


def test_the_next_process_of_the_database_works_once_the_first_one_is_silent(
    processes: Processes, database: Database, clock: SteadyClock
) -> None:
    first, second = processes.start(database), processes.start(database)
    assert first.holds()
    for _ in range(2 * STILL_TURNS):
        assert not second.holds()
        clock.now_s += TURN_S
        assert first.holds()
    assert holds_after_a_wait(second, clock)
    clock.now_s += TURN_S
    assert not first.holds()


def test_a_copy_next_to_its_original_never_works(
    processes: Processes, database: Database, clock: SteadyClock, newest_postgres: PostgresServer
) -> None:
    original = processes.start(database)
    assert original.holds()
    folder = Path(tempfile.mkdtemp(prefix="cairn-postgres-"))
    newest_postgres.copy_to(folder / "data")
    other = PostgresServer(programs_of(WHEEL), folder)
    try:
        copy = processes.start(Database(other, database.name))
        for _ in range(2 * STILL_TURNS):
            assert not copy.holds()
            clock.now_s += TURN_S
            assert original.holds()
        age(Database(other, database.name), TAIL_S + 1)
        assert "adopt" in refusal_of(copy, clock)
        # Not even while the original is silent, for days.
        clock.now_s += 1e6
        refusal_of(copy, clock)
        assert original.holds()
    finally:
        other.stop()
        shutil.rmtree(folder)


def test_a_restored_dump_never_works_before_it_is_adopted(
    processes: Processes, database: Database, clock: SteadyClock
) -> None:
    original = processes.start(database)
    assert original.holds()
    copy = dumped(database)
    process = processes.start(copy)
    clock.now_s += 1e6
    assert "cairn serve adopt" in refusal_of(process, clock)
    assert original.holds()
    processes.adopt(copy)
    refusal_of(original, clock)
    assert holds_after_a_wait(process, clock)
    refusal_of(original, clock)


def test_a_standby_that_lost_the_newest_turns_goes_on_by_itself(
    processes: Processes, database: Database, clock: SteadyClock
) -> None:
    assert processes.start(database).holds()
    age(database, TAIL_S - 60)
    assert holds_after_a_wait(processes.start(database), clock)


def test_a_database_that_was_set_back_goes_on_when_it_is_adopted(
    processes: Processes, database: Database, clock: SteadyClock
) -> None:
    process = processes.start(database)
    assert process.holds()
    age(database, 86_400)
    restored = processes.start(database)
    refusal_of(restored, clock)
    processes.adopt(database)
    assert holds_after_a_wait(restored, clock)
    clock.now_s += TURN_S
    assert not process.holds()


def test_a_state_from_before_an_adoption_is_refused(
    processes: Processes, database: Database, clock: SteadyClock
) -> None:
    assert processes.start(database).holds()
    ((era,),) = database.execute("SELECT era FROM object_store")
    processes.adopt(database)
    database.execute(f"UPDATE object_store SET era = '{era}'")
    refusal_of(processes.start(database), clock)


def test_an_object_that_cannot_be_read_stops_work_until_it_is_adopted(
    processes: Processes, database: Database, clock: SteadyClock, store: ColdStore
) -> None:
    process = processes.start(database)
    assert process.holds()
    store.bucket.put(OWNER, b"\xff")
    refusal_of(process, clock)
    processes.adopt(database)
    assert holds_after_a_wait(process, clock)


def test_a_bucket_that_lost_the_object_is_taken_after_a_wait(
    processes: Processes, database: Database, clock: SteadyClock, store: ColdStore
) -> None:
    process = processes.start(database)
    assert process.holds()
    store.bucket.delete(OWNER)
    clock.now_s += TURN_S
    assert holds_after_a_wait(process, clock)


def test_a_server_on_a_copy_reads_and_neither_settles_nor_deletes(
    store: ColdStore, database: Database, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    row = folded_map(store, *COMMITS)
    assert store.settler.may_work()
    store.settle(row)
    copy = dumped(database)
    before = store.bucket.objects()
    # Dead in the copy alone.
    copy.execute("INSERT INTO dead_object (map, name, since_age_s) SELECT map, object, -1e9 FROM cell")
    assert isinstance(store.bucket, SwitchedBucket)
    with closing(ColdStore(copy.url, store.bucket)) as other, Live(tmp_path, store=other) as live:
        live.push(row, pushed(1, 0))
        SettleThread(live.service, other.settler).look()
        assert store.bucket.objects() == before
        with other.snapshot(row) as snapshot:
            assert snapshot.cell(next(iter(COMMITS[0].cells)))
        figures = live.http.get("/metrics").text
    assert 'cairn_settle_failures_total{what="own"} 1.0' in figures
    assert "cairn serve adopt" in caplog.text
