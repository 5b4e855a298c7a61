"""`cairn map retract`: which commits are meant, and a look before the leap."""

import argparse
from datetime import UTC, datetime

from cairn_client.cli.arguments import api_of, say
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import Retract

TIMES = ("pushed_after", "pushed_before", "captured_after", "captured_before")


def retract(args: argparse.Namespace) -> None:
    """Take commits out, or with --dry-run say which it would be."""
    api, name = api_of(args.map, args.token)
    request = Retract(
        commits=args.commit or [],
        robot=args.robot,
        rig=args.rig,
        note=args.note,
        preview=args.dry_run,
        **{f"{part}_s": seconds_of(getattr(args, part)) for part in TIMES},
    )
    with api:
        done = api.retract(name, request)
    if done.id is None:
        say(f"would take out {len(done.commits)} commits (nothing was done):")
    else:
        say(f"{done.id} takes out {len(done.commits)} commits:")
    for commit in done.commits:
        say(f"  {commit}")


def add_retract_arguments(parser: argparse.ArgumentParser) -> None:
    """Commits by id, and all that fit every other option."""
    parser.add_argument("--commit", action="append", metavar="ID", help="robot.incarnation.n, as `log` shows it")
    parser.add_argument("--robot", help="of what this robot pushed")
    parser.add_argument("--rig", metavar="SHA256", help="of what was made with this rig.json (`sha256sum rig.json`)")
    for part in TIMES:
        what, side = part.split("_")
        parser.add_argument(
            f"--{what}-{side}", metavar="TIME", help=f"of what was {what} {side} a time, UTC: 14:05, 2026-11-20T14:05"
        )
    parser.add_argument("--dry-run", action="store_true", help="say which commits it would be, and change nothing")
    parser.add_argument("--note", default="", help="why; kept in the log")


def seconds_of(text: str | None, *, now: datetime | None = None) -> float | None:
    """UTC seconds since 1970 of a time of today, or a date and time, UTC unless it says otherwise; None for None.

    Raises:
        BadInputError: kind `bad_time`.
    """
    if text is None:
        return None
    today = (now or datetime.now(UTC)).date().isoformat()
    for whole in (text, f"{today}T{text}"):
        try:
            time = datetime.fromisoformat(whole)
        except ValueError:
            continue
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    raise BadInputError(
        "bad_time", f"a time is 14:05, 2026-11-20T14:05 or 2026-11-20T14:05+01:00 (else UTC), got {text!r}"
    )
