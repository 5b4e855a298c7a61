"""Rounds of one robot with its server: on call, in the background, and the last push before the robot closes.

    sync, SyncThread -> Rounds.run: one round at a time
                          watched (events, last contact), as a member of the map:
                            push commits -> fetch cells -> carried commits -> status report

The background thread does a round after each wake-up, one every so often, and after a failure only after a wait.
"""

import logging
import sys
import threading
import time
from collections.abc import Callable

from cairn_client.http.api import MapApi
from cairn_client.http.backoff import Backoff
from cairn_client.http.http_link import Link
from cairn_client.relay.carried_commits import Carrier
from cairn_client.replica.limits import Limits
from cairn_client.replica.replica import Replica
from cairn_client.robot.cell_budget import NO_ROOM, CellBudget
from cairn_client.robot.map_marks import follow_marks, keep_following
from cairn_client.robot.mark_attachments import AT_ONCE_BYTES, bring_attachments
from cairn_client.robot.membership import Membership
from cairn_client.robot.robot_events import Events
from cairn_client.robot.round_watch import RoundWatch
from cairn_client.robot.server_clock import ServerClock
from cairn_client.robot.status_report import OwnStatus
from cairn_client.sync.link_profile import LinkProfile
from cairn_client.sync.near_cells import cell_at
from cairn_client.sync.scope import Scope, fetch
from cairn_client.sync.sync import RoundReport, push_commits
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, CairnError, UnreachableError
from cairn_map.wire.messages import Mode

log = logging.getLogger(__name__)

OnPush = Callable[[CommitId], None]


FIRST_LOOK_S, LONGEST_LOOK_S = 0.05, 1.0
"""Pauses between rounds that look whether the server has folded; each is twice the one before."""
FLUSH_S = 60.0
"""Seconds that `Robot.close` may push before it leaves the rest for the next time."""
FOLDED_WITHIN_S = 60.0
"""Seconds that `Robot.sync(until_folded=True)` waits for the server's map."""
RETRY_S = 30.0
GONE_S = 3600.0
"""Time between two rounds once the map was deleted: only a person can bring it back, or let the robot in on another."""
ROUND_END_S = 2.0
"""Seconds that a round may go on by itself when the thread is to stop, before it is cut."""


