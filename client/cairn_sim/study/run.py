"""The study: every image configuration is photographed, solved, and verified, all in the simulator.

    places of the board -> images -> corners -> solve -> rig.json --+
                                                                    +--> verification -> Table 2
    drive past targets -> images -> centroids ----------------------+

Images of a place are taken once, whichever configurations have it; the drive is the same for all.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board as CornerBoard
from cairn_calib.board.corner_detection import find_chessboard
from cairn_calib.board.corners import Corners
from cairn_calib.rig.poses import Transform, transform_points
from cairn_calib.rig.rig import Rig
from cairn_calib.solve.board_views import BoardView, BoardViews
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_calib.solve.solved_rig import solved_rig
from cairn_calib.verify.disc_images import Method
from cairn_calib.verify.verification import PoseTargets, Sightings, add_sights, find_targets
from cairn_calib.verify.verification_table import CameraRow, table_of
from cairn_fusion.recording.scan import Scan
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.kinematics import T_FORWARD_CAMERA
from cairn_sim.robots.targets import SimulatedBoard, calibration_scene, target_scene
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.solids import placed
from cairn_sim.study.configurations import CONFIGURATIONS, Configuration, Place, pose_of

T_MAP_HEAD: Transform = placed((0.0, 0.0, 1.4)) @ T_FORWARD_CAMERA
"""In the middle of the laboratory's height."""
RANGES_M = (1.1, 5.7)
"""Nearest and farthest of the paper's 211 objects, metres."""
RADIUS_MAX_PX = 67.0
"""Radius in the range camera's image, from its principal point; the paper's."""
TILT_MAX_RAD = 0.5
DIAMETERS_M = (0.20, 0.30, 0.30)
"""Three targets, of 20 and 30 cm."""
ROOM_LOW, ROOM_HIGH = np.array([-0.5, -2.7, 0.2]), np.array([6.6, 2.7, 2.6])
APART = 1.25
"""Between two targets, times what would make them touch in the image."""
MARGIN_PX = 4
TRIES = 10_000

METHODS: tuple[Method, ...] = ("paper", "grey")
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
DRIVE_SEED, BOARD_SEED = 1, 2
"""Added to the study's."""
BoardCorners = Mapping[str, Corners]
"""By camera; of those that found the board."""
Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class StudyOutcome:
    """One configuration: its rig and Table 2 of it, or why there is none."""

    name: str
    configuration: Configuration
    rig: Rig | None
    refusal: str = ""
    sightings: Mapping[Method, Sightings] = field(default_factory=dict)
    tables: Mapping[Method, Sequence[CameraRow]] = field(default_factory=dict)

    def score(self, method: Method) -> float:
        """Root mean square of all differences, in pixels of the range camera: what the best has least of."""
        rows = self.tables.get(method, ())
        return float(np.sqrt(np.mean([(row.rms_px / row.source_pixel_px) ** 2 for row in rows]))) if rows else np.inf


def places_of(names: Sequence[str]) -> list[Place]:
    """All places of some configurations, each once.

    Raises:
        BadInputError: there is no such configuration.
    """
    if unknown := [name for name in names if name not in CONFIGURATIONS]:
        raise BadInputError("bad_arguments", f"there is no {unknown[0]!r}; there are {', '.join(CONFIGURATIONS)}")
    return list(dict.fromkeys(place for name in names for place in CONFIGURATIONS[name].places))


def photographed(head: Rig, places: Sequence[Place], *, seed: int) -> Iterator[tuple[Place, BoardCorners]]:
    """The corners that each camera found of the board at each place, in order."""
    board = SimulatedBoard()
    corner_board = corner_board_of(board)

    def take(numbered: tuple[int, Place]) -> tuple[Place, BoardCorners]:
        number, place = numbered
        T_map_board = T_MAP_HEAD @ head[RANGE_CAMERA].transform @ pose_of(place, board, head)
        scan = _scan(calibration_scene(T_map_board, board), head, number=number, seed=seed + BOARD_SEED)
        found = {}
        for camera, image in _images(scan).items():
            grey = np.asarray(image, np.float32)
            grey = grey @ LUMA if grey.ndim == 3 else grey
            # What corners call printed dark is aluminium here, which every camera sees bright.
            corners = find_chessboard(grey, corner_board, polarity="reversed").corners
            if corners is not None:
                found[camera] = corners
        return place, found

    yield from _side_by_side(take, list(enumerate(places)))


