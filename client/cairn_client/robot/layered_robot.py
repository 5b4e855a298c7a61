"""A robot on several layers of one map: it maps into some, fetches others, and reads all of them together.

    with LayeredRobot(rig, "http://base:8750/maps/lab", directory="state", name="mole",
                      contributes=["evidence", "fine"], fetches=["wide"]) as robot:
        robot.observe(scan)                            # into both
        robot.observe(scan, into=["evidence"])         # outdoors: into one of them
        robot.commit()
        robot.sync()
        robot.snapshot().state_at(points_m)            # the finest layer that knows each point answers

Each layer is a `Robot` of its own (`robots`), in a folder of its own below the robot's. Its name is bound to one key on
the map, in all layers, so the folders lend each other the keys that vouch for it.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from types import TracebackType
from typing import Self

from cairn_calib.rig.rig import Rig
from cairn_client.http.map_url import split_map_url
from cairn_client.replica.limits import Limits
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState, RobotKeys
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.robot import Robot
from cairn_client.robot.rounds import FOLDED_WITHIN_S
from cairn_client.robot.server_clock import Times
from cairn_client.sync.link_profile import LinkName
from cairn_client.sync.scope import EVERYTHING, Scope
from cairn_client.sync.sync import RoundReport
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.recording.scan import Scan
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import map_of_layer, robot_name
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot

NO_INTEGRATORS: Mapping[str, Integrator] = {}


class LayeredRobot:
    """One robot's part in several layers of a map.

    Args:
        rig: head whose scans will come.
        map_url: `http://HOST:PORT/maps/NAME`, of the map.
        directory: folder of this robot alone, with one below it for each layer.
        name: the robot's name on the map.
        contributes: layers that it maps into, and keeps; `evidence` is the one that the map began with.
        fetches: other layers that it keeps to read.
        token: enrolment (or admin) token, or the robot's own, of the map.
        integrators: range limits in a layer; a layer that is not there has the standard ones.
        scope: cells to fetch of each layer, and the size of one reply.
        limits: how much to keep of each layer on the disk and in memory.
        link: "small" for a link of some ten to some hundred kbit/s.
        stay: True for a robot that only pauses: `close` does not deregister it.
        times: "own" for scans stamped by this machine's time of day; "recorded" for those of a recording.
    """

    def __init__(
        self,
        rig: Rig,
        map_url: str,
        *,
        directory: Path | str,
        name: str,
        contributes: Sequence[str],
        fetches: Sequence[str] = (),
        token: str | None = None,
        integrators: Mapping[str, Integrator] = NO_INTEGRATORS,
        scope: Scope = EVERYTHING,
        limits: Limits | None = None,
        link: LinkName = "good",
        stay: bool = False,
        times: Times = "own",
    ) -> None:
        """Open or make the folders; the server is asked for the grid of each layer that was never opened.

        Raises:
            BadInputError: kind `bad_layer`: no layer to map into, or one that is named twice; `layer_of_map`: the URL
                is that of a layer.
            CairnError: as `Robot`.
        """
        names = [*contributes, *fetches]
        if not contributes or isinstance(contributes, str) or len({*names}) != len(names):
            raise BadInputError("bad_layer", f"a robot maps into one layer at least, each named once, got {names}")
        if map_of_layer(split_map_url(map_url)[1]) is not None:
            raise BadInputError("layer_of_map", f"{map_url} is a layer: take the map's URL, and name its layers")
        self._robots: dict[str, Robot] = {}
        self._contributes = tuple(contributes)
        with ExitStack() as opened:  # what was opened is closed again if a later one fails
            for layer in names:
                folder = Path(directory) / layer
                for other in self._robots.values():
                    lend_keys(other.replica, folder)
                robot = Robot(
                    rig if layer in contributes else None,
                    map_url if layer == EVIDENCE else f"{map_url.rstrip('/')}.{layer}",
                    directory=folder,
                    name=name,
                    token=token,
                    mode="high-end" if layer in contributes else "viewer",
                    integrator=integrators.get(layer),
                    scope=scope,
                    limits=limits,
                    link=link,
                    stay=stay,
                    times=times,
                )
                opened.callback(robot.close, stay=True, flush_s=0.0)
                self._robots[layer] = robot
            opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close; an error inside the block discards the open measurements, as of a `Robot`."""
        with ExitStack() as closed:  # each, whatever becomes of the others
            for robot in self._robots.values():
                closed.callback(robot.__exit__, kind, error, traceback)

    def __repr__(self) -> str:
        return f"LayeredRobot({', '.join(map(repr, self._robots.values()))})"

    @property
    def robots(self) -> Mapping[str, Robot]:
        """The robot of each layer, for all that is of one: its events, status, limits, amends and retracts."""
        return dict(self._robots)

    @property
    def contributes(self) -> tuple[str, ...]:
        """Layers that it maps into."""
        return self._contributes

    def observe(self, scan: Scan, *, into: Sequence[str] | None = None) -> dict[str, Commit]:
        """Add a scan to the open measurements; the commits of the scans before, where this one begins another epoch.

        Args:
            scan: one head pose, all its images.
            into: layers of `contributes`, such as those of the place where the robot is; None: all.

        Raises:
            BadInputError: kind `bad_layer`: this robot does not map into one of them; or as `Robot.observe`.
        """
        asked = self._contributes if into is None else tuple(into)
        for layer in asked:
            if layer not in self._contributes:
                raise BadInputError("bad_layer", f"this robot maps into {self._contributes}, not into {layer[:32]!r}")
        found = {layer: self._robots[layer].observe(scan) for layer in asked}
        return {layer: commit for layer, commit in found.items() if commit is not None}

    def commit(self, *, note: str = "") -> dict[str, Commit]:
        """Commit the open measurements, by layer; durable here. One commit a layer, where there is evidence.

        Raises:
            CairnError: as `Robot.commit`; the layers before it are committed, and may be committed again.
        """
        found = {layer: self._robots[layer].commit(note=note) for layer in self._contributes}
        return {layer: commit for layer, commit in found.items() if commit is not None}

    def sync(self, *, until_folded: bool = False, within_s: float = FOLDED_WITHIN_S) -> dict[str, RoundReport]:
        """One round with the server for each layer: first those that this robot maps into.

        Raises:
            CairnError: as `Robot.sync`.
        """
        return {
            layer: robot.sync(until_folded=until_folded, within_s=within_s) for layer, robot in self._robots.items()
        }

    def start_sync(self, *, every_s: float = 5.0) -> None:
        """Sync all layers in the background, as `Robot.start_sync`."""
        for robot in self._robots.values():
            robot.start_sync(every_s=every_s)

    def snapshot(self, model: SensorModel | None = None, *, at_s: float | None = None) -> LayeredSnapshot:
        """All layers as they are here now, of which the finest that knows a point answers for it; by any thread.

        Raises:
            ConflictError: kind `not_known`: with `at_s`, a layer has no epochs.
        """
        return LayeredSnapshot({layer: robot.snapshot(model, at_s=at_s) for layer, robot in self._robots.items()})

    def close(self, *, stay: bool = False) -> None:
        """Close each layer's robot, as `Robot.close`."""
        with ExitStack() as closed:
            for robot in self._robots.values():
                closed.callback(robot.close, stay=stay)


def lend_keys(replica: Replica, folder: Path) -> None:
    """Let a robot's other folder, which is not open, sign with the keys that vouch for its name in this one.

    Raises:
        BadInputError: the folder is another robot's.
        CairnError: it cannot be opened.
    """
    robot = replica.author.robot
    with closing(ReplicaStore(folder)) as store:
        state = ReplicaState(store)
        if state.robot not in (None, robot):
            raise BadInputError("other_replica", f"{folder} belongs to robot {state.robot}, not to {robot_name(robot)}")
        RobotKeys(state, robot).borrow(RobotKeys(replica.state, robot).vouching())
