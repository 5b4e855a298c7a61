"""A robot on several layers of one map: it maps into some, fetches others, and reads all of them together.

    with LayeredRobot(rig, "http://base:8750/maps/lab", directory="state", name="mole",
                      contributes=["evidence", "fine"], fetches=["wide"]) as robot:
        robot.observe(scan)                            # into both
        robot.observe(scan, into=["evidence"])         # into one of them
        robot.commit()
        robot.sync()
        robot.snapshot().state_at(points_m)            # the finest layer that knows each point answers

A layer may be mapped into by place (`MappedLayer`): outdoors the level, in the building the evidence. Without
`contributes` the layers are those that operators assigned to the robot (`cairn map layer assign`): it asks the server
for them when it is opened and in each round, and changes its layers by the answer.

Each layer is a `Robot` of its own (`robots`), in a folder of its own below the robot's. Its name is bound to one key on
the map, in all layers, so the folders lend each other the keys that vouch for it.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from cairn_calib.rig.rig import Rig
from cairn_client.http.api import MapApi
from cairn_client.http.map_url import layer_url, split_map_url
from cairn_client.replica.limits import Limits
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState, RobotKeys
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.amending import AnyCommit
from cairn_client.robot.membership import own_token
from cairn_client.robot.robot import Robot
from cairn_client.robot.rounds import FLUSH_S, FOLDED_WITHIN_S
from cairn_client.robot.server_clock import Times
from cairn_client.sync.link_profile import LinkName
from cairn_client.sync.scope import EVERYTHING, Scope
from cairn_client.sync.sync import RoundReport
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.recording.scan import Scan
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import RobotName, map_of_layer, robot_name
from cairn_map.errors import BadInputError, CairnError, NotFoundError, UnreachableError, first_error
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.wire.layer_messages import Assignment, MappedLayer
from cairn_map.wire.messages import Mode, message_from_json

log = logging.getLogger(__name__)

NO_INTEGRATORS: Mapping[str, Integrator] = {}
ASSIGNMENT_FILE = "assignment.json"
"""File of the robot's folder with the layers that operators assigned last, for a start without a link."""
MAPS: Mode = "high-end"
"""Mode in a layer that the robot maps into."""
READS: Mode = "viewer"
"""Mode in a layer that it fetches alone."""


