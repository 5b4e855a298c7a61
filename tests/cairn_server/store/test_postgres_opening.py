"""A database in PostgreSQL that is opened as a store: tables are made or brought up to date, or it is refused."""

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.map.marks import attached, mark, mark_commit
from tests.fixtures.server.commit_contract import bodies, folded_map, new_map
from tests.fixtures.server.crowd_contract import all_at_once
from tests.fixtures.server.deadline import until
from tests.fixtures.server.epoch_contract import EPOCHS, cell_of, commit_in, fold_by_hand, map_with_epochs, totals_of
from tests.fixtures.server.postgres import PASSWORD, Database, PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, WREN, pushed, read, sum_of
from tests.fixtures.server.store_contract import new_of

from cairn_map.errors import BadInputError, CairnError, ConflictError, UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.postgres import schema
from cairn_server.store.postgres.connections import connect
from cairn_server.store.postgres.schema import ATTACHMENTS_OLDEST, EPOCHS_OLDEST, MARKS_OLDEST, STEPS, Step
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.replica_notes import NotedServer

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.fixture
def store(postgres_database: Database) -> Iterator[PgStore]:
    """A store of one test."""
    with closing(PgStore(postgres_database.url)) as made:
        yield made


def refusal(url: str) -> BadInputError:
    """Error with which a URL is refused."""
    with pytest.raises(BadInputError) as refused:
        PgStore(url)
    assert PASSWORD not in refused.value.message and "%20" not in refused.value.message
    return refused.value


def tables(database: Database) -> list[object]:
    """Names of the tables of a database."""
    query = "SELECT relname FROM pg_class WHERE relnamespace = 'public'::regnamespace AND relkind = 'r' ORDER BY 1"
    return [name for (name,) in database.execute(query)]


def test_what_is_pending_and_folded_survives_a_new_start(postgres_database: Database) -> None:
    with closing(PgStore(postgres_database.url)) as store:
        row = folded_map(store, pushed(0, 0))
        store.append(row, new_of(pushed(1, 1)))
        age_s = store.age.now_s()
    with closing(PgStore(postgres_database.url)) as again:
        assert again.map(row.name) == row
        assert [commit.id for commit in again.pending(row, limit=9, size_bytes_max=0)] == [pushed(1, 1).id]
        assert read(bodies(again, row)) == sum_of([pushed(0, 0)])
        assert again.age.now_s() >= age_s


def test_servers_that_start_at_once_make_the_tables_once(postgres_database: Database) -> None:
    made: list[PgStore] = []
    all_at_once([lambda: made.append(PgStore(postgres_database.url))] * 4)
    assert postgres_database.execute("SELECT version FROM cairn_schema") == [(len(STEPS),)]
    row = folded_map(made[0], pushed(0, 0))
    assert {store.map(row.name) for store in made} == {row}
    for store in made:
        store.close()


def test_a_newer_schema_is_refused_unless_it_says_that_this_program_still_works(
    store: PgStore, postgres_database: Database
) -> None:
    row = new_map(store, pushed(0, 0))
    postgres_database.execute("UPDATE cairn_schema SET version = 99")
    with closing(PgStore(postgres_database.url)) as again:
        assert again.map(row.name) == row
    postgres_database.execute("UPDATE cairn_schema SET oldest = 98")
    refused = refusal(postgres_database.url)
    assert refused.kind == "store_version" and "99" in refused.message and "update" in refused.message


