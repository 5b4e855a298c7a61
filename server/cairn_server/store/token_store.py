"""What the server needs of a database for its tokens and its audit log (`store.Store.tokens`, `.audit_log`)."""

from dataclasses import dataclass
from typing import Protocol

from cairn_map.wire.access_messages import AuditEntry, RoleText


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """A token as it is kept: everything but its secret."""

    name: str
    role: RoleText
    map_number: int | None
    """None: all maps."""
    map_name: str | None
    robot: str | None
    created_s: float
    expires_s: float | None
    last_used_s: float | None = None


def registration_name(map_name: str, robot: str) -> str:
    """Name of the token that a registration gives; no administrator can choose it, for its colon."""
    return f"{map_name}:{robot}"


class Tokens(Protocol):
    """All tokens, by name and by the SHA-256 of their secrets."""

    def add(self, token: Token, secret_hash: bytes) -> None:
        """Keep a new token.

        Raises:
            ConflictError: kind `token_exists`.
        """
        ...

    def renew(self, name: str, secret_hash: bytes) -> Token:
        """Give a token another secret; the old one is worth nothing from then on.

        Raises:
            NotFoundError: kind `no_such_token`.
        """
        ...

    def remove(self, name: str) -> None:
        """Forget a token.

        Raises:
            NotFoundError: kind `no_such_token`.
        """
        ...

    def all(self) -> list[Token]:
        """All tokens, by name, ended ones included."""
        ...

    def of_hash(self, secret_hash: bytes) -> Token | None:
        """The token of a secret, ended or not."""
        ...

    def used(self, name: str) -> None:
        """Note that a token was shown just now; written some seconds later."""
        ...


class AuditLog(Protocol):
    """Lines that are added and never changed, each with a hash over the one before; the newest are kept."""

    def add(self, who: str, what: str, detail: str) -> None:
        """One more line; durable on return."""
        ...

    def page(self, *, after: int, limit: int) -> list[AuditEntry]:
        """Lines numbered above `after`, oldest first."""
        ...
