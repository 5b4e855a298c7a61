"""Live mapping: scans of a live source into a robot, one after the other, by the thread that calls it.

    messages -> LiveScans -> backlog -> gate -> decode -> Robot.observe -> commit after 50 scans, 5 s or 2 m

A robot that is slower than its cameras takes the newest scans: those that wait longer than half a second go, and
are counted. So arrived = taken + not moved + dropped + left out by cause + waiting, at any time. Where the disk or the
outbox is full, mapping goes on in the open measurement. Past measurements follow a SLAM's corrections in between.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterable

from cairn_client.live.path_corrections import JumpWatch, PathCorrections
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.grouping import Grouping, OpenGroup
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.recording.scan import Scan
from cairn_fusion.ros.bag import BagMessage
from cairn_fusion.ros.live_scans import Cause, LiveScans, ReadyScan
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit
from cairn_map.errors import BadInputError, CairnError, DamagedDataError, UnreachableError

log = logging.getLogger(__name__)

TOO_LARGE = "too_large"
"""Kind of the error of a measurement that can be no commit."""
BEHIND_S = 0.5
"""Wait from which on a scan gives way to newer ones: where cameras bring more scans than are mapped, each one waits so
long, and with its way here and its own mapping it must be in the robot's map within a second (`tests.bench`, live)."""
REST_S = 5.0
"""Time without a scan after which the open measurement is committed."""
FINISH_S = 1.0
"""Longest mapping of what waits at the end: a container is killed ten seconds after it is asked to stop, and the push
may take eight of them."""


