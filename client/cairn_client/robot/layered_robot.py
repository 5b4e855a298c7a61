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
for them when it is opened, with each `sync`, and in the background as often as `start_sync` says, and changes its
layers by the answer. `observe` and `commit` wait for no server.

Each layer is a `Robot` of its own (`robots`), in a folder of its own below the robot's. Its name is bound to one key on
the map, in all layers, so the folders lend each other the keys that vouch for it.
"""

import logging
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from cairn_calib.rig.rig import Rig
from cairn_client.http.api import MapApi
from cairn_client.http.map_url import layer_url, split_map_url
from cairn_client.replica.durable_file import write_durable_file
from cairn_client.replica.limits import Limits
from cairn_client.robot.amending import AnyCommit
from cairn_client.robot.layer_folders import LayerFolders
from cairn_client.robot.membership import own_token
from cairn_client.robot.robot import Robot
from cairn_client.robot.rounds import FLUSH_S, FOLDED_WITHIN_S, SyncThread
from cairn_client.robot.server_clock import Times
from cairn_client.sync.link_profile import LinkName
from cairn_client.sync.scope import EVERYTHING, Scope
from cairn_client.sync.sync import RoundReport
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.recording.scan import Scan
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import map_of_layer, robot_name
from cairn_map.epochs.layer import EVIDENCE, MapLayer
from cairn_map.errors import BadInputError, CairnError, DeniedError, NotFoundError, first_error
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

    Locks: `_changing` is held while layers are opened and left, which takes the link, and by a `sync`; `_lock`, within
    it, while scans are added, commits made, and the layers exchanged: never while a server is asked.

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

        An assigned layer that cannot be opened now is opened later, if there is another one to map into.

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
        self._folders = LayerFolders(self._folder, self._name, map_url)
        self._stay = stay
        self._changing, self._lock = threading.Lock(), threading.RLock()
        self._robots: dict[str, Robot] = {}
        """By layer; replaced, never altered."""
        self._left: dict[str, Commit] = {}
        """Commits made when layers were left, until `commit` or `observe` returns them; one a layer at most."""
        self._every_s: float | None = None
        self._watch: SyncThread | None = None
        self._is_assigned = own is None

        def opened_layer(layer: str, mode: Mode, grid: MapLayer | None) -> Robot:
            return Robot(
                rig if mode == MAPS else None,
                layer_url(map_url, layer),
                directory=self._folder / layer,
                name=name,
                token=token,
                mode=mode,
                geometry=grid,
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
            self._open_first()
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
        robots = self._robots
        return tuple(
            each.layer for each in self._wanted.contributes if each.layer in robots and robots[each.layer].mode == MAPS
        )

    @property
    def assignment(self) -> Assignment:
        """Layers that it takes part in: its program's, or those that operators assigned last."""
        return self._wanted

    def observe(self, scan: Scan, *, into: Sequence[str] | None = None) -> dict[str, Commit]:
        """Add a scan to the open measurements; the commits of the scans before, where this one begins another epoch.

        So it is with the first scan in a layer that was left and is mapped into again.

        Args:
            scan: one head pose, all its images.
            into: layers of `contributes`; None: those that take scans from its place, which may be none.

        Raises:
            BadInputError: kind `bad_layer`: this robot does not map into one of them; or as `Robot.observe`.
        """
        with self._lock:
            mapped = self.contributes
            if into is None:
                x, y, z = np.asarray(scan.T_map_rig, np.float64)[:3, 3].tolist()
                into = [layer for layer in self._wanted.layers_at((x, y, z)) if layer in mapped]
            for layer in into:
                if layer not in mapped:
                    raise BadInputError("bad_layer", f"this robot maps into {mapped}, not into {layer[:32]!r}")
            found = {layer: self._robots[layer].observe(scan) for layer in into}
            # Else the layer's next commit would take the place of the one that was made when it was left.
            found |= {layer: self._left.pop(layer) for layer in into if layer in self._left}
        return {layer: commit for layer, commit in found.items() if commit is not None}

    def commit(self, *, note: str = "") -> dict[str, Commit]:
        """Commit the open measurements, by layer; durable here. One commit a layer, where there is evidence.

        Those of layers that were left since the last call, which were committed then, are among them.

        Raises:
            CairnError: as `Robot.commit`; the layers before it are committed, and may be committed again.
        """
        with self._lock:
            found = {layer: self._robots[layer].commit(note=note) for layer in self.contributes}
            left, self._left = self._left, {}
        return left | {layer: commit for layer, commit in found.items() if commit is not None}

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
        with self._lock:
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
        with self._lock:
            return {layer: robot.retract(measurement[layer], note=note) for layer, robot in self._mapping(measurement)}

    def sync(self, *, until_folded: bool = False, within_s: float = FOLDED_WITHIN_S) -> dict[str, RoundReport]:
        """One round with the server for each layer, after a look for the layers that operators assigned.

        Raises:
            UnreachableError: no link; the layers after the first one without had no round.
            CairnError: as `Robot.sync` of the first layer that failed; all the others had their rounds.
        """
        refusal: CairnError | None = None
        with self._changing:
            if self._is_assigned:
                self._look()
            modes, reports = self._modes(), dict[str, RoundReport]()
            for layer, robot in self._robots.items():
                try:
                    reports[layer] = robot.sync(until_folded=until_folded, within_s=within_s)
                except CairnError as exc:
                    if exc.kind == "no_link":
                        raise
                    log.warning("layer %s: %s: %s", layer, exc.kind, exc.message)
                    refusal = refusal or exc
            if any(modes.get(layer) != robot.mode for layer, robot in self._robots.items()):
                self._reconcile()  # what was left to push is pushed
        if refusal is not None:
            raise refusal
        return reports

    def start_sync(self, *, every_s: float = 5.0) -> None:
        """Sync all layers in the background, as `Robot.start_sync`; layers that operators assign are taken there."""
        self._every_s = every_s
        for robot in self._robots.values():
            robot.start_sync(every_s=every_s)
        if self._is_assigned and self._watch is None:
            self._watch = SyncThread(self._follow, every_s=every_s, on_failure=lambda exc, wait_s: None)

    def snapshot(self, model: SensorModel | None = None, *, at_s: float | None = None) -> LayeredSnapshot:
        """All layers as they are here now, of which the finest that knows a point answers for it; by any thread.

        Raises:
            ConflictError: kind `not_known`: with `at_s`, a layer has no epochs.
        """
        while True:
            robots = self._robots
            try:
                return LayeredSnapshot({layer: robot.snapshot(model, at_s=at_s) for layer, robot in robots.items()})
            except BadInputError as exc:
                if exc.kind != "robot_closed" or robots is self._robots:
                    raise
                # The background left a layer at this moment; the others are read again.

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
            self._watch.stop(cut=lambda: None)  # a question under way is let end
            self._watch = None

    def _mapping(self, measurement: Mapping[str, AnyCommit]) -> list[tuple[str, Robot]]:
        mapped = self.contributes
        for layer in measurement:
            if layer not in mapped:
                raise BadInputError("bad_layer", f"this robot maps into {mapped}, not into {layer[:32]!r}")
        return [(layer, self._robots[layer]) for layer in measurement]

    def _first_assignment(self) -> Assignment:
        """The layers that operators assigned, from the server; if it cannot or will not say, those of last time.

        Raises:
            NotFoundError: kind `no_assignment`.
            CairnError: the server did not say, and there was no last time.
        """
        known = self._folder / ASSIGNMENT_FILE
        try:
            found = self._asked()
        except CairnError as exc:
            if not known.is_file():
                raise
            log.warning("the assigned layers are those of last time: %s: %s", exc.kind, exc.message)
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
        """The layers that operators assigned, by the robot's own token of an open layer, or those of a start."""
        server_url = split_map_url(self._map_url)[0]
        own = {layer: own_token(robot.replica.state, self._map_url) for layer, robot in self._robots.items()}
        asking: list[tuple[str, str | None]] = []
        asking += [(layer, token) for layer, token in own.items() if token is not None]
        if not asking:  # at a start, and before the first registration
            asking += [(EVIDENCE, self._token), *self._folders.tokens(opened=own)]
        while True:
            layer, token = asking.pop(0)
            try:
                with MapApi(server_url, token=token) as api:  # a token of a layer counts on that layer alone
                    return api.assignment(self._folders.name_of(layer), self._name)
            except DeniedError:
                if not asking:
                    raise

    def _look(self) -> None:
        """Take what operators assigned, by one that holds `_changing`; if the server will not say, all stays.

        Raises:
            UnreachableError: no link.
        """
        try:
            self._take(self._asked())
        except CairnError as exc:  # the rounds of the layers prove who asks, and report what is refused
            if exc.kind == "no_link":
                raise
            log.warning("the assigned layers are unknown now: %s: %s", exc.kind, exc.message)
        self._reconcile()

    def _follow(self) -> None:
        """Take what operators assigned, in the background.

        Raises:
            CairnError: it is unknown now, or a layer could not be opened or left; all others are.
        """
        with self._changing:
            self._take(self._asked())
            failures = self._reconcile()
        if failures:
            raise failures[0]

    def _take(self, assignment: Assignment | None) -> None:
        """Have another assignment from here on; None, which is none any more, changes nothing."""
        if assignment is not None and assignment != self._wanted:
            self._remember(assignment)
            with self._lock:
                self._wanted = assignment

    def _remember(self, assignment: Assignment) -> None:
        write_durable_file(self._folder / ASSIGNMENT_FILE, assignment.model_dump_json().encode())

    def _open_first(self) -> None:
        """Open the layers of a start.

        Raises:
            CairnError: a layer that the program named, or each of those that operators assigned to be mapped into,
                cannot be opened.
        """
        if not self._is_assigned:
            for layer, mode in self._modes().items():
                self._open(layer, mode)
            return
        failures = self._reconcile()
        if failures and not self.contributes:
            raise failures[0]

    def _modes(self) -> dict[str, Mode]:
        """Mode in each layer that is wanted, first those that it maps into."""
        wanted: dict[str, Mode] = {each.layer: MAPS for each in self._wanted.contributes}
        wanted |= dict.fromkeys(self._wanted.fetches, READS)
        return wanted

    def _reconcile(self) -> list[CairnError]:
        """Open the layers that are wanted, and close others, each once its commits are pushed; by one at a time.

        What fails in one layer stops no other; it is tried again the next time.
        """
        modes, before, failures = self._modes(), self._robots, list[CairnError]()
        # New ones first: while those that are left are open they lend their keys, and a snapshot has them.
        for layer in [*(each for each in modes if each not in before), *before]:
            try:
                robot = self._robots.get(layer)
                if robot is not None and robot.mode == modes.get(layer):
                    continue
                if robot is not None:
                    self._leave(layer, robot)
                if layer in modes and layer not in self._robots:
                    self._open(layer, modes[layer])
            except CairnError as exc:
                log.warning("layer %s is tried again later: %s: %s", layer, exc.kind, exc.message)
                failures.append(exc)
        return failures

    def _leave(self, layer: str, robot: Robot) -> None:
        """Commit what is open in a layer, and close it if all is pushed; else its rounds go on until then."""
        with self._lock:
            commit = robot.commit()
            if commit is not None:
                self._left[layer] = commit
            if robot.waiting:
                return
            self._robots = {name: each for name, each in self._robots.items() if name != layer}
        robot.close(stay=self._stay)

    def _open(self, layer: str, mode: Mode) -> None:
        """Open a layer; the keys that vouch for the robot's name come from its other layers."""
        self._folders.lend_to(layer, self._robots)
        try:
            robot = self._open_layer(layer, mode, None)
        except DeniedError:
            grid = self._grid_by_membership(layer)
            if grid is None:
                raise
            robot = self._open_layer(layer, mode, grid)
        with self._lock:
            self._robots = {**self._robots, layer: robot}
        if self._every_s is not None:
            robot.start_sync(every_s=self._every_s)

    def _grid_by_membership(self, layer: str) -> MapLayer | None:
        """Grid of a layer, by the robot's own token of the map, which counts on all layers; None: it has none."""
        member = self._robots.get(EVIDENCE)
        if member is not None:
            token = own_token(member.replica.state, self._map_url)
        else:
            token = dict(self._folders.tokens(opened=self._robots)).get(EVIDENCE)
        if token is None:
            return None
        with MapApi(split_map_url(self._map_url)[0], token=token) as api:
            return api.map_info(self._folders.name_of(layer)).layer


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
