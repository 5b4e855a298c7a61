"""Files of a server's store as a whole: the commands `cairn serve backup`, `restore` and `compact`."""

import argparse
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cairn_map.errors import EXIT_CODES, BadInputError, ConflictError, DamagedDataError
from cairn_map.progress import PercentLine
from cairn_server.http.middleware.log_format import LogForm, add_log_format, fields, start_logging
from cairn_server.operations.check import check_all
from cairn_server.settings import Settings
from cairn_server.store.sqlite.archive import SqliteArchive
from cairn_server.store.sqlite.backup import Restored, back_up, restore, send_backup
from cairn_server.store.sqlite.files.compaction import compact

log = logging.getLogger(__name__)

BACKUP = """Copy a server's store into one file, while the server runs.

    $ cairn serve backup --data ./cairn-data nightly.cairn
    nightly.cairn: 41.3 MB, the state of ./cairn-data

    $ cairn serve backup --data ./cairn-data - | ssh vault 'cat > nightly.cairn'

The file holds one state of all maps. It takes its name only when all of it is on the disk, so that an older backup of
that name is there until the new one is whole. `-` is standard output, for a pipe: the folder needs room for a copy of
the store meanwhile, and only exit code 0 says that all of it was sent. Run it as the user that the server runs as.
What is pushed after it is not in it: `cairn serve --stable-after` must be longer than the age of the oldest backup that
you may restore (docs/administrator.md).
"""
RESTORE = """Make a server's folder out of a backup.

    $ cairn serve restore nightly.cairn --data ./restored --old ./cairn-data
    ./restored: restored and checked: 2 maps, 1204 commits, 56 cells
    tokens: 14 count at once, 2 ended since the backup and stay so
    not in the backup: 31 commits, 7 audit lines, 1 tokens of ./cairn-data

The folder must be new or empty, and no server may work on it; everything is read and checked before it gets its
name, and nothing is left of it if it is not sound. Then start `cairn serve --data ./restored` in the old one's place.

Next to each store lies `ended-tokens`, a list of the tokens that were revoked, rotated or deregistered; it is in no
backup. --old names the folder with it: what ended since the backup stays ended. Where that folder is lost, put the file
into the new folder, or leave it: then all tokens of the backup are off until an admin confirms them (`cairn token
confirm`; admins by --admin-token-file always count).

Robots then do the rest by themselves: those whose cursor is newer than the backup cannot prove it, compare fingerprints
cell by cell, and fetch what differs. They push again every commit that the server lost and they still keep, which are
all that were not `stable`. A robot that was registered after the backup must register again (401). Retracts that robots
kept come back in the same way; those that an operator made and no robot heard of must be made again.
"""
BACKUP_INSTEAD = (
    "a store in PostgreSQL is backed up and restored by the database's own tools (pg_basebackup); docs/scale.md, "
    '"Backup, restore, failover", has the commands'
)
NEXT = """Start `cairn serve --data {folder}`. Robots notice by themselves: they compare their cells with the server's,
fetch what differs, and push again what is newer than the backup. Those registered after it must register again.
"""


