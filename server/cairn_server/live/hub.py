"""Hub of live events: the listeners of each map, and the events that each has still to get.

It knows no network, and is called from many threads.

    folder, routes  --- folded, robots.heard --->  hub  --- wake() --->  listener (an SSE or WebSocket stream)
                                                    ^                        |
                                                    +------- take() ---------+

A slow listener gets not more events, but later ones: it holds its place only (`EventPosition`), and it takes the newest
head and the union of the changed cells. So it costs the same however slow it is.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import lru_cache

from pydantic import ValidationError

from cairn_map.errors import CairnError, UnreachableError
from cairn_map.wire.live_events import CHAIN_DIGITS, Beat, EventPosition, Hello, LiveEvent, RobotHeard, RobotSign
from cairn_map.wire.messages import RobotStatus
from cairn_server.live.live_map import LiveChanges, LiveRobots, StoredSign
from cairn_server.store.replica_notes import NotedReport
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Branch, MapRow

log = logging.getLogger(__name__)

BEAT_S = 15.0
LISTENERS_MAX = 512
LISTENERS_OF_TOKEN_MAX = 16


class _LiveMap:
    def __init__(self, store: Store, row: MapRow) -> None:
        self.row = row
        self.name = row.name
        self.changes = LiveChanges(store, row)
        self.robots = LiveRobots(lambda: _signs(store, row))
        self.listeners: set[Listener] = set()
        self.is_gone = False


class Hub:
    """Listeners of all maps of a server."""

    def __init__(self, store: Store, *, connections: int = 2 * LISTENERS_MAX) -> None:
        """Streams take at most half of a server's `connections`: the others are for requests."""
        self._store = store
        self._streams_max = connections // 2
        self._lock = threading.Lock()
        self._maps: dict[int, _LiveMap] = {}
        self._of_token: Counter[bytes] = Counter()
        self.is_closed = False
        self.beat_s = BEAT_S

    @property
    def listeners(self) -> int:
        """Count of the streams that listen now."""
        with self._lock:
            return self._of_token.total()

    def folded(self, row: MapRow) -> None:
        """Note that a map's head moved. Never fails: after an error, listeners hear of it with the next fold."""
        live = self._maps.get(row.number)
        if live is None or not live.listeners:
            return
        try:
            live.changes.read()
        except CairnError as exc:
            log.warning("map %s: cannot tell listeners what was folded: %s", row.name, exc.message)
        self._wake(live)

    def map_gone(self, row: MapRow) -> None:
        """Send the listeners of a map away, which was deleted: when they come again, they are refused."""
        with self._lock:
            live = self._maps.pop(row.number, None)
        if live is not None:
            live.is_gone = True
            self._wake(live)

    def listened_maps(self) -> list[MapRow]:
        """Maps that have listeners."""
        with self._lock:
            return [live.row for live in self._maps.values() if live.listeners]

    def lacks(self, number: int, seq: int) -> bool:
        """True if the map of this number has listeners that cannot have heard of a log entry yet."""
        live = self._maps.get(number)
        return live is not None and bool(live.listeners) and live.changes.seq < seq

    def robots(self, row: MapRow) -> LiveRobots:
        """Robots of a map, with the last sign of each that this server knows of."""
        return self._live(row).robots

    def present_robots(self, row: MapRow) -> LiveRobots:
        """Robots of a map, with what other servers of the store heard of them up to some seconds ago."""
        live = self._live(row)
        if self._store.replicas is not None and live.robots.refresh():
            self._wake(live)
        return live.robots

    def is_registered(self, row: MapRow, branch: str) -> bool:
        """True if there is a robot of this name on a map, whichever server of the store it registered at."""
        robots = self.robots(row)
        own = robots.of(branch)
        if self._store.replicas is None:
            return own is not None
        found = self._store.branch(row, branch)
        if found is None:
            self.robot_left(row, branch)
        elif own is None:
            self.robot_came(row, _sign(found))
        return found is not None

    def robot_heard(self, row: MapRow, branch: str, **news: object) -> None:
        """Note that a robot pushed, fetched, or reported; one that is not registered does not count."""
        live = self._live(row)
        if live.robots.heard(branch, **news):
            self._wake(live)

    def robot_came(self, row: MapRow, sign: RobotSign) -> None:
        """Note that a robot was registered."""
        live = self._live(row)
        live.robots.came(sign)
        self._wake(live)

    def robot_left(self, row: MapRow, branch: str) -> None:
        """Note that a robot was deregistered."""
        live = self._live(row)
        live.robots.left(branch)
        self._wake(live)

    def join(self, row: MapRow, token: bytes, wake: Callable[[], None], *, after: EventPosition | None) -> "Listener":
        """Begin to listen.

        Args:
            row: the map.
            token: digest of the listener's token; each token has a bounded number of listeners.
            wake: called from any thread when there are events to take; must not fail or wait.
            after: id of the last event that the client saw, to go on from there.

        Raises:
            UnreachableError: kind `too_many_streams`; or the server is shutting down.
        """
        live = self._live(row)
        with self._lock:
            if self.is_closed:
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            most = min(LISTENERS_MAX, self._streams_max)
            if self._of_token.total() >= most or self._of_token[token] >= LISTENERS_OF_TOKEN_MAX:
                raise UnreachableError(
                    "too_many_streams",
                    f"at most {LISTENERS_OF_TOKEN_MAX} streams for one token and {most} in all; close another",
                    retry_after_s=30.0,
                )
            listener = Listener(self, live, token, wake)
            self._of_token[token] += 1
            live.listeners.add(listener)
        try:
            # After the listener is in: what is folded from now on is read by `folded`, if not here.
            live.changes.read()
            self.present_robots(row)
            listener.start(after)
        except BaseException:
            listener.leave()
            raise
        return listener

    def close(self) -> None:
        """End all listeners, now and from now on."""
        with self._lock:
            self.is_closed = True
            maps = list(self._maps.values())
        for live in maps:
            self._wake(live)

    def remove(self, listener: "Listener") -> None:
        """Forget a listener that leaves."""
        with self._lock:
            if listener in listener.live.listeners:
                listener.live.listeners.remove(listener)
                self._of_token[listener.token] -= 1
                self._of_token += Counter()  # drops zeros: else every token ever seen would stay

    def _live(self, row: MapRow) -> _LiveMap:
        with self._lock:
            live = self._maps.get(row.number)
            if live is None:
                live = self._maps[row.number] = _LiveMap(self._store, row)
            return live

    def _wake(self, live: _LiveMap) -> None:
        with self._lock:
            listeners = list(live.listeners)
        for listener in listeners:
            listener.wake()


