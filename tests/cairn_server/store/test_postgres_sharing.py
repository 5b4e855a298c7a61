"""What several servers do to one database in PostgreSQL at the same time, and who waits for whom."""

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import pairwise

import psycopg
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.commit_contract import bodies, folded_map, new_map
from tests.fixtures.server.crowd_contract import all_at_once
from tests.fixtures.server.evidence_contract import fold
from tests.fixtures.server.live import until
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.shares_contract import COUNT_SHARE, PLANES, author_of, heavy, refusal
from tests.fixtures.server.store_contract import NAMES, new_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import next_chain
from cairn_map.commits.ids import OPERATOR, Author
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import ConflictError, NotFoundError, UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.live.hub import Hub
from cairn_server.live.robot_reports import RobotReports
from cairn_server.store import history
from cairn_server.store.postgres import replica_notes as postgres_notes
from cairn_server.store.postgres import tokens as postgres_tokens
from cairn_server.store.postgres.connections import Connections
from cairn_server.store.postgres.folds import CHANNEL
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.replica_notes import BodyPart, BodyPlace, FoldHint, FoldHints, UseAnswer, UseBounds
from cairn_server.store.store_rows import Branch, MapRow, Use

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.fixture
def store(postgres_database: Database) -> Iterator[PgStore]:
    """A store of one test, in which no statement waits for a lock that does not go away."""
    with closing(PgStore(f"{postgres_database.url}?options=-c%20lock_timeout%3D5s")) as made:
        yield made


@pytest.fixture
def other(store: PgStore, postgres_database: Database) -> Iterator[PgStore]:
    """The same store, as another server has it."""
    with closing(PgStore(postgres_database.url)) as made:
        yield made


@contextmanager
def locked(database: Database, query: str) -> Iterator[None]:
    """Rows that another transaction has locked, for the length of a `with`."""
    with psycopg.connect(database.url) as connection:
        connection.execute(f"{query} FOR UPDATE")  # type: ignore[call-overload]
        yield


# Pushes


def test_a_robot_s_next_commit_waits_for_no_fold_and_no_other_robot(
    store: PgStore, postgres_database: Database
) -> None:
    row = new_map(store, pushed(0, 0), pushed(0, 1, WREN))
    others = [
        f"SELECT FROM head WHERE map = {row.number}",
        "SELECT FROM author WHERE robot <> 'mole'",
        "SELECT FROM held WHERE account <> 'mole'",
        "SELECT FROM commits",
    ]
    for n, query in enumerate(others, start=1):
        with locked(postgres_database, query):
            assert store.append(row, new_of(pushed(n, 0)))
    assert store.append(row, new_of(pushed(1, 1, WREN)))


def test_a_repeated_commit_is_known_to_every_server(store: PgStore, other: PgStore) -> None:
    row = new_map(store, pushed(0, 0))
    assert store.append(row, new_of(pushed(1, 1)))
    assert not other.append(row, new_of(pushed(1, 1)))
    with pytest.raises(ConflictError) as refused:
        other.append(row, new_of(pushed(1, 2)))
    assert refused.value.kind == "id_taken"


def test_one_commit_pushed_to_two_servers_at_once_is_new_once(store: PgStore, other: PgStore) -> None:
    row = new_map(store, pushed(0, 0))
    news: list[bool] = []
    for n in range(1, 20):
        all_at_once(
            [lambda each=each, n=n: news.append(each.append(row, new_of(pushed(n, n)))) for each in (store, other)]
        )  # type: ignore[misc]
    assert sum(news) == 19 and len(news) == 38


def test_two_incarnations_at_once_do_not_get_past_their_robot_s_share(store: PgStore, other: PgStore) -> None:
    authors = [author_of("mole", n) for n in range(2)]
    for _ in range(15):
        row = new_map(store, *(pushed(0, 1, author) for author in authors))
        found: list[str | None] = []
        all_at_once([partial(push_heavy, each, row, authors[n], found) for n, each in enumerate((store, other))])
        assert sorted(map(str, found)) == ["None", "evidence_overflow"]


