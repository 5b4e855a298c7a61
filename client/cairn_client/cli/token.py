"""Give, list, renew and revoke the tokens of a server.

    $ cairn token create http://127.0.0.1:8750 eye --role reader --map lab --days 30
    t1kVnB0nTq1QJvcnSvYcPZ4u3dUoF2nkE0xxN8FqI7M
    $ cairn token list http://127.0.0.1:8750
    token                    role     counts on              until             last used
    eye                      reader   lab                    2026-12-21 09:10  never
    $ cairn token rotate http://127.0.0.1:8750 eye > eye.secret
    $ cairn token revoke http://127.0.0.1:8750 eye

It asks the server, as an admin of all maps (--token), instead of opening the store's folder: so it works from anywhere,
on any store, while the server runs, and the audit log says who did it. The secret goes to standard output, once;
nobody keeps it. Roles: admin everything; operator reads and retracts; reader reads; robot (with --map and --robot) as
if registered; enroller registers robots; relay hands over what robots signed (`cairn serve --upstream`, `cairn relay`),
and with --map and --robot is that robot, too. Without --map a token counts on all maps.
"""

import argparse
import json
from collections.abc import Callable
from datetime import UTC, datetime
from typing import get_args

from pydantic import ValidationError

from cairn_client.cli.arguments import add_token, parser, say
from cairn_client.http.api import MapApi
from cairn_map.commits.ids import robot_name
from cairn_map.errors import BadInputError, first_error
from cairn_map.wire.access_messages import CreateToken, RoleText, TokenInfo

Run = Callable[[MapApi, argparse.Namespace], None]

DAY_S = 86_400.0


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    args = _parser().parse_args(argv)
    run: Run = args.run
    with MapApi(args.server, token=args.token) as api:
        run(api, args)
    return 0


def _create(api: MapApi, args: argparse.Namespace) -> None:
    try:
        lifetime_s = None if args.days is None else args.days * DAY_S
        request = CreateToken(role=args.role, map=args.map, robot=args.robot, lifetime_s=lifetime_s)
    except ValidationError as exc:
        raise BadInputError("bad_message", first_error(exc)) from exc
    say(api.create_token(robot_name(args.name), request).token)


def _list(api: MapApi, args: argparse.Namespace) -> None:
    infos = api.tokens()
    if args.json:
        say(json.dumps([info.model_dump(mode="json") for info in infos]))
        return
    say(f"{'token':<24} {'role':<8} {'counts on':<22} {'until':<17} last used")
    for info in infos:
        say(_line(info))


def _line(info: TokenInfo) -> str:
    scope = info.map or "all maps"
    where = f"{scope}, {info.robot}" if info.robot else scope
    until, used = _shown_time(info.expires_s, "no end"), _shown_time(info.last_used_s, "never")
    return f"{info.name:<24} {info.role:<8} {where:<22} {until:<17} {used}"


def _rotate(api: MapApi, args: argparse.Namespace) -> None:
    say(api.rotate_token(_name(args.name)).token)


def _revoke(api: MapApi, args: argparse.Namespace) -> None:
    api.revoke_token(_name(args.name))


def _name(text: str) -> str:
    """A token's name: one that was chosen, or MAP:ROBOT of a registration."""
    return ":".join(robot_name(part) for part in text.split(":", 1))


def _shown_time(time_s: float | None, otherwise: str) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M") if time_s is not None else otherwise


def _parser() -> argparse.ArgumentParser:
    top = parser("cairn token", __doc__)
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, text: str, run: Run) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.add_argument("server", help="http://HOST:PORT")
        if name != "list":
            added.add_argument("name", help="the token's name; of a registered robot: MAP:ROBOT")
        add_token(added)
        added.set_defaults(run=run)
        return added

    create = command("create", "give a token and print its secret", _create)
    create.add_argument("--role", required=True, choices=get_args(RoleText))
    create.add_argument("--map", metavar="NAME", help="the one map that it counts on (all)")
    create.add_argument("--robot", metavar="NAME", help="whose token it is, with --role robot or relay")
    create.add_argument("--days", type=float, metavar="DAYS", help="how long it counts (until revoked)")
    command("list", "all tokens, when they end and were used last", _list).add_argument(
        "--json", action="store_true", help="print JSON"
    )
    command("rotate", "print another secret; the old one ends at once", _rotate)
    command("revoke", "end a token", _revoke)
    return top
