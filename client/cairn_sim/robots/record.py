"""Recording of a simulated robot, with the truth in a folder of its own.

    lab-1/             a recording as any other (RECORDING.md): images, and the poses that the robot believed
      raw/           thermal images as the camera counted, 16-bit PNG (when asked for)
      truth/
        truth.json     how it was made: scene, robot, path, seed, errors
        scene.toml     the scene
        trajectory.txt the true poses, T_map_rig
        <camera>/000000.npz   the truth behind each image (`truth.CameraTruth`)

Scans are rendered side by side and written in order. Every image's noise depends on the seed, the camera and the scan's
number alone, so the same plan gives the same bytes on one machine, whatever the number of cores.

A recording of hours visits its stops at even times, round after round, and renders nothing between them:

    rounds = 3, lasts_s = 7200      |stop 0 .. stop 25|        |stop 0 .. stop 25|        |stop 0 .. stop 25|
                                    0 s                        2400 s                     4800 s           7200 s

The 36 scans of a stop take 18 s; between two stops the robot stands still. All images of a scan show the scene as it is
at the scan's time.
"""

import json
import math
import os
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from cairn_calib.rig.image_files import write_grey16
from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.recording.recording_format import RangeEncoding
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_map.errors import BadInputError
from cairn_sim.render.render import SENSORS, render_scan
from cairn_sim.render.sensors import Noise, RangeSensor, ThermalSensor
from cairn_sim.render.truth import CameraTruth, camera_truth
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.robots import SimRobot
from cairn_sim.robots.trajectories import PoseErrors, believed, drive, stops
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene import Scene

