"""Calibration and verification targets: a heated checkerboard and heated discs, in a plain laboratory.

    board, seen from its front                        target, from its side
      +---------------------------+  frame                  z -->
      |  ##  ##  ##  ##           |                         |paper, z = 0
      |    o---o---o--> x   o: inner corners, square_m     ||bare aluminium
      |    | ##| ##| ##           |  apart; o at x, y = 0  |||tape on the rim
      |    o---o---o--            |                        |||
      +----|----------------------+                        |||
           v y

Both frames are a camera's seen from the front: x right, y down, z into the thing; so a head-on view from d metres has
the pose T_camera_board = [I | (.., .., d)]. Sources: PAPER.md sections 3 and 5, which print the materials, the 50 C and
the discs' diameters. Numbers and sizes of squares are not printed; ours are the defaults here. So are the optical
constants.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from cairn_calib.rig.poses import Points, Transform, transform_points
from cairn_map.errors import BadInputError
from cairn_sim.robots.kinematics import T_FORWARD_CAMERA
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Cylinder, Metres3, Solid, placed
from cairn_sim.scene.surfaces import Material, Rgb, Surface

HEATED_K = 323.15
"""50 C, PAPER.md section 3."""
ROOM_K = 293.15
STEP_M = 5e-4
"""Between the front faces of what lies on one another: thin, and none in the plane of another."""
TAPE_M = 0.025
"""Width of the tape on a target's rim."""
PAPER_SHARE = 0.75
"""Radius of the paper, as a share of the target's radius inside the tape."""
DIAMETER_MIN_M = 0.08
"""So that tape, bare aluminium and paper are all there."""


class Look(Enum):
    """Brightness of bare aluminium against matt black in visible or near infrared light: it shows what it mirrors."""

    BRIGHT = "bright"
    DARK = "dark"


FOIL = Material((60, 60, 62), ROOM_K, emissivity=0.95, reflectivity_nir=0.15)
"""Matt black, on chipboard, at room temperature; dyes absorb less of 850 nm than of visible light."""
CHIPBOARD = Material((176, 138, 92), ROOM_K, emissivity=0.92, reflectivity_nir=0.6)
PAPER = Material((45, 45, 47), HEATED_K, emissivity=0.95, reflectivity_nir=0.25)
"""Matt black, on a heated disc: enough for a range at 5.7 m, the paper's farthest."""
TAPE = Material((190, 22, 32), HEATED_K, emissivity=0.9, reflectivity_nir=0.8, retroreflection=600.0)
"""Red, clear at 850 nm, retroreflecting: 6 % of a pixel of it saturates a ToF camera at 3 m, a quarter at 6 m."""
VISIBLE: dict[Look, Rgb] = {Look.BRIGHT: (205, 207, 210), Look.DARK: (20, 20, 22)}
NEAR_INFRARED = {Look.BRIGHT: (0.55, 0.2), Look.DARK: (0.04, 0.05)}
"""Diffuse and gloss of anodised aluminium; dark where the lamp's light is mirrored away."""


def aluminium(visible: Look = Look.BRIGHT, near_infrared: Look = Look.BRIGHT) -> Material:
    """Anodised, at 50 C: its emissivity is low, so it looks 20 K warmer than the room, not 30."""
    diffuse, gloss = NEAR_INFRARED[near_infrared]
    return Material(VISIBLE[visible], HEATED_K, emissivity=0.65, reflectivity_nir=diffuse, gloss_nir=gloss)


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedBoard:
    """A checkerboard: numbers of squares, their side, the aluminium frame around them, and how aluminium looks.

    Columns and rows are one even and one odd: turned by half a turn the colours have changed places, so one image tells
    which corner is the first.
    """

    columns: int = 8
    rows: int = 7
    square_m: float = 0.10
    border_m: float = 0.10
    visible: Look = Look.BRIGHT
    near_infrared: Look = Look.BRIGHT

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 2 or not (0 < self.square_m < np.inf and 0 < self.border_m < np.inf):
            raise BadInputError(
                "bad_board",
                "a board needs 2 x 2 squares or more, a side and a border above 0 m, got "
                f"{self.columns} x {self.rows}, {self.square_m} and {self.border_m}",
            )

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the checker, x and y in the board's frame, metres."""
        return (self.columns - 2) / 2 * self.square_m, (self.rows - 2) / 2 * self.square_m

    @property
    def corners(self) -> Points:
        """((columns - 1) (rows - 1), 3) metres, board frame: row by row from the top, each from left to right.

        Corner (i, j) is at (i * square_m, j * square_m, 0) and has the number j * (columns - 1) + i.
        """
        y, x = np.mgrid[: self.rows - 1, : self.columns - 1] * self.square_m
        return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    def corners_at(self, T_map_board: Transform) -> Points:
        """`corners` in the map frame."""
        return transform_points(T_map_board, self.corners)


