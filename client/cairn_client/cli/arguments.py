"""Parts that all commands share: parsers, subcommands, tokens, maps by URL, grids, output for people.

All commands follow one protocol. The module behind an entry point of `cairn.commands` has `main(argv) -> int`, which
parses the arguments and returns the exit code. The module of a subcommand has `add_parser(commands)`, which adds a
parser whose default `run` is a function of the parsed arguments that returns the exit code.
"""

import argparse
import os
import re
import sys
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, TypeAlias

from cairn_client.http.api import MapApi
from cairn_client.http.map_url import split_map_url
from cairn_client.http.origin_tokens import NO_TOKENS, OriginTokens
from cairn_client.sync.responses import shown_text
from cairn_map.epochs.epoch import EPOCH_S_MAX, STANDARD_EPOCH_S
from cairn_map.errors import EXIT_CODES, BadInputError
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel, ChannelKind

TOKEN_VARIABLE = "CAIRN_TOKEN"  # noqa: S105 - the variable's name
NEGATIVE = re.compile(r"-\d[-\d.]*[,:][-\d.,:]*|-[xyz]")
"""A list or span that begins with a negative number, or an axis: `-1,0,0`, `-5:40`, `-y`."""

SECONDS = re.compile(r"\d{9,11}(\.\d+)?")
"""Seconds since 1970, after 1973."""

AGE = re.compile(r"(\d{1,6}(?:\.\d+)?)([smhd])")
UNITS_S = {"s": 1, "m": 60, "h": 3600, "d": 86_400}

NO_EPOCHS = "none"
EPOCH_HELP = (
    "seconds of capture whose evidence is one sum. Sums of different epochs are kept apart, and newer ones outweigh "
    "older: what came or went shows in the next epoch, and the map as it was, and what changed since, can be asked "
    "for. Each epoch in which a cell is seen costs about the bytes of one pass (`cairn map info` shows them); shorter "
    f"epochs notice sooner. {STANDARD_EPOCH_S} suits people, doors and goods. `{NO_EPOCHS}`: one sum for all times, "
    "with the fewest bytes, for scenes that stand still, since a wall seen 200 times and then gone stays for 200 "
    "scans. Fixed for the map's life"
)
CHANNELS = {"colour": COLOUR, "intensity": INTENSITY, "temperature": TEMPERATURE}

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
Run: TypeAlias = Callable[[argparse.Namespace], int]
AddParser: TypeAlias = Callable[[Subparsers], None]


class CommandParser(argparse.ArgumentParser):
    """A parser whose help, and that of its subcommands, is printed as written, and ends with the exit codes.

    It takes `-1,0,0`, `-5:40` and `-y` for values, where argparse by itself does so with `-1` alone.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        shown: dict[str, Any] = {"epilog": EXIT_CODES, "formatter_class": argparse.RawDescriptionHelpFormatter}
        super().__init__(*args, **(shown | options))

    # typeshed's overloads let `namespace` be given by name alone; one signature cannot say so.
    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, args: Any = None, namespace: Any = None
    ) -> Any:
        """As argparse, which takes no word for an option that begins with a space; values may begin with one."""
        words = sys.argv[1:] if args is None else args
        return super().parse_known_args([f" {word}" if NEGATIVE.fullmatch(word) else word for word in words], namespace)


def parser(program: str, text: str | None) -> argparse.ArgumentParser:
    """A parser whose help is a docstring."""
    return CommandParser(program, description=text)


def run_subcommand(program: str, text: str | None, parts: Sequence[AddParser], argv: list[str]) -> int:
    """Run the subcommand that is named first; its exit code.

    Args:
        program: the command, `cairn map`.
        text: the command's help.
        parts: `add_parser` of each subcommand, in the order of the help.
        argv: the arguments behind the command.
    """
    top = parser(program, text)
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for add_parser in parts:
        add_parser(commands)
    args = top.parse_args(argv)
    run: Run = args.run
    return run(args)


def add_map_parser(commands: Subparsers, name: str, run: Run, *, text: str) -> argparse.ArgumentParser:
    """Add the parser of a subcommand on one map of a server: its URL and the token."""
    added = commands.add_parser(name, help=text, description=text)
    added.add_argument("map", help="http://HOST:PORT/maps/NAME")
    add_token(added)
    added.set_defaults(run=run)
    return added


def add_at(parser: argparse.ArgumentParser) -> None:
    """Add `--at`, a time as `seconds_of` reads it."""
    parser.add_argument(
        "--at", metavar="TIME", help="the map as it was at a time of capture (14:05, 2026-11-27T14:05, else UTC); now"
    )


class AddTokens(argparse.Action):
    """Action of `--token`: a token for the command's first URL, or for the server that it names."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Add the option's text to the tokens so far."""
        known: OriginTokens = getattr(namespace, self.dest)
        setattr(namespace, self.dest, known.with_text(values))


def add_token(
    parser: argparse.ArgumentParser,
    option: str = "--token",
    *,
    variable: str = TOKEN_VARIABLE,
    text: str = "admin, enrolment or robot token",
) -> None:
    """Add `--token`: the parsed value is an `OriginTokens`."""
    parser.add_argument(
        option,
        action=AddTokens,
        metavar="TOKEN",
        default=NO_TOKENS.with_text(os.environ.get(variable, "")),
        help=f"{text}; of another server ORIGIN=TOKEN, such as http://base:8750=TOKEN (${variable})",
    )


def api_of(map_url: str, tokens: OriginTokens) -> tuple[MapApi, str]:
    """The server of a map's URL, with the token that is for it, and the map's name."""
    server, name = split_map_url(map_url)
    return MapApi(server, token=tokens.of(server)), name


def say(text: str = "") -> None:
    """Write a line of the command's result; texts that robots and servers chose cannot steer the terminal."""
    sys.stdout.write(shown_text(text) + "\n")


