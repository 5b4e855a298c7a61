"""A five-camera head before a board, its corners with exact truth and Gaussian noise: what a solve must give back."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.corners import Corners
from cairn_calib.rig.calibration import POSE_UNITS
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector, vector_from_transform
from cairn_calib.rig.range_terms import ALWAYS, RangeTerms, off_middle_image
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import BoardView, BoardViews, RangeView
from cairn_calib.solve.rig_state import warp_at_places, warp_shape
from cairn_calib.solve.solve import Solution

Floats = npt.NDArray[np.float64]

BOARD = Board(columns=7, rows=6, pitch_m=0.1)
TOF = Camera(
    width=176, height=144, focal_px=(130.0, 130.4), centre_px=(88.3, 70.6), distortion=(-0.2, 0.06, 0.0, 0.0, 0.0)
)
COLOUR = Camera(
    width=1280,
    height=960,
    focal_px=(1330.0, 1331.0),
    centre_px=(646.0, 471.0),
    distortion=(-0.21, 0.11, 0.0007, -0.0005, 0.02),
)
THERMAL = Camera(
    width=640, height=512, focal_px=(470.0, 470.6), centre_px=(322.0, 250.0), distortion=(-0.28, 0.12, 0.0, 0.0, -0.02)
)
LENSES = {"tof": TOF, "left": COLOUR, "right": COLOUR, "thermal-left": THERMAL, "thermal-right": THERMAL}
SPECTRA = {
    "tof": Spectrum.RANGE,
    "left": Spectrum.COLOUR,
    "right": Spectrum.COLOUR,
    "thermal-left": Spectrum.THERMAL,
    "thermal-right": Spectrum.THERMAL,
}
PLACES = {
    "tof": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "left": (0.01, 0.02, -0.01, -0.1, 0.02, 0.0),
    "right": (-0.01, -0.03, 0.01, 0.1, 0.02, 0.01),
    "thermal-left": (0.02, 0.01, 0.02, -0.06, -0.08, 0.0),
    "thermal-right": (0.0, -0.02, -0.02, 0.06, -0.08, -0.01),
}
SIGMAS_PX = {"tof": 0.1, "left": 0.15, "right": 0.15, "thermal-left": 0.15, "thermal-right": 0.15}


@dataclass(frozen=True)
class World:
    """What is true."""

    names: tuple[str, ...]
    boards: Floats
    """(F, 4, 4) T_rig_board."""
    warp_m: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0
    bias: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    terms: RangeTerms = ALWAYS
    """What `bias` is of."""
    pattern_m: Floats | None = None
    """(H, W) what each pixel of the range camera adds besides."""
    has_amplitude: bool = False
    lenses: dict[str, Camera] = field(default_factory=lambda: dict(LENSES))

    def T_rig_camera(self, name: str) -> Floats:
        return transform_from_vector(PLACES[name])


def world(
    frames: int, *, seed: int = 0, tilt_deg: float = 30.0, names: tuple[str, ...] = tuple(LENSES), **more: object
) -> World:
    """Boards before the head, near and far, tilted and rolled, out to the edges of the colour cameras."""
    rng = np.random.default_rng(seed)
    middle = np.append(BOARD.points()[:, :2].mean(axis=0), 0.0)
    boards = []
    for _ in range(frames):
        far = rng.uniform(1.3, 2.6)
        axis = rng.normal(size=2)
        lean = np.append(axis / np.linalg.norm(axis) * np.radians(tilt_deg) * rng.uniform(0.4, 1), 0.0)
        turn = transform_from_vector([0, 0, rng.uniform(-0.4, 0.4), 0, 0, 0])
        T = transform_from_vector([*lean, 0, 0, 0]) @ turn
        T[:3, 3] = [far * rng.uniform(-0.3, 0.3), far * rng.uniform(-0.22, 0.22), far]
        T[:3, 3] -= T[:3, :3] @ middle
        boards.append(T)
    return World(names, np.stack(boards), **more)  # type: ignore[arg-type]


def board_points(truth: World) -> Floats:
    points = truth.scale * BOARD.points()
    points[:, 2] += warp_shape(BOARD) @ np.array(truth.warp_m)
    return points


def exact_pixels(truth: World, name: str) -> Floats:
    """(F, N, 2) pixels; NaN outside the image."""
    T = np.linalg.inv(truth.T_rig_camera(name)) @ truth.boards
    pixels = truth.lenses[name].project(board_points(truth) @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])
    inside = truth.lenses[name].contains(pixels)
    return np.where(inside[..., None], pixels, np.nan)


def views_of(truth: World, *, seed: int, noise: float = 1.0) -> BoardViews:
    """Corners with noise of the stated size times `noise`, in every image that shows at least 20 of them."""
    rng = np.random.default_rng([seed, 1])
    views = []
    for name in truth.names:
        sigma = SIGMAS_PX[name]
        for frame, pixels in enumerate(exact_pixels(truth, name)):
            # Anisotropic, so that covariances count.
            root = sigma * np.array([[1.2, 0.0], [0.3, 0.8]])
            noisy = pixels + noise * rng.normal(size=pixels.shape) @ root.T
            if np.isfinite(noisy[:, 0]).sum() < 20:
                continue
            hidden = ~np.isfinite(noisy[:, 0])
            covariance = np.where(hidden[:, None, None], np.nan, root @ root.T)
            label = f"{frame:03d}"
            views.append(BoardView(name, label, f"{name}{label}.png", Corners(BOARD, noisy, covariance)))
    sizes = {name: (truth.lenses[name].width, truth.lenses[name].height) for name in truth.names}
    return BoardViews(BOARD, sizes, tuple(views))


def ranges_of(truth: World, name: str, *, seed: int, sigma_m: float) -> tuple[RangeView, ...]:
    """Range images of the boards, alone in the world, with noise, `truth.bias` and the pixels' own offsets.

    Amplitudes fall with the square of the range; dark cells return a quarter of what bright ones do.
    """
    rng = np.random.default_rng([seed, 2])
    lens, T_camera_rig = truth.lenses[name], np.linalg.inv(truth.T_rig_camera(name))
    rays = lens.rays()
    result = []
    for frame, T_rig_board in enumerate(truth.boards):
        T = T_camera_rig @ T_rig_board
        n, o = T[:3, 2], T[:3, 3]
        flat = (n @ o) / (rays @ n)
        places = (rays * flat[..., None] - o) @ T[:3, :2]
        true_m = flat + warp_at_places(BOARD, places) @ np.array(truth.warp_m) / (rays @ n)
        on_board = ((places > -0.5 * BOARD.pitch_m) & (places < BOARD.points()[-1, :2] + 0.5 * BOARD.pitch_m)).all(
            axis=-1
        )
        dark = np.floor(places / BOARD.pitch_m).sum(axis=-1) % 2 == 0
        amplitude = np.clip(np.where(dark, 1000.0, 4000.0) / true_m**2, 1, 60000).round()
        off, faint = off_middle_image(lens.width, lens.height), truth.terms.faintness(amplitude)
        measured = true_m + truth.terms.shapes(true_m, off, faint) @ np.array(truth.bias)
        measured += rng.normal(size=true_m.shape) * sigma_m + (0.0 if truth.pattern_m is None else truth.pattern_m)
        counts = np.where(on_board, amplitude, 0).astype(np.uint16) if truth.has_amplitude else None
        result.append(RangeView(name, f"{frame:03d}", np.where(on_board, measured, np.nan), counts))
    return tuple(result)


def errors_of(solution: Solution, truth: World) -> dict[tuple[str, str], float]:
    """Estimate minus truth of every shared parameter; of poses, the error that `rig.json` speaks of, negated."""
    errors = {}
    board = {"warp_x": truth.warp_m[0], "warp_y": truth.warp_m[1], "scale": truth.scale}
    bias = dict(zip(truth.terms.names, truth.bias, strict=True))
    for (owner, name), value in solution.values().items():
        if owner == "":
            errors[owner, name] = value - board[name]
        elif name in bias:
            errors[owner, name] = value - bias[name]
        elif name in truth.lenses[owner].intrinsic_names:
            lens = truth.lenses[owner]
            errors[owner, name] = value - float(lens.intrinsics[lens.intrinsic_names.index(name)])
    for name, T in zip(solution.plan.cameras, solution.state.T_rig_camera, strict=True):
        if name == solution.plan.gauge:
            continue
        true_T = truth.T_rig_camera(name)
        turn = np.eye(4)
        turn[:3, :3] = T[:3, :3] @ true_T[:3, :3].T
        wrong = np.concatenate([vector_from_transform(turn)[:3], T[:3, 3] - true_T[:3, 3]])
        errors |= {(name, each): float(value) for each, value in zip(POSE_UNITS, wrong, strict=True)}
    return errors
