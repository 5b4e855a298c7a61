"""Robots' reports of themselves: the last status of each, and a picture of what it sees.

A status goes to listeners at once, and is written at most every few seconds: a power cut loses no more. Pictures are in
memory only, within one bound, the oldest dropped first; each robot may send so many a second. Where several servers
share the store, each notes both there at most once or twice a second, and shows the newest picture of its own and the
noted one.
"""

import threading
import time
from collections import OrderedDict

from cairn_map.errors import BadInputError, NotFoundError, UnreachableError
from cairn_map.wire.messages import RobotStatus
from cairn_server.access.rate_limits import Allowance, allowance
from cairn_server.live.hub import Hub
from cairn_server.store.replica_notes import RobotView
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow

VIEW_BYTES_MAX = 1 << 20

WRITE_EVERY_S = 10.0
SHARE_EVERY_S = 1.0
"""Time between two notes of a robot's status, or of its picture, for other servers of the store."""
VIEWS_BYTES_MAX = 64 << 20
VIEWS_PER_S = 30.0
"""Highest rate of one robot's pictures: a camera's own."""
VIEWS_AT_ONCE = 60
"""Most pictures of one robot in a row after a pause."""
MEDIA_TYPES = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG\r\n\x1a\n": "image/png"}
"""Media types by a file's first bytes."""
Key = tuple[int, str]
"""Key of a robot: number of the map, and branch."""


