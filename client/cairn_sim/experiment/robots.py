"""The robots of the experiment: simulated now, or read from recordings; both give the scans of one stop at a time.

simulated_robots   the paper's two paths at right angles, one robot each: `labs`, `corridors`
recorded_robot     a recording folder, and the truth in it where `cairn sim record` wrote one
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig
from cairn_fusion.importers import open_source
from cairn_fusion.recording.recording import Recording
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.trajectory import read_trajectory
from cairn_map.commits.ids import NAME
from cairn_map.errors import BadInputError
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan, Shot, scans_of, shots_of
from cairn_sim.robots.robots import SimRobot
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import FILE_BYTES_MAX, load_scene

PATHS = ("labs", "corridors")
"""Paths in the building, VI.C: 26 and 28 stops; together the path `experiment`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownTruth:
    """A scene, and where the range camera truly was in it, scan by scan."""

    scene: Scene
    T_map_cameras: Sequence[Transform]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentRobot:
    """One robot."""

    name: str
    rig: Rig
    range_camera: str
    stops: Sequence[Transform]
    """`T_map_rig` of the first scan of each stop, as the robot believes it is."""
    scan_count: int
    """Scans of all stops."""
    scans_at: Callable[[int], Sequence[Scan]]
    """The scans of a stop, rendered or read when asked for."""
    truth: KnownTruth | None


def simulated_robots(
    scene: Scene, robot: SimRobot, *, scale: float, seed: int, stops: int | None, threads: int
) -> list[ExperimentRobot]:
    """A robot on each of the building's two paths.

    Args:
        scene: the building, or a scene with paths of those names.
        robot: its kind.
        scale: of colour and thermal images.
        seed: of the first robot's noise; the next one has the next.
        stops: how many of each path; None for all.
        threads: that render.
    """
    plans = [
        Plan(scene=scene, robot=robot, path=path, seed=seed + n, scale=scale, truth="none", last_stop=stops)
        for n, path in enumerate(PATHS)
    ]
    return [_simulated(plan, threads) for plan in plans]


def _simulated(plan: Plan, threads: int) -> ExperimentRobot:
    shots, rig = shots_of(plan), plan.robot.rig_of(plan.scale)
    by_stop: dict[int, list[Shot]] = {}
    for shot in shots:
        by_stop.setdefault(shot.stop, []).append(shot)
    at = list(by_stop.values())
    T_rig_camera = rig[RANGE_CAMERA].transform
    return ExperimentRobot(
        name=plan.path,
        rig=rig,
        range_camera=RANGE_CAMERA,
        stops=[first.T_believed for first, *_ in at],
        scan_count=len(shots),
        scans_at=lambda stop: [scan for _, scan, _ in scans_of(plan, at[stop], rig, threads=threads)],
        truth=KnownTruth(scene=plan.scene, T_map_cameras=[shot.T_map_rig @ T_rig_camera for shot in shots]),
    )


def recorded_robot(folder: Path, *, stops: int | None) -> ExperimentRobot:
    """The robot that made a recording; its truth where the folder has one.

    Raises:
        BadInputError: no recording, or its name or its truth is not sound.
    """
    source = open_source(folder)
    if not isinstance(source, Recording):
        raise BadInputError("bad_recording", f"{folder} is a bag; experiments are made with recordings (RECORDING.md)")
    at = source.measurements()[:stops]
    if not at:
        raise BadInputError("no_stops", f"{folder} holds no scans")
    name = folder.resolve().name.lower()
    if not NAME.fullmatch(name):
        raise BadInputError(
            "bad_name", f"a recording's folder names its robot: 1-32 of a-z 0-9 _ -, got {name[:64]!r}; rename it"
        )
    files = [source.files[index] for stop in at for index in stop]
    return ExperimentRobot(
        name=name,
        rig=source.rig,
        range_camera=files[0].range_camera,
        stops=[source.files[stop[0]].T_map_rig for stop in at],
        scan_count=len(files),
        scans_at=lambda stop: [source.scan(index) for index in at[stop]],
        truth=_truth(folder / "truth", source.rig, files[0].range_camera, [file.time_s for file in files]),
    )


def _truth(folder: Path, rig: Rig, range_camera: str, times_s: Sequence[float]) -> KnownTruth | None:
    """The truth in a folder; None where there is none, or where its scene has no file, or moves.

    The experiment compares with a world that stands still: the map is one sum over all times.
    """
    scene, trajectory = folder / "scene.toml", folder / "trajectory.txt"
    if not (scene.is_file() and trajectory.is_file()):
        return None
    with scene.open("rb") as file:
        lines = file.read(FILE_BYTES_MAX).splitlines()
    if all(not line or line.startswith(b"#") for line in lines):
        return None
    known = load_scene(scene)
    if known.moving:
        return None
    true = read_trajectory(trajectory)
    T_rig_camera = rig[range_camera].transform
    return KnownTruth(
        scene=known,
        T_map_cameras=[true.pose_at(time_s, max_gap_s=0.0) @ T_rig_camera for time_s in times_s],
    )
