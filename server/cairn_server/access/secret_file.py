"""Secrets that a command is given: in a file, which other users need not be able to read, or in the environment."""

import os
from pathlib import Path

from cairn_map.errors import BadInputError


def secret_of(path: Path | None, variable: str) -> str | None:
    """What is in a file, or without one in a variable of the environment; None if there is neither.

    Raises:
        BadInputError: kind `bad_setting`: the file cannot be read.
    """
    if path is None:
        return os.environ.get(variable) or None
    try:
        return path.read_text().strip()
    except (OSError, UnicodeDecodeError) as exc:
        raise BadInputError("bad_setting", f"cannot read {path}: {exc}") from exc
