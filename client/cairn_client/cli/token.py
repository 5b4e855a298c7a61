"""Give, list, renew and revoke the tokens of a server.

    $ cairn token create http://127.0.0.1:8750 eye --role reader --map lab --days 30
    t1kVnB0nTq1QJvcnSvYcPZ4u3dUoF2nkE0xxN8FqI7M
    $ cairn token list http://127.0.0.1:8750
    token                    role     counts on              until             last used
    eye                      reader   lab                    2026-12-21 09:10  never
    $ cairn token rotate http://127.0.0.1:8750 eye > eye.secret
    $ cairn token revoke http://127.0.0.1:8750 eye

It asks the server, as an admin of all maps (--token), instead of opening the store's folder: so it works from anywhere,
on any store, while the server runs, and the audit log says who did it. The secret goes to standard output, once; it is
kept nowhere else. Roles: admin everything; operator reads and retracts; reader reads; robot (with --map and --robot) as
if registered; enroller registers robots; relay hands over what robots signed (`cairn serve --upstream`, `cairn relay`),
and with --map and --robot is that robot, too. Without --map a token counts on all maps.
"""

import argparse
import json
from datetime import UTC, datetime
from typing import get_args

from pydantic import ValidationError

from cairn_client.cli.arguments import Run, Subparsers, add_token, run_subcommand, say
from cairn_client.http.api import MapApi
from cairn_map.commits.ids import map_name, robot_name
from cairn_map.errors import BadInputError, first_error
from cairn_map.wire.access_messages import CreateToken, RoleText, TokenInfo
from cairn_map.wire.utc_times import with_utc

DAY_S = 86_400.0


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    parts = (_add_create, _add_list, _add_rotate, _add_revoke, _add_confirm)
    return run_subcommand("cairn token", __doc__, parts, argv)


def _add_create(commands: Subparsers) -> None:
    create = _token_parser(commands, "create", _create, text="give a token and print its secret")
    create.add_argument("--role", required=True, choices=get_args(RoleText))
    create.add_argument("--map", metavar="NAME", help="the one map that it counts on (all)")
    create.add_argument("--robot", metavar="NAME", help="whose token it is, with --role robot or relay")
    create.add_argument("--days", type=float, metavar="DAYS", help="how long it counts (until revoked)")


def _add_list(commands: Subparsers) -> None:
    listing = _server_parser(commands, "list", _list, text="all tokens, when they end and were used last")
    listing.add_argument("--json", action="store_true", help="print JSON")
    add_token(listing)


def _add_rotate(commands: Subparsers) -> None:
    _token_parser(commands, "rotate", _rotate, text="print another secret; the old one ends at once")


def _add_revoke(commands: Subparsers) -> None:
    _token_parser(commands, "revoke", _revoke, text="end a token")


def _add_confirm(commands: Subparsers) -> None:
    text = "let tokens count again that a restore of the server switched off"
    confirm = _server_parser(commands, "confirm", _confirm, text=text)
    confirm.add_argument("names", metavar="NAME", nargs="*", help="tokens, as `cairn token list` shows them")
    confirm.add_argument("--all", action="store_true", help="all that are off: none was ended since the backup")
    add_token(confirm)


def _token_parser(commands: Subparsers, name: str, run: Run, *, text: str) -> argparse.ArgumentParser:
    """Add the parser of a subcommand on one token."""
    added = _server_parser(commands, name, run, text=text)
    added.add_argument("name", help="the token's name; of a registered robot: MAP:ROBOT")
    add_token(added)
    return added


def _server_parser(commands: Subparsers, name: str, run: Run, *, text: str) -> argparse.ArgumentParser:
    added = commands.add_parser(name, help=text, description=text)
    added.add_argument("server", help="http://HOST:PORT")
    added.set_defaults(run=run)
    return added


def _create(args: argparse.Namespace) -> int:
    try:
        lifetime_s = None if args.days is None else args.days * DAY_S
        request = CreateToken(role=args.role, map=args.map, robot=args.robot, lifetime_s=lifetime_s)
    except ValidationError as exc:
        raise BadInputError("bad_message", first_error(exc)) from exc
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        say(api.create_token(robot_name(args.name), request).token)
    return 0


def _list(args: argparse.Namespace) -> int:
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        infos = api.tokens()
    if args.json:
        say(json.dumps([with_utc(info).model_dump(mode="json") for info in infos]))
        return 0
    say(f"{'token':<24} {'role':<8} {'counts on':<22} {'until':<17} last used")
    for info in infos:
        say(_line(info))
    return 0


def _line(info: TokenInfo) -> str:
    scope = info.map or "all maps"
    where = f"{scope}, {info.robot}" if info.robot else scope
    end = _shown_time(info.expires_s, "no end") if info.confirmed else "OFF: confirm it"
    until, used = end, _shown_time(info.last_used_s, "never")
    return f"{info.name:<24} {info.role:<8} {where:<22} {until:<17} {used}"


def _rotate(args: argparse.Namespace) -> int:
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        say(api.rotate_token(_name(args.name)).token)
    return 0


def _revoke(args: argparse.Namespace) -> int:
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        api.revoke_token(_name(args.name))
    return 0


def _confirm(args: argparse.Namespace) -> int:
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        off = [info.name for info in api.tokens() if not info.confirmed] if args.all else []
        names = off or [_name(text) for text in args.names]
        for name in names:
            api.confirm_token(name)
    say(f"{len(names)} tokens count again" + (f": {', '.join(names)}" if names else ""))
    return 0


def _name(text: str) -> str:
    """A token's name: one that was chosen, or MAP:ROBOT of a registration."""
    first, colon, robot = text.partition(":")
    return f"{map_name(first)}:{robot_name(robot)}" if colon else robot_name(first)


def _shown_time(time_s: float | None, otherwise: str) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M") if time_s is not None else otherwise
