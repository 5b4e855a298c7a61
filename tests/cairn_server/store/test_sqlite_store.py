"""The embedded store: the contract, and what is its own."""

import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import apsw
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access_contract import AccessContract
from tests.fixtures.server.admission_contract import AdmissionContract
from tests.fixtures.server.attachment_contract import AttachmentContract
from tests.fixtures.server.branch_contract import BranchContract, branch, token
from tests.fixtures.server.commit_contract import CommitContract
from tests.fixtures.server.crowd_contract import CrowdContract
from tests.fixtures.server.deletion_contract import DeletionContract
from tests.fixtures.server.epoch_contract import EpochContract
from tests.fixtures.server.evidence_contract import EvidenceContract
from tests.fixtures.server.layer_contract import LayerContract
from tests.fixtures.server.mark_contract import MarkContract
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.fixtures.server.shares_contract import SharesContract, author_of
from tests.fixtures.server.store_contract import NAMES, StoreContract, new_of
from tests.fixtures.server.stores import sqlite_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import OPERATOR, Author, CommitId
from cairn_map.errors import BadInputError, ConflictError, NotFoundError, UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.sqlite import readers as sqlite_readers
from cairn_server.store.sqlite import tokens as sqlite_tokens
from cairn_server.store.sqlite.changes import append_commit
from cairn_server.store.sqlite.schema import ensure_schema
from cairn_server.store.sqlite.shares import IS_RESERVE
from cairn_server.store.sqlite.snapshot import CELL_COLUMNS
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.sqlite.writer import first, rows
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SqliteStore]:
    """The contract's store."""
    made = SqliteStore(tmp_path_factory.mktemp("contract"))
    yield made
    made.close()


def columns_of(connection: apsw.Connection, table: str) -> set[str]:
    return {name for (name,) in rows(connection, "SELECT name FROM pragma_table_info(?)", (table,))}


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[SqliteStore]:
    """A store for one test."""
    made = SqliteStore(tmp_path)
    yield made
    made.close()


class TestSqliteStore(
    StoreContract,
    CommitContract,
    SharesContract,
    CrowdContract,
    EvidenceContract,
    EpochContract,
    MarkContract,
    LayerContract,
    AttachmentContract,
    BranchContract,
    AccessContract,
    AdmissionContract,
    DeletionContract,
):
    """All of the contract."""

    def rows_of(self, store: Store, row: MapRow) -> dict[str, int]:
        """Count of the rows that a table has of a map."""
        with sqlite_of(store)._readers.reading() as reader:
            tables = [name for (name,) in rows(reader, "SELECT name FROM sqlite_master WHERE type = 'table'")]
            of_map = [name for name in tables if "map" in columns_of(reader, name) and name != "gone_token"]
            queries = {name: f"SELECT count(*) FROM {name} WHERE map = ?1" for name in of_map}
            queries["map"] = "SELECT count(*) FROM map WHERE number = ?1"
            queries["diff"] = "SELECT count(*) FROM diff WHERE ?1 AND commit_number NOT IN (SELECT number FROM commits)"
            counts = {name: first(reader, query, (row.number,)) for name, query in queries.items()}
        return {name: count for name, count in counts.items() if count}


STEPS = [
    *(pushed(n, n, author) for author in (MOLE, WREN) for n in range(3)),
    pushed(3, 0, MOLE, cells={}, retracts=[pushed(0, 0)]),
    pushed(4, 4, MOLE, retracts=[pushed(1, 1), pushed(5, 0)]),
    pushed(5, 0, MOLE),
    pushed(0, 0, author_of(OPERATOR), cells={}, retracts=[pushed(1, 1, WREN), pushed(0, 0)]),
    *("fold", "forget", "close"),
]


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(st.sampled_from(STEPS), max_size=14))
def test_accounts_are_at_any_time_the_sum_of_what_is_pending_or_in_the_map(
    fresh: SqliteStore, steps: list[Commit | str]
) -> None:
    row, _ = fresh.create_map(next(NAMES), SMALL, SensorModel())
    commits = [commit for commit in STEPS if not isinstance(commit, str) and commit.cells]
    tops = {commit.id: new_of(commit).tops for commit in commits}
    for step in steps:
        if isinstance(step, str):
            with suppress(NotFoundError):
                {
                    "fold": lambda: fold_pending(fresh, row, CellCache(SMALL), limit=9),
                    "forget": lambda: fresh.forget_evidence(row, before_s=1e12, limit=2),
                    "close": lambda: fresh.shares.close(row, "mole"),
                }[step]()
        else:
            with suppress(ConflictError):  # of a closed author, or `evidence_gone`
                fresh.append(row, new_of(step))
        with fresh._readers.reading() as reader:
            accounts = f"CASE WHEN {IS_RESERVE} THEN '' ELSE robot END"
            counted = list(
                reader.execute(
                    f"SELECT {accounts}, robot, incarnation, n FROM commits JOIN author USING (map, robot, incarnation)"
                    " WHERE map = ? AND unfolded_seq IS NULL AND cells > 0",
                    (row.number,),
                )
            )
            held = list(reader.execute("SELECT account, region, tops FROM held WHERE map = ?", (row.number,)))
        expected: dict[tuple[str, int], npt.NDArray[np.int64]] = {}
        for account, robot, incarnation, n in counted:
            for region, top in tops[CommitId(Author(robot, incarnation), n)].items():
                expected[account, region] = expected.get((account, region), np.int64(0)) + np.array(top)
        found = {(account, region): np.frombuffer(top, "<i8").tolist() for account, region, top in held}
        assert found == {key: total.tolist() for key, total in expected.items()}