def shown_length(metres: float) -> str:
    """A length for people."""
    if metres < 0.01:
        return f"{metres * 1000:g} mm"
    return f"{metres * 100:g} cm" if metres < 1 else f"{metres:g} m"


def shown_bytes(count: float) -> str:
    """A byte count for people."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def shown_age(seconds: float) -> str:
    """An age for people."""
    for limit, unit, size in ((120, "s", 1), (7200, "min", 60), (172_800, "h", 3600)):
        if seconds < limit:
            return f"{max(0.0, seconds) / size:.0f} {unit}"
    return f"{seconds / 86_400:.0f} d"


def instant_of(text: str, *, now: datetime | None = None) -> float:
    """UTC seconds since 1970 of an age (`30m`, `2h`, `7d` ago), or of a time as `seconds_of` reads it.

    Raises:
        BadInputError: kind `bad_time`.
    """
    age = AGE.fullmatch(text)
    if age is None:
        try:
            time_s = seconds_of(text, now=now)
        except BadInputError as exc:
            raise BadInputError(
                exc.kind, f"a time is an age (30m, 2h, 7d ago), or {exc.message.removeprefix('a time is ')}"
            ) from exc
        assert time_s is not None  # noqa: S101 - of a text it is never None
        return time_s
    return (now or datetime.now(UTC)).timestamp() - float(age[1]) * UNITS_S[age[2]]


def seconds_of(text: str | None, *, now: datetime | None = None) -> float | None:
    """UTC seconds since 1970 of a time of today, or of a date and time, UTC unless it says otherwise; None for None.

    Raises:
        BadInputError: kind `bad_time`.
    """
    if text is None:
        return None
    if SECONDS.fullmatch(text):
        return float(text)
    today = (now or datetime.now(UTC)).date().isoformat()
    for whole in (text, f"{today}T{text}"):
        try:
            when = datetime.fromisoformat(whole)
        except ValueError:
            continue
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    raise BadInputError(
        "bad_time",
        f"a time is 14:05, 2026-11-20T14:05 or 2026-11-20T14:05+01:00 (else UTC), or seconds since 1970; got {text!r}",
    )


def epoch_s_from_text(text: str | None, *, otherwise: int | None = STANDARD_EPOCH_S) -> int | None:
    """Length of an epoch, seconds, or None for a map without.

    Raises:
        BadInputError: kind `bad_epoch`.
    """
    if text is None:
        return otherwise
    if text == NO_EPOCHS:
        return None
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= EPOCH_S_MAX:
        raise BadInputError(
            "bad_epoch", f"--epoch takes whole seconds from 1 to {EPOCH_S_MAX}, or `{NO_EPOCHS}`; got {text!r}"
        )
    return int(text)


def channels_from_text(text: str) -> tuple[Channel, ...]:
    """Channels of a text such as `colour,dose:uSv/h:0.01`; of an empty one none.

    Raises:
        BadInputError: kind `bad_channel`.
    """
    return tuple(map(_channel, text.split(","))) if text else ()


def _channel(text: str) -> Channel:
    """`colour`, `intensity`, `temperature`, or a scalar `name:unit:step`."""
    if text in CHANNELS:
        return CHANNELS[text]
    name, *rest = text.split(":")
    try:
        unit, step = rest
        return Channel(kind=ChannelKind.SCALAR, name=name, unit=unit, step=float(step))
    except ValueError as exc:
        raise BadInputError(
            "bad_channel",
            f"a channel is {', '.join(CHANNELS)}, or a scalar NAME:UNIT:STEP such as dose:uSv/h:0.01; got {text!r}",
        ) from exc
