"""A database that is put back to an older state while servers have it open: what was lost, they do not mix in."""

import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from tests.fixtures.map.made import MIDDLE, SMALL
from tests.fixtures.server.commit_contract import bodies, folded_map, new_map
from tests.fixtures.server.postgres import WHEEL, PostgresServer, programs_of
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.store_contract import new_of

from cairn_map.errors import NotFoundError, UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending, plan_fold
from cairn_server.store.postgres import store as postgres_store
from cairn_server.store.postgres.store import PgStore

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    """A server of this module alone: it is stopped, and put back."""
    folder = Path(tempfile.mkdtemp(prefix="cairn-postgres-"))
    try:
        made = PostgresServer(programs_of(WHEEL), folder)
        yield made
        made.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def store(server: PostgresServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[PgStore]:
    """A store in an empty database."""
    monkeypatch.setattr(postgres_store, "NAMES_S", 0.0)
    server.execute("DROP DATABASE IF EXISTS cairn (FORCE)")
    server.execute("CREATE DATABASE cairn")
    with closing(PgStore(server.url("cairn"))) as made:
        yield made


@pytest.fixture
def copy() -> Iterator[Path]:
    """Place of a copy of the server's data."""
    folder = Path(tempfile.mkdtemp(prefix="cairn-postgres-"))
    yield folder / "copy"
    shutil.rmtree(folder, ignore_errors=True)


def put_back(server: PostgresServer, store: PgStore, copy: Path) -> None:
    """Put the copy back, and let the store notice that its connections are gone."""
    server.put_back(copy, signal.SIGINT)
    with pytest.raises(UnreachableError):
        store.maps()


def test_a_fold_that_was_planned_of_a_lost_commit_is_not_written_over_the_one_that_has_its_number(
    store: PgStore, server: PostgresServer, copy: Path
) -> None:
    before, lost, later = pushed(0, 0), pushed(1, 1), pushed(1, 2)
    row = folded_map(store, before)
    server.copy_to(copy)
    store.append(row, new_of(lost))
    (waiting,) = store.pending(row, limit=9, size_bytes_max=1)
    with store.snapshot(row) as snapshot:
        head = snapshot.head
    cache = CellCache(SMALL)
    cache.begin(head)
    fold = plan_fold(store, row, head, [waiting], cache)
    put_back(server, store, copy)
    assert not store.fold(row, fold)
    # Under the number that the lost commit had, as after a stop in good order: the head is where the fold begins.
    server.execute(f"ALTER TABLE commits ALTER number RESTART WITH {waiting.number}", "cairn")
    store.append(row, new_of(later))
    assert [commit.number for commit in store.pending(row, limit=9, size_bytes_max=1)] == [waiting.number]
    assert not store.fold(row, fold)
    assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
    assert read(bodies(store, row)) == sum_of([before, later])


def test_a_map_that_was_lost_is_no_other_map_that_was_made_since(
    store: PgStore, server: PostgresServer, copy: Path
) -> None:
    new_map(store)
    server.copy_to(copy)
    lost, _ = store.create_map("lost", SMALL, SensorModel())
    store.append(lost, new_of(pushed(0, 0)))
    put_back(server, store, copy)
    other, _ = store.create_map("other", MIDDLE, SensorModel())
    assert other.number != lost.number
    for use in (
        lambda: store.append(lost, new_of(pushed(1, 0))),
        lambda: store.append(lost, new_of(pushed(0, 0, WREN))),
    ):
        with pytest.raises(UnreachableError) as refused:
            use()
        assert refused.value.kind == "store_failed" and "lost" in refused.value.message
    with pytest.raises(UnreachableError), store.snapshot(lost):
        pass
    with pytest.raises(NotFoundError):
        store.map("lost")
    again, is_new = store.create_map("lost", SMALL, SensorModel())
    assert is_new and store.map("lost") == again != lost
    assert store.append(again, new_of(pushed(0, 0, MOLE)))
