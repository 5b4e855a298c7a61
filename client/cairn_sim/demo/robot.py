"""A simulated robot of the demo: drives its path in a thread, maps as it goes, tells how far it is."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig
from cairn_client.robot.robot import Robot
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.wire.messages import Mode
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.kinematics import Manipulator, measurement_joints
from cairn_sim.robots.record import SCAN_S
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene import Scene

STOP_S = 1000.0
"""From one stop to the next in the scene's time, which passes at once: one robot sees a door closed, then open."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoDrive:
    """Drive of one robot of the demo: its path, its cameras, its mode and its lapses."""

    name: str
    head: str
    rig: Rig
    stops: Sequence[Transform]
    """`T_map_robot` where it measures."""
    mode: Mode
    starts_after: int = 0
    """Commits of the first robot that this one waits for before it joins."""
    offline: Sequence[int] = ()
    """Stops at which it has no link."""
    scans: tuple[int, int] = (8, 3)
    """Pans and tilts of the head at each stop."""


@dataclass(slots=True)
class DemoProgress:
    """Progress of a robot, for the table."""

    state: str = "waits"
    stops_done: int = 0
    commits: int = 0
    waiting: int = 0
    up_bytes: int = 0
    down_bytes: int = 0
    cells: int = 0


class DemoRobot:
    """One robot with its thread; `robot` is open until `close`."""

    def __init__(self, plan: DemoDrive, scene: Scene, map_url: str, folder: Path, seed: int) -> None:
        self.plan = plan
        self.stop_count = len(plan.stops)
        self.progress = DemoProgress()
        self.error: BaseException | None = None
        self._scene = scene
        self._noise = Noise(seed)
        self.robot = Robot(
            plan.rig,
            map_url,
            directory=folder / plan.name,
            name=plan.name,
            mode=plan.mode,
            stay=True,
            times="recorded",  # the scene's time is not this machine's
        )
        self.may_start = threading.Event()
        self._thread = threading.Thread(target=self._run, name=plan.name, daemon=True)

    def start(self) -> None:
        """Begin to wait for `may_start`, then to drive."""
        self._thread.start()

    @property
    def is_done(self) -> bool:
        """True once the robot is at the end of its path, or failed."""
        return not self._thread.is_alive()

    def close(self) -> None:
        """Close the robot's directory."""
        self.robot.close()

    def sync(self) -> None:
        """One round with the server, and note what it cost."""
        self.robot.sync()
        self._note()

    def _run(self) -> None:
        try:
            self.may_start.wait()
            for number, T_map_robot in enumerate(self.plan.stops):
                self._measure(number, T_map_robot)
                self._sync_unless_offline(number)
            self.progress.state = "arrived"
        except CairnError as exc:
            self.error = exc
            self.progress.state = "failed"

    def _measure(self, stop: int, T_map_robot: Transform) -> None:
        joints = measurement_joints(*self.plan.scans)
        for scan, joint in enumerate(joints):
            number = stop * len(joints) + scan
            self.robot.observe(
                render_scan(
                    self._scene,
                    self.plan.rig,
                    T_map_rig=T_map_robot @ Manipulator().T_robot_rig(joint),
                    range_camera=RANGE_CAMERA,
                    time_s=CLOCK_START_S + stop * STOP_S + scan * SCAN_S,
                    noise=self._noise,
                    number=number,
                    threads=1,
                )
            )
        self.progress.commits += self.robot.commit() is not None
        self.progress.stops_done = stop + 1

    def _sync_unless_offline(self, number: int) -> None:
        if number in self.plan.offline:
            self.progress.state = "offline"
            self._note()
            return
        self.progress.state = "maps"
        try:
            self.sync()
        except UnreachableError as exc:
            self.progress.state = exc.kind.replace("_", " ")
            time.sleep(0.1)

    def _note(self) -> None:
        self.progress.waiting = self.robot.waiting
        self.progress.up_bytes = self.robot.traffic.up_bytes
        self.progress.down_bytes = self.robot.traffic.down_bytes
        self.progress.cells = len(self.robot.map)
