"""A robot: scans in, a shared map out.

    with Robot(rig, "http://base:8750/maps/lab", directory="state", name="mole") as robot:
        for scan in scans:
            robot.observe(scan)        # evidence of one head pose
        robot.commit()                 # one measurement, durable from here on
        robot.sync()                   # or let the background thread do it

It maps on without a link: commits wait in the directory, and power may be cut at any instant.
"""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from cairn_calib.rig.rig import Rig
from cairn_client.http.map_url import split_map_url
from cairn_client.relay.carrying import carrier_in
from cairn_client.relay.link import RelayApi
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_identity import note_use
from cairn_client.robot.alignment import Aligning
from cairn_client.robot.amending import Amending
from cairn_client.robot.commit_meta import own_meta
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.limits import NO_LIMITS, Limits, limits_in
from cairn_client.robot.membership import Membership
from cairn_client.robot.opening import open_replica
from cairn_client.robot.robot_events import SIZE, Committed, Events, EventStream
from cairn_client.robot.rounds import Rounds
from cairn_client.robot.status_report import OwnStatus
from cairn_client.sync.link_profile import LINKS, LinkName
from cairn_client.sync.responses import Traffic
from cairn_client.sync.scope import EVERYTHING, Scope
from cairn_client.sync.sync import RoundReport
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit, CommitMeta
from cairn_map.commits.ids import CommitId, robot_name
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry, cell_of_key
from cairn_map.kernels.compile_progress import show_compiling
from cairn_map.wire.robot_status import Mode

log = logging.getLogger(__name__)

FLUSH_S = 60.0
"""How long `close` may push before it leaves the rest for the next time."""


