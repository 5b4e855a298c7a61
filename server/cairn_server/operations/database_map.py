"""One map of a database as an archive, and an archive as a map of a database, while its servers run."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from cairn_server.operations.bucket_owner import settings_of_database
from cairn_server.operations.store_opening import store_of
from cairn_server.store.objects.cold_bytes import ColdReads, NoObjects
from cairn_server.store.sqlite.files.map_archive import archived_rows, opened_archive, write_archive

if TYPE_CHECKING:
    from cairn_server.store.postgres.connections import Connections


def archive_of_database(store: str, objects: str | None, name: str, target: Path) -> None:
    """Copy the map of a name out of a database, on which servers may work, into an empty store.

    Raises:
        NotFoundError: kind `no_map`.
        AwayError: the object store does not answer.
        BadInputError: kind `disk_full`; `bad_store`: there is no such database.
    """
    with _opened(store, objects) as (connections, bucket), connections.snapshot() as connection:
        from cairn_server.store.postgres.files.map_file import archive_rows

        age_s, tables = archive_rows(connection, name, bucket)
        write_archive(target, age_s, tables)


def restore_to_database(archive: Path, store: str, objects: str | None) -> tuple[str, int]:
    """Copy the map of an archive, which was checked, into a database, on which servers may work.

    Its name, and the count of the robots that may come back by their keys.

    Raises:
        ConflictError: kind `map_exists`: the store has a map of that name; `older_servers`.
        BadInputError: kind `bad_backup`: there is not one map in it; `bad_store`: there is no such database.
    """
    with _opened(store, objects) as (connections, _), opened_archive(archive) as source:
        from cairn_server.store.postgres.files.map_file import put_map

        return put_map(connections, lambda: archived_rows(source))


@contextmanager
def _opened(store: str, objects: str | None) -> Iterator[tuple["Connections", ColdReads]]:
    """Connection to a database, and its object store, of which both are found to be fit first."""
    open_store, _ = store_of(settings_of_database(store, objects))
    open_store().close()
    from cairn_server.store.postgres.connections import Connections

    bucket: ColdReads = NoObjects()
    if objects is not None:
        from cairn_server.store.objects.bucket import open_bucket

        bucket = open_bucket(objects)
    with closing(Connections(store, limit=1)) as connections:
        yield connections, bucket
