"""One map as a file, and back: the commands `cairn serve archive` and `cairn serve unarchive`."""

import argparse
import sys
import tempfile
from pathlib import Path

from cairn_map.errors import EXIT_CODES, BadInputError, NotFoundError
from cairn_map.progress import PercentLine
from cairn_server.operations.backup import verified
from cairn_server.operations.bucket_owner import settings_of_database
from cairn_server.operations.database_map import archive_of_database, restore_to_database
from cairn_server.settings import Settings
from cairn_server.store.folder_lock import lock_folder
from cairn_server.store.sqlite.backup import (
    check_backup,
    copy_checked,
    give_store_to_owner,
    is_backup,
    partial_file,
    scratch_file,
    settle_file,
)
from cairn_server.store.sqlite.files.map_archive import archive_map, restore_map
from cairn_server.store.sqlite.store import FILE_NAME

ARCHIVE = """Copy one map of a server into a file, while the server runs.

    $ cairn serve archive lab lab.cairn --data ./cairn-data
    lab.cairn: map lab, 41.3 MB: 1 maps, 1204 commits, 56 cells

The file holds the whole map: its cells, its log, all commits with signatures and seals, what is kept of their evidence.
It has no tokens in it. It is read and checked before it gets its name. `cairn map delete` may follow.

    $ cairn serve archive lab lab.cairn --store postgresql://cairn@database/cairn

Out of a database it takes the same, with what is in its object store (--objects), while its servers run.
"""
UNARCHIVE = """Bring a map back out of an archive: into a stopped server's store, or into a database at work.

    $ cairn serve unarchive lab.cairn --data ./cairn-data
    map lab is in ./cairn-data: 1 maps, 1204 commits, 56 cells; 4 robots come back by their keys
    $ cairn serve unarchive lab.cairn --store postgresql://cairn@database/cairn

Cells, log and seals are those of the archive, byte for byte, so robots of the map go on where they were: each shows
its key once instead of its old token, by itself, within the hour. The store may have no map of that name; other maps
stay as they are. Tokens of readers and operators are made again with `cairn token create`. It does not matter whether
the archive is from a folder or from a database. For a database it is copied to TMPDIR first, and checked there.
"""


def archive_command(argv: list[str]) -> int:
    """Archive a map."""
    parser = _parser("archive", ARCHIVE)
    parser.add_argument("map", metavar="MAP", help="name of the map")
    parser.add_argument("file", type=Path, metavar="FILE", help="the archive; an older one of that name is replaced")
    args = parser.parse_args(argv)
    store: str | None = args.store
    source = _store_in(args.data) if store is None else None
    if args.file.exists() and ((source and args.file.samefile(source)) or not is_backup(args.file)):
        raise BadInputError("bad_backup", f"{args.file} is there and is no archive; choose another name")
    with partial_file(args.file) as partial:
        if store is not None:
            archive_of_database(store, args.objects, args.map, partial)
        else:
            archive_map(_store_in(args.data), args.map, partial)
        settle_file(partial)
        summary = verified(partial)
    size_mb = args.file.stat().st_size / 1e6
    sys.stdout.write(f"{args.file}: map {args.map}, {size_mb:.1f} MB: {summary}\n")
    return 0


def unarchive_command(argv: list[str]) -> int:
    """Bring an archived map back."""
    parser = _parser("unarchive", UNARCHIVE)
    parser.add_argument("file", type=Path, metavar="FILE", help="a file that `cairn serve archive` made")
    args = parser.parse_args(argv)
    check_backup(args.file)
    if args.store is not None:
        place = settings_of_database(args.store, args.objects).place
        with tempfile.TemporaryDirectory() as folder:
            summary = _checked_copy(args.file, Path(folder) / args.file.name, shown=Path(folder))
            name, robots = restore_to_database(Path(folder) / args.file.name, args.store, args.objects)
    else:
        place, store = str(args.data), _store_in(args.data)
        with lock_folder(args.data), scratch_file(args.data / args.file.name) as scratch:
            summary = _checked_copy(args.file, scratch, shown=store)
            name, robots = restore_map(scratch, store)
            give_store_to_owner(args.data)
    sys.stdout.write(f"map {name} is in {place}: {summary}; {robots} robots come back by their keys\n")
    return 0


def _checked_copy(file: Path, target: Path, *, shown: Path) -> str:
    """Summary of an archive, which is copied, brought up to date, and found to be sound."""
    progress, summary = PercentLine("unarchive"), list[str]()
    copy_checked(file, target, progress.at, lambda path: summary.append(verified(path)), shown=shown)
    progress.finish()
    return summary[0]


def _parser(name: str, description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        f"cairn serve {name}",
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--data", type=Path, default=Settings().folder, metavar="DIR", help="folder of the store")
    parser.add_argument("--store", metavar="URL", help="this PostgreSQL database instead of a folder")
    parser.add_argument("--objects", metavar="URL", help="bucket with the cold bytes of this database (s3://...)")
    return parser


def _store_in(folder: Path) -> Path:
    path = folder / FILE_NAME
    if not path.is_file():
        raise NotFoundError("no_store", f"{folder} has no store; name the folder that `cairn serve --data` works on")
    return path
