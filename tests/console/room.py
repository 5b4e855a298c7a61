"""A room that two simulated robots mapped: colour, temperature and bare surfaces, in a few cells."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.fixtures.server.live import Process, until

from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.grid import Geometry
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, thermal_and_tof_head
from cairn_sim.robots.kinematics import Manipulator, measurement_joints
from cairn_sim.robots.trajectories import path_names, stops
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import load_scene

LOOPBACK = "127.0.0.1"

MAP = "room"
ADMIN_TOKEN = "admin-of-the-console-tests"
GEOMETRY = Geometry(voxel_edge_um=80_000, depth=5)
SCALE = 0.1
HEADS = {"scout": full_head(scale=SCALE), "mole": thermal_and_tof_head(scale=SCALE)}
CLOCK_S = 1_760_000_000.0


def scans_of(scene: Scene, robot: str, stop: int) -> Iterator[Scan]:
    """What a robot's head sees from one stop, turned all round."""
    (path, *_) = path_names("small-room")
    T_map_robot = stops(scene, path)[stop]
    for number, joint in enumerate(measurement_joints(6, 2)):
        yield render_scan(
            scene,
            HEADS[robot],
            T_map_rig=T_map_robot @ Manipulator().T_robot_rig(joint),
            range_camera=RANGE_CAMERA,
            time_s=CLOCK_S + number + 100 * stop,
            noise=Noise(1),
            number=number,
            threads=1,
        )


@contextmanager
def mapping(url: str, folder: Path, robot: str, *, token: str | None = None) -> Iterator[Robot]:
    """A robot of the team, with a link."""
    with Robot(HEADS[robot], url, directory=folder / robot, name=robot, token=token, stay=True) as made:
        yield made


def push_measurement(robot: Robot, name: str, stop: int) -> str:
    """Let a robot map from one stop and push that; the commit's id."""
    for scan in scans_of(load_scene("small-room"), name, stop):
        robot.observe(scan)
    commit = robot.commit()
    assert commit is not None
    robot.sync()
    return str(commit.id)


@dataclass
class Room:
    """The server, which can be stopped and started again at the same address."""

    folder: Path
    port: int
    host: str = LOOPBACK
    name: str = MAP
    options: tuple[str, ...] = ()
    """More arguments of the server."""
    process: Process | None = None
    commits: list[str] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://{self.host}:{self.port}"

    @property
    def api(self) -> MapApi:
        return MapApi(self.url, token=ADMIN_TOKEN)

    def start(self) -> None:
        token = self.folder / "token"
        token.write_text(ADMIN_TOKEN)
        place = ("--host", self.host, "--port", str(self.port))
        self.process = Process(self.folder / "server", *place, "--admin-token-file", str(token), *self.options)
        # A process tells of loopback only.
        assert self.process.url == (self.url if self.host == LOOPBACK else None), self.process.said()

    def stop(self) -> None:
        if self.process is not None:
            self.process.send(15)
            self.process.end()
        self.process = None

    def measure(self, robot: str, stop: int) -> None:
        """A robot pushes what it sees from one stop; returns when it is in the map."""
        with mapping(f"{self.url}/maps/{MAP}", self.folder, robot, token=ADMIN_TOKEN) as made:
            self.commits.append(push_measurement(made, robot, stop))
        with self.api as api:
            until(lambda: any(entry.id == self.commits[-1] for entry in api.log(MAP)), "the commit is folded")
