"""Show who did what on a server, newest first.

    $ cairn audit http://127.0.0.1:8750 --since 2h
    time                       who       what          from          about
    2026-11-27 22:05:01+01:00  ada       retract       192.0.2.7     map lab: operator.1f2e3d4c5b6a7988.3 takes out 2...
    2026-11-27 21:58:40+01:00  server    bad_token     198.51.100.9  wrong token from 198.51.100.9, and 12 more since...
    $ cairn audit http://127.0.0.1:8750 --map lab --who ada --count 1000
    $ cairn audit http://127.0.0.1:8750 --what bad_token --since 2026-11-27T08:00 --json

It asks the server, as an admin of all maps (--token). Give each admin a token of their own (`cairn token create SERVER
ada --role admin`): the log then has their names, and `admin` only for the token of --admin-token-file. Times are shown
in the time zone of this machine, with its lead over UTC; those of --since and --until are UTC unless they say
otherwise.
"""

import argparse
import json
from datetime import UTC, datetime

from cairn_client.cli.arguments import add_token, instant_of, parser, say
from cairn_client.http.api import MapApi
from cairn_map.wire.access_messages import AuditEntry
from cairn_map.wire.utc_times import with_utc

PAGE = 1000
WIDTHS = (25, 16, 14, 15)
"""Columns before the last one."""


def main(argv: list[str]) -> int:
    """Show lines of the audit log."""
    options = parser("cairn audit", __doc__)
    options.add_argument("server", help="http://HOST:PORT")
    options.add_argument("--since", metavar="TIME", help="not before: 2h, 30m, 7d ago; 14:05, 2026-11-27T14:05")
    options.add_argument("--until", metavar="TIME", help="before, as --since")
    options.add_argument("--who", metavar="NAME", help="of this token; admin, enroller, server: see the help above")
    options.add_argument("--what", metavar="KIND", help="of this kind: retract, create_token, bad_token, ...")
    options.add_argument("--map", metavar="NAME", help="about this map")
    options.add_argument("--count", type=int, default=50, metavar="N", help="at most so many (50)")
    options.add_argument("--json", action="store_true", help="print JSON")
    add_token(options)
    args = options.parse_args(argv)
    lines = _lines(args)
    if args.json:
        say(json.dumps([with_utc(line).model_dump(mode="json") for line in lines]))
        return 0
    say(_row("time", "who", "what", "from", "about"))
    for line in lines:
        say(_row(local_time(line.time_s), line.who, line.what, line.client or "-", line.detail))
    if not lines:
        say("(nothing)")
    return 0


def _lines(args: argparse.Namespace) -> list[AuditEntry]:
    """Lines that are asked for, newest first, page by page."""
    choice: dict[str, str | int] = {name: getattr(args, name) for name in ("who", "what", "map") if getattr(args, name)}
    choice |= {name: repr(instant_of(getattr(args, name))) for name in ("since", "until") if getattr(args, name)}
    found: list[AuditEntry] = []
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        while len(found) < args.count:
            limit = min(PAGE, args.count - len(found))
            page = api.audit(**choice, limit=limit, **({"before": found[-1].number} if found else {}))
            found += page
            if len(page) < limit:
                break
    return found


def local_time(time_s: float) -> str:
    """Time of day of this machine's zone, with its lead over UTC."""
    return datetime.fromtimestamp(time_s, UTC).astimezone().isoformat(" ", "seconds")


def _row(*texts: str) -> str:
    cells = [text.ljust(width) for text, width in zip(texts, WIDTHS, strict=False)]
    return "  ".join([*cells, *texts[len(WIDTHS) :]])
