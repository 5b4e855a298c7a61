"""Bond of a store and its bucket: one id in both, so that a wrong bucket is refused at the start.

The first server that is started with --objects makes it. The bucket may move: what counts is the object that marks it.
All copies of a database have its id; which of them may write there is the matter of `ownership`.
"""

import secrets
from contextlib import closing, suppress

from cairn_map.errors import BadInputError
from cairn_server.store.objects.bucket import Bucket
from cairn_server.store.objects.cold_bytes import MARK, AwayError
from cairn_server.store.postgres.connections import Connection, Connections, first
from cairn_server.store.postgres.schema import BOUND_OLDEST

PROBE = b"cairn"


def try_bucket(bucket: Bucket, url: str) -> None:
    """Write, read, list and delete an object, before anything is made in a database for it.

    Raises:
        BadInputError: kind `bad_objects`: the bucket cannot be reached, written, read, listed or deleted from.
    """
    name = f"probes/{secrets.token_hex(8)}"
    try:
        bucket.put(name, PROBE)
        if bucket.part(name, start=1, size_bytes=len(PROBE) - 1) != PROBE[1:]:
            raise AwayError(f"what was written as {name} cannot be read")
        if not any(name in page for page in bucket.names("probes")):
            raise AwayError(f"what was written as {name} is not listed")
        bucket.delete(name)
    except AwayError as exc:
        with suppress(AwayError):
            bucket.delete(name)
        raise _bad(url, exc.message) from exc


def bind(connections: Connections, bucket: Bucket, url: str) -> None:
    """Bind a database to a bucket that was tried (`try_bucket`), or find them bound.

    Raises:
        BadInputError: kind `bad_objects`: it is another store's.
        CairnError: the database or the bucket does not answer.
    """
    with connections.lent() as connection:
        known = first(connection, "SELECT id FROM object_store")
        # A settler claims before it makes its first object.
        is_used = first(connection, "SELECT 1 FROM object_store WHERE holder IS NOT NULL") is not None
    found = bucket.get(MARK)
    mark = None if found is None else found.decode(errors="replace")
    if mark is not None and mark != known:
        raise _bad(url, "it has the bytes of another store; name an empty prefix, s3://BUCKET/PREFIX")
    if mark is None and is_used:
        raise _bad(url, "it does not have the bytes of this store; name the bucket and prefix that were used until now")
    if mark is None:
        bucket.put(MARK, connections.run(lambda connection: _note(connection, url)).encode())
    elif known is not None:
        with connections.lent() as connection:
            connection.execute("UPDATE object_store SET url = %s WHERE url <> %s", (url, url))


def is_bound(store_url: str, url: str) -> bool:
    """True if a database, which may have no tables yet, has its bytes in the bucket of this URL.

    Raises:
        CairnError: the database does not answer.
    """
    with closing(Connections(store_url, limit=1)) as connections, connections.lent() as connection:
        if not first(connection, "SELECT to_regclass('object_store') IS NOT NULL"):
            return False
        return bool(first(connection, "SELECT url FROM object_store") == url)


def _note(connection: Connection, url: str) -> str:
    """Note the bond; its id, which another server may have drawn."""
    connection.execute("UPDATE cairn_schema SET oldest = greatest(oldest, %s)", (BOUND_OLDEST,))
    query = "INSERT INTO object_store (one, id, url) VALUES (true, %s, %s) ON CONFLICT (one) DO NOTHING"
    connection.execute(query, (secrets.token_hex(16), url))
    return str(first(connection, "SELECT id FROM object_store"))


def _bad(url: str, why: str) -> BadInputError:
    return BadInputError(
        "bad_objects",
        f"--objects {url}: {why}. Credentials and endpoint are taken from AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, "
        "AWS_REGION and AWS_ENDPOINT_URL; the key has to write, read, list and delete objects",
    )
