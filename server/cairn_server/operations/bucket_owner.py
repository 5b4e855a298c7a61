"""Make a database the owner of its bucket.

    $ cairn serve adopt --store postgresql://cairn@database/cairn --objects s3://BUCKET/maps
    s3://BUCKET/maps: owned by postgresql://cairn@database/cairn from now on; until now by database 7575.../16384,
    which worked on it until 2026-11-24 12:00:00 UTC
    End the servers of that database if it is another one.

Of all copies of a database only the owner moves bytes into the bucket and deletes objects there; a server on another
one reads, and says in its log that the bucket is not its own. A standby that became the primary goes on by itself.
After a restore, a move by a dump or an upgrade by `pg_upgrade` the new database is made the owner by this command,
once; its servers may run.
"""

import argparse
import sys
from contextlib import closing

from pydantic import ValidationError

from cairn_map.errors import EXIT_CODES, BadInputError, first_error
from cairn_server.operations.store_opening import store_of
from cairn_server.settings import Settings


def adopt_command(argv: list[str]) -> int:
    """Adopt a bucket."""
    parser = argparse.ArgumentParser(
        "cairn serve adopt", description=__doc__, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--store", required=True, metavar="URL", help="database that is to own the bucket")
    parser.add_argument("--objects", required=True, metavar="URL", help="its bucket (s3://...)")
    args = parser.parse_args(argv)
    settings = settings_of_database(args.store, args.objects)
    open_store, _ = store_of(settings)
    open_store().close()  # refuses the bucket of another store
    from cairn_server.store.objects.bucket import open_bucket
    from cairn_server.store.postgres.connections import Connections
    from cairn_server.store.settling.ownership import adopt, time_text

    with closing(Connections(args.store, limit=1)) as connections:
        before = adopt(connections, open_bucket(args.objects))
    sys.stdout.write(f"{args.objects}: owned by {settings.place} from now on")
    if before is not None:
        sys.stdout.write(f"; until now by database {before.database},\nwhich worked on it until {time_text(before)}\n")
        sys.stdout.write("End the servers of that database if it is another one.")
    sys.stdout.write("\n")
    return 0


def bucket_complaints(store: str, objects: str | None) -> list[str]:
    """Complaint about a bucket that is another database's; empty if it is this one's, or there is none.

    Raises:
        AwayError: the object store does not answer.
    """
    if objects is None:
        return []
    from cairn_server.store.objects.bucket import open_bucket
    from cairn_server.store.postgres.connections import Connections
    from cairn_server.store.settling.ownership import check_owner

    with closing(Connections(store, limit=1)) as connections:
        try:
            check_owner(connections, open_bucket(objects))
        except BadInputError as exc:
            return [exc.message]
    return []


def settings_of_database(store: str, objects: str | None) -> Settings:
    """Settings of a command that works on a database.

    Raises:
        BadInputError: kind `bad_setting`: a URL is none.
    """
    try:
        return Settings(store=store, objects=objects)
    except ValidationError as exc:
        raise BadInputError("bad_setting", f"--{first_error(exc)}") from exc
