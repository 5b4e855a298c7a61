"""`cairn map robots keys` and `admit`: keys that robots' names are bound to, and an operator's word for another one.

    $ cairn map robots keys http://127.0.0.1:8750/maps/lab
    mole.1f2e3d4c5b6a7988             since 2026-11-20 09:10, by enroller
    mole.77a0c4f1d2e36b58  asks       since 2026-11-22 17:02, last 2026-11-22 18:24, by enroller
    $ cairn map robots admit http://127.0.0.1:8750/maps/lab mole
    mole.77a0c4f1d2e36b58 may speak for mole from now on

A name is bound to its first key. A robot with another one, as after its disk was lost, maps on and keeps its commits
until an operator says that it is the same robot. `cairn robot status DIR` on the robot shows its key: compare the two.
NAME alone is enough while one robot of that name asks; else give NAME.KEY.
"""

import argparse
from datetime import UTC, datetime

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say
from cairn_client.sync.responses import one_line
from cairn_map.commits.ids import Author, author_from_text
from cairn_map.errors import BadInputError
from cairn_map.wire.access_messages import RobotKeyList


def add_keys(commands: Subparsers) -> None:
    """Add `keys` to the subcommand's own."""
    listing = add_map_parser(
        commands, "keys", _list, text="keys that are admitted, and robots that were refused lately"
    )
    listing.add_argument("--json", action="store_true", help="print JSON")


def add_admit(commands: Subparsers) -> None:
    """Add `admit` to the subcommand's own."""
    admit = add_map_parser(commands, "admit", _admit, text="admit another key of a robot, by an operator's word")
    admit.description = __doc__
    admit.add_argument("robot", metavar="NAME[.KEY]", help="the robot, or its key as `robots keys` shows it")


def _list(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        found = api.keys(name)
    if args.json:
        say(found.model_dump_json())
        return 0
    for key in found.admitted:
        waits = "may return" if key.may_return else ""
        say(f"{key.author:<50} {waits:<10} since {_shown(key.since_s)}, by {one_line(key.by)}")
    for robot in found.asking:
        when = f"since {_shown(robot.since_s)}, last {_shown(robot.asked_s)}"
        say(f"{robot.author:<50} {'asks':<10} {when}, by {one_line(robot.by)}")
    if not found.admitted and not found.asking:
        say("(none yet; a name is bound to the first key that comes)")
    return 0


def _admit(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        author = author_from_text(args.robot) if "." in args.robot else _asking(api.keys(name), args.robot)
        api.admit(name, author)
    say(f"{author} may speak for {author.robot} from now on")
    return 0


def _asking(keys: RobotKeyList, robot: str) -> Author:
    """Author of the one robot of this name that asks.

    Raises:
        BadInputError: kind `bad_name`: none does, or several do.
    """
    found = [author for asking in keys.asking if (author := author_from_text(asking.author)).robot == robot]
    if len(found) == 1:
        return found[0]
    if found:
        raise BadInputError("bad_name", f"several ask as {robot}, say which one: {', '.join(map(str, found))}")
    raise BadInputError(
        "bad_name", f"no robot {robot} asks; give its key, {robot}.KEY, as `cairn robot status` shows it"
    )


def _shown(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M")
