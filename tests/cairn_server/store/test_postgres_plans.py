"""What the store asks of PostgreSQL: no query reads through a table that grows with the map, no key spans maps.

Queries are asked for few rows each: for many of them PostgreSQL may rightly read through a table of this size. Nothing
is used that databases which only speak its language lack, so that maps can be spread over several one day.
"""

import ast
import json
import math
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psycopg
import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.postgres import Database
from tests.fixtures.server.pushes import MOLE

from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY
from cairn_map.evidence.grid import Cell, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store import postgres, settling
from cairn_server.store.postgres import connections, health, reads, retention, snapshot, tile_rows
from cairn_server.store.postgres.connections import Connection
from cairn_server.store.postgres.snapshot import PgSnapshot
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.store_rows import MapRow

pytestmark = [pytest.mark.processes, pytest.mark.slow]

COMMITS, SIDE = 20_000, 64
MARK = COMMITS - 50
KEYS = [cell_key((i, j, 0)) for i in range(SIDE) for j in range(SIDE)]
FILL = """
INSERT INTO commits (map, robot, incarnation, n, sha, size_bytes, cells, bricks, meta, retracts, regions, tops,
    received_s, received_age_s, folded_age_s, folded_seq, captured_last_s)
SELECT {map}, 'mole', '0123456789abcdef', n, sha256('x'), 9, 1, 0, '', '', '{{}}', '{{}}', n, n, n, n + 1, n
FROM generate_series(0, {commits} - 1) AS n;
INSERT INTO log SELECT map, folded_seq, '+', number, substr(sha, 1, 16) FROM commits;
INSERT INTO diff SELECT map, 0, number, n, 'abc' FROM commits;
INSERT INTO cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, body, stamps)
SELECT {map}, key, place * 4, sha256('y'), substr(sha256('z'), 1, 16), 1, 9, 'abc', ''
FROM unnest('{{{keys}}}'::bigint[]) WITH ORDINALITY AS k (key, place);
INSERT INTO tile (map, tile, lm, cells, size_bytes, fingerprint)
SELECT map, cell >> 6, max(lm), count(*), sum(size_bytes), substr(sha256('z'), 1, 16) FROM cell GROUP BY 1, 2;
INSERT INTO touched SELECT {map}, 0, ('{{{keys}}}'::bigint[])[1 + n % {side}], n + 1, '+', robot, incarnation, n, 9
FROM commits;
UPDATE head SET seq = {commits}, folded = {commits}, chain = (SELECT chain FROM log WHERE seq = {commits})
WHERE map = {map};
"""


@pytest.fixture
def store(postgres_database: Database) -> Iterator[PgStore]:
    """A store with a map of thousands of commits and cells."""
    with closing(PgStore(postgres_database.url)) as made:
        row, _ = made.create_map("large", SMALL, SensorModel())
        keys = ",".join(map(str, KEYS))
        values = {"map": row.number, "commits": COMMITS, "side": SIDE, "keys": keys}
        with psycopg.connect(postgres_database.url) as connection:
            connection.execute(FILL.format(**values))  # type: ignore[call-overload]
            vector = EMPTY.with_commits(CommitId(MOLE, n) for n in range(MARK))
            mark = (row.number, MARK, json.dumps(vector.to_json()))
            connection.execute("INSERT INTO vector_mark VALUES (%s, %s, %s)", mark)
        postgres_database.execute("VACUUM ANALYZE")
        yield made