class LayeredRobot:
    """One robot's part in several layers of a map; by one thread, but any may take a `snapshot`.

    Args:
        rig: head whose scans will come.
        map_url: `http://HOST:PORT/maps/NAME`, of the map.
        directory: folder of this robot alone, with one below it for each layer.
        name: the robot's name on the map.
        contributes: layers that it maps into, and keeps, by name or with the places where it does; `evidence` is the
            one that the map began with. None: layers, those that it fetches included, are as operators assign them.
        fetches: other layers that it keeps to read.
        token: enrolment (or admin) token, or the robot's own, of the map.
        integrators: range limits in a layer; a layer that is not there has the standard ones.
        scope: cells to fetch of each layer, and the size of one reply.
        limits: how much to keep of each layer on the disk and in memory.
        link: "small" for a link of some ten to some hundred kbit/s.
        stay: True for a robot that only pauses: `close` does not deregister it.
        keep_scans_bytes: bytes of the newest scans, kept for each layer for `amend`.
        times: "own" for scans stamped by this machine's time of day; "recorded" for those of a recording.
    """

    def __init__(
        self,
        rig: Rig,
        map_url: str,
        *,
        directory: Path | str,
        name: str,
        contributes: Sequence[str | MappedLayer] | None = None,
        fetches: Sequence[str] = (),
        token: str | None = None,
        integrators: Mapping[str, Integrator] = NO_INTEGRATORS,
        scope: Scope = EVERYTHING,
        limits: Limits | None = None,
        link: LinkName = "good",
        stay: bool = False,
        keep_scans_bytes: int = 0,
        times: Times = "own",
    ) -> None:
        """Open or make the folders; the server is asked for the grid of each layer that was never opened.

        Raises:
            BadInputError: kind `bad_layer`: no layer to map into, or one that is named twice; `layer_of_map`: the URL
                is that of a layer.
            NotFoundError: kind `no_assignment`: without `contributes`, no operator assigned layers to this robot.
            CairnError: as `Robot`.
        """
        if map_of_layer(split_map_url(map_url)[1]) is not None:
            raise BadInputError("layer_of_map", f"{map_url} is a layer: take the map's URL, and name its layers")
        own = None if contributes is None else _assignment_of(contributes, fetches)
        self._map_url, self._folder, self._name, self._token = map_url, Path(directory), robot_name(name), token
        self._stay = stay
        self._robots: dict[str, Robot] = {}
        self._roles: dict[str, str] = {}
        self._every_s: float | None = None
        self._watch: AssignmentWatch | None = None
        self._is_assigned = own is None

        def opened_layer(layer: str, mode: Mode) -> Robot:
            return Robot(
                rig if mode == MAPS else None,
                layer_url(map_url, layer),
                directory=self._folder / layer,
                name=name,
                token=token,
                mode=mode,
                integrator=integrators.get(layer),
                scope=scope,
                limits=limits,
                link=link,
                stay=stay,
                keep_scans_bytes=keep_scans_bytes if mode == MAPS else 0,
                times=times,
            )

        self._open_layer = opened_layer
        self._wanted = own if own is not None else self._first_assignment()
        try:  # what was opened is closed again if a later one fails
            self._reconcile(is_first=True)
        except BaseException:
            self._close_all(stay=True, flush_s=0.0)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close; an error inside the block discards the open measurements, as of a `Robot`."""
        self._end_watch()
        with ExitStack() as closed:  # each, whatever becomes of the others
            for robot in self._robots.values():
                closed.callback(robot.__exit__, kind, error, traceback)

    def __repr__(self) -> str:
        return f"LayeredRobot({', '.join(map(repr, self._robots.values()))})"

    @property
    def robots(self) -> Mapping[str, Robot]:
        """The robot of each layer, for all that is of one: its events, status and limits."""
        return dict(self._robots)

    @property
    def contributes(self) -> tuple[str, ...]:
        """Layers that it maps into, somewhere."""
        return tuple(each.layer for each in self._wanted.contributes if self._roles.get(each.layer) == MAPS)

    @property
    def assignment(self) -> Assignment:
        """Layers that it takes part in: its program's, or those that operators assigned last."""
        return self._wanted

    def observe(self, scan: Scan, *, into: Sequence[str] | None = None) -> dict[str, Commit]:
        """Add a scan to the open measurements; the commits of the scans before, where this one begins another epoch.

        Args:
            scan: one head pose, all its images.
            into: layers of `contributes`; None: those that take scans from its place, which may be none.

        Raises:
            BadInputError: kind `bad_layer`: this robot does not map into one of them; or as `Robot.observe`.
        """
        self._take_news()
        mapped = self.contributes
        if into is None:
            x, y, z = np.asarray(scan.T_map_rig, np.float64)[:3, 3].tolist()
            into = [each.layer for each in self._wanted.contributes if each.layer in mapped and each.takes((x, y, z))]
        for layer in into:
            if layer not in mapped:
                raise BadInputError("bad_layer", f"this robot maps into {mapped}, not into {layer[:32]!r}")
        found = {layer: self._robots[layer].observe(scan) for layer in into}
        return {layer: commit for layer, commit in found.items() if commit is not None}

    def commit(self, *, note: str = "") -> dict[str, Commit]:
        """Commit the open measurements, by layer; durable here. One commit a layer, where there is evidence.

        Raises:
            CairnError: as `Robot.commit`; the layers before it are committed, and may be committed again.
        """
        self._take_news()
        found = {layer: self._robots[layer].commit(note=note) for layer in self.contributes}
        return {layer: commit for layer, commit in found.items() if commit is not None}

    def amend(
        self,
        measurement: Mapping[str, AnyCommit],
        T_map_rig: npt.ArrayLike | None = None,
        *,
        T_map_observed: npt.ArrayLike | None = None,
        note: str = "",
    ) -> dict[str, Commit]:
        """Correct the poses of a past measurement in all its layers, each as `Robot.amend`.

        Args:
            measurement: commits of the measurement by layer, as `commit` returned them.
            T_map_rig: (N, 4, 4) poses of its N scans, where all layers took the same.
            T_map_observed: or (4, 4), one correction of the observed poses, whatever scans each layer took.
            note: for the map's log.

        Raises:
            CairnError: as `Robot.amend`; the layers before it are amended, and may be amended again.
        """
        return {
            layer: robot.amend(measurement[layer], T_map_rig, T_map_observed=T_map_observed, note=note)
            for layer, robot in self._mapping(measurement)
        }

    def retract(self, measurement: Mapping[str, AnyCommit], *, note: str = "") -> dict[str, Commit]:
        """Take a past measurement back in all its layers, each as `Robot.retract`.

        Args:
            measurement: commits of the measurement by layer, as `commit` returned them.
            note: for the map's log.

        Raises:
            CairnError: as `Robot.retract`; the layers before it are taken back.
        """
        return {layer: robot.retract(measurement[layer], note=note) for layer, robot in self._mapping(measurement)}

    def sync(self, *, until_folded: bool = False, within_s: float = FOLDED_WITHIN_S) -> dict[str, RoundReport]:
        """One round with the server for each layer, after a look for the layers that operators assigned.

        Raises:
            CairnError: as `Robot.sync`.
        """
        if self._is_assigned:
            self._take(self._asked())
        reports = {
            layer: robot.sync(until_folded=until_folded, within_s=within_s) for layer, robot in self._robots.items()
        }
        self._reconcile()  # what was left to push is pushed
        return reports

    def start_sync(self, *, every_s: float = 5.0) -> None:
        """Sync all layers in the background, as `Robot.start_sync`.

        Layers that operators assign meanwhile are opened by the next `observe`, `commit` or `sync`.
        """
        self._every_s = every_s
        for robot in self._robots.values():
            robot.start_sync(every_s=every_s)
        if self._is_assigned and self._watch is None:
            self._watch = AssignmentWatch(self._asked, every_s=every_s)

    def snapshot(self, model: SensorModel | None = None, *, at_s: float | None = None) -> LayeredSnapshot:
        """All layers as they are here now, of which the finest that knows a point answers for it; by any thread.

        Raises:
            ConflictError: kind `not_known`: with `at_s`, a layer has no epochs.
        """
        return LayeredSnapshot({layer: robot.snapshot(model, at_s=at_s) for layer, robot in self._robots.items()})

    def close(self, *, stay: bool = False) -> None:
        """Close each layer's robot, as `Robot.close`."""
        self._end_watch()
        self._close_all(stay=stay, flush_s=FLUSH_S)

    def _close_all(self, *, stay: bool, flush_s: float) -> None:
        with ExitStack() as closed:
            for robot in self._robots.values():
                closed.callback(robot.close, stay=stay, flush_s=flush_s)

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.stop()
            self._watch = None

    def _mapping(self, measurement: Mapping[str, AnyCommit]) -> list[tuple[str, Robot]]:
        for layer in measurement:
            if self._roles.get(layer) != MAPS:
                raise BadInputError("bad_layer", f"this robot maps into {self.contributes}, not into {layer[:32]!r}")
        return [(layer, self._robots[layer]) for layer in measurement]

    def _first_assignment(self) -> Assignment:
        """The layers that operators assigned, from the server; without a link those of last time.

        Raises:
            NotFoundError: kind `no_assignment`.
            UnreachableError: no link, and there was no last time.
        """
        known = self._folder / ASSIGNMENT_FILE
        try:
            found = self._asked()
        except UnreachableError:
            if not known.is_file():
                raise
            found = None
        if found is None and known.is_file():
            return message_from_json(Assignment, known.read_bytes())
        if found is None:
            raise NotFoundError(
                "no_assignment",
                f"no layers of {self._map_url} are assigned to {self._name}: name some here, or have an operator do it "
                f"(`cairn map layer assign {self._map_url} {self._name} --contributes evidence`)",
            )
        self._remember(found)
        return found

    def _asked(self) -> Assignment | None:
        """The layers that operators assigned, by the token of any layer, or the one given."""
        server_url, name = split_map_url(self._map_url)
        token = self._token
        for layer, robot in self._robots.items():
            own = own_token(robot.replica.state, self._map_url)
            if own is not None:  # it counts on its layer alone
                token, name = own, split_map_url(layer_url(self._map_url, layer))[1]
                break
        with MapApi(server_url, token=token) as api:
            return api.assignment(name, self._name)

    def _take_news(self) -> None:
        if self._watch is not None:
            self._take(self._watch.take_news())

    def _take(self, assignment: Assignment | None) -> None:
        """Change the layers to those of an assignment; None, which is none any more, changes nothing."""
        if assignment is not None and assignment != self._wanted:
            self._remember(assignment)
            self._wanted = assignment
        self._reconcile()

    def _remember(self, assignment: Assignment) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        new = self._folder / f"{ASSIGNMENT_FILE}.new"
        new.write_text(assignment.model_dump_json())
        new.replace(self._folder / ASSIGNMENT_FILE)

    def _reconcile(self, *, is_first: bool = False) -> None:
        """Open the layers that are wanted, and close others, each once its commits are pushed.

        A layer whose grid cannot be asked for now is opened later; the first time, that is the caller's error.
        """
        wanted: dict[str, Mode] = {each.layer: MAPS for each in self._wanted.contributes}
        wanted |= dict.fromkeys(self._wanted.fetches, READS)
        for layer, robot in list(self._robots.items()):
            if wanted.get(layer) == self._roles[layer]:
                continue
            if self._roles[layer] == MAPS:
                robot.commit()
            if not robot.waiting:  # else its rounds go on until there is nothing to push
                self._robots = {name: each for name, each in self._robots.items() if name != layer}
                robot.close(stay=self._stay)
        for layer, mode in wanted.items():
            if layer in self._robots:
                continue
            for other in self._robots.values():
                lend_keys(other.replica, self._folder / layer)
            try:
                robot = self._open_layer(layer, mode)
            except UnreachableError as exc:
                if is_first:
                    raise
                log.info("layer %s is opened later: %s", layer, exc.message)
                continue
            self._roles[layer] = mode
            self._robots = {**self._robots, layer: robot}
            if self._every_s is not None:
                robot.start_sync(every_s=self._every_s)


