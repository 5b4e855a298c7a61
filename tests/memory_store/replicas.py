"""Notes that servers over one store share (`store.ReplicaNotes`), in dictionaries: for servers in one process."""

import secrets
import threading
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

from tests.memory_store.maps import MemoryMaps

from cairn_map.errors import UnreachableError
from cairn_server.store.replica_notes import (
    SERVER_S,
    BodyPart,
    BodyPlace,
    NotedReport,
    NotedServer,
    OnHint,
    ReplicaNotes,
    RobotView,
    StagedBody,
    TicketNote,
    UseAnswer,
    UseBounds,
)
from cairn_server.store.store_age import CLOCKS, Clocks
from cairn_server.store.store_rows import MapRow, Robot, Use

DAY_S = 86_400


class MemoryReplicaNotes:
    """All notes of one store."""

    def __init__(self, maps: MemoryMaps, clocks: Clocks = CLOCKS) -> None:
        self.reports = MemoryReports(maps)
        self.tickets = MemoryTickets(clocks)
        self.bodies = MemoryBodies(clocks)
        self.uses = MemoryUseAccounts(clocks)
        self.servers = MemoryServers(clocks)
        self.secret = secrets.token_bytes(32)
        self._handed_over: dict[tuple[str, str], float] = {}
        self._maps = maps

    def fold_hints(self, on_hint: OnHint) -> "MemoryFoldHints":
        """Begin to hear of folds."""
        return MemoryFoldHints(self._maps, on_hint)

    def put_handed_over(self, upstream: str, map_name: str, age_s: float) -> None:
        """Note up to which age all of a map is on an upstream server."""
        key = upstream, map_name
        self._handed_over[key] = max(age_s, self._handed_over.get(key, age_s))

    def handed_over(self, upstream: str) -> Mapping[str, float]:
        """Ages by the map's name."""
        return {name: age_s for (url, name), age_s in list(self._handed_over.items()) if url == upstream}


class MemoryServers:
    """`replica_notes.NotedServers`."""

    def __init__(self, clocks: Clocks) -> None:
        self._clocks = clocks
        self._kept: dict[str, tuple[NotedServer, float]] = {}

    def put(self, sign: NotedServer, *, wall_s: float) -> None:
        """Keep the sign of a server."""
        noted = replace(sign, clock_ahead_s=wall_s - self._clocks.wall_s())
        self._kept[sign.id] = noted, self._clocks.steady_s()

    def all(self) -> list[NotedServer]:
        """Servers that gave a sign of late."""
        found = []
        for sign, at_s in list(self._kept.values()):
            heard_s = self._clocks.steady_s() - at_s
            folded_s = None if sign.folded_s is None else sign.folded_s + heard_s
            if heard_s < SERVER_S:
                found.append(replace(sign, heard_s=heard_s, folded_s=folded_s))
        return sorted(found, key=lambda sign: sign.id)

    def remove(self, server: str) -> None:
        """Drop a server."""
        self._kept.pop(server, None)


class MemoryFoldHints:
    """`replica_notes.FoldHints`, called by the thread that folds."""

    def __init__(self, maps: MemoryMaps, on_hint: OnHint) -> None:
        self._maps = maps
        self._on_hint = on_hint
        self.are_heard = True
        maps.hear_folds(on_hint)
        on_hint(None)

    def close(self) -> None:
        """Hear no more."""
        self.are_heard = False
        self._maps.hear_no_folds(self._on_hint)


