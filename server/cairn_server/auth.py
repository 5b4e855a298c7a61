"""Who may do what: a bearer token stands for a role; robots' tokens are bound to one map and one robot.

admin     everything                           `admin_token`, or anybody while there is none (loopback only)
enroller  register robots                      `enrolment_token`
robot     push its own commits, fetch, read    given at registration, kept as SHA-256 only
"""

import hashlib
import hmac
import secrets
from dataclasses import dataclass
from enum import StrEnum

from cairn_map.errors import DeniedError
from cairn_server.settings import Settings
from cairn_server.store import Store
from cairn_server.store_rows import MapRow


class Role(StrEnum):
    """What a token stands for."""

    ADMIN = "admin"
    ENROLLER = "enroller"
    ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who makes a request."""

    role: Role
    robot: str | None = None

    def may_author(self, robot: str) -> bool:
        """Whether commits of this robot may come from here."""
        return self.role is Role.ADMIN or self.robot == robot


def new_token() -> str:
    """A random token of 256 bits."""
    return secrets.token_urlsafe(32)


def token_hash(token: str) -> bytes:
    """What is kept of a token; random ones need no salt."""
    return hashlib.sha256(token.encode()).digest()


def caller_of(token: str | None, row: MapRow | None, store: Store, settings: Settings) -> Caller:
    """Who shows this token.

    Raises:
        DeniedError: kind `no_token` or `bad_token`.
    """
    if token is not None and row is not None:
        robot = store.branch_of_token(row, token_hash(token))
        if robot is not None:
            return Caller(Role.ROBOT, robot)
    if _is(token, settings.admin_token):
        return Caller(Role.ADMIN)
    if _is(token, settings.enrolment_token):
        return Caller(Role.ENROLLER)
    if settings.admin_token is None and token is None:
        return Caller(Role.ADMIN)
    if token is None:
        raise DeniedError(
            "no_token",
            "this server wants a token: Authorization: Bearer TOKEN (the cairn command: --token, CAIRN_TOKEN)",
        )
    raise DeniedError("bad_token", "the token is wrong, or another registration under the same name replaced it")


def require(caller: Caller, *roles: Role) -> None:
    """Refuse a caller without one of these roles; an admin has them all.

    Raises:
        DeniedError: kind `not_allowed`.
    """
    if caller.role is not Role.ADMIN and caller.role not in roles:
        raise DeniedError(
            "not_allowed",
            f"this takes {' or '.join([*roles, Role.ADMIN])} rights; the token shown is of role {caller.role}",
        )


def _is(token: str | None, expected: str | None) -> bool:
    return token is not None and expected is not None and hmac.compare_digest(token.encode(), expected.encode())
