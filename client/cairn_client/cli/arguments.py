"""What all subcommands share: help from the module's docstring, tokens, a progress bar, maps by URL."""

import argparse
import os
import re
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from cairn_client.http.api import MapApi
from cairn_client.http.map_url import split_map_url
from cairn_map.errors import EXIT_CODES

Item = TypeVar("Item")
TOKEN_VARIABLE = "CAIRN_TOKEN"  # noqa: S105 - the variable's name


class CommandParser(argparse.ArgumentParser):
    """A parser whose help, and that of its subcommands, is shown as written, and ends with the exit codes."""

    def __init__(self, *args: Any, **options: Any) -> None:
        shown: dict[str, Any] = {"epilog": EXIT_CODES, "formatter_class": argparse.RawDescriptionHelpFormatter}
        super().__init__(*args, **(shown | options))


def parser(program: str, text: str | None) -> argparse.ArgumentParser:
    """A parser whose help is a docstring."""
    return CommandParser(program, description=text)


def add_token(parser: argparse.ArgumentParser) -> None:
    """Add `--token`."""
    parser.add_argument(
        "--token", default=os.environ.get(TOKEN_VARIABLE), help=f"admin, enrolment or robot token (${TOKEN_VARIABLE})"
    )


def allow_negative_lists(parser: argparse.ArgumentParser) -> None:
    """Take `-1,0,0` or `-5:40` for a value and not for an option, as argparse by itself does with `-1` alone."""
    parser._negative_number_matcher = re.compile(r"^-\d[-\d.,:]*$")


def api_of(map_url: str, token: str | None) -> tuple[MapApi, str]:
    """The server of a map's URL, and the map's name."""
    server, name = split_map_url(map_url)
    return MapApi(server, token=token), name


def with_progress(items: Iterable[Item], what: str, *, total: int) -> Iterator[Item]:
    """The items, with a bar on standard error: count, rate, time left."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        yield from bar.track(items, total=total, description=what)


def say(text: str = "") -> None:
    """A line of the command's result."""
    sys.stdout.write(text + "\n")


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