class MemoryReports:
    """`replica_notes.NotedReports`, among the rows of the maps."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps

    def write_seen(self) -> None:
        """Do nothing: what is heard of branches is written at once."""

    def put_status(self, row: MapRow, branch: str, status: str, *, heard_s: float) -> None:
        """Keep a status, unless a later one is kept."""
        with suppress(UnreachableError), self._maps.changing(row) as changed:
            if branch in changed.branches and heard_s >= changed.heard_s.get(branch, 0.0):
                changed.heard_s[branch] = heard_s
                changed.statuses[branch] = status

    def put_view(self, row: MapRow, branch: str, view: RobotView) -> None:
        """Keep a picture, unless a later one is kept."""
        with suppress(UnreachableError), self._maps.changing(row) as changed:
            known = changed.views.get(branch)
            if branch in changed.branches and (known is None or view.time_s >= known.time_s):
                changed.views[branch] = view

    def view(self, row: MapRow, branch: str) -> RobotView | None:
        """The picture of a branch."""
        with self._maps.reading(row) as state:
            return state.views.get(branch)

    def view_s(self, row: MapRow, branch: str) -> float | None:
        """Time at which the picture of a branch came."""
        view = self.view(row, branch)
        return view.time_s if view else None

    def all(self, row: MapRow) -> dict[str, NotedReport]:
        """Reports of all branches, without their pictures."""
        with self._maps.reading(row) as state:
            return {
                branch: NotedReport(
                    state.statuses.get(branch),
                    state.heard_s.get(branch, 0.0),
                    state.views[branch].time_s if branch in state.views else None,
                )
                for branch in state.statuses.keys() | state.views.keys()
            }


class MemoryTickets:
    """`replica_notes.NotedTickets`."""

    def __init__(self, clocks: Clocks) -> None:
        self._steady_s = clocks.steady_s
        self._lock = threading.Lock()
        self._kept: dict[bytes, tuple[TicketNote, float]] = {}

    def put(self, key: bytes, note: TicketNote, *, lifetime_s: float) -> None:
        """Keep a ticket."""
        with self._lock:
            now_s = self._steady_s()
            self._kept = {other: kept for other, kept in self._kept.items() if kept[1] > now_s}
            self._kept[key] = note, now_s + lifetime_s

    def take(self, key: bytes) -> TicketNote | None:
        """Take a ticket out."""
        with self._lock:
            note, until_s = self._kept.pop(key, (None, 0.0))
            return note if until_s > self._steady_s() else None

    def left(self, keys: Collection[bytes]) -> set[bytes]:
        """Those of these tickets that were neither taken nor have ended."""
        with self._lock:
            now_s = self._steady_s()
            return {key for key in keys if key in self._kept and self._kept[key][1] > now_s}


@dataclass(slots=True)
class _Body:
    digest: str
    total_bytes: int
    used_s: float
    data: bytes = b""


class MemoryBodies:
    """`replica_notes.StagedBodies`."""

    def __init__(self, clocks: Clocks) -> None:
        self._steady_s = clocks.steady_s
        self._lock = threading.Lock()
        self._kept: dict[BodyPlace, _Body] = {}

    def all(self) -> list[StagedBody]:
        """All of them, the one without a part for the longest time first."""
        with self._lock:
            found = [self._staged(place, body) for place, body in self._kept.items()]
        return sorted(found, key=lambda body: -body.idle_s)

    def at(self, place: BodyPlace) -> StagedBody | None:
        """The one at a place."""
        with self._lock:
            body = self._kept.get(place)
            return self._staged(place, body) if body else None

    def append(self, place: BodyPlace, part: BodyPart) -> StagedBody | None:
        """Add a part where the last one of this very body ended."""
        with self._lock:
            body = self._kept.get(place)
            if body is None or (body.digest, body.total_bytes) != (part.digest, part.total_bytes):
                if part.offset_bytes or not part.data:
                    return None
                body = _Body(part.digest, part.total_bytes, 0.0)
            if part.offset_bytes == len(body.data):
                body.data += part.data
            body.used_s = self._steady_s()
            self._kept[place] = body
            return self._staged(place, body)

    def body(self, place: BodyPlace, digest: str) -> bytes | None:
        """Bytes that came of a body."""
        with self._lock:
            body = self._kept.get(place)
            return body.data if body and body.digest == digest else None

    def drop(self, place: BodyPlace) -> None:
        """Drop what is at a place."""
        with self._lock:
            self._kept.pop(place, None)

    def _staged(self, place: BodyPlace, body: _Body) -> StagedBody:
        return StagedBody(place, body.digest, body.total_bytes, len(body.data), self._steady_s() - body.used_s)


@dataclass(slots=True)
class _Bucket:
    left: float
    seen_s: float


@dataclass(slots=True)
class _Account:
    day: int
    used: Use = field(default_factory=Use)


class MemoryUseAccounts:
    """`replica_notes.UseAccounts`."""

    def __init__(self, clocks: Clocks) -> None:
        self._clocks = clocks
        self._lock = threading.RLock()
        self._days: dict[Robot, _Account] = {}
        self._buckets: dict[str, _Bucket] = {}

    def take(self, robot: Robot, use: Use, bounds: UseBounds, *, commits: int) -> UseAnswer:
        """Take use of the day and commits of the minute, or nothing."""
        day = int(self._clocks.wall_s() // DAY_S)
        with self._lock:
            account = self._days.get(robot)
            if account is None or account.day != day:
                account = self._days[robot] = _Account(day)
            of_day = account.used + use
            if not bounds.hold(of_day):
                return UseAnswer(day, of_day)
            most = bounds.commits_per_minute
            if commits and most is not None:
                wait_s = self.take_turn(_commits_of(robot), most=most, per_s=most / 60)
                if wait_s:
                    return UseAnswer(day, of_day, wait_s)
            account.used = of_day
            return UseAnswer(day, of_day)

    def give_back(self, robot: Robot, use: Use, *, day: int, commits: int) -> None:
        """Give back what was taken on a day."""
        with self._lock:
            account = self._days.get(robot)
            if account is not None and account.day == day:
                account.used -= use
            if commits:
                self.give_turn(_commits_of(robot))

    def take_turn(self, bucket: str, *, most: float, per_s: float) -> float:
        """Take one from a token bucket; 0, or the seconds to wait."""
        with self._lock:
            now_s = self._clocks.steady_s()
            kept = self._buckets.setdefault(bucket, _Bucket(most, now_s))
            kept.left = min(most, kept.left + (now_s - kept.seen_s) * per_s)
            kept.seen_s = now_s
            if kept.left < 1:
                return (1 - kept.left) / per_s
            kept.left -= 1
            return 0.0

    def give_turn(self, bucket: str) -> None:
        """Put one back."""
        with self._lock:
            if bucket in self._buckets:
                self._buckets[bucket].left += 1


def _commits_of(robot: Robot) -> str:
    return f"commits {robot[0]} {robot[1]}"


_IS_REPLICA_NOTES: type[ReplicaNotes] = MemoryReplicaNotes
"""Refused by the type checker if it is none."""