class LiveMapping:
    """Mapping of one live source by one robot."""

    def __init__(
        self,
        robot: Robot,
        scans: LiveScans,
        decoder: ScanDecoder,
        gate: ScanGate,
        *,
        profile: Profile | None = None,
        corrections: PathCorrections | None = None,
        on_taken: Callable[[ReadyScan], object] = lambda ready: None,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open.

        Args:
            robot: takes the scans.
            scans: assembles them.
            decoder: decodes them.
            gate: says which are taken.
            profile: coding of the commits; None: the link's.
            corrections: moves past measurements; None: they stay, and jumps are counted all the same.
            on_taken: called with each scan that became evidence.
            steady_s: clock.
        """
        self.taken = 0
        """Scans that became evidence."""
        self.dropped = 0
        """Scans that gave way to newer ones, or to the end, or for which there was no room."""
        self.commits = 0
        self.refusal = ""
        """Reason for which the last commit waits; empty: there is none."""
        self.newest_s = float("-inf")
        """Stamp of the scan taken last."""
        self.jumps = JumpWatch(robot.replica.geometry.voxel_edge_m / 2)
        """Jumps of the odometry in the map."""
        self.corrections = corrections
        self._robot = robot
        self._scans = scans
        self._decoder = decoder
        self._gate = gate
        self._profile = profile
        self._on_taken = on_taken
        self._steady_s = steady_s
        self._group = OpenGroup(Grouping())
        self._backlog: deque[ReadyScan] = deque()
        self._open_scans = 0
        """Scans of the open measurement."""
        self._last_scan_s: float | None = None
        """Steady time of the last scan of the open measurement; None: it is empty."""

    @property
    def not_moved(self) -> int:
        """Scans that the gate did not take."""
        return self._gate.kept_out

    @property
    def is_behind(self) -> bool:
        """True if scans wait for their turn."""
        return bool(self._backlog)

    @property
    def waiting(self) -> int:
        """Range images and scans that wait."""
        return self._scans.waiting + len(self._backlog)

    def step(self, messages: Iterable[BagMessage]) -> None:
        """Take new messages, and map one scan at most.

        Raises:
            BadInputError: kind `frames_moved`: a frame that carries cameras moves.
        """
        now_s = self._steady_s()
        for message in messages:
            self._scans.add(message, now_s)
        self._backlog.extend(self._scans.ready(now_s))
        while len(self._backlog) > 1 and now_s - self._backlog[0].arrived_s > BEHIND_S:
            self._backlog.popleft()
            self.dropped += 1
        if self._backlog:
            self._map(self._backlog.popleft())
        elif self._last_scan_s is not None and now_s - self._last_scan_s > REST_S:
            self._commit()
        self._correct(now_s)

    def _correct(self, now_s: float) -> None:
        """Take the newest path, and move one measurement at most."""
        if self.corrections is None:
            return
        if self.corrections.is_due(now_s) and (path := self._scans.take_path()) is not None:
            self.corrections.note_path(path)
        self.corrections.step(now_s, is_idle=not self._backlog)

    def finish(self) -> None:
        """Map what waits, as far as a second allows, and commit; no more messages come."""
        end_s = self._steady_s() + FINISH_S
        self._backlog.extend(self._scans.ready(self._steady_s(), is_over=True))
        while self._backlog and self._steady_s() <= end_s:
            self._map(self._backlog.popleft())
        self.dropped += len(self._backlog)
        self._backlog.clear()
        self._commit()
        if self.corrections is not None:
            if (path := self._scans.take_path()) is not None:
                self.corrections.note_path(path)
            self.corrections.finish(lambda: self._steady_s() <= end_s)

    def _map(self, ready: ReadyScan) -> None:
        found = ready.found
        self.jumps.note(found.time_s, found.T_map_rig, ready.T_map_odom)
        if not self._gate.takes(found.camera, found.time_s, found.T_map_rig):
            return
        try:
            scan = self._decoder.decode(found, ready.messages.__getitem__, ready.pose_at)
        except (BadInputError, DamagedDataError) as exc:
            self._leave_out(ready, exc)
            return
        if self._group.ends_before(scan.time_s, scan.T_map_rig):
            self._commit()
        self._observe(ready, scan)

    def _observe(self, ready: ReadyScan, scan: Scan) -> None:
        """Add a scan to the open measurement, which another epoch ends before."""
        try:
            commit = self._robot.observe(scan)
        except UnreachableError as exc:
            self._keep_open(exc)
            self.dropped += 1
            return
        except BadInputError as exc:
            if exc.kind == TOO_LARGE:  # the measurement before, not this scan
                self._give_up(exc)
                self.dropped += 1
            else:
                self._leave_out(ready, exc)
            return
        if commit is not None:
            self.commits, self.refusal, self._open_scans = self.commits + 1, "", 0
            self._note_commit(commit)
        if self.corrections is not None:
            self.corrections.note_scan(scan.time_s, scan.T_map_rig, ready.T_map_odom)
        self.taken += 1
        self._on_taken(ready)
        self.newest_s = scan.time_s
        self._open_scans += 1
        self._last_scan_s = self._steady_s()

    def _commit(self) -> None:
        """Commit the open measurement; where the disk or the outbox is full it stays open, and is tried again."""
        try:
            commit = self._robot.commit(profile=self._profile)
            self.commits += commit is not None
            self._note_commit(commit)
            self.refusal, self._open_scans, self._last_scan_s = "", 0, None
        except UnreachableError as exc:
            self._keep_open(exc)
        except BadInputError as exc:
            self._give_up(exc)

    def _note_commit(self, commit: Commit | None) -> None:
        if self.corrections is not None:
            self.corrections.note_commit(None if commit is None else commit.id)

    def _leave_out(self, ready: ReadyScan, exc: CairnError) -> None:
        found = ready.found
        log.warning("a scan of %s at %.3f s is left out: %s", found.camera, found.time_s, exc.message)
        self._scans.left_out[Cause.DAMAGED] += 1

    def _keep_open(self, exc: UnreachableError) -> None:
        """Keep the open measurement, for which there is no room now."""
        if not self.refusal:
            log.error("%s; mapping goes on in the open measurement", exc.message)
        self.refusal, self._last_scan_s = exc.message, self._steady_s()

    def _give_up(self, exc: BadInputError) -> None:
        """Drop the open measurement, which can be no commit: it would only grow."""
        log.error("%s; its %d scans are dropped", exc.message, self._open_scans)
        self._robot.discard()
        self._note_commit(None)
        self.taken -= self._open_scans
        self.dropped += self._open_scans
        self.refusal, self._open_scans, self._last_scan_s = "", 0, None
