"""Pictures of calibration boards with exact truth, in three spectra, and pictures that only look like boards.

Every pixel is the mean of its samples on the board's plane, found by rays through the distorted lens; then come the
lens's blur and the sensor's noise. Seeded; nothing is read from disk.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.rig.camera import Camera

Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

BOARD = Board(columns=9, rows=6, pitch_m=0.05)
DISC = 0.3
"""Radius of a disc in pitches."""


@dataclass(frozen=True)
class Spectrum:
    """A camera and how it sees the board."""

    camera: Camera
    dark: float
    bright: float
    around: float
    blur_px: float
    noise: float
    ranges_m: tuple[float, float]
    bits: int
    samples: int


COLOUR = Spectrum(
    Camera(
        width=1280,
        height=960,
        focal_px=(1330.0, 1332.0),
        centre_px=(646.0, 471.0),
        distortion=(-0.21, 0.11, 0.0007, -0.0005, 0.0),
    ),
    *(30.0, 205.0, 120.0, 0.9, 2.0, (0.9, 2.2), 8, 2),
)
THERMAL = Spectrum(
    Camera(
        width=640,
        height=512,
        focal_px=(470.0, 470.5),
        centre_px=(322.0, 250.0),
        distortion=(-0.28, 0.12, 0.0, 0.0, 0.0),
    ),
    *(22060.0, 22000.0, 21980.0, 1.0, 4.0, (0.6, 1.4), 16, 2),
)
"""Counts of 1/64 K: a contrast of one kelvin on 345 K; what is printed dark is warmer."""
TOF = Spectrum(
    Camera(
        width=176,
        height=144,
        focal_px=(130.0, 130.2),
        centre_px=(88.0, 71.0),
        distortion=(-0.2, 0.05, 0.0, 0.0, 0.0),
    ),
    *(4000.0, 11000.0, 6500.0, 0.6, 150.0, (0.5, 1.2), 16, 4),
)


def pose(rng: np.random.Generator, spectrum: Spectrum, *, board: Board = BOARD, tilt_deg: float = 40.0) -> Floats:
    """(4, 4) T_camera_board of a board that lies in the image with a small margin, tilted by up to `tilt_deg`."""
    outline = _outline(board, 0.6)
    for _ in range(1000):
        axis = rng.normal(size=2)
        axis /= np.linalg.norm(axis)
        tilt = np.radians(rng.uniform(0, tilt_deg))
        lean, _ = cv2.Rodrigues(np.append(axis * tilt, 0.0))
        roll, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        T = np.eye(4)
        T[:3, :3] = lean @ roll
        z = rng.uniform(*spectrum.ranges_m)
        ray = spectrum.camera.unproject(rng.uniform(0.2, 0.8, 2) * [spectrum.camera.width, spectrum.camera.height])
        T[:3, 3] = ray / ray[2] * z - T[:3, :3] @ board.points().mean(axis=0)
        seen = spectrum.camera.project(outline @ T[:3, :3].T + T[:3, 3])
        size = np.array([spectrum.camera.width, spectrum.camera.height])
        if np.isfinite(seen).all() and ((seen > 1) & (seen < size - 2)).all() and cell_px(spectrum, T, board) >= 4:
            return T
    raise AssertionError("no pose fits the image")


def truth(spectrum: Spectrum, T_camera_board: Floats, *, board: Board = BOARD) -> Floats:
    """(N, 2) pixels of the board's points."""
    return spectrum.camera.project(board.points() @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])


def cell_px(spectrum: Spectrum, T_camera_board: Floats, board: Board = BOARD) -> float:
    """The shortest step from a point to the next, pixels."""
    grid = truth(spectrum, T_camera_board, board=board).reshape(board.rows, board.columns, 2)
    return float(min(np.linalg.norm(np.diff(grid, axis=k), axis=-1).min() for k in (0, 1)))


