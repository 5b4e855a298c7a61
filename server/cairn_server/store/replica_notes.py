"""Protocol of notes that servers over one store share, and the values in them (`Store.replicas`).

What one process may keep in memory is wrong once the requests of a robot come to several: a picture that another one
has, a ticket that another one gave, a quota that each grants as a whole. Such things are noted in the store. They are
no evidence: losing them costs bytes or a moment, so a store need not keep them through a power cut, the marks of relays
and the use of quotas apart.

    reports   statuses and pictures of robots; a deregistered one's go with it
    tickets   exports that were asked for and not fetched yet
    bodies    beginnings of commits that come in parts
    uses      use of the quotas, and token buckets
    servers   servers that are alive

Hints of folds are no notes: a server that folds says so to all, and one that misses it sees the new head when it looks.
"""

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from cairn_map.commits.ids import CommitId
from cairn_server.store.store_rows import MapRow, Robot, Use


@dataclass(frozen=True, slots=True)
class RobotView:
    """Latest picture of a robot."""

    data: bytes = field(repr=False)
    media_type: str
    time_s: float
    """Time of its arrival, UTC seconds."""

    @property
    def digest(self) -> str:
        """Hex of its SHA-256."""
        return hashlib.sha256(self.data).hexdigest()


@dataclass(frozen=True, slots=True)
class NotedReport:
    """Last report of a robot to any server."""

    status: str | None = None
    """Its status, as JSON."""
    status_s: float = 0.0
    """Time at which the status was heard, UTC seconds."""
    view_s: float | None = None
    """Time at which its latest picture came, UTC seconds; None: there is none."""


class NotedReports(Protocol):
    """Reports of robots; of those that are not registered none is kept."""

    def write_seen(self) -> None:
        """Write soon what this server heard of branches and did not write yet (`store.Store.seen`)."""
        ...

    def put_status(self, row: MapRow, branch: str, status: str, *, heard_s: float) -> None:
        """Keep the status of a branch, unless one that was heard later is kept.

        It is that of `BranchNotes.statuses`, too.
        """
        ...

    def put_view(self, row: MapRow, branch: str, view: RobotView) -> None:
        """Keep the picture of a branch, unless one that came later is kept."""
        ...

    def view(self, row: MapRow, branch: str) -> RobotView | None:
        """The picture of a branch."""
        ...

    def all(self, row: MapRow) -> dict[str, NotedReport]:
        """Reports of all branches of a map that ever sent one, without their pictures."""
        ...

    def view_s(self, row: MapRow, branch: str) -> float | None:
        """Time at which the kept picture of a branch came."""
        ...


@dataclass(frozen=True, slots=True)
class TicketNote:
    """Ticket for an export, as any server can honour it."""

    map_name: str
    asked: str
    """The request, as JSON."""
    holder: bytes | None
    """SHA-256 of the token that asked; None: none was shown, to a server that wants none."""


class NotedTickets(Protocol):
    """Tickets, by the SHA-256 of their texts."""

    def put(self, key: bytes, note: TicketNote, *, lifetime_s: float) -> None:
        """Keep a ticket for so long."""
        ...

    def take(self, key: bytes) -> TicketNote | None:
        """Take a ticket out: of all that ask for it one gets it, and none once it has ended."""
        ...

    def left(self, keys: Collection[bytes]) -> set[bytes]:
        """Those of these tickets that were neither taken nor have ended."""
        ...


class BodyPlace(NamedTuple):
    """Place of a body that comes in parts: map, robot or relay, and commit."""

    map: int
    robot: str
    commit: CommitId


@dataclass(frozen=True, slots=True)
class BodyPart:
    """Part of a body."""

    digest: str
    """Hex of the whole body's SHA-256."""
    total_bytes: int
    offset_bytes: int
    data: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class StagedBody:
    """Beginning of a body, without its bytes."""

    place: BodyPlace
    digest: str
    total_bytes: int
    size_bytes: int
    """Count of the bytes that came."""
    idle_s: float
    """Seconds since its last part."""


