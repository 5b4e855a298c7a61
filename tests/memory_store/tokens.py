"""Tokens and the audit log in memory (`store.Tokens`)."""

import logging
import time
from collections import deque
from contextlib import suppress
from dataclasses import replace

from tests.memory_store.maps import MemoryMaps

from cairn_map.errors import ConflictError, NotFoundError, UnreachableError
from cairn_map.wire.access_messages import AuditEntry, AuditText, audit_chain
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_rows import (
    ALL_LINES,
    AUDIT_ROWS_MAX,
    AuditChoice,
    MapRow,
    Token,
    audit_entry,
    registration_name,
)

log = logging.getLogger(__name__)


class MemoryTokens:
    """`store.Tokens`, under the lock of the maps."""

    def __init__(self, maps: MemoryMaps, age: StoreAge) -> None:
        self._maps = maps
        self._age = age
        self._tokens: dict[str, tuple[Token, bytes]] = {}
        self._names: dict[bytes, str] = {}
        """By the hash of the secret."""

    def add(self, token: Token, secret_hash: bytes) -> None:
        """Keep a new token."""
        with self._maps.locked():
            if token.name in self._tokens:
                raise ConflictError("token_exists", f"a token {token.name!r} exists; rotate it, or take another name")
            self._put(replace(token, created_age_s=self._age.now_s()), secret_hash)

    def renew(self, name: str, secret_hash: bytes) -> Token:
        """Give a token another secret."""
        with self._maps.locked():
            token = self._removed(name)
            self._put(token, secret_hash)
            return token

    def remove(self, name: str) -> None:
        """Forget a token."""
        with self._maps.locked():
            self._removed(name)

    def confirm(self, name: str) -> Token:
        """Let a restored token count again; here nothing is restored."""
        with self._maps.locked():
            if name not in self._tokens:
                raise NotFoundError("no_such_token", f"there is no token {name!r}")
            return self._tokens[name][0]

    def all(self) -> list[Token]:
        """All tokens, by name."""
        with self._maps.locked():
            return [token for _, (token, _) in sorted(self._tokens.items())]

    def of_hash(self, secret_hash: bytes) -> Token | None:
        """The token of a secret."""
        with self._maps.locked():
            name = self._names.get(secret_hash)
            return None if name is None else self._tokens[name][0]

    def used(self, name: str) -> None:
        """Note that a token was shown just now."""
        with suppress(UnreachableError), self._maps.locked():  # it is only a note
            if name in self._tokens:
                token, secret_hash = self._tokens[name]
                self._tokens[name] = self._shown(token), secret_hash

    def _shown(self, token: Token) -> Token:
        return replace(token, last_used_s=time.time(), used_age_s=self._age.now_s())

    def put_registration(self, row: MapRow, robot: str, secret_hash: bytes) -> None:
        """The token of a registration; the one of an earlier registration is worth nothing then."""
        token = Token(
            name=registration_name(row.name, robot),
            role="robot",
            map_number=row.number,
            map_name=row.name,
            robot=robot,
            created_s=time.time(),
            expires_s=None,
            created_age_s=self._age.now_s(),
        )
        with self._maps.locked():
            if token.name in self._tokens:
                self._removed(token.name)
            self._put(token, secret_hash)

    def remove_of(self, row: MapRow, robot: str) -> None:
        """Forget every token of a robot on a map."""
        with self._maps.locked():
            for token, _ in list(self._tokens.values()):
                if (token.map_number, token.robot) == (row.number, robot):
                    self._removed(token.name)

    def _put(self, token: Token, secret_hash: bytes) -> None:
        self._tokens[token.name] = token, secret_hash
        self._names[secret_hash] = token.name

    def _removed(self, name: str) -> Token:
        if name not in self._tokens:
            raise NotFoundError("no_such_token", f"there is no token {name[:80]!r}; `cairn token list` shows them")
        token, secret_hash = self._tokens.pop(name)
        del self._names[secret_hash]
        return token


class MemoryAuditLog:
    """`store.AuditLog`, under the lock of the maps."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps
        self._lines: deque[AuditEntry] = deque(maxlen=AUDIT_ROWS_MAX)

    def add(self, who: str, what: str, detail: str, *, client: str = "") -> None:
        """One more line, chained to the last; the newest are kept."""
        log.info("%s: %s: %r", who, what, detail)
        with self._maps.locked():
            number, before = (self._lines[-1].number, self._lines[-1].chain) if self._lines else (0, "")
            number, time_s = number + 1, time.time()
            chain = audit_chain(bytes.fromhex(before), number, time_s, AuditText(who, what, detail, client))
            self._lines.append(audit_entry((number, time_s, who, what, detail, chain, client)))

    def page(
        self, *, limit: int, after: int = 0, before: int | None = None, choice: AuditChoice = ALL_LINES
    ) -> list[AuditEntry]:
        """Lines of a choice, oldest first, or with `before` newest first."""
        with self._maps.locked():
            found = [line for line in self._lines if line.number > after and choice.fits(line)]
        return found[:limit] if before is None else [line for line in reversed(found) if line.number < before][:limit]
