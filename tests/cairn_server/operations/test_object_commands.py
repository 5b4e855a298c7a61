"""`cairn serve --store --objects` over a real database and a real object store, which goes away and comes back."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.database_servers import ended, folded, push, served
from tests.fixtures.server.live import Process, until
from tests.fixtures.server.object_store import READER, ObjectPlace
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, pushed

from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import cell_of_key
from cairn_server.operations.serve import main

__all__ = ["ended"]
pytestmark = [pytest.mark.processes, pytest.mark.slow]
COMMITS = [pushed(n, n) for n in range(4)]


@pytest.fixture
def database(newest_postgres: PostgresServer) -> Database:
    """A database for one test."""
    return new_database(newest_postgres)


@pytest.fixture
def place(object_place: ObjectPlace) -> Iterator[ObjectPlace]:
    """A place whose server is running at the end, for other tests."""
    assert object_place.bucket
    yield object_place
    if not object_place.server.is_running:
        object_place.server.start()


@pytest.fixture
def at_once(tmp_path: Path) -> Path:
    """Settings under which everything moves as soon as it is folded."""
    file = tmp_path / "settings.toml"
    file.write_text("settle_cells_s = 0\nsettle_evidence_s = 0\nobjects_grace_s = 0\n")
    return file


def warm(database: Database) -> int:
    """Count of the cells and pieces of evidence whose bytes are in the database."""
    query = "SELECT (SELECT count(body) FROM cell) + (SELECT count(body) FROM diff)"
    return int(str(database.execute(query)[0][0]))


def cell_of(url: str, key: int) -> httpx.Response:
    """The answer for a cell."""
    i, j, k = cell_of_key(key)
    return httpx.get(f"{url}/maps/lab/main/cells/{i},{j},{k}")


def test_a_map_moves_and_is_served_through_the_loss_of_its_object_store(
    database: Database,
    place: ObjectPlace,
    at_once: Path,
    tmp_path: Path,
    ended: list[Process],
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = "--objects", place.url, "--settings", str(at_once)
    url = served(tmp_path / "one", database, ended, *options)
    push(url, *COMMITS[:2])
    until(lambda: folded(url, 2), "it is folded")
    before = [cell_of(url, key).content for key in KEYS]
    until(lambda: warm(database) == 0, "everything moved")
    assert len(place.names()) >= len(KEYS)
    other = served(tmp_path / "two", database, ended, *options, "--no-fold")
    assert [cell_of(other, key).content for key in KEYS] == before
    # Away: what is known stays known, pushes go on, cold cells are refused, and the server is ready.
    place.server.stop()
    push(other, COMMITS[2])
    assert httpx.get(f"{other}/readyz").status_code == 200
    assert {cell_of(other, key).status_code for key in KEYS} <= {200, 503}
    place.server.start()
    until(lambda: folded(url, 3), "what waited is folded")
    until(lambda: warm(database) == 0, "and moved")
    found = re.search(r'cairn_settled_bytes_total\{what="cells"\} (\d+)', httpx.get(f"{url}/metrics").text)
    assert found
    assert int(found[1]) > 0
    assert main(["check", "--store", database.url, "--objects", place.url]) == 0
    assert capsys.readouterr().out == "1 maps, 3 commits, 3 cells: all sound\n"
    until(lambda: len(place.names()) == len(set(place.names())) == named(database), "the others are deleted")


def named(database: Database) -> int:
    """Count of the objects that rows name."""
    query = "SELECT (SELECT count(object) FROM cell) + (SELECT count(*) FROM segment)"
    return int(str(database.execute(query)[0][0]))


def test_a_cell_in_an_object_store_that_is_down_is_503(
    database: Database, place: ObjectPlace, at_once: Path, tmp_path: Path, ended: list[Process]
) -> None:
    options = "--objects", place.url, "--settings", str(at_once)
    url = served(tmp_path / "one", database, ended, *options)
    push(url, COMMITS[0])
    until(lambda: warm(database) == 0 and folded(url, 1), "everything moved")
    other = served(tmp_path / "two", database, ended, *options, "--no-fold")
    place.server.stop()
    key = min(COMMITS[0].cells)
    answer = cell_of(other, key)
    assert (answer.status_code, kind_of(answer)) == (503, "objects_away")
    # A server that is started meanwhile takes pushes, too: of a store that is in that bucket already.
    third = served(tmp_path / "three", database, ended, *options, "--no-fold")
    assert cell_of(third, key).status_code == 503
    push(third, COMMITS[1])
    assert "started without the object store" in ended[-1].said()
    refused = Process(tmp_path / "four", "--store", new_database(database.server).url, *options)
    assert refused.end()[0] == 1
    place.server.start()
    until(lambda: cell_of(other, key).status_code == 200, "the cell is back")


def test_a_place_that_will_not_do_is_refused_with_the_next_step(
    database: Database, place: ObjectPlace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusal(*options: str) -> str:
        code, said = Process(tmp_path / "one", *options).end()
        assert code == 1
        return said

    store = "--store", database.url
    assert "expected a URL like s3://BUCKET/PREFIX" in refusal(*store, "--objects", "http://x")
    assert "SQLite keeps everything" in refusal("--objects", place.url)
    assert "AWS_ENDPOINT_URL" in refusal(*store, "--objects", "s3://there-is-none/x")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", READER)
    assert "cannot write" in refusal(*store, "--objects", place.url)
    assert not place.names()
    tables = "SELECT count(*) FROM pg_class WHERE relnamespace = 'public'::regnamespace"
    assert database.execute(tables) == [(0,)]  # nothing is made for a bucket that will not do
    with pytest.raises(BadInputError, match="--objects: expected a URL"):
        main(["check", "--store", database.url, "--objects", "x"])


def test_a_dump_that_takes_the_place_of_its_original_adopts_the_bucket(
    database: Database,
    place: ObjectPlace,
    at_once: Path,
    tmp_path: Path,
    ended: list[Process],
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = "--objects", place.url, "--settings", str(at_once)
    url = served(tmp_path / "one", database, ended, *options)
    push(url, COMMITS[0])
    until(lambda: warm(database) == 0 and folded(url, 1), "everything moved")
    ended[-1].send(signal.SIGTERM)
    ended.pop().end()
    copy = Database(database.server, f"{database.name}_copy")
    copy.server.execute(f"CREATE DATABASE {copy.name} TEMPLATE {database.name}")
    named_by = "--store", copy.url, "--objects", place.url
    with pytest.raises(DamagedDataError):
        main(["check", *named_by])
    assert "objects: the bucket is not this database's" in capsys.readouterr().out
    url = served(tmp_path / "two", copy, ended, *options)
    push(url, COMMITS[1])
    until(lambda: 'failures_total{what="own"}' in httpx.get(f"{url}/metrics").text, "the bucket is not its own")
    assert warm(copy) > 0
    assert main(["adopt", *named_by]) == 0
    assert "until now by database" in capsys.readouterr().out
    until(lambda: warm(copy) == 0 and folded(url, 2), "everything moved")
    assert main(["check", *named_by]) == 0
    with pytest.raises(BadInputError, match="another store"):
        main(["adopt", "--store", new_database(database.server).url, "--objects", place.url])
