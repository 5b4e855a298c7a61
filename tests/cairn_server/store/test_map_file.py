"""A map goes between folders and databases as one archive: cells, log and seals, byte for byte; its robots go on."""

from contextlib import closing
from pathlib import Path

import pytest
from tests.fixtures.server.archived_map import COMMITS, answers, filled, tables_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.postgres import PostgresServer, new_database
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.settled_store import ColdStore, SwitchedBucket

from cairn_map.errors import ConflictError, NotFoundError
from cairn_server.operations.serve import main
from cairn_server.store.postgres.connections import Connections
from cairn_server.store.postgres.files.map_file import archive_rows
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.sqlite.backup import settle_file
from cairn_server.store.sqlite.files.map_archive import write_archive
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow

pytestmark = pytest.mark.slow


def goes_on(live: Live, row: MapRow) -> None:
    """A map that came back takes commits, knows those that it has, and takes them out."""
    made = live.service.store.map(row.name)
    assert made.seal_key == row.seal_key
    assert live.push(made, pushed(9, 2)).status_code == 201
    assert live.push(made, COMMITS[5]).status_code == 200
    assert live.retract(made, COMMITS[2]).status_code == 201
    live.folded(made)


def test_folder_to_database_and_back_is_the_identity(newest_postgres: PostgresServer, tmp_path: Path) -> None:
    data, url = tmp_path / "data", new_database(newest_postgres).url
    with Live(data, store=SqliteStore(data)) as live:
        row = filled(live)
        told = answers(live, row)
    main(["archive", row.name, str(tmp_path / "a"), "--data", str(data)])
    with Live(tmp_path / "other", store=PgStore(url)) as live:
        filled(live)  # of another name, and with numbers of its own
        live.service.maps.delete(live.service.store.map("map0"), by="admin")
        main(["unarchive", str(tmp_path / "a"), "--store", url])
        with pytest.raises(ConflictError) as refusal:
            main(["unarchive", str(tmp_path / "a"), "--store", url])
        assert refusal.value.kind == "map_exists"
        main(["archive", row.name, str(tmp_path / "b"), "--store", url])
        # A column of former versions, which nothing reads.
        there, here = (tables_of(tmp_path / name, row.name, "operator") for name in "ba")
        assert there == here
        assert answers(live, row) == told
        goes_on(live, row)
        assert main(["check", "--store", url]) == 0
    with pytest.raises(NotFoundError, match="has no map 'nowhere'"):
        main(["archive", "nowhere", str(tmp_path / "c"), "--store", url])
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("is_cold", [False, True], ids=["warm", "cold"])
def test_a_map_of_a_database_comes_back_in_a_folder(
    is_cold: bool, newest_postgres: PostgresServer, tmp_path: Path
) -> None:
    url, bucket, data = new_database(newest_postgres).url, SwitchedBucket(), tmp_path / "data"
    store = ColdStore(url, bucket) if is_cold else PgStore(url)
    with Live(tmp_path / "site", store=store) as live:
        row = filled(live)
        told = answers(live, row)
        if isinstance(store, ColdStore):
            store.settle(row)
        assert bool(bucket.objects()) == is_cold
        with closing(Connections(url, limit=1)) as connections, connections.snapshot() as connection:
            write_archive(tmp_path / "a", *archive_rows(connection, row.name, bucket))
        settle_file(tmp_path / "a")
    with Live(data, store=SqliteStore(data)):
        pass
    main(["unarchive", str(tmp_path / "a"), "--data", str(data)])
    with Live(data, store=SqliteStore(data)) as live:
        assert answers(live, row) == told
        goes_on(live, row)