def heated_checkerboard(
    T_map_board: Transform, board: SimulatedBoard | None = None, *, name: str = "board"
) -> list[Solid]:
    """A sheet of heated aluminium with square holes, before chipboard with matt black foil.

    The top left square is aluminium. Aluminium and foil are one face, as if the sheet had no thickness.

    Args:
        T_map_board: where the first inner corner is; x right, y down, z into the board.
        board: None for a `SimulatedBoard()`.
        name: its solids' names begin with it.
    """
    board = board or SimulatedBoard()
    metal = aluminium(board.visible, board.near_infrared)
    x, y = board.centre
    width, height = board.columns * board.square_m, board.rows * board.square_m
    checker = Surface(metal, FOIL, (board.square_m, board.square_m), (-x, -y))

    def slab(part: str, surface: Surface, margin_m: float, front_m: float, back_m: float) -> Solid:
        size_m = width + 2 * margin_m, height + 2 * margin_m, back_m - front_m
        return Solid(f"{name} {part}", Box(size_m), surface, T_map_board @ placed((x, y, (front_m + back_m) / 2)))

    return [
        slab("checker", checker, 0.0, 0.0, 2 * STEP_M),
        slab("frame", Surface(metal), board.border_m, STEP_M, 4 * STEP_M),
        slab("back", Surface(CHIPBOARD), board.border_m * 0.9, 3 * STEP_M, 0.02),
    ]


def circle_target(T_map_target: Transform, *, diameter_m: float, name: str = "target") -> list[Solid]:
    """A heated disc of aluminium, matt black paper in its middle, retroreflecting tape on its rim.

    The origin of its frame, the true centre of everything round on it, is on the front of the paper.

    Raises:
        BadInputError: it is smaller than 8 cm.
    """
    if not DIAMETER_MIN_M <= diameter_m < np.inf:
        raise BadInputError("bad_target", f"a target must be {DIAMETER_MIN_M} m wide or more, got {diameter_m}")
    inner_m = diameter_m / 2 - TAPE_M

    def disc(part: str, material: Material, radius_m: float, front_m: float, back_m: float) -> Solid:
        shape = Cylinder(radius_m, back_m - front_m)
        return Solid(f"{name} {part}", shape, Surface(material), T_map_target @ placed((0, 0, (front_m + back_m) / 2)))

    return [
        disc("paper", PAPER, inner_m * PAPER_SHARE, 0.0, 3 * STEP_M),
        disc("bare", aluminium(), inner_m, STEP_M, 4 * STEP_M),
        disc("tape", TAPE, diameter_m / 2, 2 * STEP_M, 5 * STEP_M),
        disc("plate", aluminium(), diameter_m / 2 - STEP_M, 4.5 * STEP_M, 0.005),
    ]


def target_centre(T_map_target: Transform) -> Points:
    """(3,) metres, map frame: where a target's centroid should be seen."""
    return np.array(T_map_target[:3, 3])


def calibration_scene(T_map_board: Transform, board: SimulatedBoard | None = None) -> Scene:
    """The laboratory with a board in it."""
    return scene_of([*laboratory(), *heated_checkerboard(T_map_board, board)], name="calibration", ambient_k=ROOM_K)


def target_scene(targets: Iterable[tuple[Transform, float]]) -> Scene:
    """The laboratory with targets, each a `T_map_target` and a diameter; `target 0`, `target 1`, ... in that order."""
    solids = laboratory()
    for number, (T_map_target, diameter_m) in enumerate(targets):
        solids += circle_target(T_map_target, diameter_m=diameter_m, name=f"target {number}")
    return scene_of(solids, name="targets", ambient_k=ROOM_K)


def laboratory() -> list[Solid]:
    """A bare room, free from x = -1 to 7, y = -3 to 3 and z = 0 to 2.8 m: a head above the origin sees 7 m ahead."""

    def slab(name: str, colour: Rgb, kelvin: float, nir: float, at_m: Metres3, size_m: Metres3) -> Solid:
        surface = Surface(Material(colour, kelvin, reflectivity_nir=nir))
        return Solid(name, Box(size_m), surface, placed(at_m))

    return [
        slab("floor", (112, 116, 112), ROOM_K - 1.0, 0.35, (3, 0, -0.1), (8.4, 6.4, 0.2)),
        slab("ceiling", (228, 228, 222), ROOM_K + 0.8, 0.7, (3, 0, 2.9), (8.4, 6.4, 0.2)),
        slab("wall ahead", (196, 196, 186), ROOM_K, 0.6, (7.1, 0, 1.4), (0.2, 6.4, 3.2)),
        slab("wall behind", (190, 186, 176), ROOM_K, 0.6, (-1.1, 0, 1.4), (0.2, 6.4, 3.2)),
        slab("wall left", (176, 186, 196), ROOM_K - 0.4, 0.55, (3, 3.1, 1.4), (8.4, 0.2, 3.2)),
        slab("wall right", (196, 182, 176), ROOM_K + 0.3, 0.55, (3, -3.1, 1.4), (8.4, 0.2, 3.2)),
    ]


def _facing_the_robot(x_m: float, y_m: float, z_m: float) -> Transform:
    """`T_map_board` of a thing that faces -x."""
    return placed((x_m, y_m, z_m)) @ T_FORWARD_CAMERA


def _example_calibration() -> Scene:
    """The board upright in the bare room, 2.2 m ahead."""
    board = SimulatedBoard()
    middle = _facing_the_robot(2.2, 0.0, 1.15)
    return calibration_scene(middle @ placed((-board.centre[0], -board.centre[1], 0.0)), board)


def _example_targets() -> Scene:
    """Three discs at three distances in the bare room."""
    places = ((3.0, -0.7, 1.0, 0.2), (3.6, 0.1, 1.4, 0.3), (4.3, 0.9, 0.8, 0.3))
    return target_scene([(_facing_the_robot(x, y, z), diameter_m) for x, y, z, diameter_m in places])


TARGET_SCENES: Mapping[str, Callable[[], Scene]] = {"calibration": _example_calibration, "targets": _example_targets}
"""By the scene's name: one board, three discs; each stands still, and robots look at it from several stops."""
