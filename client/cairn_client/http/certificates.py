"""Whose signature a server's certificate must have."""

from pathlib import Path
from typing import TYPE_CHECKING

from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    import ssl


def certificates(ca_file: Path | None) -> "ssl.SSLContext | bool":
    """Those of a file (PEM), or True: those that are known everywhere.

    Raises:
        BadInputError: kind `bad_setting`: it is no such file.
    """
    import ssl

    try:
        return ssl.create_default_context(cafile=ca_file) if ca_file else True
    except OSError as exc:  # ssl.SSLError is one
        raise BadInputError("bad_setting", f"{ca_file} is no file of certificates: {exc}") from exc
