"""A robot: scans in, a shared map out.

    with Robot(rig, "http://base:8750/maps/lab", directory="state", name="mole") as robot:
        for scan in scans:
            robot.observe(scan)        # evidence of one head pose
        robot.commit()                 # one measurement, durable from here on
        robot.sync()                   # or let the background thread do it

It maps on without a link: commits wait in the directory, and power may be cut at any instant.
"""

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Literal, Self
from urllib.parse import urlsplit

from cairn_calib.rig import Rig
from cairn_client.api import MapApi, Traffic
from cairn_client.backoff import Backoff
from cairn_client.replica import Replica
from cairn_client.replica_store import ReplicaStore
from cairn_client.sync import RoundReport, Wanted, fetch_cells, fetch_missing, push_commits
from cairn_fusion.integrate import Integrator
from cairn_fusion.measurement import Measurement
from cairn_fusion.scan import Scan
from cairn_map.commit import Commit, CommitMeta
from cairn_map.errors import BadInputError, CairnError, DeniedError, UnreachableError
from cairn_map.evidence_map import EvidenceMap
from cairn_map.grid import Geometry
from cairn_map.ids import CommitId, robot_name
from cairn_map.messages import Register

log = logging.getLogger(__name__)

Mode = Literal["high-end", "low-end", "viewer"]
FLUSH_TRIES = 3


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
        wanted: Wanted | None = None,
    ) -> None:
        """Open or make the robot's directory; no network unless the map's geometry is not known yet.

        Args:
            rig: the head whose scans will come; None for a robot that only reads.
            map_url: `http://HOST:PORT/maps/NAME`.
            directory: of this robot alone; everything durable is in it.
            name: the robot's name on the map.
            token: enrolment (or admin) token; not needed where the server trusts this machine.
            mode: high-end keeps the whole map and fetches differences; low-end fetches whole cells; a viewer pushes
                nothing.
            geometry: of the map, to start without a link; else the server is asked once.
            integrator: range limits.
            wanted: low-end: which cells to fetch; default all.

        Raises:
            BadInputError: bad URL or name, or the directory belongs to another robot or map.
            UnreachableError: the geometry is not known and the server cannot be asked.
        """
        server_url, self._map_name = split_map_url(map_url)
        self.name = robot_name(name)
        self.mode = mode
        self._rig = rig
        self._enrolment_token = token
        self._wanted = wanted
        self._api = MapApi(server_url, token=token)
        store = ReplicaStore(Path(directory))
        self._replica = Replica(store, robot=self.name, geometry=geometry or self._known_geometry(store))
        self._api.token = store.get("token") or token
        self._measurement = self._new_measurement(integrator or Integrator()) if rig else None
        self._round = threading.Lock()
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def map(self) -> EvidenceMap:
        """What the robot sees: the server's map as far as it is here, and its own commits."""
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

    def observe(self, scan: Scan) -> None:
        """Add a scan to the open measurement.

        Raises:
            BadInputError: the scan does not fit the rig or the map; nothing was added.
        """
        if self._measurement is None:
            raise BadInputError("no_rig", "this robot was opened without a rig, so it cannot read scans")
        self._measurement.add(scan)

    def commit(self, *, note: str = "", retracts: tuple[CommitId, ...] = ()) -> Commit | None:
        """Close the open measurement and keep it durably; None if there is nothing in it."""
        measurement = self._measurement
        if measurement is None or self._rig is None or (not len(measurement) and not retracts):
            return None
        diff = measurement.diff()
        if not diff and not retracts:
            log.warning("%d scans gave no evidence; nothing is committed", len(measurement))
            self._measurement = self._new_measurement(measurement.integrator)
            return None
        meta = CommitMeta(
            id=str(CommitId(self._replica.author, 0)),  # the replica gives the number
            geometry=self._replica.geometry.digest().hex(),
            captured_s=measurement.captured_s,
            scans=tuple(measurement.poses),
            sensors=tuple(self._rig.cameras),
            rig=self._rig.digest(),
            integrator=str(measurement.integrator),
            retracts=tuple(str(target) for target in retracts),
            note=note,
        )
        commit = self._replica.commit(diff, meta)
        self._measurement = self._new_measurement(measurement.integrator)
        self._wake.set()
        return commit

    def sync(self, *, on_push: Callable[[CommitId], None] | None = None) -> RoundReport:
        """One round with the server: push, then fetch what is missing.

        Raises:
            UnreachableError: no link; try again later, nothing is lost.
            CairnError: the server refuses this robot, or its data is damaged.
        """
        with self._round:
            if self._replica.store.get("token") is None:
                self._register()
            try:
                return self._sync_once(on_push)
            except DeniedError as exc:
                if exc.kind != "bad_token":
                    raise
                self._register()  # the server was replaced, or somebody registered under this name
                return self._sync_once(on_push)

    def start_sync(self, *, every_s: float = 5.0) -> None:
        """Sync in the background: after each commit, and at least every so many seconds while there is a link."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._sync_for_ever, args=(every_s,), name="cairn-sync", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Commit what is open, push what waits if there is a link, and close; what could not be pushed stays."""
        self._stop.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
        self.commit()
        if self.mode != "viewer" and self._replica.store.get("token") and self.waiting:
            try:
                push_commits(self._replica, self._api, self._map_name)
            except CairnError as exc:
                log.warning("%d commits wait in the directory: %s", self.waiting, exc.message)
        self._api.close()
        self._replica.close()

    def deregister(self) -> None:
        """Leave the map; the evidence stays there, and this directory keeps its own."""
        self._api.deregister(self._map_name, self.name)
        with self._replica.store.transaction():
            self._replica.store.put("token", None)

    def _sync_once(self, on_push: Callable[[CommitId], None] | None) -> RoundReport:
        pushed = 0
        if self.mode != "viewer":
            pushed = push_commits(self._replica, self._api, self._map_name, on_push=on_push)
        if self.mode == "low-end":
            report = fetch_cells(self._replica, self._api, self._map_name, wanted=self._wanted)
        else:
            report = fetch_missing(self._replica, self._api, self._map_name, self.name)
        report.pushed = pushed
        return report

    def _sync_for_ever(self, every_s: float) -> None:
        backoff = Backoff()
        wait_s = 0.0
        while not self._stop.is_set():
            self._wake.wait(wait_s)
            self._wake.clear()
            if self._stop.is_set():
                return
            try:
                self.sync()
                backoff.reset()
                wait_s = every_s
            except UnreachableError as exc:
                wait_s = backoff.next_s(exc.retry_after_s)
                log.info("no link (%s); trying again in %.1f s", exc.message, wait_s)
                self._stop.wait(wait_s)
                wait_s = 0.0
            except CairnError as exc:
                wait_s = backoff.next_s(None)
                log.error("sync failed: %s: %s; trying again in %.1f s", exc.kind, exc.message, wait_s)
                self._stop.wait(wait_s)
                wait_s = 0.0

    def _register(self) -> None:
        self._api.token = self._enrolment_token
        request = Register(
            robot=self.name,
            mode=self.mode,
            incarnation=self._replica.author.incarnation,
            sensors=list(self._rig.cameras) if self._rig else [],
        )
        registered = self._api.register(self._map_name, request)
        if registered.map.geometry != self._replica.geometry:
            raise BadInputError("other_geometry", f"map {self._map_name} has another grid than this robot's directory")
        with self._replica.store.transaction():
            self._replica.store.put("token", registered.token)

    def _known_geometry(self, store: ReplicaStore) -> Geometry:
        remembered = store.get("geometry")
        if remembered is not None:
            return Geometry.model_validate_json(remembered)
        return self._api.map_info(self._map_name).geometry

    def _new_measurement(self, integrator: Integrator) -> Measurement:
        assert self._rig is not None  # noqa: S101 - narrows the type
        return Measurement(self._rig, self._replica.geometry, integrator)


def split_map_url(map_url: str) -> tuple[str, str]:
    """Server and map of `http://HOST:PORT/maps/NAME`.

    Raises:
        BadInputError: it is not of that form.
    """
    parts = urlsplit(map_url)
    head, _, name = parts.path.rstrip("/").rpartition("/maps/")
    if parts.scheme not in ("http", "https") or not parts.netloc or not name or "/" in name:
        raise BadInputError("bad_url", f"a map's URL is http://HOST:PORT/maps/NAME, got {map_url!r}")
    return f"{parts.scheme}://{parts.netloc}{head}", robot_name(name)