def test_a_store_of_the_first_step_takes_those_that_it_lacks(
    postgres_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as old:
        old.setattr(schema, "STEPS", STEPS[:1])
        schema.prepare(postgres_database.url)
    assert postgres_database.execute("SELECT * FROM cairn_schema") == [(1, 1)]
    with closing(PgStore(postgres_database.url)) as store:
        folded_map(store, pushed(0, 0))
    assert postgres_database.execute("SELECT * FROM cairn_schema") == [(len(STEPS), STEPS[-1].oldest)]


WITHOUT_EPOCHS = """
ALTER TABLE audit DROP COLUMN client;
DROP TABLE assignment, attachment, attachment_part, mark, gone_map, gone_token;
ALTER TABLE author DROP COLUMN kept_bytes;
ALTER TABLE author DROP COLUMN marks;
ALTER TABLE age DROP COLUMN clock;
ALTER TABLE map DROP COLUMN epoch_s;
ALTER TABLE commits DROP COLUMN epoch;
ALTER TABLE touched DROP COLUMN epoch;
ALTER TABLE head DROP COLUMN history_bytes;
ALTER TABLE cell DROP COLUMN history_bytes;
ALTER TABLE tile DROP COLUMN history_bytes;
ALTER TABLE server DROP COLUMN step;
UPDATE cairn_schema SET version = 5;
"""
"""SQL that takes the step of epochs and those after it back."""


def test_a_store_of_before_epochs_opens_as_it_was_and_takes_maps_with_them(postgres_database: Database) -> None:
    def state(store: PgStore) -> tuple[object, ...]:
        row = store.map(name)
        with store.snapshot(row) as snapshot:
            cells = [snapshot.cell(cell.key) for cell in snapshot.cells()]
            return row, snapshot.head, cells, snapshot.totals(), store.pending(row, limit=9, size_bytes_max=1 << 30)

    with closing(PgStore(postgres_database.url)) as store:
        row = folded_map(store, pushed(0, 0), pushed(1, 1))
        store.append(row, new_of(pushed(2, 2)))
        name = row.name
        before = state(store)
    postgres_database.execute(WITHOUT_EPOCHS)
    with closing(PgStore(postgres_database.url)) as store:
        assert state(store) == before
        assert postgres_database.execute("SELECT oldest FROM cairn_schema") == [(1,)]
        with_epochs = map_with_epochs(store)
        store.append(with_epochs, commit_in(EPOCHS[3], 0))
        fold_by_hand(store, with_epochs, [cell_of(KEYS[0], lm=1, history_bytes=7)])
        assert totals_of(store, with_epochs).history_bytes == 7
        assert fold_pending(store, row, CellCache(SMALL), limit=9) == 1
        assert read(bodies(store, row)) == sum_of([pushed(n, n) for n in range(3)])


def test_a_map_with_epochs_bars_programs_that_do_not_know_them_those_at_work_first(
    store: PgStore, postgres_database: Database
) -> None:
    new_map(store)
    assert postgres_database.execute("SELECT oldest FROM cairn_schema") == [(1,)]
    sign = NotedServer(id="a" * 16, answers=True, folds=True, version="1.0", folded_s=None)
    store.replicas.servers.put(sign, wall_s=0.0)
    store.replicas.servers.put(replace(sign, id="b" * 16), wall_s=0.0)
    postgres_database.execute(f"UPDATE server SET step = NULL WHERE id = '{'b' * 16}'")  # as one of before says it
    count = len(store.maps())
    with pytest.raises(ConflictError) as refused:
        map_with_epochs(store)
    assert refused.value.kind == "older_servers" and "(1)" in refused.value.message
    assert len(store.maps()) == count
    store.replicas.servers.remove("b" * 16)
    map_with_epochs(store)
    assert postgres_database.execute("SELECT oldest FROM cairn_schema") == [(EPOCHS_OLDEST,)]


def test_an_attachment_bars_programs_that_read_no_mark_with_one(store: PgStore, postgres_database: Database) -> None:
    row = new_map(store)
    store.append(row, new_of(mark_commit(0, mark())))
    assert postgres_database.execute("SELECT oldest FROM cairn_schema") == [(MARKS_OLDEST,)]
    sign = NotedServer(id="a" * 16, answers=True, folds=True, version="1.0", folded_s=None)
    store.replicas.servers.put(sign, wall_s=0.0)
    postgres_database.execute(f"UPDATE server SET step = {MARKS_OLDEST}")
    with pytest.raises(ConflictError, match="attachments of marks") as refused:
        store.append(row, new_of(mark_commit(1, attached(b"picture"))))
    assert refused.value.kind == "older_servers"
    store.replicas.servers.remove(sign.id)
    store.append(row, new_of(mark_commit(1, attached(b"picture"))))
    assert postgres_database.execute("SELECT oldest FROM cairn_schema") == [(ATTACHMENTS_OLDEST,)]


def test_a_step_that_fails_leaves_the_store_as_it_was(
    postgres_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(PgStore(postgres_database.url)) as store:
        row = folded_map(store, pushed(0, 0))
    before = tables(postgres_database)
    with monkeypatch.context() as wrong:
        wrong.setattr(schema, "STEPS", (*STEPS, Step("CREATE TABLE half (x int); SELECT 1 / 0", oldest=1)))
        assert refusal(postgres_database.url).kind == "bad_store"
    assert tables(postgres_database) == before
    with closing(PgStore(postgres_database.url)) as store:
        assert read(bodies(store, row)) == sum_of([pushed(0, 0)])


def test_a_database_of_another_program_is_refused_and_left_as_it_is(postgres_database: Database) -> None:
    postgres_database.execute("CREATE TABLE token (secret text)")
    refused = refusal(postgres_database.url)
    assert refused.kind == "bad_store" and "another program" in refused.message
    assert tables(postgres_database) == ["token"]


def test_a_user_without_rights_is_refused_and_nothing_is_made(postgres_database: Database) -> None:
    name = f"guest_{postgres_database.name}"
    postgres_database.execute(f"CREATE USER {name} PASSWORD '{PASSWORD}'")
    refused = refusal(postgres_database.url.replace("//cairn:", f"//{name}:"))
    assert refused.kind == "bad_store" and "owner" in refused.message
    assert tables(postgres_database) == []


def test_a_database_that_cannot_hold_every_text_is_refused(postgres: PostgresServer) -> None:
    refused = refusal(new_database(postgres, encoding="SQL_ASCII").url)
    assert refused.kind == "bad_store" and "UTF8" in refused.message


@pytest.mark.parametrize("setting", ["synchronous_commit=off", "default_transaction_read_only=on"])
def test_a_database_that_would_not_keep_what_is_acknowledged_is_refused(
    postgres_database: Database, setting: str
) -> None:
    refused = refusal(f"{postgres_database.url}?options=-c%20{setting.replace('=', '%3D')}")
    assert refused.kind == "bad_store"
    assert tables(postgres_database) == []


def test_a_wrong_url_a_wrong_password_and_no_server_are_refused_with_the_next_step(
    postgres_database: Database,
) -> None:
    with closing(socket.socket()) as nowhere:
        nowhere.bind(("127.0.0.1", 0))
        closed_port = nowhere.getsockname()[1]
    port = postgres_database.server.port
    for url in (
        f"postgresql://cairn:{PASSWORD.replace(' ', '%20')}@127.0.0.1:{closed_port}/maps",
        postgres_database.url.replace("cairn:", "cairn:x"),
        postgres_database.url.replace(postgres_database.name, "no_such_database"),
    ):
        refused = refusal(url)
        assert refused.kind == "bad_store" and "check that it runs" in refused.message
        assert "127.0.0.1" in refused.message
    assert refusal(f"postgresql://cairn@127.0.0.1:{port}/maps?no_such=1").kind == "bad_store"


def test_a_lost_connection_is_reported_and_the_next_call_has_a_fresh_one(
    store: PgStore, postgres_database: Database
) -> None:
    row = new_map(store, pushed(0, 0))
    end = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity WHERE application_name = 'cairn'"
    postgres_database.execute(f"{end} AND datname = current_database()")
    with pytest.raises(UnreachableError) as refused:
        store.append(row, new_of(pushed(1, 1)))
    assert refused.value.kind == "store_failed" and refused.value.retry_after_s
    assert store.append(row, new_of(pushed(1, 1)))


def test_connections_give_a_cut_link_up_after_seconds_unless_the_url_says_another_time(
    postgres_database: Database,
) -> None:
    for url, idle_s in ((postgres_database.url, "5"), (f"{postgres_database.url}?keepalives_idle=60", "60")):
        with connect(url) as connection:
            stated = connection.info.get_parameters()
        assert (stated["keepalives_idle"], stated["tcp_user_timeout"]) == (idle_s, "10000")
        assert stated["target_session_attrs"] == "read-write"


def test_a_snapshot_whose_connection_is_lost_is_reported(store: PgStore, postgres_database: Database) -> None:
    row = new_map(store)
    with pytest.raises(UnreachableError), store.snapshot(row) as snapshot:
        postgres_database.execute(
            "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity"
            " WHERE application_name = 'cairn' AND datname = current_database()"
        )
        list(snapshot.cells())
    with store.snapshot(row) as snapshot:
        assert snapshot.head.seq == 0


def test_what_was_acknowledged_survives_a_crash_of_the_database(store: PgStore, postgres_database: Database) -> None:
    commits = [pushed(n, n) for n in range(4)]
    row = folded_map(store, *commits[:2])
    for commit in commits[2:]:
        store.append(row, new_of(commit))
    postgres_database.server.stop(signal.SIGQUIT)
    for _ in range(2):
        with pytest.raises(UnreachableError) as refused:
            store.maps()
        assert refused.value.kind == "store_failed"
    postgres_database.server.start()
    assert not store.append(row, new_of(commits[3]))
    assert fold_pending(store, row, CellCache(SMALL), limit=9) == 2
    assert read(bodies(store, row)) == sum_of(commits)


def test_a_closed_store_says_so_and_notes_are_dropped_silently(postgres_database: Database) -> None:
    store = PgStore(postgres_database.url)
    row, _ = store.create_map("lab", SMALL, SensorModel())
    with store.snapshot(row) as snapshot:
        store.close()
        assert list(snapshot.cells()) == []
    store.close()
    store.audit("late", "no line")
    store.seen(row, "mole", None)
    store.notes.put_status(row, "mole", "{}")
    for call in (store.maps, lambda: store.append(row, new_of(pushed(0, 0)))):
        with pytest.raises(UnreachableError) as refused:
            call()
        assert refused.value.kind == "shutting_down"
    with pytest.raises(UnreachableError):
        store.submit(row, new_of(pushed(0, 0)))


NEXT = Step(
    "ALTER TABLE commits ADD COLUMN added text; ALTER TABLE head ADD COLUMN added bigint NOT NULL DEFAULT 7;"
    " ALTER TABLE cell ADD COLUMN added bytea; CREATE TABLE added (map bigint PRIMARY KEY)",
    oldest=1,
)
"""A step that the next version could bring: it adds to the tables that are used most."""
AFTER_NEXT = Step("DROP TABLE added", oldest=len(STEPS) + 1)
"""The step after it, which takes away what only the version before it needs."""


def test_a_step_gives_way_to_a_reader_that_waits_for_it(
    postgres_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    PgStore(postgres_database.url).close()
    monkeypatch.setattr(schema, "STEPS", (*STEPS, NEXT))
    with connect(postgres_database.url) as reader, reader.transaction():
        # The reader has the step's last table, the step the first one, for which the reader asks next.
        reader.execute("SELECT count(*) FROM cell")
        opened: list[PgStore] = []
        step = threading.Thread(target=lambda: opened.append(PgStore(postgres_database.url)))
        step.start()
        waits = "SELECT count(*) FROM pg_locks WHERE NOT granted"
        until(lambda: postgres_database.execute(waits)[0][0] > 0, "the step waits")
        for _ in range(20):
            assert reader.execute("SELECT count(*) FROM commits").fetchone() == (0,)
        assert not opened
    step.join()
    opened[0].close()


def test_a_server_goes_on_while_the_next_version_brings_its_step_and_works_beside_it(
    postgres_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, ended = PgStore(postgres_database.url), threading.Event()
    row, failed, count = new_map(old, pushed(0, 0)), [], 0

    def work() -> None:
        nonlocal count
        while not ended.is_set():
            count += 1
            try:
                old.append(row, new_of(pushed(count, count % 5)))
                fold_pending(old, row, CellCache(SMALL), limit=9)
                bodies(old, row)
            except CairnError as exc:
                failed.append(exc)

    worker = threading.Thread(target=work)
    worker.start()
    try:
        until(lambda: count > 20, "statements are prepared")
        with monkeypatch.context() as newer:
            newer.setattr(schema, "STEPS", (*STEPS, NEXT))
            with closing(PgStore(postgres_database.url)) as new:
                before = count
                for n in range(10):
                    new.append(row, new_of(pushed(n, n % 5, WREN)))
                    fold_pending(new, row, CellCache(SMALL), limit=9)
                until(lambda: count > before + 20, "the old one goes on")
    finally:
        ended.set()
        worker.join()
    assert failed == []
    with closing(PgStore(postgres_database.url)) as again:  # the old version starts again, too
        while fold_pending(again, row, CellCache(SMALL), limit=99):
            pass
        everything = [pushed(n, n % 5) for n in range(count + 1)] + [pushed(n, n % 5, WREN) for n in range(10)]
        assert read(bodies(again, row)) == sum_of(everything)
    old.close()
    with monkeypatch.context() as newer:
        newer.setattr(schema, "STEPS", (*STEPS, NEXT, AFTER_NEXT))
        PgStore(postgres_database.url).close()
    assert refusal(postgres_database.url).kind == "store_version"
