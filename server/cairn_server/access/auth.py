"""Roles and rights: a bearer token stands for a role, on one map or on all.

admin     everything                           `admin_token`, or any client while there is none (loopback only)
operator  read, retract
robot     read, push its own commits, fetch    given at registration; of one map and one robot
reader    read
relay     read, hand over what robots signed   a robot's, too, if it names one
enroller  register robots                      `enrolment_token`

The first three roles and relays may read. Tokens are stored as SHA-256 only (`store.Tokens`); the two secrets of the
settings are kept by the operator who starts the server.
"""

import hashlib
import hmac
import secrets
import time
from dataclasses import dataclass
from enum import StrEnum

from cairn_map.commits.ids import SERVERS_OWN, RobotName
from cairn_map.errors import BadInputError, DeniedError
from cairn_server.map_refusals import map_gone
from cairn_server.settings import Settings
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, Token


class Role(StrEnum):
    """Role of a token."""

    ADMIN = "admin"
    OPERATOR = "operator"
    ROBOT = "robot"
    READER = "reader"
    ENROLLER = "enroller"
    RELAY = "relay"


READING = (Role.READER, Role.ROBOT, Role.OPERATOR, Role.RELAY)
"""Roles that may read a map."""


@dataclass(frozen=True, slots=True)
class Caller:
    """Maker of a request: its role, and the robot or token that it stands for."""

    role: Role
    robot: str | None = None
    name: str = ""
    """Name of the token, for the audit log."""
    map_number: int | None = None
    """Number of the one map that the token counts on; None: all maps."""
    is_returning: bool = False
    """True if there is no token, but a robot's key that an operator lets in."""
    address: str = ""
    """Address that the request came from, for the audit log."""

    def may_author(self, robot: str) -> bool:
        """True if this caller may push commits of this robot."""
        return self.role is Role.ADMIN or (self.robot == robot and robot not in RESERVED_ROBOT_NAMES)

    def counts_on(self, row: MapRow | None) -> bool:
        """True if the token counts on a map or layer (None: on the server as a whole); a map's does on its layers."""
        return self.map_number is None or (row is not None and self.map_number in (row.number, row.names_number))


ADMIN_FILE, ENROLLER_FILE, LOCAL = Caller(Role.ADMIN, name="admin"), Caller(Role.ENROLLER, name="enroller"), "local"
UPSTREAM = Caller(Role.RELAY, name="upstream")
"""This server's own relay, which brings the upstream server's commits."""
RESERVED_ROBOT_NAMES = frozenset({*SERVERS_OWN, RobotName("main")})
"""Names that no robot has: servers speak in them."""
RESERVED_TOKEN_NAMES = frozenset({ADMIN_FILE.name, ENROLLER_FILE.name, LOCAL, UPSTREAM.name, "server"})


def check_robot_name(name: str) -> None:
    """Refuse names that servers speak in.

    Raises:
        BadInputError: kind `reserved_name`.
    """
    if name in RESERVED_ROBOT_NAMES:
        raise BadInputError("reserved_name", f"{name} is not a robot's name; reserved are operator, initial, main")


def new_token() -> str:
    """A random token of 256 bits, in digits that no command line takes for an option."""
    return secrets.token_hex(32)


def token_hash(token: str) -> bytes:
    """SHA-256 under which a token is stored; tokens are random and need no salt."""
    return hashlib.sha256(token.encode()).digest()


class TokenHolders:
    """Callers by the tokens that they show: those of the store, and the secrets of the settings.

    The secrets may be replaced while the server runs, by any thread: each request is judged by those of its moment.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store = store
        self._settings = settings
        self._secrets = _callers_of_secrets(settings)

    def use_secrets(self, settings: Settings) -> None:
        """Take the secrets of these settings from now on, and no others; they have an admin's if there was one."""
        self._secrets = _callers_of_secrets(settings)

    def of(self, token: str | None, row: MapRow | None) -> Caller:
        """Caller that shows this token, on a map or (None) on the server as a whole.

        Raises:
            DeniedError: kind `no_token`, `bad_token`, also on a map that the token is not for, or `unconfirmed_token`.
            NotFoundError: kind `gone`: the token ended with its map.
        """
        return self.of_hash(None if token is None else token_hash(token), row)

    def of_hash(self, secret_hash: bytes | None, row: MapRow | None) -> Caller:
        """Caller that showed a token of this SHA-256; as `of`."""
        if secret_hash is None:
            if not self._secrets:
                return Caller(Role.ADMIN, name=LOCAL)
            raise DeniedError(
                "no_token",
                "this server wants a token: Authorization: Bearer TOKEN (the cairn command: --token, CAIRN_TOKEN)",
            )
        caller = self._holder(secret_hash)
        if caller is None and (gone := self._store.tokens.gone(secret_hash)) is not None:
            raise map_gone(gone)
        if caller is None or not (row is None or caller.counts_on(row)):
            raise bad_token()
        return caller

    def _holder(self, secret_hash: bytes) -> Caller | None:
        store = self._store
        known = store.tokens.of_hash(secret_hash)
        if known is None:
            same = (who for own, who in self._secrets if hmac.compare_digest(secret_hash, own))
            return next(same, None)
        if has_ended(known, self._settings, now_s=time.time(), age_s=store.age.now_s()):
            return None
        if not known.is_confirmed:
            raise DeniedError(
                "unconfirmed_token",
                f"the server was restored from a backup, and the token {known.name} is off until an admin says that it "
                f"was not ended meanwhile: cairn token confirm SERVER {known.name}",
            )
        store.tokens.used(known.name)
        return Caller(Role(known.role), known.robot, known.name, known.map_number)


def _callers_of_secrets(settings: Settings) -> tuple[tuple[bytes, Caller], ...]:
    """SHA-256 of each secret of the settings, and who shows it; empty if any client is trusted."""
    admins = ((token_hash(secret), ADMIN_FILE) for secret in settings.admin_tokens)
    return (*admins, *((token_hash(secret), ENROLLER_FILE) for secret in settings.enrolment_tokens))


def bad_token() -> DeniedError:
    """Error for any token that is not valid here, the same in every case."""
    return DeniedError(
        "bad_token",
        "the token is wrong, of another map, or ended: expired, revoked, or replaced by a rotation or registration",
    )


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


def require_all_maps(caller: Caller) -> None:
    """Refuse an admin of one map, where the whole server is concerned.

    Raises:
        DeniedError: kind `not_allowed`.
    """
    if caller.map_number is not None:
        raise DeniedError("not_allowed", "this takes an admin token of all maps; the token shown is of one map")


def has_ended(token: Token, settings: Settings, *, now_s: float, age_s: float) -> bool:
    """True if a token has expired, or its robot was silent for longer than `branch_expiry_s`.

    A date passes by the wall clock (`now_s`), or after as long an age of the store: the clock set back gives no more
    life than the token was made with. Set ahead, it ends the token only until it is right again.
    """
    if token.expires_s is not None:
        return now_s >= token.expires_s or age_s - token.created_age_s >= token.expires_s - token.created_s
    if token.role != "robot" or settings.branch_expiry_s is None:
        return False
    return age_s >= max(token.created_age_s, token.used_age_s) + settings.branch_expiry_s
