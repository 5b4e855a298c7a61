"""One map as a file, and back: the commands `cairn serve archive` and `cairn serve unarchive`."""

import argparse
import sys
from pathlib import Path

from cairn_map.errors import EXIT_CODES, BadInputError, NotFoundError
from cairn_map.progress import PercentLine
from cairn_server.operations.backup import verified
from cairn_server.settings import Settings
from cairn_server.store.folder_lock import lock_folder
from cairn_server.store.sqlite.backup import (
    check_backup,
    copy_checked,
    is_backup,
    partial_file,
    scratch_file,
    settle_file,
)
from cairn_server.store.sqlite.files.map_archive import archive_map, restore_map
from cairn_server.store.sqlite.store import FILE_NAME

ARCHIVE = """Copy one map of a server into a file, while the server runs.

    $ cairn serve archive lab lab.cairn --data ./cairn-data
    lab.cairn: map lab, 41.3 MB: 1 map, 1204 commits, 56 cells

The file holds the whole map: its cells, its log, all commits with signatures and seals, what is kept of their evidence.
It has no tokens in it. It is read and checked before it gets its name. `cairn map delete` may follow.

A map in PostgreSQL goes to a server with a folder first, with `cairn map copy`.
"""
UNARCHIVE = """Bring a map back out of an archive into a stopped server's store.

    $ cairn serve unarchive lab.cairn --data ./cairn-data
    map lab is in ./cairn-data: 1 map, 1204 commits, 56 cells; 4 robots come back by their keys

Cells, log and seals are those of the archive, byte for byte, so robots of the map go on where they were: each shows
its key once instead of its old token, by itself, within the hour. The store may have no map of that name; other maps
stay as they are. Tokens of readers and operators are made again with `cairn token create`.
"""


def archive_command(argv: list[str]) -> int:
    """Archive a map."""
    parser = _parser("archive", ARCHIVE)
    parser.add_argument("map", metavar="MAP", help="name of the map")
    parser.add_argument("file", type=Path, metavar="FILE", help="the archive; an older one of that name is replaced")
    args = parser.parse_args(argv)
    source = _store_in(args.data)
    if args.file.exists() and (args.file.samefile(source) or not is_backup(args.file)):
        raise BadInputError("bad_backup", f"{args.file} is there and is no archive; choose another name")
    with partial_file(args.file) as partial:
        archive_map(source, args.map, partial)
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
    store = _store_in(args.data)
    progress = PercentLine("unarchive")
    summary: list[str] = []
    with lock_folder(args.data), scratch_file(args.data / args.file.name) as scratch:
        copy_checked(
            args.file, scratch, progress.at, lambda path: summary.append(verified(path)), shown=args.data / FILE_NAME
        )
        progress.finish()
        name, robots = restore_map(scratch, store)
    sys.stdout.write(f"map {name} is in {args.data}: {summary[0]}; {robots} robots come back by their keys\n")
    return 0


def _parser(name: str, description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        f"cairn serve {name}",
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--data", type=Path, default=Settings().folder, metavar="DIR", help="folder of the store")
    return parser


def _store_in(folder: Path) -> Path:
    path = folder / FILE_NAME
    if not path.is_file():
        raise NotFoundError("no_store", f"{folder} has no store; name the folder that `cairn serve --data` works on")
    return path