class AssignmentWatch:
    """Thread that asks now and then for the layers that operators assigned, until stopped."""

    def __init__(self, ask: Callable[[], Assignment | None], *, every_s: float) -> None:
        """Begin; `ask` returns the assignment, or raises why it is unknown now."""
        self._ask = ask
        self._every_s = every_s
        self._news: Assignment | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-layers", daemon=True)
        self._thread.start()

    def take_news(self) -> Assignment | None:
        """The newest answer since the last call; None: there is none."""
        news, self._news = self._news, None
        return news

    def stop(self) -> None:
        """End the thread; a question under way is let end."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(self._every_s):
            try:
                self._news = self._ask()
            except CairnError as exc:  # the rounds of the layers report the link; this is asked again
                log.debug("the assigned layers are unknown now: %s", exc.message)


def _assignment_of(contributes: Sequence[str | MappedLayer], fetches: Sequence[str]) -> Assignment:
    """Layers as a program names them.

    Raises:
        BadInputError: kind `bad_layer`.
    """
    if isinstance(contributes, str):
        contributes = []
    mapped = [each if isinstance(each, MappedLayer) else {"layer": each} for each in contributes]
    try:
        return Assignment.model_validate({"contributes": mapped, "fetches": [*fetches]})
    except ValidationError as exc:
        names = [*contributes, *fetches]
        raise BadInputError(
            "bad_layer", f"a robot maps into one layer at least, each named once, got {names}: {first_error(exc)}"
        ) from exc


def lend_keys(replica: Replica, folder: Path) -> None:
    """Let a robot's other folder, which is not open, sign with the keys that vouch for its name in this one.

    Raises:
        BadInputError: the folder is another robot's.
        CairnError: it cannot be opened.
    """
    lend_stored_keys(replica.state, replica.author.robot, folder)


def lend_stored_keys(state: ReplicaState, robot: RobotName, folder: Path) -> None:
    """`lend_keys`, out of the state of a folder that no robot works in.

    Raises:
        BadInputError: the folder is another robot's.
        CairnError: it cannot be opened.
    """
    with closing(ReplicaStore(folder)) as store:
        other = ReplicaState(store)
        if other.robot not in (None, robot):
            raise BadInputError("other_replica", f"{folder} belongs to robot {other.robot}, not to {robot}")
        RobotKeys(other, robot).borrow(RobotKeys(state, robot).vouching())
