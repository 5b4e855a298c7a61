"""A robot: scans in, a shared map out.

    with Robot(rig, "http://base:8750/maps/lab", directory="state", name="mole") as robot:
        for scan in scans:
            robot.observe(scan)        # evidence of one head pose
        robot.commit()                 # one measurement, durable from here on
        robot.sync()                   # or let the background thread do it

It maps on without a link: commits wait in the directory, and power may be cut at any instant. Any thread may call it;
calls that add scans or make commits wait for each other, and so do rounds. A forked process may not.
"""

import logging
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy.typing as npt

from cairn_calib.rig.rig import Rig
from cairn_client.http.map_url import split_map_url
from cairn_client.relay.carried_commits import Carrier, carrier_in
from cairn_client.relay.link import RelayApi
from cairn_client.replica.limits import Limits
from cairn_client.replica.outbox import NO_NOTES, CommitFacts
from cairn_client.replica.replica import Replica
from cairn_client.robot.alignment import STEP_M, STEP_RAD, align_points, points_of_scans
from cairn_client.robot.alignment_verdict import Alignment
from cairn_client.robot.amending import Amending, AnyCommit, facts_of_measurement
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.map_marks import seen_marks
from cairn_client.robot.membership import Membership, bind_token, check_kinds
from cairn_client.robot.replica_opening import open_replica
from cairn_client.robot.robot_events import SIZE, Committed, Events, EventStream
from cairn_client.robot.rounds import FLUSH_S, FOLDED_WITHIN_S, Rounds
from cairn_client.robot.server_clock import ServerClock, Times
from cairn_client.robot.status_report import OwnStatus
from cairn_client.sync.link_profile import LINKS, LinkName
from cairn_client.sync.responses import Traffic
from cairn_client.sync.scope import EVERYTHING, Scope
from cairn_client.sync.sync import RoundReport
from cairn_fusion.mapping.beam_returns import ReturnCounts
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId, robot_name
from cairn_map.commits.mark import make_mark
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.grid import Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.kernels.numba_runtime import show_compiling
from cairn_map.machine_clocks import MACHINE_CLOCKS, MachineClocks
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.wire.mark_messages import MarkEntry
from cairn_map.wire.messages import Mode

log = logging.getLogger(__name__)