class RobotReports:
    """Reports of all robots; thread-safe."""

    def __init__(self, store: Store, hub: Hub) -> None:
        self._store = store
        self._hub = hub
        self._lock = threading.Lock()
        self._notes = store.replicas.reports if store.replicas is not None else None
        self._written_s: dict[Key, float] = {}
        self._unwritten: dict[Key, tuple[MapRow, RobotStatus, float]] = {}
        """With the time at which each was heard."""
        self._shared_s: dict[Key, float] = {}
        self._unshared: dict[Key, MapRow] = {}
        """Robots whose latest pictures other servers cannot see yet."""
        self._views: OrderedDict[Key, RobotView] = OrderedDict()
        self._views_bytes = 0
        self._view_rates: dict[Key, Allowance] = {}

    def put_status(self, row: MapRow, branch: str, status: RobotStatus) -> None:
        """Store a robot's status.

        Raises:
            NotFoundError: kind `no_branch`.
        """
        self._check(row, branch)
        key, heard_s = (row.number, branch), time.time()
        every_s = WRITE_EVERY_S if self._notes is None else SHARE_EVERY_S
        with self._lock:
            is_due = _is_due(self._written_s, key, every_s)
            self._unwritten[key] = (row, status, heard_s)
        if is_due:
            self._write_status(key)
        self._hub.robot_heard(row, branch, status=status)
        self._store.seen(row, branch, None)

    def put_view(self, row: MapRow, branch: str, data: bytes) -> None:
        """Store a robot's picture.

        Raises:
            NotFoundError: kind `no_branch`.
            UnreachableError: kind `too_many_views`: too soon; with the seconds until the next one is accepted.
            BadInputError: kind `bad_picture`, or `too_large`.
        """
        self._check(row, branch)
        self._take_view(row, branch)
        media_type = next((found for magic, found in MEDIA_TYPES.items() if data.startswith(magic)), None)
        if media_type is None:
            raise BadInputError("bad_picture", "a picture is JPEG or PNG; this begins like neither")
        if len(data) > VIEW_BYTES_MAX:
            raise BadInputError("too_large", f"a picture has at most {VIEW_BYTES_MAX} bytes, got {len(data)}")
        key, view = (row.number, branch), RobotView(data, media_type, time.time())
        self._keep(key, view)
        if self._notes is not None:
            with self._lock:
                is_due = _is_due(self._shared_s, key, SHARE_EVERY_S)
                self._unshared[key] = row
            if is_due:
                self._share_view(key)
        self._hub.robot_heard(row, branch, view_s=view.time_s)

    def view(self, row: MapRow, branch: str) -> RobotView:
        """A robot's latest picture.

        Raises:
            NotFoundError: kind `no_branch`, or `no_view`: it sent none since the server started.
        """
        self._check(row, branch)
        with self._lock:
            found = self._views.get((row.number, branch))
        if self._notes is not None:
            found = self._newest_view(row, branch, found)
        if found is None:
            raise NotFoundError("no_view", f"robot {branch} has sent no picture, or not of late")
        return found

    def forget(self, row: MapRow, branch: str) -> None:
        """Forget the reports of a robot that left."""
        key = (row.number, branch)
        with self._lock:
            self._drop(key)
            for noted in (self._unwritten, self._written_s, self._unshared, self._shared_s, self._view_rates):
                noted.pop(key, None)

    def flush(self) -> None:
        """Write the latest statuses, and note the latest pictures and signs for other servers."""
        if self._notes is not None:
            # The last sign of a robot that fell silent waits for no further one.
            self._notes.write_seen()
        with self._lock:
            statuses, views = list(self._unwritten), list(self._unshared)
        for key in statuses:
            self._write_status(key)
        for key in views:
            self._share_view(key)

    def close(self) -> None:
        """Write what is not written yet."""
        self.flush()

    def _write_status(self, key: Key) -> None:
        with self._lock:
            found = self._unwritten.pop(key, None)
        if found is None:
            return
        (row, status, heard_s), (_, branch) = found, key
        if self._notes is None:
            self._store.notes.put_status(row, branch, status.model_dump_json())
        else:
            self._notes.put_status(row, branch, status.model_dump_json(), heard_s=heard_s)

    def _share_view(self, key: Key) -> None:
        with self._lock:
            row, view = self._unshared.pop(key, None), self._views.get(key)
        if self._notes is not None and row is not None and view is not None:
            self._notes.put_view(row, key[1], view)

    def _newest_view(self, row: MapRow, branch: str, own: RobotView | None) -> RobotView | None:
        """The newest of an own picture and the noted one; none is noted of a robot that was deregistered elsewhere."""
        assert self._notes is not None  # noqa: S101 - by its caller
        noted_s = self._notes.view_s(row, branch)
        if noted_s is None or (own is not None and own.time_s >= noted_s):
            return own if noted_s is not None else None
        found = self._notes.view(row, branch)
        if found is not None:
            self._keep((row.number, branch), found)
        return found

    def _keep(self, key: Key, view: RobotView) -> None:
        """Keep a picture in memory unless a later one is there, and drop the oldest ones beyond the bound."""
        with self._lock:
            known = self._views.get(key)
            if known is not None and known.time_s > view.time_s:
                return
            self._drop(key)
            self._views[key] = view
            self._views_bytes += len(view.data)
            while self._views_bytes > VIEWS_BYTES_MAX:
                self._drop(next(iter(self._views)))

    def _check(self, row: MapRow, branch: str) -> None:
        if not self._hub.is_registered(row, branch):
            self.forget(row, branch)
            raise NotFoundError("no_branch", f"map {row.name} has no branch {branch!r}")

    def _take_view(self, row: MapRow, branch: str) -> None:
        now_s = time.monotonic()
        with self._lock:
            fresh = allowance(VIEWS_AT_ONCE, VIEWS_PER_S, now_s=now_s)
            wait_s = self._view_rates.setdefault((row.number, branch), fresh).take(now_s)
        if wait_s:
            message = f"robot {branch} may show {VIEWS_PER_S:.0f} pictures a second"
            raise UnreachableError("too_many_views", message, retry_after_s=wait_s)

    def _drop(self, key: Key) -> None:
        view = self._views.pop(key, None)
        self._views_bytes -= len(view.data) if view else 0


def _is_due(written_s: dict[Key, float], key: Key, every_s: float) -> bool:
    """True if it is time to write a robot's report, which is noted."""
    now_s = time.monotonic()
    if now_s - written_s.get(key, float("-inf")) < every_s:
        return False
    written_s[key] = now_s
    return True
