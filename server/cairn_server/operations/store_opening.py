"""Opening of the store that settings name: SQLite in a folder, or PostgreSQL with or without an object store behind."""

import logging
import secrets
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from pathlib import Path

from cairn_map.errors import BadInputError, ConflictError
from cairn_server.folding.folding import FoldReads
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.backup_note import NOTE_NAME
from cairn_server.store.folder_lock import LOCK_NAME
from cairn_server.store.sqlite.ended_tokens import LIST_NAME
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store import Store

log = logging.getLogger(__name__)

OWN_NAMES = frozenset({LOCK_NAME, LIST_NAME, NOTE_NAME, "kernels", "lost+found"})
"""Names next to a store: compiled kernels come before it; and that of a new file system."""
NAMED_MAX = 3
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


def opened(open_store: Callable[[], Store], settings: Settings) -> Store:
    """The open store; one without maps is announced, since it may be there by mistake.

    A server that finds no maps where many were looks like a healthy one: to robots, probes and the page.

    Raises:
        ConflictError: kind `not_empty`: the folder has no store, and files of others.
        CairnError: the store's own.
    """
    what = f"the store in {settings.place} has no maps"
    if settings.store is None:
        what = _news_of_folder(settings.folder) or what
    store = open_store()
    if not store.maps():
        flag = "--store" if settings.store is not None else "--data"
        log.warning("%s: if it should have some, stop, and see whether %s is right and its disk is mounted", what, flag)
    return store


def _news_of_folder(folder: Path) -> str | None:
    """Text on the store that is to be made in a folder; None if there is one.

    Raises:
        ConflictError: kind `not_empty`.
        BadInputError: kind `bad_store`: the folder cannot be read.
    """
    try:
        if (folder / FILE_NAME).exists():
            return None
        if not folder.exists():
            return f"{folder} is new, and so is the store in it, without maps"
        found = sorted(
            path.name
            for path in folder.iterdir()
            if path.name not in OWN_NAMES and not path.name.startswith((".", FILE_NAME))
        )
    except OSError as exc:
        raise BadInputError("bad_store", f"cannot keep a store in {folder}: {exc.strerror}") from exc
    if found:
        raise ConflictError(
            "not_empty",
            f"{folder} has no store, but other files ({', '.join(found[:NAMED_MAX])}): name the folder that the maps "
            f"are in, or one for them alone, such as --data {folder / 'cairn-data'}",
        )
    return f"the store in {folder} is new, without maps"


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