@pytest.fixture
def scanned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Tables of commits and cells that were read through, each with the query."""
    found: list[str] = []

    def watched(run: Callable[..., Any]) -> Callable[..., Any]:
        def explained(connection: Connection, query: str, values: Any = ()) -> Any:
            plan = connection.execute(f"EXPLAIN {query}", values).fetchall()
            text = "\n".join(line for (line,) in plan)
            found.extend(
                f"{table}: {query}" for table in re.findall(r"Seq Scan on (commits|diff|log|touched|cell)\b", text)
            )
            return run(connection, query, values)

        return explained

    for module in (health, reads, retention, snapshot, tile_rows):
        for name in ("rows", "first"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, watched(getattr(connections, name)))
    return found


def test_no_query_of_a_snapshot_reads_through_commits_or_cells(store: PgStore, scanned: list[str]) -> None:
    row = store.map("large")
    some = [CommitId(MOLE, n) for n in range(50)]
    corner = Cell(0, 0, 0)
    read: list[Callable[[PgSnapshot], object]] = [
        lambda s: s.vector_at(COMMITS),
        lambda s: s.vector_at(COMMITS - 30),
        lambda s: list(s.cells(after_seq=4 * len(KEYS) - 100)),
        lambda s: list(s.cells(after_seq=5, box=(corner, Cell(4, 4, 0)))),
        lambda s: s.fingerprint_sum((corner, Cell(7, 8, 0))),
        lambda s: list(s.cells(after_key=KEYS[9], limit=20)),
        lambda s: s.cells_of(KEYS[:9]),
        lambda s: s.cell(KEYS[5]),
        lambda s: s.contributions(KEYS[5], after_seq=100, newest=9),
        lambda s: s.named(some),
        lambda s: s.touched_cells(some),
        lambda s: s.diff(some[7], KEYS[5]),
        lambda s: s.tip(MOLE),
        lambda s: s.newest_captured_s(),
        lambda s: s.pending(),
        lambda s: s.seq_before(9000.5),
        lambda s: s.log(after_seq=COMMITS - 50, limit=20),
        lambda s: s.chained(after_seq=100, limit=20),
        lambda s: s.totals(),
    ]
    with store.snapshot(row) as found:
        for each in read:
            each(found)
    assert scanned == []


def test_no_query_outside_of_snapshots_reads_through_commits(store: PgStore, scanned: list[str]) -> None:
    row = store.map("large")
    idle: list[MapRow] = store.waiting_maps()
    assert idle == [] and store.pending(row, limit=9, size_bytes_max=1) == []
    store.maps_with_evidence(before_s=9000.0)
    store.heads()
    store.commit(row, CommitId(MOLE, 7))
    store.health.backlogs()
    store.uses.since(COMMITS - 9.0)
    store.forget_evidence(row, before_s=9000.0, limit=9)
    assert scanned == []


def test_chains_of_the_entries_of_a_vector_are_not_asked_for_again(
    store: PgStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    execute = psycopg.Connection.execute

    def counted(self: Connection, query: Any, *args: Any, **options: Any) -> Any:
        asked.append(query)
        return execute(self, query, *args, **options)

    with store.snapshot(store.map("large")) as found:
        entries = found.chained(after_seq=COMMITS - 50, limit=50)
        with monkeypatch.context() as counting:
            counting.setattr(psycopg.Connection, "execute", counted)
            chains = [found.chain_at(entry.seq) for entry in entries]
    assert chains == [entry.chain for entry in entries] and len(chains) == 50
    assert asked == []


def test_idle_maps_cost_probes_and_metrics_no_statement(
    store: PgStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    execute = psycopg.Connection.execute
    service = Service(store, Settings(folder=tmp_path, folding="elsewhere"))

    def counted(self: Connection, query: Any, *args: Any, **options: Any) -> Any:
        asked.append(query)
        return execute(self, query, *args, **options)

    def statements() -> int:
        service._full_authors_until_s = service.readiness._looked_s = -math.inf
        asked.clear()
        with monkeypatch.context() as counting:
            counting.setattr(psycopg.Connection, "execute", counted)
            service.metrics_text()
            service.readiness.reasons()
        return len(asked)

    assert service.watch is not None
    service.watch.close()  # it asks by itself
    statements()
    before = statements()
    for n in range(50):
        store.create_map(f"idle{n}", SMALL, SensorModel())
    assert statements() == before < 20
    monkeypatch.setattr(store, "close", lambda: None)  # by the fixture
    service.close()


OF_THE_STORE = {"map", "token", "gone_map_name", "gone_token", "dead_object_since"}
"""Tables and an index whose keys find a map, or what is due in any: those of a directory, were maps spread."""
KEYS_OF_TABLES = """
    SELECT table_.relname, index_.relname,
        array(SELECT attname FROM unnest(i.indkey::int2[]) WITH ORDINALITY AS k (n, place)
            JOIN pg_attribute ON attrelid = i.indrelid AND attnum = k.n ORDER BY place)::text
    FROM pg_index AS i JOIN pg_class AS table_ ON table_.oid = indrelid
        JOIN pg_class AS index_ ON index_.oid = indexrelid
    WHERE table_.relnamespace = 'public'::regnamespace AND EXISTS (
        SELECT FROM pg_attribute WHERE attrelid = table_.oid AND attname = 'map' AND NOT attisdropped)
"""
STATEMENT = re.compile(r"\b(SELECT|INSERT|UPDATE|DELETE|CREATE|ALTER|LOCK|DROP)\b")
FOREIGN_TO_MANY = re.compile(
    r"advisory|SKIP LOCKED|nextval|currval|lastval|setval|\bSERIAL\b|\bREFERENCES\b|CREATE\s+(OR REPLACE\s+)?"
    r"(TRIGGER|FUNCTION|PROCEDURE|EXTENSION|RULE)|\blo_(import|create|put|get)",
    re.IGNORECASE,
)
"""What is in no statement: locks that no row has, sequences that are read, and what is the database's program."""


def test_every_key_begins_with_the_map_and_those_of_cells_have_room_for_a_layer(
    postgres_database: Database,
) -> None:
    PgStore(postgres_database.url).close()
    rows = postgres_database.execute(KEYS_OF_TABLES)
    found = [(str(table), str(index), re.findall(r"\w+", str(columns))) for table, index, columns in rows]
    tables = {table for table, *_ in found}
    assert {"commits", "log", "cell", "diff", "touched", "tile", "head", "author", "lease"} <= tables
    for table, index, columns in found:
        if not {table, index} & OF_THE_STORE:
            assert columns[0] == "map", (index, columns)
        if {"cell", "tile"} & set(columns) and table != "settled":
            assert "layer" in columns, (index, columns)


def test_the_database_has_no_program_of_its_own_and_no_key_across_tables(postgres_database: Database) -> None:
    of_public = "pronamespace = 'public'::regnamespace"
    PgStore(postgres_database.url).close()
    for query in (
        "SELECT tgname FROM pg_trigger WHERE NOT tgisinternal",
        f"SELECT proname FROM pg_proc WHERE {of_public}",
        "SELECT conname FROM pg_constraint WHERE contype = 'f'",
        "SELECT relname FROM pg_class WHERE relkind = 'S' AND relname NOT IN ('map_map_seq', 'commits_number_seq')",
    ):
        assert postgres_database.execute(query) == []


def test_no_statement_takes_what_other_databases_of_this_language_lack() -> None:
    rooms = [Path(postgres.__file__).parent, Path(settling.__file__).parent]
    texts = [
        (path.name, str(node.value))
        for room in rooms
        for path in sorted(room.glob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and STATEMENT.search(node.value)
    ]
    assert len(texts) > 100
    assert [(name, text) for name, text in texts if FOREIGN_TO_MANY.search(text)] == []
    # One connection of its own listens, which is never lent to anybody else.
    listening = [name for room in rooms for name in room.glob("*.py") if re.search(r"LISTEN \{", name.read_text())]
    assert [path.name for path in listening] == ["replica_notes.py"]
