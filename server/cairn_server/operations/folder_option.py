"""Option `--data` of commands that look after a store in a folder; `--store` is refused, with a database's way."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cairn_map.errors import BadInputError
from cairn_server.settings import Settings


def add_folder(parser: argparse.ArgumentParser, *, instead: str, what: str = "folder of the store") -> None:
    """Add the option; `instead` is what to do for a store in PostgreSQL."""
    parser.add_argument("--data", type=Path, default=Settings().folder, metavar="DIR", help=what)
    for flag in ("--store", "--objects"):
        parser.add_argument(flag, action=_OfDatabase, const=instead, help=argparse.SUPPRESS)


class _OfDatabase(argparse.Action):
    """Refusal of a database, for a command that works on a folder."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option: str | None = None,
    ) -> None:
        raise BadInputError("bad_setting", f"`{parser.prog}` works on a folder (--data): {self.const}")
