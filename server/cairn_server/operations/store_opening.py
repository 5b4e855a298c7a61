"""Opening of the store that settings name: SQLite in a folder, or a PostgreSQL database."""

from collections.abc import Callable
from functools import partial

from cairn_map.errors import BadInputError
from cairn_server.folding.folding import FoldReads
from cairn_server.settings import Settings
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store import Store

FOLD_CONNECTIONS = 4
"""Connections to the database of the process that plans folds: it has two threads."""


def store_of(settings: Settings) -> tuple[Callable[[], Store], Callable[[], FoldReads]]:
    """Function that opens the store, and one that opens what the process that folds reads of it.

    Raises:
        BadInputError: kind `bad_setting`: the package for PostgreSQL is not installed.
    """
    if settings.store is None:
        file = settings.folder / FILE_NAME
        return partial(SqliteStore, settings.folder), lambda: SqliteReads(Readers(file))
    try:
        from cairn_server.store.postgres.connections import Connections
        from cairn_server.store.postgres.reads import PgReads
        from cairn_server.store.postgres.store import PgStore
    except ImportError as exc:
        raise BadInputError(
            "bad_setting", "--store postgresql://... takes psycopg: pip install 'cairn-robotics[postgresql]'"
        ) from exc
    url = settings.store
    return partial(PgStore, url), lambda: PgReads(Connections(url, limit=FOLD_CONNECTIONS))