def driven(head: Rig, images: int, *, seed: int) -> Iterator[dict[Method, PoseTargets]]:
    """The targets that each camera found along a drive, by each method."""
    rng = np.random.default_rng(seed + DRIVE_SEED)
    views = [targets_in_view(head, rng) for _ in range(images)]

    def take(number: int) -> dict[Method, PoseTargets]:
        scene = target_scene([(each.T_map_target, each.diameter_m) for each in views[number]])
        scan = _scan(scene, head, number=number, seed=seed + DRIVE_SEED)
        found = _images(scan)
        name = f"{number:06d}"
        return {m: find_targets(head, found, scan.range_m, name=name, method=m) for m in METHODS}

    yield from _side_by_side(take, range(images))


def outcome_of(
    name: str, corners: Mapping[Place, BoardCorners], drive: Sequence[Mapping[Method, PoseTargets]], head: Rig
) -> StudyOutcome:
    """One configuration, solved from its images alone, and verified."""
    configuration = CONFIGURATIONS[name]
    try:
        rig = calibrated(configuration, corners, head, name=name)
    except BadInputError as exc:
        return StudyOutcome(name, configuration, None, exc.message)
    sightings: dict[Method, Sightings] = {}
    for method in METHODS:
        sightings[method] = Sightings(rig, RANGE_CAMERA, method)
        for found in drive:
            add_sights(sightings[method], found[method])
    return StudyOutcome(name, configuration, rig, "", sightings, {m: table_of(each) for m, each in sightings.items()})


def calibrated(configuration: Configuration, corners: Mapping[Place, BoardCorners], head: Rig, *, name: str) -> Rig:
    """The rig that a configuration's images give; of `head` only image sizes and spectra are known.

    Raises:
        BadInputError: the images do not determine it.
    """
    views = tuple(
        BoardView(camera, f"{frame:02d}", f"{name}-{frame:02d}", found)
        for frame, place in enumerate(configuration.places)
        for camera, found in corners[place].items()
    )
    sizes = {camera: (each.camera.width, each.camera.height) for camera, each in head.cameras.items()}
    plan = usual_plan({camera: each.spectrum for camera, each in head.cameras.items()}, rig_name=name)
    solution = solve_rig(BoardViews(corner_board_of(SimulatedBoard()), sizes, views), plan)
    return solved_rig(solution, made_s=0.0)


def corner_board_of(board: SimulatedBoard) -> CornerBoard:
    """The simulator's board as the corner finder knows it."""
    return CornerBoard(columns=board.columns - 1, rows=board.rows - 1, pitch_m=board.square_m)


def _scan(scene: Scene, head: Rig, *, number: int, seed: int) -> Scan:
    return render_scan(
        scene,
        head,
        T_map_rig=T_MAP_HEAD,
        range_camera=RANGE_CAMERA,
        time_s=0.0,
        noise=Noise(seed),
        number=number,
        threads=1,
    )


def _images(scan: Scan) -> dict[str, npt.NDArray[np.generic]]:
    amplitude = {} if scan.amplitude is None else {scan.range_camera: scan.amplitude}
    return {**amplitude, **scan.colour, **scan.thermal}


def _side_by_side(take: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Results in order, computed on all cores."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        yield from pool.map(take, items)


@dataclass(frozen=True, slots=True)
class Target:
    """One disc: where it is, and how wide."""

    T_map_target: Transform
    diameter_m: float


def targets_in_view(rig: Rig, rng: np.random.Generator) -> list[Target]:
    """Three discs at random places of the range camera's image and random ranges, none before another."""
    lens = rig[RANGE_CAMERA].camera
    placed_at: list[tuple[Floats, float]] = []
    targets: list[Target] = []
    for diameter_m in DIAMETERS_M:
        for _ in range(TRIES):
            pixel = rng.uniform([0, 0], [lens.width - 1, lens.height - 1])
            range_m = float(rng.uniform(*RANGES_M))
            beam = lens.unproject(pixel)
            at = transform_points(T_MAP_HEAD @ rig[RANGE_CAMERA].transform, (beam * range_m)[None])[0]
            reach_px = diameter_m / 2 / range_m * lens.width / 1.2 + MARGIN_PX
            size = np.array([lens.width, lens.height])
            inside = (pixel > reach_px).all() and (pixel < size - reach_px).all()
            away = np.linalg.norm(pixel - (size - 1) / 2) < RADIUS_MAX_PX
            free = all(np.linalg.norm(pixel - other) > APART * (reach_px + reach) for other, reach in placed_at)
            if inside and away and free and (at > ROOM_LOW).all() and (at < ROOM_HIGH).all():
                rx, ry, rz = (float(v) for v in rng.uniform(-TILT_MAX_RAD, TILT_MAX_RAD, 3))
                x, y, z = (float(v) for v in at)
                T = placed((x, y, z)) @ T_FORWARD_CAMERA @ placed((0, 0, 0), (rx, ry, rz))
                targets.append(Target(T, diameter_m))
                placed_at.append((pixel, reach_px))
                break
    return targets