SCAN_S = 0.5
"""From one head pose to the next, at a stop."""
MILLIMETRES_REACH_M = 65.0
AHEAD = 2
"""Scans rendered before their turn to be written, for each thread."""
SCANS_MAX = 200_000
"""Scans of a plan: their poses take some 200 MB."""
Truths = Literal["none", "range", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Plan of a recording: scene, robot, path, and the imperfections to simulate."""

    scene: Scene
    robot: SimRobot
    path: str
    seed: int = 1
    perfect: bool = False
    """True for sensors without noise."""
    scale: float = 1.0
    """Size of colour and thermal images, as a share of the sensor's."""
    raw: bool = False
    """True if thermal images are written as raw counts, too."""
    truth: Truths = "range"
    """For which images the truth is written."""
    errors: PoseErrors = field(default_factory=PoseErrors)
    backlash_rad: float = 0.0
    """Play of the manipulator's gears; a tenth of it shakes them."""
    speed_m_s: float = 0.0
    """0: the robot stops along the path; else it drives through, and every scan is a measurement."""
    rate_hz: float = 5.0
    """Scans a second of a drive."""
    rounds: int = 1
    """Times that the robot goes along the path."""
    lasts_s: float = 0.0
    """Time over which the stops, or the rounds of a drive, are evenly spread; 0: one follows at once on the other."""
    first_stop: int = 0
    """The first stop that is recorded, in each round."""
    last_stop: int | None = None
    """The first stop that is not recorded; None for all."""

    def __post_init__(self) -> None:
        if self.seed < 0 or not (0 <= self.speed_m_s < math.inf and 0 < self.rate_hz < math.inf):
            raise BadInputError(
                "bad_plan",
                "a recording needs a seed from 0, a speed from 0 m/s and a rate above 0 Hz, got "
                f"{self.seed}, {self.speed_m_s:g}, {self.rate_hz:g}",
            )
        if self.rounds < 1 or not 0 <= self.lasts_s < math.inf:
            raise BadInputError(
                "bad_plan",
                f"a recording needs at least 1 round, and a time from 0 s, got {self.rounds} and {self.lasts_s:g} s",
            )
        if not 0 <= self.backlash_rad < 1:
            raise BadInputError("bad_plan", f"backlash must be 0 to 1 rad (57 degrees), got {self.backlash_rad:g} rad")

    @property
    def noise(self) -> Noise | None:
        """The source of the images' noise."""
        return None if self.perfect else Noise(self.seed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """One scan to take."""

    number: int
    """Number of the scan along the path."""
    stop: int
    """Number of the stop along the path, the same in each round."""
    scan: int
    """Number of the scan at its stop."""
    time_s: float
    T_map_rig: Transform
    """True pose of the head."""
    T_believed: Transform
    """Pose of the head as the robot believes it."""
    ends_stop: bool


def places_of(plan: Plan) -> list[Transform]:
    """`T_map_robot`, true, at each of a plan's measurements, chosen or not.

    Raises:
        BadInputError: the scene has no such path.
    """
    if plan.speed_m_s > 0:
        return drive(plan.scene, plan.path, speed_m_s=plan.speed_m_s, rate_hz=plan.rate_hz)
    return stops(plan.scene, plan.path)


def shots_of(plan: Plan) -> list[Shot]:
    """The scans of a plan, in order.

    Raises:
        BadInputError: the scene has no such path, or no such stops; too many scans, or too little time for them.
    """
    rng, places = Noise(plan.seed).of_poses(), places_of(plan)
    if not places[plan.first_stop : plan.last_stop]:
        raise BadInputError("no_stops", f"path {plan.path} has {len(places)} stops, none of them chosen")
    robot = replace(plan.robot, scans=(1, 1)) if plan.speed_m_s > 0 else plan.robot
    per_stop, per_round = robot.scans_per_stop, len(places) * robot.scans_per_stop
    if plan.rounds * per_round > SCANS_MAX:
        raise BadInputError(
            "bad_plan", f"a recording has at most {SCANS_MAX} scans, got {plan.rounds} rounds of {per_round}"
        )
    times_s = _scan_times_s(
        plan, per_visit=per_round if plan.speed_m_s > 0 else per_stop, count=plan.rounds * per_round
    )
    way = places * plan.rounds
    told = [T for place in believed(way, plan.errors, rng) for T in robot.head_poses(place)]
    gap = plan.backlash_rad
    true = robot.true_head_poses(way, gap_rad=gap, sigma_rad=gap / 10, rng=rng)
    shots = [
        Shot(
            number=number,
            stop=number % per_round // per_stop,
            scan=number % per_stop,
            time_s=time_s,
            T_map_rig=T,
            T_believed=T_believed,
            ends_stop=(number + 1) % per_stop == 0,
        )
        for number, (time_s, T, T_believed) in enumerate(zip(times_s, true, told, strict=True))
    ]
    last = len(places) if plan.last_stop is None else plan.last_stop
    return [shot for shot in shots if plan.first_stop <= shot.stop < last]


def _scan_times_s(plan: Plan, *, per_visit: int, count: int) -> list[float]:
    """UTC of each of `count` scans; a visit, which nothing interrupts, is a stop, or a round of a drive."""
    scan_s = 1 / plan.rate_hz if plan.speed_m_s > 0 else SCAN_S
    if plan.lasts_s == 0:
        return [CLOCK_START_S + number * scan_s for number in range(count)]
    visit_s = plan.lasts_s * per_visit / count
    if visit_s < per_visit * scan_s:
        raise BadInputError(
            "bad_plan",
            f"{count} scans take {count * scan_s / 3600:.2g} h at least, got {plan.lasts_s / 3600:.2g} h; "
            "choose more hours or fewer rounds",
        )
    return [CLOCK_START_S + number // per_visit * visit_s + number % per_visit * scan_s for number in range(count)]


def scans_of(
    plan: Plan, shots: Sequence[Shot], rig: Rig, *, threads: int | None = None
) -> Generator[tuple[Shot, Scan, dict[str, CameraTruth]], None, None]:
    """Each shot with its scan and the truth behind its images, in order; rendered side by side (None: on all cores).

    At most `AHEAD` scans a thread are held, however many there are.
    """
    cameras = {"none": [], "range": [RANGE_CAMERA], "all": list(rig.cameras)}[plan.truth]

    def take(shot: Shot) -> tuple[Shot, Scan, dict[str, CameraTruth]]:
        scan = render_scan(
            plan.scene,
            rig,
            T_map_rig=shot.T_map_rig,
            range_camera=RANGE_CAMERA,
            time_s=shot.time_s,
            noise=plan.noise,
            number=shot.number,
            sensors=plan.robot.sensors,
            threads=1,
        )
        scene = plan.scene.at(shot.time_s)
        truths = {name: camera_truth(scene, rig, name, T_map_rig=shot.T_map_rig) for name in cameras}
        return shot, replace(scan, T_map_rig=shot.T_believed), truths

    workers = threads or os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[tuple[Shot, Scan, dict[str, CameraTruth]]]] = deque()
        try:
            for shot in shots:
                waiting.append(pool.submit(take, shot))
                if len(waiting) > AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def record(plan: Plan, folder: Path, *, scene_text: str) -> Iterator[Shot]:
    """Write the recording of a plan, and its truth, into a new folder; yields each shot when its scan is written.

    Args:
        plan: what to record.
        folder: new or empty.
        scene_text: the scene's file, kept with the truth.

    The recording is finished when the iterator came to its end; one that is left early stays unfinished.

    Raises:
        ConflictError: the folder holds something already.
        BadInputError: the scene has no such path.
    """
    shots, rig = shots_of(plan), plan.robot.rig_of(plan.scale)
    sensor = plan.robot.sensors.get(RANGE_CAMERA, SENSORS[Spectrum.RANGE])
    reach_m = sensor.wrap_m if isinstance(sensor, RangeSensor) else 0.0
    encoding = RangeEncoding(units_per_m=1000.0 if reach_m < MILLIMETRES_REACH_M else 500.0)
    name = f"{plan.scene.name}-{plan.robot.name}-{plan.path}"
    with RecordingWriter(folder, rig, name=name, note=_note(plan), range_encoding=encoding) as writer:
        truth = folder / "truth"
        truth.mkdir()
        (truth / "scene.toml").write_text(scene_text, encoding="utf-8")
        (truth / "truth.json").write_text(json.dumps(_about(plan, rig), indent=1) + "\n", encoding="utf-8")
        with (truth / "trajectory.txt").open("w", encoding="utf-8", newline="\n") as poses:
            poses.write("# time tx ty tz qx qy qz qw (T_map_rig, true)\n")
            for index, (shot, scan, truths) in enumerate(scans_of(plan, shots, rig)):
                writer.add(scan)
                poses.write(trajectory_line(shot.time_s, shot.T_map_rig))
                if plan.raw:
                    _write_raw(scan, plan.robot, folder, index)
                for camera, behind in truths.items():
                    (truth / camera).mkdir(exist_ok=True)
                    behind.write(truth / camera / f"{index:06d}.npz")
                if shot.ends_stop:
                    writer.end_measurement()
                yield shot


def _write_raw(scan: Scan, robot: SimRobot, folder: Path, index: int) -> None:
    for camera, kelvin in scan.thermal.items():
        (folder / "raw" / camera).mkdir(parents=True, exist_ok=True)
        write_grey16(folder / "raw" / camera / f"{index:06d}.png", _thermal_sensor(robot, camera).raw_counts(kelvin))


def _thermal_sensor(robot: SimRobot, camera: str) -> ThermalSensor:
    sensor = robot.sensors.get(camera, SENSORS[Spectrum.THERMAL])
    if not isinstance(sensor, ThermalSensor):
        raise BadInputError("bad_sensor", f"camera {camera} of {robot.name} needs a thermal sensor, has {sensor}")
    return sensor


def _note(plan: Plan) -> str:
    return (
        f"Simulated: {plan.robot.about}; scene {plan.scene.name}, path {plan.path}, seed {plan.seed}. Truth in truth/."
    )


def _about(plan: Plan, rig: Rig) -> dict[str, object]:
    return {
        "format": "cairn-truth",
        "version": 1,
        "scene": plan.scene.name,
        "robot": plan.robot.name,
        "path": plan.path,
        "seed": plan.seed,
        "perfect": plan.perfect,
        "errors": asdict(plan.errors),
        "backlash_rad": plan.backlash_rad,
        "cameras": list(rig.cameras),
        "thermal": {name: asdict(_thermal_sensor(plan.robot, name)) for name in rig.of_spectrum(Spectrum.THERMAL)},
        "solids": [solid.name for solid in plan.scene.solids],
    }