class StagedBodies(Protocol):
    """Beginnings of bodies."""

    def all(self) -> list[StagedBody]:
        """All of them, the one without a part for the longest time first."""
        ...

    def at(self, place: BodyPlace) -> StagedBody | None:
        """The one at a place."""
        ...

    def append(self, place: BodyPlace, part: BodyPart) -> StagedBody | None:
        """Add a part where the last one of this very body ended, and return what is there of it; None: nothing.

        The first part of another body (digest, length) takes the place of what is there. One that begins elsewhere adds
        nothing; if its body has begun, it counts as a sign that this is still wanted.
        """
        ...

    def body(self, place: BodyPlace, digest: str) -> bytes | None:
        """Bytes that came of a body."""
        ...

    def drop(self, place: BodyPlace) -> None:
        """Drop what is at a place, if anything is."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class UseBounds:
    """Bounds of one robot's use; None is no bound."""

    size_bytes: int | None = None
    """A day (UTC), as are cells and bricks."""
    cells: int | None = None
    bricks: int | None = None
    commits_per_minute: int | None = None

    def hold(self, used: Use) -> bool:
        """True if this use of a day is within the bounds."""
        pairs = (used.size_bytes, self.size_bytes), (used.cells, self.cells), (used.bricks, self.bricks)
        return all(most is None or spent <= most for spent, most in pairs)


@dataclass(frozen=True, slots=True)
class UseAnswer:
    """Answer to a request for use: taken, over a bound of the day, or too many commits for now."""

    day: int
    """Days since 1970, by the clock of the store."""
    of_day: Use
    """Use of the day, with what was asked for; nothing of it was taken if this is over a bound."""
    wait_s: float = 0.0
    """Seconds until there is a commit left; 0: there was one."""


class UseAccounts(Protocol):
    """Use of quotas; each method is atomic over all servers."""

    def take(self, robot: Robot, use: Use, bounds: UseBounds, *, commits: int) -> UseAnswer:
        """Take use of the day and so many commits of the minute (0 or 1), all if all is within bounds, else nothing.

        Commits of the minute are a token bucket of `commits_per_minute`, which is full at first.
        """
        ...

    def give_back(self, robot: Robot, use: Use, *, day: int, commits: int) -> None:
        """Give back what was taken on a day; use of a day that is over is gone."""
        ...

    def take_turn(self, bucket: str, *, most: float, per_s: float) -> float:
        """Take one from the token bucket of a name; 0, or the seconds to wait, with nothing taken."""
        ...

    def give_turn(self, bucket: str) -> None:
        """Put one back."""
        ...


SERVER_S = 30.0
"""Seconds for which a server counts as alive after its last sign."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NotedServer:
    """Sign of a server of the store."""

    id: str
    answers: bool
    folds: bool
    version: str
    clock_ahead_s: float = 0.0
    """Lead of its clock over the store's."""
    folded_s: float | None
    """Seconds since its last fold; None: it made none."""
    heard_s: float = 0.0
    """Seconds since the sign."""


class NotedServers(Protocol):
    """Servers of the store."""

    def put(self, sign: NotedServer, *, wall_s: float) -> None:
        """Keep the sign of a server, given now, whose clock says `wall_s`."""
        ...

    def all(self) -> list[NotedServer]:
        """Servers that gave a sign within `SERVER_S`, by id."""
        ...

    def remove(self, server: str) -> None:
        """Drop a server that ends."""
        ...


class FoldHint(NamedTuple):
    """Hint that a server folded."""

    map: int
    """Number of the map."""
    seq: int
    """Newest log entry."""


OnHint = Callable[[FoldHint | None], None]
"""Receiver of hints, called from one thread; None: some may have been missed until now."""


class FoldHints(Protocol):
    """Hints of folds by all servers of a store, until closed."""

    @property
    def are_heard(self) -> bool:
        """True while hints come; False while only looks at the heads tell of folds."""
        ...

    def close(self) -> None:
        """Hear no more."""
        ...


class ReplicaNotes(Protocol):
    """Notes of servers over one store; every method may be called from any thread."""

    @property
    def reports(self) -> NotedReports:
        """Reports of robots."""
        ...

    @property
    def tickets(self) -> NotedTickets:
        """Tickets for exports."""
        ...

    @property
    def bodies(self) -> StagedBodies:
        """Bodies that come in parts."""
        ...

    @property
    def uses(self) -> UseAccounts:
        """Use of the quotas."""
        ...

    @property
    def servers(self) -> NotedServers:
        """Servers that are alive."""
        ...

    @property
    def secret(self) -> bytes:
        """32 random bytes, made with the store: key of the challenges that its servers give."""
        ...

    def fold_hints(self, on_hint: OnHint) -> FoldHints:
        """Begin to hear of folds by any server of the store, this one included; hints may be lost at any time."""
        ...

    def put_handed_over(self, upstream: str, map_name: str, age_s: float) -> None:
        """Note that all of a map at this age of the store was given to an upstream server, unless a later age is noted.

        Durable on return: evidence goes by it.
        """
        ...

    def handed_over(self, upstream: str) -> Mapping[str, float]:
        """Ages up to which maps were given to an upstream server, by the map's name."""
        ...
