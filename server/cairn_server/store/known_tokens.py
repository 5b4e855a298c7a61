"""Tokens that a store found a moment ago: robots show one with each push, and a token seldom changes."""

import time
from collections.abc import Callable
from typing import Any

from cairn_map.errors import NotFoundError
from cairn_server.store.store_rows import Token

KNOWN_S, KNOWN_MAX = 1.0, 4096
"""Time for which a found token is not looked up again, and most such tokens."""


class KnownTokens:
    """Tokens by the SHA-256 of their secrets, each for a second; usable from any thread."""

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[Token, float]] = {}

    def forget(self) -> None:
        """Look all tokens up again; called once a change is durable, before it is answered."""
        self._known = {}

    def get(self, secret_hash: bytes, look_up: Callable[[], Token | None]) -> Token | None:
        """The token of a secret, as `look_up` found it at most a second ago, and not before the last change here."""
        known = self._known  # what is read before a change must not become known after it
        token, until_s = known.get(secret_hash, (None, 0.0))
        if token is not None and time.monotonic() < until_s:
            return token
        token = look_up()
        if token is None:
            return None
        if len(known) >= KNOWN_MAX:
            known.clear()
        known[secret_hash] = token, time.monotonic() + KNOWN_S
        return token


def token_row(columns: tuple[Any, ...]) -> Token:
    """A token from the columns that databases keep of it."""
    *known, created_age_s, used_age_s, is_confirmed = columns
    name, role, number, map_name, robot, created_s, expires_s, last_used_s = known
    return Token(
        name=name,
        role=role,
        map_number=number,
        map_name=map_name,
        robot=robot,
        created_s=created_s,
        expires_s=expires_s,
        last_used_s=last_used_s,
        created_age_s=created_age_s,
        used_age_s=used_age_s,
        is_confirmed=bool(is_confirmed),
    )


def check_changed(count: int, name: str) -> None:
    """Refuse to have changed a token that is not there.

    Raises:
        NotFoundError: kind `no_such_token`.
    """
    if not count:
        raise NotFoundError("no_such_token", f"there is no token {name[:80]!r}; `cairn token list` shows them")