def push_heavy(store: PgStore, row: MapRow, author: Author, found: list[str | None]) -> None:
    """Push half of a robot's share, which leaves no room for another half next to what is there."""
    found.append(refusal(store, row, heavy(1, COUNT_SHARE // 2, author, key=KEYS[1])))


# Folds


def test_two_folders_and_three_robots_leave_a_log_without_gaps_and_the_sum_of_all(
    store: PgStore, other: PgStore
) -> None:
    row = new_map(store)
    authors = [author_of(name) for name in ("a", "b", "c")]
    commits = [[pushed(n, n % 5, author) for n in range(15)] for author in authors]
    left = threading.Semaphore(0)

    def push(mine: list[Commit]) -> None:
        for n, commit in enumerate(mine):
            (store, other)[n % 2].append(row, new_of(commit))
        left.release()

    def fold(each: PgStore) -> None:
        cache = CellCache(SMALL)
        while not left.acquire(blocking=False):
            fold_pending(each, row, cache, limit=4)
        left.release()

    all_at_once([*(partial(push, mine) for mine in commits), partial(fold, store), partial(fold, other)])
    while fold_pending(store, row, CellCache(SMALL), limit=64):
        pass
    everything = [commit for mine in commits for commit in mine]
    assert read(bodies(other, row)) == sum_of(everything)
    with other.snapshot(row) as snapshot:
        chain = snapshot.chain_at(0)
        for entry in snapshot.chained(after_seq=0, limit=1000):
            assert chain is not None
            chain = next_chain(chain, entry.kind, entry.commit, entry.sha)
            assert entry.chain == chain
        assert snapshot.head.seq == len(everything) == len(snapshot.vector_at(snapshot.head.seq))


def test_a_fold_notifies_once_those_that_listen(store: PgStore, postgres_database: Database) -> None:
    row = new_map(store, pushed(0, 0), pushed(1, 1))
    with psycopg.connect(postgres_database.url, autocommit=True) as listener:
        listener.execute(f"LISTEN {CHANNEL}")  # type: ignore[call-overload]
        fold_pending(store, row, CellCache(SMALL), limit=9)
        assert [note.payload for note in listener.notifies(timeout=30, stop_after=1)] == [f"{row.number} 2"]


def test_vectors_are_kept_at_marks(
    store: PgStore, other: PgStore, postgres_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history, "MARK_EVERY", 3)
    row = new_map(store, *(pushed(n, n) for n in range(8)))
    while fold_pending(store, row, CellCache(SMALL), limit=2):
        pass
    assert postgres_database.execute("SELECT seq FROM vector_mark ORDER BY seq") == [(4,), (6,)]
    with other.snapshot(row) as snapshot:
        for seq in range(9):
            assert snapshot.vector_at(seq) == EMPTY.with_commits(pushed(n, n).id for n in range(seq))


# What must not miss each other (a retract and forgetting: tests.replicas.races)


def test_lines_of_two_servers_are_one_chain_of_which_the_newest_are_kept(
    store: PgStore, other: PgStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgres_tokens, "AUDIT_ROWS_MAX", 30)

    def add(each: PgStore) -> None:
        for n in range(20):
            each.audit("test", str(n))

    all_at_once([partial(add, store), partial(add, other)])
    lines = store.audit_log.page(after=0, limit=99)
    assert [line.number for line in lines] == list(range(11, 41))
    assert all(line.is_next_after(before) for before, line in pairwise(lines))


def test_lines_that_come_while_another_server_writes_its_own_are_written_at_once(
    store: PgStore, postgres_database: Database
) -> None:
    store.audit("test", "the row of the chain's end is there")
    details = [f"robot {n}" for n in range(6)]
    threads = [threading.Thread(target=partial(store.audit_log.add, "chief", "register", each)) for each in details]
    with locked(postgres_database, "SELECT FROM audit_head"):
        for thread in threads:
            thread.start()
        until(lambda: len(store.audit_log._waiting) == 5, "one is being written, and all others wait for it")
    for thread in threads:
        thread.join()
    assert {line.detail for line in store.audit_log.page(after=1, limit=9)} == set(details)
    ((transactions,),) = postgres_database.execute("SELECT count(DISTINCT xmin::text) FROM audit WHERE number > 1")
    assert transactions == 2


def test_a_line_that_cannot_be_written_fails_alone(store: PgStore) -> None:
    with pytest.raises(UnicodeEncodeError):
        store.audit_log.add("chief", "register", "\ud800")
    store.audit_log.add("chief", "register", "the next one")
    assert [line.detail for line in store.audit_log.page(after=0, limit=9)] == ["the next one"]


def test_servers_together_take_no_more_use_than_one_may(store: PgStore, other: PgStore) -> None:
    robot, bounds = (new_map(store).number, "mole"), UseBounds(size_bytes=100, commits_per_minute=12)
    taken: list[UseAnswer] = []

    def take(each: PgStore) -> None:
        for _ in range(10):
            answer = each.replicas.uses.take(robot, Use(7), bounds, commits=1)
            taken.extend([answer] * (bounds.hold(answer.of_day) and not answer.wait_s))

    all_at_once([partial(take, store), partial(take, other)])
    assert sorted(answer.of_day.size_bytes for answer in taken) == [7 * n for n in range(1, 13)]


def test_first_parts_that_come_to_two_servers_at_once_are_one_body(store: PgStore, other: PgStore) -> None:
    number = new_map(store).number

    def append(each: PgStore, place: BodyPlace) -> None:
        for offset, data in ((0, b"abc"), (3, b"de")):
            each.replicas.bodies.append(place, BodyPart("a" * 64, 5, offset, data))

    for n in range(10):
        place = BodyPlace(number, "mole", pushed(n, 0).id)
        all_at_once([partial(append, store, place), partial(append, other, place)])
        assert store.replicas.bodies.body(place, "a" * 64) == b"abcde"


def test_the_last_sign_of_a_robot_that_fell_silent_reaches_other_servers(store: PgStore, other: PgStore) -> None:
    row = new_map(store)
    store.register(row, Branch("mole", "high-end", (), None, 5.0, MOLE.incarnation), b"m" * 32)
    with store.snapshot(row) as snapshot:
        before = snapshot.head
    store.seen(row, "mole", before)
    fold(store, row, pushed(0, 0))
    with store.snapshot(row) as snapshot:
        store.seen(row, "mole", snapshot.head)  # a moment later, which is not written at once
    reports = RobotReports(store, Hub(store, connections=9))
    reports.flush()  # as each second, by the watch

    def is_told() -> bool:
        found = other.branch(row, "mole")
        return found is not None and found.cursor is not None and found.cursor.seq == before.seq + 1

    until(is_told, "it is written")


def test_servers_have_one_secret(store: PgStore, other: PgStore) -> None:
    assert store.replicas.secret == other.replicas.secret


STEPS = [
    *(pushed(n, n, author) for author in (MOLE, WREN) for n in range(3)),
    pushed(3, 0, MOLE, cells={}, retracts=[pushed(0, 0)]),
    pushed(4, 4, MOLE, retracts=[pushed(1, 1), pushed(5, 0)]),
    pushed(5, 0, MOLE),
    pushed(0, 0, author_of(OPERATOR), cells={}, retracts=[pushed(1, 1, WREN), pushed(0, 0)]),
    *("fold", "forget", "close"),
]


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(steps=st.lists(st.sampled_from(STEPS), max_size=14))
def test_accounts_are_at_any_time_the_sum_of_what_is_pending_or_in_the_map(
    store: PgStore, postgres_database: Database, steps: list[Commit | str]
) -> None:
    row, _ = store.create_map(next(NAMES), SMALL, SensorModel())
    charges = {commit.id: new_of(commit).tops for commit in STEPS if not isinstance(commit, str)}
    ids = {str(commit): commit for commit in charges}
    query = (
        "SELECT CASE WHEN closed OR robot IN ('initial', 'operator') THEN '' ELSE robot END,"
        f" robot || '.' || incarnation || '.' || n FROM commits JOIN author USING (map, robot, incarnation)"
        f" WHERE map = {row.number} AND unfolded_seq IS NULL AND cells > 0"
    )
    for step in steps:
        try:
            if not isinstance(step, str):
                store.append(row, new_of(step))
            elif step == "fold":
                fold_pending(store, row, CellCache(SMALL), limit=9)
            elif step == "forget":
                store.forget_evidence(row, before_s=1e12, limit=2)
            else:
                store.shares.close(row, "mole")
        except (ConflictError, NotFoundError):
            pass  # of a closed author, or `evidence_gone`
        expected: dict[object, list[int]] = {}
        for account, id_ in postgres_database.execute(query):
            for region, top in charges[ids[str(id_)]].items():
                had = expected.get((account, region), [0] * PLANES)
                expected[account, region] = [a + b for a, b in zip(had, top, strict=True)]
        found = postgres_database.execute(f"SELECT account, region, tops FROM held WHERE map = {row.number}")
        assert {(account, region): tops for account, region, tops in found} == expected


def test_servers_that_start_at_different_times_have_one_age(postgres_database: Database) -> None:
    one = PgStore(postgres_database.url)
    postgres_database.set_clock(40.0)
    two = PgStore(postgres_database.url)  # the time since the first one's tick has passed by the database's clock
    try:
        assert two.age.now_s() >= 40.0
        one.keep_age()
        until(lambda: one.age.now_s() >= 40.0, "the first one follows")
        before_s = two.age.now_s()
        postgres_database.set_clock(1e9)  # a jump is no time that passed, nor is the way back
        one.keep_age()
        postgres_database.set_clock(0.0)
        three = PgStore(postgres_database.url)
        assert before_s <= three.age.now_s() < before_s + 60.0
        three.close()
    finally:
        two.close()
        one.close()


def test_a_process_that_stops_in_a_write_frees_its_locks_and_does_it_again(postgres_database: Database) -> None:
    store, other = PgStore(postgres_database.url), PgStore(postgres_database.url)
    row = new_map(store, pushed(0, 1))
    tries, is_held = [], threading.Event()

    def job(connection: psycopg.Connection[object]) -> int:
        tries.append(connection)
        if len(tries) == 1:
            connection.execute("SET LOCAL idle_in_transaction_session_timeout TO '300ms'")
        connection.execute("SELECT FROM head WHERE map = %s FOR UPDATE", (row.number,))
        if len(tries) == 1:
            is_held.set()
            until(lambda: fold_pending(other, row, CellCache(row.geometry), limit=9) > 0, "another one folds")
        return len(tries)

    try:
        assert store._connections.run(job) == 2  # type: ignore[arg-type]
        assert is_held.is_set()
    finally:
        other.close()
        store.close()


# Hints


@contextmanager
def heard_hints(store: PgStore) -> Iterator[tuple[FoldHints, list[FoldHint | None]]]:
    """Hints of folds, and what came of them."""
    heard: list[FoldHint | None] = []
    with closing(store.replicas.fold_hints(heard.append)) as hints:
        yield hints, heard


def test_hints_come_again_after_the_connection_was_cut(store: PgStore, postgres_database: Database) -> None:
    row = new_map(store)
    with heard_hints(store) as (hints, heard):
        until(lambda: hints.are_heard, "hints come")
        postgres_database.execute(
            "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity"
            " WHERE application_name = 'cairn' AND datname = current_database()"
        )
        until(lambda: heard.count(None) == 2, "what was missed is said to be")
        until(lambda: is_appended(store, row), "the store has fresh connections")
        fold_pending(store, row, CellCache(SMALL), limit=9)
        until(lambda: FoldHint(row.number, 1) in heard, "the fold is hinted")


def is_appended(store: PgStore, row: MapRow) -> bool:
    """True once a commit is there."""
    with suppress(UnreachableError):
        store.append(row, new_of(pushed(0, 0)))
        return True
    return False


def test_where_notices_do_not_come_back_listening_is_tried_seldom_and_said_once(
    store: PgStore, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As through a pooler in transaction mode: the connection that listens is not the one that is notified."""
    monkeypatch.setattr(postgres_notes, "PROVE_S", 0.01)
    monkeypatch.setattr(postgres_notes, "FIRST_PAUSE_S", 0.01)
    pauses: list[float] = []
    select = postgres_notes.select.select
    monkeypatch.setattr(
        postgres_notes.select, "select", lambda *a: select(*a[:3], min(pauses.append(a[3]) or a[3], 0.01))
    )
    heard: list[FoldHint | None] = []
    elsewhere = Connections(new_database(postgres).url, limit=1)
    with caplog.at_level("INFO"), closing(postgres_notes.PgFoldHints(store.replicas._url, elsewhere, heard.append)):
        until(lambda: len(pauses) >= 17, "it was tried often")
    elsewhere.close()
    assert heard == [] and pauses[:4] == [0.02, 0.04, 0.08, 0.16]
    assert pauses[-1] == postgres_notes.SILENT_PAUSE_S
    assert sum("pooler" in record.getMessage() for record in caplog.records) == 1


# Numbers


def test_a_new_map_in_a_database_of_very_many_commits_is_folded(store: PgStore, postgres_database: Database) -> None:
    # In one statement stand lists of small numbers (entries of the log) and of large ones (commits).
    postgres_database.execute("ALTER TABLE commits ALTER number RESTART WITH 5000000000")
    commits = [pushed(0, 0), pushed(1, 1)]
    row = folded_map(store, *commits)
    assert read(bodies(store, row)) == sum_of(commits)
