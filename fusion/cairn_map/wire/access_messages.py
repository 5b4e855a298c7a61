"""JSON messages of operation: tokens, the servers of a store, and the audit log with its chain of hashes."""

import hashlib
import json
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_map.wire.messages import MapNameText, NameText
from cairn_map.wire.utc_times import UtcText

RoleText = Literal["admin", "operator", "robot", "reader", "enroller", "relay"]
LIFETIME_MAX_S = 20 * 366 * 86_400.0


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CreateToken(_Model):
    """Body of `PUT /tokens/{token}`."""

    role: RoleText
    map: NameText | None = None
    """The one map for which it is valid; None: all maps, future ones included."""
    robot: NameText | None = None
    """Robot that holds the token (role robot, or a relay that is a robot, too), or the one robot that it enrols."""
    lifetime_s: Annotated[float, Field(gt=0, le=LIFETIME_MAX_S)] | None = None
    """Seconds for which it is valid; None: until it is revoked."""

    @model_validator(mode="after")
    def _check_robot(self) -> Self:
        if self.role == "robot" and not (self.map and self.robot):
            raise ValueError("a robot's token names its map and its robot")
        if self.role == "relay" and self.robot and not self.map:
            raise ValueError("a relay that is a robot names its map, too")
        if self.role == "enroller" and self.robot and not self.map:
            raise ValueError("an enrolment token for one robot names its map, too")
        if self.role not in ("robot", "relay", "enroller") and self.robot:
            raise ValueError(f"a token of role {self.role} names no robot")
        return self


class TokenInfo(_Model):
    """Facts of one token, without its secret, which is not stored."""

    name: str
    role: RoleText
    map: MapNameText | None
    robot: NameText | None
    created_s: float
    expires_s: float | None
    last_used_s: float | None
    """Time of its last use, UTC seconds since 1970; updated every few seconds at most."""
    confirmed: bool = True
    """False after a restore, until an admin confirms that the token still counts."""
    created_utc: UtcText = None
    expires_utc: UtcText = None
    last_used_utc: UtcText = None


class ServerInfo(_Model):
    """One server of a store, as it was heard of last."""

    id: str
    """16 hex digits, drawn at its start."""
    answers: bool
    """False for one that only folds."""
    folds: bool
    """True if it folds, and its thread that does is alive."""
    version: str
    clock_ahead_s: float
    """Lead of its clock over the store's; 0 where it has the store alone."""
    folded_s: float | None
    """Seconds since its last fold; None: it made none yet."""
    heard_s: float
    """Seconds since it was heard of."""


class SiteInfo(_Model):
    """Answer of `GET /servers`: the servers of one store."""

    store: Literal["one process", "shared"]
    """Kind of the store: the server's alone (SQLite), or a database of several (PostgreSQL)."""
    store_id: str
    """16 hex digits: the same at all servers of a shared store; else drawn at the start."""
    server_id: str
    """The one that answers."""
    servers: list[ServerInfo]
    """Those heard of within the last half minute, this one included, by id."""
    waiting_s: float
    """Seconds for which the oldest commit has waited to be folded; 0: none waits."""
    clock: str | None = None
    """Reason why the clock of the store is not trusted, as `code: what`; None, and left out, if it is."""


class TrustedTime(_Model):
    """Answer to `POST /clock`: the time of day that is trusted from here on."""

    time_s: float
    """UTC seconds since 1970."""


class RobotUse(_Model):
    """Use of its shares of a map's bounds by one robot."""

    robot: NameText | None
    """None: the reserve, of the servers' own commits and of closed robots."""
    incarnations: int
    intervals: int
    """Intervals of the numbers of its commits, in all incarnations."""
    used: dict[str, float]
    """Part that is used of each bound: `sums` (0 up to a half), `incarnations`, `intervals`."""


class RobotClosed(_Model):
    """Answer to closing a robot: what went into the reserve."""

    robot: NameText
    incarnations: int
    intervals: int


class NewSecret(_Model):
    """Answer to a creation or rotation: the secret, shown this once."""

    token: str
    info: TokenInfo


class KeyInfo(_Model):
    """An admitted key of a robot."""

    author: str
    """`robot.incarnation`: the incarnation follows from the key."""
    since_s: float
    """Time at which it came, UTC seconds since 1970."""
    by: str
    """Name of the token that brought it."""
    may_return: bool
    """True from an operator's word until the robot has registered by it."""
    since_utc: UtcText = None


class AskingRobot(_Model):
    """A robot that was refused, because its name is bound to another key."""

    author: str
    since_s: float
    """Time of its first try that is remembered, UTC seconds since 1970."""
    asked_s: float
    """Time of its last try, UTC seconds since 1970."""
    by: str
    """Name of the token that it showed, or of the relay that brought its commit."""
    since_utc: UtcText = None
    asked_utc: UtcText = None


class RobotKeyList(_Model):
    """Answer to `GET /maps/{map}/keys`."""

    admitted: list[KeyInfo]
    asking: list[AskingRobot]
    """Refused lately, oldest first; forgotten with each start of the server."""


class Challenge(_Model):
    """Answer to `GET /challenge`."""

    challenge: str
    """Text that a robot's keys sign (`commits.key_proof`); good for a minute."""


class AuditEntry(_Model):
    """One line of the audit log."""

    number: int
    time_s: float
    who: str
    """Name of the token, or `local` (an open server's caller), `admin` and `enroller` (its files), `server`."""
    what: str
    detail: str
    chain: str
    """SHA-256 over the line before and this one, in hex; empty for lines older than the chain."""
    client: Annotated[str, Field(exclude_if=lambda value: not value)] = ""
    """Address that the request came from; empty, and left out, where there was none, and in older lines."""
    time_utc: UtcText = None

    def is_next_after(self, before: "AuditEntry") -> bool:
        """True if this line follows the line `before` in the chain, and is unchanged."""
        said = AuditText(self.who, self.what, self.detail, self.client)
        return audit_chain(bytes.fromhex(before.chain), self.number, self.time_s, said).hex() == self.chain


@dataclass(frozen=True, slots=True)
class AuditText:
    """Texts of a line of the audit log."""

    who: str
    what: str
    detail: str
    client: str = ""


def audit_chain(before: bytes, number: int, time_s: float, said: AuditText) -> bytes:
    """The chain at a line of the audit log, from the chain at the line before (empty at the first).

    Lines without an address are hashed as those of before there were addresses.
    """
    parts = [number, time_s, said.who, said.what, said.detail, *([said.client] if said.client else [])]
    line = json.dumps(parts, separators=(",", ":"))
    return hashlib.sha256(before + line.encode()).digest()
