"""Copy a server's store into one file, while the server runs.

    $ cairn serve backup --data ./cairn-data nightly.cairn
    nightly.cairn: 41.3 MB, the state of ./cairn-data

The file holds one state of all maps. It takes its name only when all of it is on the disk, so that an older backup of
that name is there until the new one is whole. Run it as the user that the server runs as. What is pushed after it
is not in it: `cairn serve --stable-after` must be longer than the age of the oldest backup that you may restore
(docs/administrator.md).
"""

import argparse
import sys
from pathlib import Path

from cairn_map.errors import EXIT_CODES
from cairn_map.progress import PercentLine
from cairn_server.settings import Settings
from cairn_server.store.sqlite.backup import back_up


def main(argv: list[str]) -> int:
    """Make a backup."""
    parser = argparse.ArgumentParser(
        "cairn serve backup", description=__doc__, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Settings().folder, metavar="DIR", help="folder of the store")
    parser.add_argument("file", type=Path, metavar="FILE", help="the backup; an older one of that name is replaced")
    args = parser.parse_args(argv)
    progress = PercentLine("backup")
    size_bytes = back_up(args.data, args.file, progress.at)
    progress.finish()
    sys.stdout.write(f"{args.file}: {size_bytes / 1e6:.1f} MB, the state of {args.data}\n")
    return 0