class Robot:
    """One robot's map, kept in `directory` and shared through one server."""

    def __init__(
        self,
        rig: Rig | None,
        map_url: str,
        *,
        directory: Path | str,
        name: str,
        token: str | None = None,
        mode: Mode = "high-end",
        geometry: Geometry | None = None,
        integrator: Integrator | None = None,
        scope: Scope = EVERYTHING,
        limits: Limits | None = None,
        link: LinkName = "good",
        stay: bool = False,
        carry_bytes_max: int = 0,
        keep_scans_bytes: int = 0,
    ) -> None:
        """Open or make the robot's directory; no network unless the map's geometry is not known yet.

        Args:
            rig: the head whose scans will come; None for a robot that only reads.
            map_url: `http://HOST:PORT/maps/NAME`.
            directory: of this robot alone; everything durable is in it.
            name: the robot's name on the map.
            token: enrolment (or admin) token, or the robot's own; not needed where the server trusts this machine.
            mode: high-end keeps the whole map and fetches differences; low-end fetches whole cells; a viewer pushes
                nothing.
            geometry: of the map, to start without a link; else the server is asked once.
            integrator: range limits.
            scope: which cells to fetch, and how much in one reply.
            limits: how much to keep on the disk and in memory, and what goes when that is full; None: as before.
            link: small for a link of some ten to some hundred kbit/s (`link_profile`).
            stay: a robot that only pauses: `close` does not deregister it.
            carry_bytes_max: room on the disk for others' signed commits, taken along from server to server; it needs
                a token of role relay that names this robot. 0: none are.
            keep_scans_bytes: of the newest scans, kept in `directory/scans` for `amend`; what they cost: `kept_scans`.

        Raises:
            BadInputError: bad URL or name, or the directory belongs to another robot or map.
            ConflictError: another process has the directory open.
            UnreachableError: the geometry is not known and the server cannot be asked.
        """
        show_compiling()
        server_url, self._map_name = split_map_url(map_url)
        self.name = robot_name(name)
        self.mode: Mode = mode
        self._rig = rig
        self._profile = LINKS[link]
        self._api = RelayApi(server_url, token=token)
        with ExitStack() as opened:
            opened.callback(self._api.close)
            self._kept_scans = KeptScans(Path(directory) / "scans", bytes_max=keep_scans_bytes)
            self._replica = open_replica(
                Path(directory), self._api, robot=self.name, map_name=self._map_name, geometry=geometry
            )
            opened.callback(self._replica.close)
            note_use(self._replica.store, url=map_url, mode=mode)
            limits = limits_in(self._replica.store, limits)
            sensors = list(rig.cameras) if rig else []
            membership = Membership(
                self._api, self._replica, map_name=self._map_name, mode=mode, sensors=sensors, enrolment_token=token
            )
            self.status = OwnStatus(every_s=self._profile.tell_every_s)
            self._events = Events()
            self._rounds = Rounds(
                *(self._api, self._replica, membership, self._events),
                map_name=self._map_name,
                mode=mode,
                scope=scope,
                profile=self._profile,
                limits=limits,
                status=self.status,
                carrier=carrier_in(Path(directory), self._api, self._map_name, size_bytes_max=carry_bytes_max),
            )
            self.deregister = self._rounds.leave
            """Leave the map; the evidence stays there, and this directory keeps its own. Ends the background sync."""
            self._stay, self._is_closed = stay, False
            self._integrator = integrator or Integrator()
            self._measurement = self._new_measurement()
            self.snapshot = self._replica.snapshot
            """`robot.snapshot()`: the map as it is now, under its own sensor model (`map_snapshot`); by any thread."""
            if limits == NO_LIMITS:  # else commits that the server has for good go first
                self._replica.outbox.amendable = lambda: self._kept_scans.commits
            amending = Amending(
                *(self._replica, self._kept_scans, self._profile.commits),
                fresh=self._new_measurement,
                meta_of=self._meta,
                on_commit=self._made,
            )
            self.align = Aligning(self.snapshot, lambda: self._rig, self._integrator).align
            """Where this robot's own frame lies in the map (`alignment.Aligning`); below: past measurements, moved."""
            self.amend, self.amend_all = amending.amend, amending.amend_all
            opened.pop_all()  # for `close`

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def map(self) -> EvidenceMap:
        """What the robot sees: the server's map as far as it is here, and its own commits.

        The thread that commits may read it at any time; another one only while it holds `replica.lock`.
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

    def events(self, *, size: int = SIZE) -> EventStream:
        """What happens from here on (`robot_events`), for one reader; who is too slow loses the oldest of `size`."""
        return self._events.open(size)

    def observe(self, scan: Scan) -> None:
        """Add a scan to the open measurement.

        Raises:
            BadInputError: the scan does not fit the rig or the map; nothing was added.
        """
        if self._measurement is None:
            raise BadInputError("no_rig", "this robot was opened without a rig, so it cannot read scans")
        self._measurement.add(scan)
        self._kept_scans.add(scan)
        self.status.pose = self._measurement.poses[-1]

    def mount(self, rig: Rig) -> None:
        """Take another head, whose scans come from here on.

        Raises:
            BadInputError: kind `open_measurement`: there are scans of the old one.
        """
        if self._measurement is not None and len(self._measurement):
            raise BadInputError("open_measurement", "commit or discard the scans of the old head first")
        self._rig = rig
        self._measurement = self._new_measurement()

    def discard(self) -> None:
        """Forget the scans since the last commit."""
        self._measurement = self._new_measurement()
        self._kept_scans.drop_measurement()

    def commit(
        self, *, note: str = "", retracts: tuple[CommitId, ...] = (), profile: Profile | None = None
    ) -> Commit | None:
        """Close the open measurement and keep it durably; None if there is nothing in it.

        Args:
            note: up to 1024 characters for the map's log.
            retracts: own commits that it takes back and stands for: here at once, elsewhere as they sync.
            profile: small spends more work, up to a second, on four tenths fewer bytes; None: as the link wants it.

        Raises:
            BadInputError: the commit would be too large, its note too long, or it retracts what is not this robot's.
            UnreachableError: kind `store_failed`: the disk is full or broken; `outbox_full`: the limits are reached,
                and nothing is left to drop. The measurement stays open in any case.
        """
        diff = self._measurement.diff() if self._measurement else {}
        if not diff and not retracts:
            if self._measurement:
                log.warning("%d scans gave no evidence; nothing is committed", len(self._measurement))
                self.discard()
            return None
        meta = self._meta(self._measurement, note, retracts)
        commit = self._replica.commit(diff, meta, profile=profile or self._profile.commits)
        self._measurement = self._new_measurement()
        self._kept_scans.close_measurement(commit.id)
        self._made(commit)
        return commit

    def sync(self, *, on_push: Callable[[CommitId], None] | None = None) -> RoundReport:
        """One round with the server: push, then fetch what is missing.

        Raises:
            UnreachableError: no link; try again later, nothing is lost.
            CairnError: the server refuses this robot, or its data is damaged.
        """
        return self._rounds.sync(on_push)

    def start_sync(self, *, every_s: float = 5.0) -> None:
        """Sync in the background: after each commit, and at least every so many seconds while there is a link."""
        self._rounds.start(every_s=every_s)

    def close(self, *, stay: bool = False, flush_s: float = FLUSH_S) -> None:
        """Commit what is open, push what waits if there is a link, deregister if nothing is left, and close.

        What could not be pushed stays here, and the robot on the map. May be called twice. Where `commit` refuses,
        the open measurement is lost; what waited is pushed all the same, and then its error is raised.

        Args:
            stay: only pause: do not deregister.
            flush_s: how long to push at most, seconds; a round in the background is cut after two.
        """
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._rounds.stop()
            try:
                self.commit()
            except CairnError:
                self._rounds.finish(is_leaving=False, within_s=flush_s)
                raise
            self._rounds.finish(is_leaving=not (stay or self._stay), within_s=flush_s)
        finally:
            self._api.close()
            self._replica.close()
            self._events.close()
            self._kept_scans.drop_measurement()

    def _new_measurement(self) -> Measurement | None:
        return Measurement(self._rig, self._replica.geometry, self._integrator) if self._rig else None

    def _made(self, commit: Commit) -> None:
        cells = tuple(cell_of_key(key) for key in sorted(commit.cells))
        self._events.tell(Committed(commit=commit.id, cells=cells, size_bytes=len(commit.data)))
        self._rounds.wake()

    def _meta(self, measurement: Measurement | None, note: str, retracts: tuple[CommitId, ...]) -> CommitMeta:
        return own_meta(self._replica, measurement, self._rig, self._integrator, note=note, retracts=retracts)
