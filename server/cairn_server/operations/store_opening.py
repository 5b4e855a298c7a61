"""Opening of the store that settings name: SQLite in a folder, or PostgreSQL with or without an object store behind."""

import logging
import secrets
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial

from cairn_map.errors import BadInputError
from cairn_server.folding.folding import FoldReads
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store import Store

log = logging.getLogger(__name__)

FOLD_CONNECTIONS = 4
"""Connections to the database of the process that plans folds: it has two threads."""
SETTLE_CONNECTIONS = 2
"""Those of the thread that moves bytes to the object store."""


def store_of(settings: Settings) -> tuple[Callable[[], Store], Callable[[], FoldReads]]:
    """Function that opens the store, and one that opens what the process that folds reads of it.

    Raises:
        BadInputError: kind `bad_setting`: the package for PostgreSQL, or for object stores, is not installed.
    """
    if settings.store is None:
        file = settings.folder / FILE_NAME
        return partial(SqliteStore, settings.folder), lambda: SqliteReads(Readers(file))
    try:
        from cairn_server.store.postgres.connections import Connections
        from cairn_server.store.postgres.reads import PgReads
        from cairn_server.store.postgres.store import PgStore
    except ImportError as exc:
        raise _not_installed("--store postgresql://...", "psycopg", "postgresql") from exc
    url, size_bytes_max = settings.store, settings.database_bytes_max
    if settings.objects is None:
        return (
            partial(PgStore, url, size_bytes_max=size_bytes_max),
            lambda: PgReads(Connections(url, limit=FOLD_CONNECTIONS)),
        )
    try:
        from cairn_server.store.objects.bucket import open_bucket
        from cairn_server.store.objects.read_ahead import ReadAhead
        from cairn_server.store.settling.binding import bind, is_bound, try_bucket
    except ImportError as exc:
        raise _not_installed("--objects s3://...", "obstore", "objects") from exc
    place = settings.objects

    # A bucket has threads: each process opens its own, after it was forked.
    def open_store() -> Store:
        bucket, is_away = open_bucket(place), False
        try:
            try_bucket(bucket, place)
        except BadInputError as exc:
            # A store that is in it already goes on without it: what is not cold can be had, and robots can push.
            is_away = bucket.failures > 0 and is_bound(url, place)
            if not is_away:
                raise
            log.error("started without the object store, which does not answer: %s", exc.message)
        store = PgStore(url, objects=bucket, size_bytes_max=size_bytes_max)
        try:
            with closing(Connections(url, limit=1)) as connections:
                if not is_away:
                    bind(connections, bucket, place)
        except BaseException:
            store.close()
            raise
        return store

    return open_store, lambda: PgReads(Connections(url, limit=FOLD_CONNECTIONS), ahead=ReadAhead(open_bucket(place)))


def settling(service: Service) -> AbstractContextManager[object]:
    """Move bytes at rest to the object store for the length of a `with`, where this server is to do so."""
    settings = service.settings
    if settings.store is None or settings.objects is None or settings.folding == "elsewhere":
        return nullcontext()
    from cairn_server.operations.settle_thread import SettleThread, look_s_of
    from cairn_server.store.objects.bucket import open_bucket
    from cairn_server.store.postgres.connections import Connections
    from cairn_server.store.settling.settler import Settler

    connections = Connections(settings.store, limit=SETTLE_CONNECTIONS)
    bucket, holder = open_bucket(settings.objects), secrets.token_hex(8)
    return SettleThread(service, Settler(connections, bucket, holder=holder, turn_s=look_s_of(settings)))


def _not_installed(flag: str, package: str, extra: str) -> BadInputError:
    return BadInputError("bad_setting", f"{flag} takes {package}: pip install 'cairn-robotics[{extra}]'")