class SyncThread:
    """A thread that does rounds until stopped; a failure is logged, reported and tried again, never raised."""

    def __init__(
        self, sync: Callable[[], object], *, every_s: float, on_failure: Callable[[CairnError, float], None]
    ) -> None:
        """Begin.

        Args:
            sync: does one round.
            every_s: seconds between two rounds while nothing wakes the thread.
            on_failure: called with the error of a round, and the seconds after which it is tried again.
        """
        self._sync = sync
        self._every_s = every_s
        self._on_failure = on_failure
        self._stopping = threading.Event()
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Do a round soon: there is something to push. The wait after a failure is not cut short."""
        self._woken.set()

    def stop(self, cut: Callable[[], None]) -> None:
        """Stop: a wait ends at once, a round under way at its end, or after two seconds by `cut`."""
        self._stopping.set()
        self._woken.set()
        # A round that waits for an answer cannot see the flag: its sockets are cut, and what was answered stays.
        self._thread.join(ROUND_END_S)
        if self._thread.is_alive():
            cut()
            self._thread.join()

    def _run(self) -> None:
        backoff = Backoff()
        while not self._stopping.is_set():
            # Cleared before the round: a commit made during it wakes the thread again, and no wake-up is lost.
            self._woken.clear()
            try:
                # After a failure the wait grows, and no wake-up shortens it: else each commit would try a dead link.
                self._sync()
            except UnreachableError as exc:
                wait_s = backoff.next_s(exc.retry_after_s)
                what = "no link" if exc.kind == "no_link" else f"the server takes nothing now: {exc.kind}"
                log.info("%s (%s); trying again in %.1f s", what, exc.message, wait_s)
                self._wait(exc, wait_s)
            except CairnError as exc:
                wait_s = GONE_S if exc.kind == "gone" else backoff.next_s(None)
                log.error("sync failed: %s: %s; trying again in %.1f s", exc.kind, exc.message, wait_s)
                self._wait(exc, wait_s)
            except Exception as exc:  # a fault of ours; uncaught, the robot would never sync again, and say nothing
                wait_s = backoff.next_s(None)
                log.exception("sync failed in a way that was not expected; trying again in %.1f s", wait_s)
                self._wait(CairnError("internal", f"{type(exc).__name__}: {exc}; the log says more"), wait_s)
            else:
                backoff.reset()
                if not self._stopping.is_set():
                    self._woken.wait(self._every_s)

    def _wait(self, exc: CairnError, wait_s: float) -> None:
        if not self._stopping.is_set():
            self._on_failure(exc, wait_s)
            self._stopping.wait(wait_s)


class Rounds:
    """Rounds of one robot, one at a time, by any thread."""

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
        clock: ServerClock,
        carrier: Carrier | None = None,
    ) -> None:
        """Nothing is sent before `sync` or `start`."""
        # What a round talks to, and as whom.
        self._api = api
        self._replica = replica
        self._membership = membership
        self._map_name = map_name
        self._mode: Mode = mode
        # What it fetches and pushes, as far as the link can carry it.
        self._scope = profile.scope_of(scope)
        self._parts = profile.parts
        self._status = status
        self._clock = clock
        self._carrier = carrier
        self._branch = replica.author.robot
        self._link = Link(api, map_name, branch=self._branch, has_epochs=lambda: replica.layer.has_epochs)
        # Cells that are held at all, by the limits; then the reports, and the lock that lets one round pass at a time.
        scope_box = scope.box(replica.geometry.cell_edges_m)
        self._budget = CellBudget(replica, limits, events, place=status.place, scope_box=scope_box)
        self._watch = RoundWatch(replica, events)
        self._lock = threading.Lock()
        self._thread: SyncThread | None = None

    def sync(self, on_push: OnPush | None = None) -> RoundReport:
        """Do one round; raises what `Robot.sync` does."""
        try:
            return self._run(on_push)
        except CairnError as exc:
            self._watch.failed(exc, None)
            raise

    def sync_until_folded(self, on_push: OnPush | None, *, within_s: float) -> RoundReport:
        """Do rounds until one finds all own commits in the server's map; raises what `Robot.sync` does."""
        end_s, pause_s = time.monotonic() + within_s, FIRST_LOOK_S
        while True:
            report = self.sync(on_push)
            # Commits that the server refuses wait for ever: only those that it took can be waited for.
            if not report.has_more and not report.pending and report.waiting <= len(report.refused):
                return report
            if time.monotonic() > end_s:
                raise UnreachableError(
                    "not_folded",
                    f"after {within_s:g} s the server's map lacks {report.pending + report.waiting} own commits still; "
                    "nothing is lost, sync again later",
                    retry_after_s=RETRY_S,
                )
            if not report.has_more:
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_LOOK_S)

    def begin_marks(self) -> None:
        """Fetch the map's marks if they never were: each round brings the copy on from then on."""
        with self._lock:
            if self._replica.marks.cursor is None:
                self._membership.as_member(follow_marks, self._api, self._replica.marks, self._map_name)

    def start(self, *, every_s: float) -> None:
        """Do rounds in the background, if there are none yet."""
        if self._thread is None:
            self._thread = SyncThread(self._run, every_s=every_s, on_failure=self._watch.failed)

    def wake(self) -> None:
        """Do a round in the background soon: there is something to push."""
        if self._thread is not None:
            self._thread.wake()

    def stop(self) -> None:
        """End the rounds in the background; one under way has two seconds to end."""
        if self._thread is not None:
            self._thread.stop(self._api.sockets.cut)
            self._thread = None
            # A cut lasts until it is mended, and the last push of `finish` needs the link.
            self._api.sockets.mend()

    def leave(self) -> None:
        """Leave the map; no more rounds in the background."""
        self.stop()
        self._membership.leave()

    def finish(self, *, is_leaving: bool, within_s: float) -> None:
        """Push the commits that wait, and deregister if none is left; without a link all stays as it is."""
        # Cut from outside, because a slow link gives the push no moment to look at a clock; what was answered stays.
        limit = threading.Timer(within_s, self._api.sockets.cut)
        limit.start()
        try:
            if self._mode != "viewer" and self._replica.push_set():
                self._membership.as_member(self._push, None)
            self._bring_attachments(at_once_bytes=sys.maxsize)
            # Asked again after the push: a commit that is still only here must not lose its robot's place on the map.
            if is_leaving and not self._replica.push_set():
                self._membership.leave_if_welcome_back()
        # It is closing, so there is no later try to wait for: the next start pushes what waits.
        except CairnError as exc:
            waiting = len(self._replica.push_set())
            log.warning("still on the map, and %d commits wait in the directory: %s", waiting, exc.message)
        finally:
            limit.cancel()

    def _run(self, on_push: OnPush | None = None) -> RoundReport:
        """One round; its failure is reported by the caller, who knows when it is tried again."""
        # The background and a caller of `sync` share the replica and the link: their rounds take turns.
        with self._lock:
            try:
                with self._watch.cell_changes():
                    report = self._membership.as_member(self._push_and_fetch, on_push)
            finally:  # also of a round that failed, such as one whose registration was refused
                self._clock.learn(self._api.take_time())
            self._watch.succeeded(report)
            return report

    def _push_and_fetch(self, on_push: OnPush | None) -> RoundReport:
        # Own commits first: the fetch may be long, and what it brings covers them then.
        pushes = self._push(on_push)
        report = self._fetch()
        report.add_pushes(pushes)
        if self._mode != "viewer":
            report.waiting, report.pending = self._replica.behind()
        keep_following(self._api, self._replica, self._map_name)
        # Then attachments and others' commits, and the status, which costs nothing if it is lost.
        if self._bring_attachments(at_once_bytes=AT_ONCE_BYTES):
            self.wake()
        if self._carrier is not None:
            self._carrier.exchange()
        # A round that ended at its limit of bytes goes on at once; commits made meanwhile have their turn first.
        if report.has_more:
            self.wake()
        self._status.send(self._replica, self._api, self._map_name, branch=self._branch, mode=self._mode)
        return report

    def _bring_attachments(self, *, at_once_bytes: int) -> bool:
        """Send attachments of own marks that the server wants; True if there is more to send."""
        if self._mode == "viewer" or not self._replica.attachments.names():
            return False
        bring = self._membership.as_member
        return bring(bring_attachments, self._api, self._replica, self._map_name, at_once_bytes)

    def _fetch(self) -> RoundReport:
        """Fetch the cells that fit: again with a smaller box when there is no room for them."""
        # The box of cells that fit goes with the robot, and is made smaller until its cells do fit.
        is_low_end, place = self._mode == "low-end", self._status.place()
        near = cell_at(place, self._replica.geometry.cell_edges_m) if place is not None else None
        self._link.hold(self._budget.keep_up())
        while True:
            box = self._budget.box()
            try:
                fetching = fetch(self._replica, is_low_end=is_low_end, scope=self._scope, within=box, near=near)
                return self._link.hold(fetching)
            except UnreachableError as exc:
                if exc.kind != NO_ROOM:
                    raise
                # Each try fills less of the limits, so it ends: with a box that fits, or with no smaller one left.
                if not self._link.hold(self._budget.tighten()):
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
            # From here on smaller commits go in parts, too: what came of one before a cut stays on the server.
            self._parts = self._parts.after_a_cut()
            raise