class Robot:
    """One robot's map, kept in `directory` and shared through one server.

    Args:
        rig: head whose scans will come; None for a robot that only reads.
        map_url: `http://HOST:PORT/maps/NAME`.
        directory: folder of this robot alone; everything durable is in it.
        name: the robot's name on the map.
        token: enrolment (or admin) token, or the robot's own; not needed where the server trusts this machine.
        mode: high-end keeps the whole map and fetches differences; low-end fetches whole cells; a viewer pushes
            nothing.
        geometry: grid of the map, or its grid and epochs, to start without a link; otherwise the server is asked once.
        integrator: range limits.
        scope: cells to fetch, and the size of one reply.
        limits: how much to keep on the disk and in memory, and what is dropped first when that is full; None: the
            limits of the robot that had this directory open last.
        link: "small" for a link of some ten to some hundred kbit/s (`link_profile`).
        stay: True for a robot that only pauses: `close` does not deregister it.
        carry_bytes_max: bytes on the disk for others' signed commits, carried from server to server; it needs a
            token of role relay that names this robot. 0: none are carried.
        keep_scans_bytes: bytes of the newest scans, kept in `directory/scans` for `amend`; their cost: `kept_scans`.
        times: "own" for scans stamped by this machine's time of day; "recorded" for those of a recording.
        clocks: clocks of this machine.
    """

    def __init__(
        self,
        rig: Rig | None,
        map_url: str,
        *,
        directory: Path | str,
        name: str,
        token: str | None = None,
        mode: Mode = "high-end",
        geometry: Geometry | MapLayer | None = None,
        integrator: Integrator | None = None,
        scope: Scope = EVERYTHING,
        limits: Limits | None = None,
        link: LinkName = "good",
        stay: bool = False,
        carry_bytes_max: int = 0,
        keep_scans_bytes: int = 0,
        times: Times = "own",
        clocks: MachineClocks = MACHINE_CLOCKS,
    ) -> None:
        """Open or make the robot's directory; no network unless the map's geometry is unknown.

        Raises:
            BadInputError: bad URL, name, rig or mode, or the directory belongs to another robot or map.
            ConflictError: another process has the directory open.
            UnreachableError: the geometry is unknown and the server cannot be asked.
        """
        show_compiling()
        # All of this is checked before anything is opened or written.
        check_kinds(rig, mode)
        server_url, self._map_name = split_map_url(map_url)
        self.name = robot_name(name)
        self.mode: Mode = mode
        # What it senses with, and how it uses its link.
        self._rig = rig
        self._integrator = integrator or Integrator()
        self._profile = LINKS[link]
        self._stay, self._is_closed = stay, False
        self._pid, self._lock = os.getpid(), threading.RLock()
        self.returns = ReturnCounts()
        """Count of the pixels of the measurements that were closed, by what became of them."""
        self._status = OwnStatus(every_s=self._profile.tell_every_s)
        self._events = Events()
        self._api = RelayApi(server_url, token=token, steady_s=clocks.steady_s)
        # The folder, scans first: the outbox asks them which commits must keep their bytes for an amend.
        with ExitStack() as opened:  # what was opened is closed again if a later step fails
            opened.callback(self._api.close)
            self._kept_scans = KeptScans(Path(directory) / "scans", bytes_max=keep_scans_bytes)
            self._replica, self._limits = open_replica(
                Path(directory),
                self._api,
                robot=self.name,
                map_name=self._map_name,
                geometry=geometry,
                limits=limits,
                amendable=self._amendable_commits,
            )
            opened.callback(self._replica.close)
            bind_token(self._replica.state, map_url)
            self._replica.state.note_use(url=map_url, mode=mode)
            carrier = carrier_in(Path(directory), self._api, self._map_name, size_bytes_max=carry_bytes_max)
            # Then what works on it; nothing is sent before the first round.
            self._clock = ServerClock(self._replica.state, clocks, times=times)
            self._rounds = self._make_rounds(token, scope, carrier)
            self._measurement = self._new_measurement()
            opened.pop_all()  # from here on `close` does it

    def _amendable_commits(self) -> list[CommitId]:
        """Commits whose bytes stay for an amend; none if the disk is bounded, as they go first there."""
        # Asked by the thread that syncs, too: `commits` is replaced whole at each change, never altered.
        return self._kept_scans.commits if self._limits.keeps_commits else []

    def _make_rounds(self, token: str | None, scope: Scope, carrier: Carrier | None) -> Rounds:
        membership = Membership(
            self._api,
            self._replica,
            map_name=self._map_name,
            mode=self.mode,
            sensors=list(self._rig.cameras) if self._rig else [],
            enrolment_token=token,
        )
        return Rounds(
            self._api,
            self._replica,
            membership,
            self._events,
            map_name=self._map_name,
            mode=self.mode,
            scope=scope,
            profile=self._profile,
            limits=self._limits,
            status=self._status,
            clock=self._clock,
            carrier=carrier,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close; an error inside the block discards the open measurement, which it may have cut anywhere.

        A signal (`KeyboardInterrupt`, `SystemExit`) ends the block as its last line does: the scans are committed.
        """
        # Scans of half a measurement, or under a pose that the failed code had yet to correct, are no evidence to
        # publish; those of earlier commits are. KeyboardInterrupt is no Exception.
        if isinstance(error, Exception) and not self._is_closed and self._measurement:
            log.warning("%d scans since the last commit are discarded: %s", len(self._measurement), error)
            self.discard()
        self.close()

    @property
    def status(self) -> OwnStatus:
        """The robot's report of itself; set its fields at any time, and the next sync sends it if it changed.

        `robot.status.note = "at the stairs"`, `robot.status.battery = 0.5`; the pose is set by `observe`.
        """
        return self._status

    @property
    def map(self) -> HistoryMap:
        """The robot's view: the server's map as far as it is here, and its own commits.

        The thread that commits may read it at any time; any other thread takes a `snapshot`.
        """
        return self._replica.view

    @property
    def replica(self) -> Replica:
        """The robot's durable state."""
        return self._replica

    @property
    def traffic(self) -> Traffic:
        """Bytes sent and received since the robot was opened."""
        return self._api.traffic

    @property
    def waiting(self) -> int:
        """Commits that the server has not yet acknowledged."""
        return len(self._replica.push_set())

    def snapshot(self, model: SensorModel | None = None, *, at_s: float | None = None) -> MapSnapshot:
        """The map as it is now, unchanged by what comes later; by any thread.

        Args:
            model: sensor model to read the evidence under; None: the map's own, which the server states.
            at_s: UTC seconds since 1970: the map as it was then, by time of capture, to the end of that time's epoch.

        Raises:
            ConflictError: kind `not_known`: the map has no epochs, so it holds nothing of earlier times.
        """
        self._check_open()
        return self._replica.snapshot(model, at_s=at_s)  # made once for each state of the view

    def events(self, *, size: int = SIZE) -> EventStream:
        """Stream of the events from here on (`robot_events`), for one reader.

        Args:
            size: events that wait for the reader; one that is too slow loses the oldest.
        """
        return self._events.open(size)

    def align(
        self,
        scans: Sequence[Scan],
        *,
        T_map_robot: npt.ArrayLike,
        reach_m: float = STEP_M,
        reach_rad: float = STEP_RAD,
    ) -> Alignment:
        """Place of the robot's own frame in the map as it is here, before anything is observed from that frame.

        Args:
            scans: a look around, whose poses are in the robot's own frame: their `T_map_rig` is read as `T_robot_rig`.
            T_map_robot: (4, 4) guess, metres; its roll and pitch to some 10 degrees, its height to half a metre.
            reach_m: largest error of the guess along x and along y of the map, metres. Farther off, a room that looks
                alike may be accepted.
            reach_rad: largest error of its heading, radians; pi: any heading. The search takes some 0.1 s for each of
                nine starts (reach_m up to 0.5) every 15 degrees.

        Raises:
            BadInputError: a scan does not fit the rig, the guess is no rigid transform, the reach asks for too many
                starts, there is no rig, or small_gicp is not installed.
        """
        self._check_open()
        if self._rig is None:
            raise BadInputError("no_rig", "this robot was opened without a rig, so it cannot read scans")
        points = points_of_scans(scans, self._rig, self._integrator)
        # A snapshot, because a round in the background may change the view during the search.
        return align_points(self.snapshot(), points, T_map_robot=T_map_robot, reach_m=reach_m, reach_rad=reach_rad)

    def __repr__(self) -> str:
        return f"Robot({self.name} on map {self._map_name}, {self.mode}, {self.waiting} commits wait)"

    def observe(self, scan: Scan) -> Commit | None:
        """Add a scan to the open measurement; the commit of the scans before, if this one begins another epoch.

        Raises:
            BadInputError: the scan does not fit the rig or the map; nothing was added.
        """
        self._check_open()
        if self._measurement is None:
            raise BadInputError("no_rig", "this robot was opened without a rig, so it cannot read scans")
        self._clock.look()
        with self._lock:
            commit = self._end_epoch_before(scan)
            # The measurement first: it refuses what does not fit, before anything else has the scan.
            self._measurement.add(scan)
            self._kept_scans.add(scan, self._measurement.rig)
            self._status.place_at(self._measurement.poses[-1])
            return commit

    def _end_epoch_before(self, scan: Scan) -> Commit | None:
        """Commit the open measurement if its scans are of another epoch than this one."""
        # Rule T1: a commit is of one epoch, that of its last scan. Scans of a minute ago must not outrank what others
        # saw since, only because the measurement was closed late.
        open_s = self._measurement.captured_s if self._measurement else None
        if open_s is None or not self._clock.parts(open_s[1], scan.time_s, self._replica.layer.epoch_s):
            return None
        return self._commit("", (), None, NO_NOTES)

    def mount(self, rig: Rig) -> None:
        """Mount another head, whose scans come from here on.

        Raises:
            BadInputError: kind `open_measurement`: there are scans of the old head.
        """
        self._check_open()
        check_kinds(rig, self.mode)
        with self._lock:
            # A commit names one rig, by which an operator can retract it: scans of two heads must not share one.
            if self._measurement is not None and len(self._measurement):
                raise BadInputError("open_measurement", "commit or discard the scans of the old head first")
            self._rig = rig
            self._measurement = self._new_measurement()

    def discard(self) -> None:
        """Forget the scans since the last commit."""
        with self._lock:
            self._measurement = self._new_measurement()
            self._kept_scans.drop_measurement()

    def commit(
        self,
        *,
        note: str = "",
        retracts: tuple[CommitId, ...] = (),
        profile: Profile | None = None,
        remember: Mapping[str, str] = NO_NOTES,
    ) -> Commit | None:
        """Commit the open measurement, durably; None if there is no evidence in it.

        Args:
            note: up to 1024 characters for the map's log.
            retracts: own commits that this one takes back and stands for: here at once, elsewhere as they sync.
            profile: small spends up to a second of work on four tenths fewer bytes; None: the link's own profile.
            remember: texts by key that the directory is to keep, in the same transaction as the commit.

        Raises:
            BadInputError: the commit would be too large, its note too long, or it retracts what is not this robot's.
            UnreachableError: kind `store_failed`: the disk is full or broken; `outbox_full`: the limits are reached,
                and nothing is left to drop. The measurement stays open in any case.
        """
        self._check_open()
        with self._lock:
            return self._commit(note, retracts, profile, remember)

    def _commit(
        self, note: str, retracts: tuple[CommitId, ...], profile: Profile | None, remember: Mapping[str, str]
    ) -> Commit | None:
        """Commit the open measurement, of a robot that is open or being closed."""
        diff = self._measurement.diff() if self._measurement else {}
        counts = self._measurement.counts if self._measurement else ReturnCounts()
        # No evidence is no commit, except to take others out.
        if not diff and not retracts:
            if self._measurement:
                log.warning("%d scans gave no evidence, nothing is committed: %s", len(self._measurement), counts)
                self.returns += counts
                self.discard()
            return None
        # Until the replica has the commit on its disk, the measurement stays open: the caller may try again.
        facts = self._facts(self._measurement, note, retracts)
        commit = self._replica.commit(diff, facts, profile=profile or self._profile.commits, notes=remember)
        # It is durable. A power cut before the next two lines may cost the scans for an amend, never evidence.
        self.returns += counts
        self._measurement = self._new_measurement()
        self._kept_scans.close_measurement(commit.id)
        self._made(commit)
        return commit

    def amend(
        self,
        measurement: AnyCommit,
        T_map_rig: npt.ArrayLike | None = None,
        *,
        T_map_observed: npt.ArrayLike | None = None,
        note: str = "",
        profile: Profile | None = None,
    ) -> Commit:
        """Correct the poses of a past measurement: integrate its scans again, and commit that in its place.

        This robot shows the new evidence at once, also where the first commit was never pushed; all others after they
        sync. The map is then the one that these poses would have given from the start, byte for byte. The rig and the
        integrator are those of this robot now.

        Args:
            measurement: commit of the measurement, or any amend of it: the latest one is replaced.
            T_map_rig: (N, 4, 4) poses of its N scans, in their order, metres; the body moves with the rig.
            T_map_observed: or (4, 4), one correction of the observed poses: `T_map_observed @ T_observed`, counted
                from the poses given to `observe`, also if the measurement was amended since.
            note: up to 1024 characters for the map's log.
            profile: as for `commit`.

        Raises:
            NotFoundError: kind `no_scans`: the scans are not kept (any more); the message says how to keep more.
            ConflictError: kind `taken_back`: the measurement was taken back, and not by an amend.
            BadInputError: no rigid poses, or not one for each scan; or the scans do not fit the rig any more.
            DamagedDataError: the disk damaged the scans.
            UnreachableError: kind `store_failed`: the disk is full or broken. In all cases nothing was changed.
        """
        profile = profile or self._profile.commits
        with self._lock:
            return self._amending().amend(
                measurement, T_map_rig, T_map_observed=T_map_observed, note=note, profile=profile
            )

    def amend_all(
        self, T_map_rig: Mapping[CommitId | str, npt.ArrayLike], *, note: str = "", profile: Profile | None = None
    ) -> list[Commit]:
        """Amend many measurements, as after a loop closure; none if the scans of one of them are not kept.

        Args:
            T_map_rig: for the id of each measurement's commit (N, 4, 4), the poses of its N scans, metres.
            note: as for `amend`.
            profile: as for `commit`.

        Raises:
            CairnError: as `amend`; except for `no_scans` and `taken_back`, the amends before the failed one were made.
        """
        with self._lock:
            return self._amending().amend_all(T_map_rig, note=note, profile=profile or self._profile.commits)

    def retract(self, measurement: AnyCommit, *, note: str = "") -> Commit:
        """Take a past measurement back: its evidence leaves this map at once, and all others as they sync.

        The open measurement stays open. Operators take back anybody's commits: `cairn map retract`.

        Args:
            measurement: commit of the measurement, or any amend of it: the latest one is taken back.
            note: up to 1024 characters for the map's log, such as the reason.

        Raises:
            ConflictError: kind `taken_back`: it was taken back before.
            BadInputError: it is not this robot's, or the note is too long.
            UnreachableError: kind `store_failed`: the disk is full or broken.
        """
        with self._lock:
            return self._amending().retract(measurement, note=note)

    def mark(
        self,
        name: str,
        at_m: Sequence[float],
        *,
        kind: str = "mark",
        extent_m: Sequence[float] = (0.0, 0.0, 0.0),
        note: str = "",
        attachment: Path | bytes | None = None,
        instead_of: AnyCommit | None = None,
    ) -> Commit:
        """Mark a place for all robots and people of the map; durable here, elsewhere as they sync.

        Args:
            name: one line of 1 to 64 characters.
            at_m: its middle, x, y, z, metres, map frame.
            kind: sort of thing, such as `hot_spot` or `door`.
            extent_m: edges of a box around it, metres; zeros: a point.
            note: up to 1024 characters.
            attachment: a file or bytes, such as a picture, to 2^24 bytes: kept here, sent once the server has the mark.
            instead_of: commit of an own mark that it takes the place of; `retract` takes one out.

        Raises:
            BadInputError: kind `bad_mark`, `bad_place`, `bad_attachment`, `layer_of_map`; `not_own`: another's mark.
            CairnError: kind `no_mark` or `taken_back`: of `instead_of`; `store_failed`, `outbox_full`; or the server's.
        """
        time_s = self._clock.best_s()  # the server's, if it was learnt
        mark = make_mark(kind=kind, name=name, at_m=at_m, extent_m=extent_m, note=note, time_s=time_s)
        with self._lock:  # durable, and pushed with the next round
            return self._amending().mark(mark, instead_of=instead_of, attachment=attachment)

    def marks(self, box_m: Sequence[float] | None = None) -> list[MarkEntry]:
        """Marks of the map at the last round, all or in a box (metres), and own ones; the first call takes a link."""
        self._check_open()
        self._rounds.begin_marks()  # each round follows them from here on
        return seen_marks(self._replica, box_m)

    def sync(
        self,
        *,
        on_push: Callable[[CommitId], None] | None = None,
        until_folded: bool = False,
        within_s: float = FOLDED_WITHIN_S,
    ) -> RoundReport:
        """One round with the server: push, then fetch what is missing; `is_up_to_date` of its report says if all is.

        The server adds commits to its map after it took them, mostly within a second: after one round, others may not
        see the newest of them yet.

        Args:
            on_push: called with each commit that the server has for good.
            until_folded: do rounds until one finds all own commits, but those that the server refuses, in the map.
            within_s: how long to do so at most, seconds.

        Raises:
            UnreachableError: no link; or kind `not_folded`: not in that time. Try again later, nothing is lost.
            CairnError: the server refuses this robot, or its data is damaged.
        """
        self._check_open()
        rounds = self._rounds
        return rounds.sync_until_folded(on_push, within_s=within_s) if until_folded else rounds.sync(on_push)

    def start_sync(self, *, every_s: float = 5.0) -> None:
        """Sync in the background: after each commit, and at least every so many seconds while there is a link."""
        self._check_open()
        self._rounds.start(every_s=every_s)

    def deregister(self) -> None:
        """Leave the map; the evidence stays there, and this directory keeps its own. Ends the background sync.

        Raises:
            UnreachableError: no link; the robot stays on the map.
            CairnError: the server refuses.
        """
        self._check_open()
        self._rounds.leave()

    def close(self, *, stay: bool = False, flush_s: float = FLUSH_S) -> None:
        """Commit the open measurement, push the commits that wait, deregister if none is left, and close.

        Without a link, the commits stay here, and the robot stays on the map. May be called twice. If `commit` refuses,
        the open measurement is lost; the other commits are pushed all the same, and then its error is raised. What is
        called later raises BadInputError of kind `robot_closed`; the map as it was may still be read.

        Args:
            stay: only pause: do not deregister.
            flush_s: how long to push at most, seconds; a round in the background is cut after two.
        """
        if self._is_closed or os.getpid() != self._pid:
            return  # a process that was forked from the robot's leaves all as it is
        # Before anything can fail: `close` by hand and again by `with` pushes once.
        self._is_closed = True
        try:
            # The background ends first: from here on this thread alone talks to the server.
            self._rounds.stop()
            # The last measurement first, then one push; a robot whose commit was refused does not leave the map.
            try:
                self._commit("", (), None, NO_NOTES)
            except CairnError:
                self._rounds.finish(is_leaving=False, within_s=flush_s)
                raise
            self._rounds.finish(is_leaving=not (stay or self._stay), within_s=flush_s)
        finally:
            # Whatever failed: the folder's lock is given back, and the readers of events come to their end.
            self._api.close()
            self._replica.close()
            self._events.close()
            self._kept_scans.drop_measurement()

    def _new_measurement(self) -> Measurement | None:
        return Measurement(self._rig, self._replica.geometry, self._integrator) if self._rig else None

    def _check_open(self) -> None:
        # One error for all, before the closed store or link would raise one of their own.
        if os.getpid() != self._pid:
            raise BadInputError(
                "robot_forked",
                f"robot {self.name} was opened by process {self._pid}, from which this one was forked: its folder and "
                'its link are that one\'s. Open it after the fork, or start processes with "spawn"',
            )
        if self._is_closed:
            raise BadInputError("robot_closed", f"robot {self.name} is closed: open it again with Robot(...)")

    def _amending(self) -> Amending:
        self._check_open()
        # Made for each call: it works with the rig that is mounted now.
        return Amending(
            self._replica,
            self._kept_scans,
            new_measurement=self._new_measurement,
            facts_of=self._facts,
            on_commit=self._made,
        )

    def _made(self, commit: Commit) -> None:
        cells = tuple(cell_of_key(key) for key in sorted(commit.cells))
        self._events.send(Committed(commit=commit.id, cells=cells, size_bytes=len(commit.data)))
        self._rounds.wake()

    def _facts(self, measurement: Measurement | None, note: str, retracts: tuple[CommitId, ...] = ()) -> CommitFacts:
        """Statements of a measurement's commit about itself."""
        if measurement is None:
            return CommitFacts(integrator=str(self._integrator), retracts=retracts, note=note)
        facts = facts_of_measurement(measurement, note=note, retracts=retracts)
        return replace(facts, epoch=self._clock.epoch_of(facts.captured_s, self._replica.layer.epoch_s))
