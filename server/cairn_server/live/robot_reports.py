"""Robots' reports of themselves: the last status of each, and a picture of what it sees.

A status goes to listeners at once, and is written at most every few seconds: a power cut loses no more. Pictures are in
memory only, within one bound, the oldest dropped first; each robot may send so many a second.
"""

import hashlib
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field

from cairn_map.errors import BadInputError, NotFoundError, UnreachableError
from cairn_map.wire.messages import RobotStatus
from cairn_server.access.rate_limits import Allowance, allowance
from cairn_server.live.hub import Hub
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow

VIEW_BYTES_MAX = 1 << 20

WRITE_EVERY_S = 10.0
VIEWS_BYTES_MAX = 64 << 20
VIEWS_PER_S = 30.0
"""Highest rate of one robot's pictures: a camera's own."""
VIEWS_AT_ONCE = 60
"""Most pictures of one robot in a row after a pause."""
MEDIA_TYPES = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG\r\n\x1a\n": "image/png"}
"""Media types by a file's first bytes."""


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


class RobotReports:
    """Reports of all robots; thread-safe."""

    def __init__(self, store: Store, hub: Hub) -> None:
        self._store = store
        self._hub = hub
        self._lock = threading.Lock()
        self._written_s: dict[tuple[int, str], float] = {}
        self._unwritten: dict[tuple[int, str], tuple[MapRow, RobotStatus]] = {}
        self._views: OrderedDict[tuple[int, str], RobotView] = OrderedDict()
        self._views_bytes = 0
        self._view_rates: dict[tuple[int, str], Allowance] = {}

    def put_status(self, row: MapRow, branch: str, status: RobotStatus) -> None:
        """Store a robot's status.

        Raises:
            NotFoundError: kind `no_branch`.
        """
        self._check(row, branch)
        self._hub.robot_heard(row, branch, status=status)
        self._store.seen(row, branch, None)
        key, now_s = (row.number, branch), time.monotonic()
        with self._lock:
            if now_s - self._written_s.get(key, float("-inf")) < WRITE_EVERY_S:
                self._unwritten[key] = (row, status)
                return
            self._written_s[key] = now_s
            self._unwritten.pop(key, None)
        self._store.notes.put_status(row, branch, status.model_dump_json())

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
        view = RobotView(data, media_type, time.time())
        with self._lock:
            self._drop((row.number, branch))
            self._views[row.number, branch] = view
            self._views_bytes += len(data)
            while self._views_bytes > VIEWS_BYTES_MAX:
                self._drop(next(iter(self._views)))
        self._hub.robot_heard(row, branch, view_s=view.time_s)

    def view(self, row: MapRow, branch: str) -> RobotView:
        """A robot's latest picture.

        Raises:
            NotFoundError: kind `no_branch`, or `no_view`: it sent none since the server started.
        """
        self._check(row, branch)
        with self._lock:
            found = self._views.get((row.number, branch))
        if found is None:
            raise NotFoundError("no_view", f"robot {branch} has sent no picture, or not of late")
        return found

    def forget(self, row: MapRow, branch: str) -> None:
        """Forget the reports of a robot that left."""
        key = (row.number, branch)
        with self._lock:
            self._drop(key)
            self._unwritten.pop(key, None)
            self._written_s.pop(key, None)
            self._view_rates.pop(key, None)

    def close(self) -> None:
        """Write the latest statuses."""
        with self._lock:
            rest, self._unwritten = self._unwritten, {}
        for (_, branch), (row, status) in rest.items():
            self._store.notes.put_status(row, branch, status.model_dump_json())

    def _check(self, row: MapRow, branch: str) -> None:
        if self._hub.robots(row).of(branch) is None:
            raise NotFoundError("no_branch", f"map {row.name} has no branch {branch!r}")

    def _take_view(self, row: MapRow, branch: str) -> None:
        now_s = time.monotonic()
        with self._lock:
            fresh = allowance(VIEWS_AT_ONCE, VIEWS_PER_S, now_s=now_s)
            wait_s = self._view_rates.setdefault((row.number, branch), fresh).take(now_s)
        if wait_s:
            message = f"robot {branch} may show {VIEWS_PER_S:.0f} pictures a second"
            raise UnreachableError("too_many_views", message, retry_after_s=wait_s)

    def _drop(self, key: tuple[int, str]) -> None:
        view = self._views.pop(key, None)
        self._views_bytes -= len(view.data) if view else 0
