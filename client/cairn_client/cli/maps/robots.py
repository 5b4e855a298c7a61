"""Look after the robots of a map: what each uses of the map's bounds, robots that are to begin again, their keys.

    $ cairn map robots list http://127.0.0.1:8750/maps/lab
    robot  incarnations  intervals  fullest
    mole              1          1  sums 53 %
    wren              2          3  incarnations 6 %
    $ cairn map robots close http://127.0.0.1:8750/maps/lab mole
    mole: 1 incarnations closed; its next commits count from nothing
    $ cairn map robots keys http://127.0.0.1:8750/maps/lab
    $ cairn map robots admit http://127.0.0.1:8750/maps/lab mole

Each robot has shares of its own of what a map can hold, so that no robot can use up another's. `list` shows how full
the fullest of them is, and what closed robots and the server itself use together. `close` takes nothing out of the map:
the robot's incarnations take no more commits, the robot goes on with a new one, and all its shares are whole again.
A robot's name is bound to its first key: `keys` shows them, and robots that come with another one, as after the loss of
a disk; `admit` says that it is the same robot.
"""

import argparse
import json
from collections.abc import Iterator

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say
from cairn_client.cli.maps.robot_keys import add_admit, add_keys
from cairn_map.wire.access_messages import RobotUse

HEAD = ("robot", "incarnations", "intervals", "fullest")


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand, and its own."""
    text = "what each robot uses of a map's bounds; begin a robot's again"
    parts = commands.add_parser("robots", help=text, description=__doc__).add_subparsers(
        required=True, metavar="COMMAND"
    )
    for add_part in (_add_list, _add_close, add_keys, add_admit):
        add_part(parts)


def _add_list(commands: Subparsers) -> None:
    listing = add_map_parser(commands, "list", _list, text="what each robot uses of the map's bounds")
    listing.add_argument("--json", action="store_true", help="print JSON")


def _add_close(commands: Subparsers) -> None:
    text = "close a robot's incarnations, so that it begins again with whole shares; takes an admin's token"
    closing = add_map_parser(commands, "close", _close, text=text)
    closing.add_argument("robot", metavar="NAME", help="the robot")


def _list(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        uses = api.robot_uses(name)
    if args.json:
        say(json.dumps([use.model_dump(mode="json") for use in uses]))
        return 0
    for line in use_table(uses):
        say(line)
    return 0


def use_table(uses: list[RobotUse]) -> Iterator[str]:
    """Lines of the table, columns as wide as they must be."""
    rows = [HEAD, *map(_row, uses)]
    widths = [max(len(row[c]) for row in rows) for c in range(len(HEAD))]
    for robot, incarnations, intervals, fullest in rows:
        yield (f"{robot:<{widths[0]}}  {incarnations:>{widths[1]}}  {intervals:>{widths[2]}}  {fullest}")


def _row(use: RobotUse) -> tuple[str, ...]:
    bound = max(use.used, key=lambda name: use.used[name])
    return use.robot or "(reserve)", str(use.incarnations), str(use.intervals), f"{bound} {use.used[bound]:.0%}"


def _close(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        closed = api.close_robot(name, args.robot)
    say(f"{closed.robot}: {closed.incarnations} incarnations closed; its next commits count from nothing")
    return 0