def picture(
    spectrum: Spectrum,
    T_camera_board: Floats,
    rng: np.random.Generator,
    *,
    board: Board = BOARD,
    noise: float | None = None,
) -> Image:
    """What the camera records of the board."""
    camera = spectrum.camera
    seen = camera.project(_outline(board, 1.8) @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])
    low = np.clip(np.floor(np.nanmin(seen, axis=0)).astype(int) - 6, 0, [camera.width, camera.height])
    high = np.clip(np.ceil(np.nanmax(seen, axis=0)).astype(int) + 7, 0, [camera.width, camera.height])
    n = spectrum.samples
    x = low[0] - 0.5 + (np.arange((high[0] - low[0]) * n) + 0.5) / n
    y = low[1] - 0.5 + (np.arange((high[1] - low[1]) * n) + 0.5) / n
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1))
    light = _light(spectrum, board, _board_xy(rays, T_camera_board) / board.pitch_m)
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), spectrum.blur_px * n), np.float64)
    part = light.reshape(high[1] - low[1], n, high[0] - low[0], n).mean(axis=(1, 3))
    image = np.full((camera.height, camera.width), spectrum.around)
    image[low[1] : high[1], low[0] : high[0]] = part
    image += rng.normal(0, spectrum.noise, image.shape)
    if spectrum.bits == 8:
        return np.asarray(np.clip(np.round(image), 0, 255), np.uint8)
    return np.asarray(np.clip(np.round(image), 0, 65535), np.uint16)


def _outline(board: Board, margin: float) -> Floats:
    lattice = board.lattice()
    low, high = lattice.min(axis=0) - 1 - margin, lattice.max(axis=0) + 1 + margin
    t = np.linspace(0, 1, 9)
    sides = [np.column_stack([low[0] + t * (high[0] - low[0]), np.full(9, y)]) for y in (low[1], high[1])]
    sides += [np.column_stack([np.full(9, x), low[1] + t * (high[1] - low[1])]) for x in (low[0], high[0])]
    return np.column_stack([np.concatenate(sides) * board.pitch_m, np.zeros(36)])


def _board_xy(rays: Floats, T_camera_board: Floats) -> Floats:
    """Where rays meet the board's plane, in its frame, metres."""
    normal, origin = T_camera_board[:3, 2], T_camera_board[:3, 3]
    points = rays * ((normal @ origin) / (rays @ normal))[..., None] - origin
    return points @ T_camera_board[:3, :2]


def _light(spectrum: Spectrum, board: Board, at: Floats) -> Floats:
    """Brightness at places of the board's plane, given in pitches; the white margin is half a cell wide.

    An edge is a ramp as wide as the sample that it crosses.
    """
    width = [np.hypot(*np.gradient(at[..., k])) + 1e-9 for k in (0, 1)]
    lattice = board.lattice()
    low, high = lattice.min(axis=0) - 1, lattice.max(axis=0) + 1

    def within(low: Floats, high: Floats) -> Floats:
        shares = [
            np.clip((a - start) / w + 0.5, 0, 1) * np.clip((end - a) / w + 0.5, 0, 1)
            for a, w, start, end in zip((at[..., 0], at[..., 1]), width, low, high, strict=True)
        ]
        return np.asarray(shares[0] * shares[1])

    if board.pattern == "chessboard":
        near = np.round(at)
        waves = [
            np.clip(2 * (at[..., k] - near[..., k]) / width[k], -1, 1) * (1 - 2 * (near[..., k] % 2)) for k in (0, 1)
        ]
        dark = (1 + waves[0] * waves[1]) / 2 * within(low, high)
    else:
        near = np.round(at)
        if board.pattern == "asymmetric-circles":
            row = np.round(at[..., 1])
            near = np.stack([2 * np.round((at[..., 0] - row % 2) / 2) + row % 2, row], axis=-1)
        named = ((near >= lattice.min(axis=0)) & (near <= lattice.max(axis=0))).all(axis=-1)
        away = at - near
        radius = np.hypot(away[..., 0], away[..., 1])
        footprint = np.hypot(away[..., 0] * width[0], away[..., 1] * width[1]) / np.maximum(radius, 1e-9)
        dark = np.clip((DISC - radius) / np.maximum(footprint, 1e-9) + 0.5, 0, 1) * named
    paper = within(low - 0.5, high + 0.5)
    board_light = spectrum.bright + dark * (spectrum.dark - spectrum.bright)
    return np.asarray(spectrum.around + paper * (board_light - spectrum.around))
