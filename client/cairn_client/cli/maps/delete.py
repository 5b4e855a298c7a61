"""Delete a map from its server, for good.

    $ cairn map delete http://127.0.0.1:8750/maps/lab
    map lab: 1204 commits of 4 robots, 56 cells, 41.3 MB. Deleted, nothing of it can be had from this server again.
    Type the map's name to delete it: lab
    map lab is deleted, its tokens ended; its room comes back in the next minutes

It takes an admin's token of all maps. Robots of the map are answered 410 `gone` from then on: they keep their folders,
commits that wait included, map on, and ask once an hour. A new map may take the name; it is another map, which they
join only where an operator lets them in (`cairn map robots admit`). `cairn serve archive` keeps a map that may be
wanted again.
"""

import argparse
import sys

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say, shown_bytes
from cairn_map.errors import BadInputError


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    delete = add_map_parser(commands, "delete", _delete, text="delete a map for good, with its tokens")
    delete.description = __doc__
    delete.add_argument("--yes", action="store_true", help="ask nothing: for scripts")


def add_rename(commands: Subparsers) -> None:
    """Add the subcommand that says why there is no such thing."""
    rename = add_map_parser(commands, "rename", _rename, text="why a map keeps its name, and what to do instead")
    rename.add_argument("name", metavar="NAME", nargs="?", help="the name that it should have")


def _delete(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        info = api.map_info(name)
        size = shown_bytes(info.size_bytes)
        what = f"map {name}: {info.commits} commits of {info.branches} robots, {info.cells} cells, {size}"
        if not args.yes:
            _ask(what, name)
        api.delete_map(name)
    say(f"map {name} is deleted, its tokens ended; its room comes back in the next minutes")
    return 0


def _ask(what: str, name: str) -> None:
    """Have the map's name typed by a person.

    Raises:
        BadInputError: kind `not_confirmed`: there is no terminal, or another text was typed.
    """
    if not sys.stdin.isatty():
        raise BadInputError(
            "not_confirmed", f"{what}. There is no terminal to ask: --yes deletes it without a question"
        )
    say(f"{what}. Deleted, nothing of it can be had from this server again.")
    sys.stdout.write("Type the map's name to delete it: ")
    sys.stdout.flush()
    if sys.stdin.readline().strip() != name:
        raise BadInputError("not_confirmed", f"that is not {name}: nothing was deleted")


def _rename(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        api.map_info(name)
    raise BadInputError(
        "map_is_fixed",
        f"map {name} keeps its name: its robots signed their commits for that name, and their tokens and folders go by "
        "it. Make a map of the other name with `cairn map create`, and have robots begin there with new folders; "
        f"`cairn map copy` takes {name} to another server under its own name",
    )
