"""Copy a map into a folder of this machine.

    $ cairn clone http://127.0.0.1:8750/maps/lab
    lab: 34 cells, 412873 known voxels, 15 commits, 1.2 MB down
    $ cairn pull lab          # later: only what changed
    $ cairn diff lab          # is the copy still what the server has?

The copy is a viewer: it pushes nothing, holds the whole map, and programs can ask it (`Robot` with mode
"viewer"). Cut off by a lost link, it is finished by `cairn pull`. A map's URL is http://HOST:PORT/maps/NAME.
"""

import json
from pathlib import Path

from cairn_client.cli.arguments import add_token, parser, say, shown_bytes
from cairn_client.folders.map_copy import clone
from cairn_client.http.map_url import split_map_url


def main(argv: list[str]) -> int:
    """Make the copy."""
    command = parser("cairn clone", __doc__)
    command.add_argument("url", help="http://HOST:PORT/maps/NAME")
    command.add_argument("folder", type=Path, nargs="?", metavar="DIR", help="new folder (the map's name)")
    command.add_argument("--name", help="name of this copy among the map's robots (copy-RANDOM)")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_token(command)
    args = command.parse_args(argv)
    folder = args.folder or Path(split_map_url(args.url)[1])
    pulled = clone(args.url, folder, token=args.token.of(args.url), name=args.name)
    if args.json:
        say(json.dumps(pulled.as_json()))
        return 0
    say(
        f"{folder}: {pulled.cells} cells, {pulled.voxels} known voxels, {pulled.new_commits} commits, "
        f"{shown_bytes(pulled.down_bytes)} down"
    )
    return 0