CROWD = sqlite_readers.IDLE_MAX + 10


def test_signs_of_life_of_a_crowd_are_few_writes_and_none_is_lost(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    row, _ = store.create_map("lab", SMALL, SensorModel())
    names = [f"robot{n}" for n in range(20)]
    for name in names:
        store.register(row, branch(name), token(row, name))
    with store.snapshot(row) as snapshot:
        cursor = snapshot.head
    written = store.health.figures().written
    for name in names:
        store.seen(row, name, cursor)
        store.seen(row, name, None)
    store.close()
    again = SqliteStore(tmp_path)
    assert [found.cursor for found in again.branches(row)] == [cursor] * len(names)
    again.close()
    assert store._writer.written - written <= 3


def test_a_second_store_on_the_same_folder_is_refused_until_the_first_is_closed(tmp_path: Path) -> None:
    first = SqliteStore(tmp_path)
    with pytest.raises(ConflictError) as refused:
        SqliteStore(tmp_path)
    assert refused.value.kind == "store_in_use"
    first.close()
    SqliteStore(tmp_path).close()


@pytest.mark.parametrize("content", [b"not a database at all, but long enough to be looked at" * 50, b""])
def test_a_file_that_is_no_store_is_refused(tmp_path: Path, content: bytes) -> None:
    if content:
        (tmp_path / FILE_NAME).write_bytes(content)
    else:
        other = apsw.Connection(str(tmp_path / FILE_NAME))
        other.execute("CREATE TABLE somebody_else (x)")
        other.close()
    with pytest.raises(BadInputError) as refused:
        SqliteStore(tmp_path)
    assert refused.value.kind in ("bad_store", "store_version")
    with pytest.raises(BadInputError):  # and the folder is not left locked
        SqliteStore(tmp_path)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInputError) as refused:
        SqliteStore(tmp_path / "file" / "data")
    assert refused.value.kind == "bad_store"


def test_threads_that_come_and_go_leave_no_connections_behind(fresh: SqliteStore) -> None:
    row, _ = fresh.create_map("lab", SMALL, SensorModel())
    for _ in range(3):
        threads = [threading.Thread(target=lambda: fresh.branches(row)) for _ in range(CROWD)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(fresh._readers._idle) <= sqlite_readers.IDLE_MAX


def test_a_snapshot_that_is_open_while_the_store_closes_is_not_pulled_away(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    row, _ = store.create_map("lab", SMALL, SensorModel())
    with store.snapshot(row) as snapshot:
        store.close()
        assert list(snapshot.cells()) == []
    assert store._readers._idle == []


def test_a_closed_store_says_so_and_notes_are_dropped_silently(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    row, _ = store.create_map("lab", SMALL, SensorModel())
    store.close()
    store.close()
    store.audit("late", "nobody hears it")
    store.seen(row, "mole", None)
    with pytest.raises(UnreachableError) as refused:
        store.append(row, new_of(pushed(0, 0)))
    assert refused.value.kind == "shutting_down"
    with pytest.raises(UnreachableError):
        store.maps()


def test_what_is_pending_survives_a_new_start(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    row, _ = store.create_map("lab", SMALL, SensorModel())
    store.append(row, new_of(pushed(0, 0)))
    store.close()
    again = SqliteStore(tmp_path)
    assert again.map("lab") == row
    assert [commit.id for commit in again.pending(row, limit=9, size_bytes_max=0)] == [pushed(0, 0).id]
    again.close()


def test_one_job_that_fails_does_not_take_its_group_with_it(fresh: SqliteStore) -> None:
    row, _ = fresh.create_map("lab", SMALL, SensorModel())
    gate = threading.Event()
    blocked = fresh._writer.submit(lambda _: gate.wait(60))
    jobs = [
        fresh._writer.submit(partial(append_commit, row=row, age_s=0.0, commit=new_of(pushed(n, n)))) for n in (0, 1)
    ]
    bad = fresh._writer.submit(partial(append_commit, row=row, age_s=0.0, commit=new_of(pushed(0, 5))))
    gate.set()
    assert blocked.result()
    assert [job.result() for job in jobs] == [True, True]
    assert isinstance(bad.exception(), ConflictError)
    with fresh.snapshot(row) as snapshot:
        assert len(snapshot.pending()) == 2


def test_a_failure_of_the_file_fails_the_group_and_the_writer_goes_on(fresh: SqliteStore) -> None:
    row, _ = fresh.create_map("lab", SMALL, SensorModel())
    with pytest.raises(UnreachableError) as refused:
        fresh._writer.run(lambda connection: connection.execute("INSERT INTO no_such_table VALUES (1)"))
    assert refused.value.kind == "store_failed"
    assert fresh.append(row, new_of(pushed(0, 0)))


def test_the_audit_log_keeps_its_newest_lines(fresh: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_tokens, "AUDIT_ROWS_MAX", 3)
    for n in range(9):
        fresh.audit("test", str(n))
    found = fresh._writer.run(lambda connection: connection.execute("SELECT detail FROM audit").fetchall())
    assert found == [("6",), ("7",), ("8",)]


def test_a_list_of_cells_reads_none_of_their_bytes(tmp_path: Path) -> None:
    connection = apsw.Connection(str(tmp_path / FILE_NAME))
    ensure_schema(connection)
    query = f"SELECT {CELL_COLUMNS} FROM cell WHERE map = 1 AND lm > 5 AND cell > 7 ORDER BY cell LIMIT 9"
    [(*_, plan)] = connection.execute(f"EXPLAIN QUERY PLAN {query}")
    assert "COVERING INDEX cell_listed" in str(plan)
