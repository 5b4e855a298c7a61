"""One robot's rounds with its server: called for, in the background, and the last one before the robot goes."""

import logging
import threading
from collections.abc import Callable

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.relay.carrying import Carrier
from cairn_client.replica.replica import Replica
from cairn_client.robot.cell_budget import NO_ROOM, Room
from cairn_client.robot.limits import Limits
from cairn_client.robot.membership import Membership
from cairn_client.robot.robot_events import Events
from cairn_client.robot.round_watch import RoundWatch
from cairn_client.robot.status_report import OwnStatus
from cairn_client.robot.sync_thread import SyncThread
from cairn_client.sync.link_profile import LinkProfile
from cairn_client.sync.near_cells import cell_at
from cairn_client.sync.scope import Scope, fetch
from cairn_client.sync.sync import RoundReport, push_commits
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, CairnError, UnreachableError
from cairn_map.wire.messages import Mode

log = logging.getLogger(__name__)

OnPush = Callable[[CommitId], None]


class Rounds:
    """Push, then fetch; one round at a time, by whichever thread."""

    def __init__(
        self,
        api: MapApi,
        replica: Replica,
        membership: Membership,
        events: Events,
        *,
        map_name: str,
        mode: Mode,
        scope: Scope,
        profile: LinkProfile,
        limits: Limits,
        status: OwnStatus,
        carrier: Carrier | None = None,
    ) -> None:
        """Nothing is sent before `sync` or `start`."""
        self._api = api
        self._replica = replica
        self._membership = membership
        self._map_name = map_name
        self._mode: Mode = mode
        self._scope = profile.scope_of(scope)
        self._parts = profile.parts
        self._status = status
        self._carrier = carrier
        self._branch = replica.author.robot
        self._link = Link(api, map_name, branch=self._branch)
        scope_box = scope.box(replica.geometry.cell_edge_m)
        self._room = Room(replica, limits, events, place=status.place, scope_box=scope_box)
        self._watch = RoundWatch(replica, events)
        self._lock = threading.Lock()
        self._thread: SyncThread | None = None

    def sync(self, on_push: OnPush | None = None) -> RoundReport:
        """One round; raises what `Robot.sync` does."""
        try:
            return self._round(on_push)
        except CairnError as exc:
            self._watch.failed(exc)
            raise

    def start(self, *, every_s: float) -> None:
        """Rounds in the background, if there are none yet."""
        if self._thread is None:
            self._thread = SyncThread(self._round, every_s=every_s, on_failure=self._watch.failed)

    def wake(self) -> None:
        """There is something to push."""
        if self._thread is not None:
            self._thread.wake()

    def stop(self) -> None:
        """No more rounds in the background; one under way has two seconds to end."""
        if self._thread is not None:
            self._thread.stop(self._api.sockets.cut)
            self._thread = None
            self._api.sockets.mend()

    def leave(self) -> None:
        """Deregister."""
        self.stop()
        self._membership.leave()

    def finish(self, *, is_leaving: bool, within_s: float) -> None:
        """Push what waits, and deregister if nothing is left; without a link all stays as it is."""
        limit = threading.Timer(within_s, self._api.sockets.cut)
        limit.start()
        try:
            if self._mode != "viewer" and self._replica.push_set():
                self._membership.as_member(lambda: self._push(None))
            if is_leaving and not self._replica.push_set():
                self._membership.leave_if_welcome_back()
        except CairnError as exc:
            waiting = len(self._replica.push_set())
            log.warning("still on the map, and %d commits wait in the directory: %s", waiting, exc.message)
        finally:
            limit.cancel()

    def _round(self, on_push: OnPush | None = None) -> RoundReport:
        with self._lock:
            return self._watch.round(lambda: self._membership.as_member(lambda: self._push_and_fetch(on_push)))

    def _push_and_fetch(self, on_push: OnPush | None) -> RoundReport:
        pushes = self._push(on_push)
        report = self._fetch()
        report.pushed, report.refused = pushes.pushed, pushes.refused
        if self._carrier is not None:
            self._carrier.exchange()
        if report.has_more:
            self.wake()
        self._status.tell(self._replica, self._api, self._map_name, branch=self._branch, mode=self._mode)
        return report

    def _fetch(self) -> RoundReport:
        """What fits: again with a smaller box when there is no room for it."""
        is_low_end, place = self._mode == "low-end", self._status.place()
        near = cell_at(place, self._replica.geometry.cell_edge_m) if place is not None else None
        self._link.hold(self._room.keep_up())
        while True:
            box = self._room.box()
            try:
                fetching = fetch(self._replica, is_low_end=is_low_end, scope=self._scope, room=box, near=near)
                return self._link.hold(fetching)
            except UnreachableError as exc:
                if exc.kind != NO_ROOM:
                    raise
                if not self._link.hold(self._room.tighten()):
                    raise BadInputError(NO_ROOM, f"not even the cell around the robot fits: {exc.message}") from exc

    def _push(self, on_push: OnPush | None) -> RoundReport:
        def pushed(commit: CommitId) -> None:
            self._watch.pushed(commit)
            if on_push:
                on_push(commit)

        sealed_only = self._mode == "viewer"
        pushing = push_commits(self._replica, sealed_only=sealed_only, on_push=pushed, parts=self._parts)
        try:
            return self._link.hold(pushing)
        except UnreachableError:
            self._parts = self._parts.after_a_cut()
            raise
