"""Look after the robots of a map: what each uses of the map's bounds, robots that are to begin again, their keys.

    $ cairn map robots list http://127.0.0.1:8750/maps/lab
    robot  incarnations  intervals  fullest
    mole              1          1  sums 53 %
    wren              2          3  incarnations 6 %
    $ cairn map robots close http://127.0.0.1:8750/maps/lab mole
    mole: 1 incarnations closed; its next commits count from nothing
    $ cairn map robots close http://127.0.0.1:8750/maps/lab --by lost-relay
    $ cairn map robots keys http://127.0.0.1:8750/maps/lab
    $ cairn map robots admit http://127.0.0.1:8750/maps/lab mole

Each robot has shares of its own of what a map can hold, so that no robot can use up another's. `list` shows how full
the fullest of them is, and what closed robots and the server itself use together. `close` takes nothing out of the map:
the robot's incarnations take no more commits, the robot goes on with a new one, and all its shares are whole again.
`--by` closes all robots that a stolen token brought, whose places it took (revoke the token first).
A robot's name is bound to its first key: `keys` shows them, and robots that come with another one, as after the loss of
a disk; `admit` says that it is the same robot.
"""

import argparse
import json
from collections.abc import Iterator

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say
from cairn_client.cli.maps.robot_keys import add_admit, add_keys
from cairn_map.commits.ids import author_from_text
from cairn_map.errors import NotFoundError
from cairn_map.wire.access_messages import KeyInfo, RobotKeyList, RobotUse

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
    which = closing.add_mutually_exclusive_group(required=True)
    which.add_argument("robot", metavar="NAME", nargs="?", help="the robot")
    help_by = "all robots whose first key came by this token: of the enroller or relay that made or brought them"
    which.add_argument("--by", metavar="TOKEN", help=help_by)


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
        for robot in [args.robot] if args.robot else _brought(api.keys(name), args.by, api.robot_uses(name)):
            closed = api.close_robot(name, robot)
            say(f"{closed.robot}: {closed.incarnations} incarnations closed; its next commits count from nothing")
    return 0


def _brought(keys: RobotKeyList, by: str, uses: list[RobotUse]) -> list[str]:
    """Robots to close whose first key came by a token; those without open incarnations hold no place.

    Raises:
        NotFoundError: kind `no_author`: there is none.
    """
    first: dict[str, KeyInfo] = {}
    for key in sorted(keys.admitted, key=lambda key: key.since_s):
        first.setdefault(author_from_text(key.author).robot, key)
    found = [use.robot for use in uses if use.robot in first and first[use.robot].by == by]
    if not found:
        raise NotFoundError("no_author", f"no robot that may be closed came by the token {by}; see `map robots keys`")
    return [robot for robot in found if robot is not None]