def back_up_command(argv: list[str]) -> int:
    """Make a backup."""
    parser = argparse.ArgumentParser(
        "cairn serve backup", description=BACKUP, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    _add_folder(parser, instead=BACKUP_INSTEAD)
    parser.add_argument(
        "file", metavar="FILE", help="the backup; an older one of that name is replaced; -: standard output"
    )
    add_log_format(parser)
    args = parser.parse_args(argv)
    is_piped = args.file == "-"
    if is_piped and sys.stdout.isatty():
        raise BadInputError("bad_backup", "a backup is no text: send standard output to a file or into a pipe")
    is_json = args.log_format == LogForm.JSON
    start_logging(LogForm(args.log_format), logging.INFO if is_json else logging.WARNING)
    about = {"file": args.file, "data": str(args.data)}
    log.info("backup begun", extra=fields(**about))
    start_s, progress = time.monotonic(), PercentLine("backup")
    if is_piped:
        size_bytes = send_backup(args.data, sys.stdout.buffer, progress.at)
    else:
        size_bytes = back_up(args.data, Path(args.file), progress.at)
    progress.finish()
    seconds = round(time.monotonic() - start_s, 3)
    log.info("backup done", extra=fields(**about, size_bytes=size_bytes, seconds=seconds))
    if not is_json:
        place, stream = ("standard output", sys.stderr) if is_piped else (args.file, sys.stdout)
        stream.write(f"{place}: {size_bytes / 1e6:.1f} MB, the state of {args.data}\n")
    return 0


TIME_MAX_S = 1e11
"""Latest time that is shown: the year 5138; a client's clock may have said anything."""


def restore_command(argv: list[str]) -> int:
    """Restore a backup."""
    parser = argparse.ArgumentParser(
        "cairn serve restore", description=RESTORE, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="a file that `cairn serve backup` made")
    _add_folder(parser, instead=BACKUP_INSTEAD, what="a new or empty folder")
    parser.add_argument("--old", type=Path, metavar="DIR", help="folder of the server that it replaces")
    args = parser.parse_args(argv)
    progress = PercentLine("restore")
    summary: list[str] = []
    restored = restore(args.file, args.data, progress.at, lambda path: summary.append(verified(path)), old=args.old)
    progress.finish()
    sys.stdout.write(f"{args.data}: restored and checked: {summary[0]}\n")
    for line in _told(restored, args.old):
        sys.stdout.write(f"{line}\n")
    sys.stdout.write(NEXT.format(folder=args.data))
    return 0


def _told(restored: Restored, old: Path | None) -> Iterator[str]:
    """Lines on the tokens of a restored store, and on what the backup has not."""
    if restored.unconfirmed:
        yield (
            f"tokens: ALL {restored.unconfirmed} ARE OFF: nothing says which of them were revoked since the backup. "
            "Look at `cairn token list SERVER`, and let those count that should: `cairn token confirm SERVER NAME`"
        )
    else:
        yield f"tokens: {restored.tokens} count at once, {restored.ended} ended since the backup and stay so"
    if restored.lost is not None:
        lost = ", ".join(f"{count} {what}" for what, count in restored.lost.items())
        yield f"not in the backup: {lost} of {old}"
        return
    newest = datetime.fromtimestamp(min(restored.newest_s, TIME_MAX_S), UTC).strftime("%Y-%m-%d %H:%M:%S")
    when = f"after {newest} UTC" if restored.newest_s else "ever"
    yield f"not in the backup: commits, audit lines and tokens that came {when}; --old DIR would count them"


def verified(path: Path) -> str:
    """Summary of a copy of a store.

    Raises:
        DamagedDataError: kind `damaged_store`: something in it is not sound.
    """
    archive = SqliteArchive(path)
    try:
        outcome = check_all(archive, archive.complaints())
    # Numbers and texts of the right kind that no store writes: a cell below 0, a vector that is no JSON.
    except (ValueError, TypeError, OverflowError, KeyError) as exc:
        raise DamagedDataError("damaged_store", f"the backup is damaged, take another one: {exc}") from exc
    finally:
        archive.close()
    if outcome.findings:
        raise DamagedDataError("damaged_store", f"the backup is damaged, take another one: {outcome.findings[0][1]}")
    return outcome.summary


COMPACT = """Write a stopped server's store again, as small as it can be.

    $ cairn serve compact --data ./cairn-data
    cairn-data: 812.4 MB before, 41.3 MB now

A running server gives room back by itself: what a deleted map or old evidence leaves is used again for what comes, and
where more than an eighth of the file is unused, it shrinks by a megabyte at a time. That holds for stores made by this
version; an older one does so once it was compacted. Compacting leaves no unused room at all. It needs room on the disk
for the smaller file next to the old one, and the server must be stopped; a kill leaves the old file as it was.

A store in PostgreSQL is looked after by the database: autovacuum makes room for what comes, and VACUUM FULL, which
locks the tables, gives it back to the disk.
"""


def compact_command(argv: list[str]) -> int:
    """Compact a store."""
    parser = argparse.ArgumentParser(
        "cairn serve compact", description=COMPACT, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    _add_folder(parser, instead="in PostgreSQL autovacuum makes room, and VACUUM FULL gives it back to the disk")
    args = parser.parse_args(argv)
    try:
        found = compact(args.data)
    except ConflictError as exc:
        raise ConflictError(
            exc.kind, f"a server works on {args.data}, and gives unused room back by itself; stop it to compact"
        ) from exc
    before, after = (f"{size / 1e6:.1f} MB" for size in found)
    sys.stdout.write(f"{args.data}: {before} before, {after} now\n")
    return 0


def _add_folder(parser: argparse.ArgumentParser, *, instead: str, what: str = "folder of the store") -> None:
    """Add the option of the folder; `instead` is what to do for a store in PostgreSQL."""
    parser.add_argument("--data", type=Path, default=Settings().folder, metavar="DIR", help=what)
    for flag in ("--store", "--objects"):
        parser.add_argument(flag, action=_OfDatabase, const=instead, help=argparse.SUPPRESS)


class _OfDatabase(argparse.Action):
    """Refusal of a database, for a command that works on a folder."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option: str | None = None,
    ) -> None:
        raise BadInputError("bad_setting", f"`{parser.prog}` works on a folder (--data): {self.const}")
