"""Bring a copy that `cairn clone` made up to date: fetch what changed since.

    $ cairn pull lab
    lab: 3 of 34 cells changed by 2 commits, 48.1 kB down
    $ cairn pull lab
    lab: up to date

It pushes nothing. A robot's own folder, with commits that wait, is brought up to date by `cairn robot sync DIR`, which
with --map also makes such a folder, of a part of the map if need be.
"""

import json
from pathlib import Path

from cairn_client.cli.arguments import add_token, parser, say, shown_bytes
from cairn_client.folders.map_copy import pull
from cairn_client.folders.state_folder import url_of


def main(argv: list[str]) -> int:
    """Bring the copy up to date."""
    command = parser("cairn pull", __doc__)
    command.add_argument("folder", type=Path, nargs="?", default=Path(), metavar="DIR", help="the copy (here)")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_token(command)
    args = command.parse_args(argv)
    pulled = pull(args.folder, token=args.token.of(url_of(args.folder)))
    if args.json:
        say(json.dumps(pulled.as_json()))
    elif not pulled.changed_cells and not pulled.new_commits:
        say(f"{args.folder}: up to date")
    else:
        say(
            f"{args.folder}: {pulled.changed_cells} of {pulled.cells} cells changed by {pulled.new_commits} commits, "
            f"{shown_bytes(pulled.down_bytes)} down"
        )
    return 0