class Listener:
    """Place of one stream in the events of one map."""

    def __init__(self, hub: Hub, live: _LiveMap, token: bytes, wake: Callable[[], None]) -> None:
        self.live = live
        self.token = token
        self.wake = wake
        self._hub = hub
        self._seen = EventPosition(0, "0" * CHAIN_DIGITS, 0)
        self._losses = 0
        self._heard = 0
        """Tick up to which robots' signs were taken."""
        self._hello: Hello | None = None

    @property
    def beat_s(self) -> float:
        """Longest time without an event, after which a beat is sent."""
        return self._hub.beat_s

    @property
    def is_over(self) -> bool:
        """True if the server stops, the map is gone, or its log lost entries: then a listener begins again."""
        return self._hub.is_closed or self.live.is_gone or self.live.changes.losses != self._losses

    @property
    def is_behind(self) -> bool:
        """True if the map changed since the last events were taken."""
        return self._hello is not None or self.live.changes.head.seq > self._seen.seq

    def start(self, after: EventPosition | None) -> None:
        """Prepare the first event, and go on after the last event seen if it is one of this log."""
        head, self._losses = self.live.changes.place()
        tick, self._heard, robots = self.live.robots.present()
        resumed = after is not None and self.live.changes.has_proof(after)
        seq, chain = head.seq, head.chain.hex()[:CHAIN_DIGITS]
        if after is not None and resumed:
            # Another server of this store, whose clock was ahead, may have given the last id: ids never fall. Of robots
            # nothing is lost by it, since the first event has all of them.
            tick = max(tick, after.tick)
            if after.seq <= head.seq:
                seq, chain = after.seq, after.chain
        self._seen = EventPosition(seq, chain, tick)
        self._hello = Hello(
            id=str(self._seen),
            map=self.live.name,
            cursor=str(head),
            resumed=resumed,
            robots=robots,
            beat_s=self.beat_s,
        )

    def take(self) -> list[LiveEvent]:
        """Take all events since the last call, put together; never waits for a disk."""
        events: list[LiveEvent] = []
        if self._hello is not None:
            events.append(self._hello)
            self._hello = None
        changes, self._seen = self.live.changes.since(self._seen, losses=self._losses)
        events += changes
        for heard, sign in self.live.robots.since(self._heard):
            self._heard = heard
            self._seen = EventPosition(self._seen.seq, self._seen.chain, max(heard, self._seen.tick))
            events.append(RobotHeard(id=str(self._seen), robot=sign))
        return events

    def beat(self) -> Beat:
        """Event that says that the link is alive."""
        return Beat(id=str(self._seen), time_s=time.time())

    def leave(self) -> None:
        """Stop listening; may be called twice."""
        self._hub.remove(self)


def _signs(store: Store, row: MapRow) -> list[StoredSign]:
    if store.replicas is not None:
        noted = store.replicas.reports.all(row)
    else:
        noted = {name: NotedReport(status) for name, status in store.notes.statuses(row).items()}
    found = []
    for branch in store.branches(row):
        report = noted.get(branch.name, NotedReport())
        sign = _sign(branch).model_copy(update={"status": _status(report.status), "view_s": report.view_s})
        found.append(StoredSign(sign, report.status_s))
    return found


def _sign(branch: Branch) -> RobotSign:
    cursor = str(branch.cursor) if branch.cursor else None
    return RobotSign(branch=branch.name, mode=branch.mode, time_s=branch.last_seen_s, cursor=cursor)


@lru_cache(maxsize=4096)  # of a crowd few report within the second in which all are read again
def _status(text: str | None) -> RobotStatus | None:
    """Stored status; None if there is none, or it is of another version."""
    try:
        return RobotStatus.model_validate_json(text) if text else None
    except ValidationError:
        return None
