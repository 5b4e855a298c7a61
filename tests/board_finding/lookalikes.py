"""Regular things that robots meet in buildings, and of which none is a calibration board; values of 0 to 255."""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt
from tests.fixtures.calib.board_images import TOF, picture, pose, truth

from cairn_calib.board.board import Board

Floats = npt.NDArray[np.float64]
Maker = Callable[[np.random.Generator, int, int], Floats]


def windows(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Panes in a frame, each of its own brightness, at times as many as a board has cells."""
    image = np.full((height, width), rng.uniform(20, 100))
    columns, rows = int(rng.integers(4, 14)), int(rng.integers(3, 11))
    step = min(width / columns, height / rows)
    bar = rng.uniform(0, 0.3) * step
    for row in range(rows):
        for column in range(columns):
            y, x = int(step * row + bar), int(step * column + bar)
            image[y : int(step * (row + 1)), x : int(step * (column + 1))] = rng.uniform(80, 230)
    return image


def tiles(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A chequered floor that fills the image."""
    y, x = np.mgrid[:height, :width]
    step = rng.uniform(5, min(width, height) / 13)
    return np.where((np.floor(x / step) + np.floor(y / step)) % 2 == 0, 60.0, 190.0)


def bricks(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Courses of bricks, each moved by half a brick."""
    y, x = np.mgrid[:height, :width]
    tall = rng.uniform(6, height / 8)
    course, joint = np.floor(y / tall), rng.uniform(1, 0.25 * tall)
    return np.where((y % tall < joint) | ((x + tall * (course % 2)) % (2 * tall) < joint), 200.0, 110.0)


def blinds(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Slats before a bright window, at times with the window's bars behind them."""
    y, x = np.mgrid[:height, :width]
    step, pane = rng.uniform(4, height / 7), rng.uniform(12, width / 3)
    light = np.where(x % pane < rng.uniform(0, 0.5) * pane, rng.uniform(40, 120), 230.0)
    return np.where(y % step < rng.uniform(0.3, 0.7) * step, rng.uniform(20, 160), light)


def floor(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Tiles of one colour, each a little different, with joints."""
    y, x = np.mgrid[:height, :width]
    step = rng.uniform(6, min(width, height) / 6)
    joint = rng.uniform(0.05, 0.35) * step
    each = rng.normal(0, rng.uniform(0, 30), (height, width))[(y // step).astype(int), (x // step).astype(int)]
    return np.where((x % step < joint) | (y % step < joint), rng.choice([40.0, 220.0]), 130.0 + each)


def keyboard(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Rows of keys, each moved a little against the last, with a letter on each."""
    image = np.full((height, width), rng.uniform(10, 90), np.uint8)
    key = min(width / 12, height / 6)
    gap, light = rng.uniform(0.08, 0.3) * key, rng.uniform(120, 240)
    for row in range(6):
        shift = rng.uniform(0, 0.5) * key * (rng.random() < 0.7)
        for column in range(12):
            y, x = int(row * key), int(column * key + shift)
            image[y : int(y + key - gap), x : int(x + key - gap)] = light
            at = (int(x + 0.2 * key), int(y + 0.6 * key))
            cv2.putText(image, chr(int(rng.integers(65, 91))), at, cv2.FONT_HERSHEY_SIMPLEX, key / 50, 30.0, 1)
    return image.astype(np.float64)


def gingham(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Cloth of stripes that cross: bright, between and dark."""
    y, x = np.mgrid[:height, :width]
    step, share = rng.uniform(4, min(width, height) / 8), rng.uniform(0.4, 0.6)
    return 60.0 + 80.0 * (x % step < share * step) + 80.0 * (y % step < share * step)


def dots(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A perforated ceiling, or a lamp of many diodes."""
    y, x = np.mgrid[:height, :width]
    step, radius = rng.uniform(5, min(width, height) / 8), rng.uniform(0.15, 0.5)
    moved = x + 0.5 * step * (np.floor(y / step) % 2) * (rng.random() < 0.5)
    hole = np.hypot(moved % step - step / 2, y % step - step / 2) < radius * step
    return np.where(hole, *rng.permutation([60.0, 190.0]))


def crossed(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A wire fence: two sets of lines at an angle."""
    y, x = np.mgrid[:height, :width]
    step, half = rng.uniform(5, min(width, height) / 7), rng.uniform(0.1, 0.45)
    a, b = rng.uniform(0, np.pi, 2)
    lines = [np.abs((x * np.cos(t) + y * np.sin(t)) % step - step / 2) < half * step for t in (a, b)]
    return np.where(lines[0] != lines[1] if rng.random() < 0.3 else lines[0] | lines[1], 190.0, 70.0)


def herringbone(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Parquet of blocks, each a little different."""
    y, x = np.mgrid[:height, :width]
    short, ratio = rng.uniform(5, height / 10), int(rng.integers(2, 5))
    column, row = np.floor(x / short).astype(int), np.floor(y / short).astype(int)
    lying = (column - row) % (2 * ratio) < ratio
    block = np.where(lying, 7 * row + (column - row) // (2 * ratio), 11 * column + (row - column) // (2 * ratio) + 5)
    return rng.uniform(50, 210, 997)[block % 997] if rng.random() < 0.5 else np.where(lying, 170.0, 90.0)


def page(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Lines of text, and a table beneath."""
    image = np.full((height, width), 225, np.uint8)
    size = rng.uniform(0.25, 0.7)
    line = int(32 * size)
    for y in range(line, height // 2, line):
        text = "".join(chr(int(code)) for code in rng.integers(33, 126, 60))
        cv2.putText(image, text, (3, y), cv2.FONT_HERSHEY_SIMPLEX, size, 40.0, 1, cv2.LINE_AA)
    step = int(rng.integers(6, 24))
    for y in range(height // 2, height, step):
        for x in range(0, width, step):
            image[y : y + step, x : x + step] = rng.choice([225, 225, 150, 60])
    return image.astype(np.float64)


def other_board(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A chessboard with a row or column more or less; of a time-of-flight camera's size."""
    columns, rows = ((9, 5), (8, 6), (10, 6), (9, 7), (7, 6))[int(rng.integers(5))]
    board = Board(columns=columns, rows=rows, pitch_m=0.04)
    return np.asarray(picture(TOF, pose(rng, TOF, board=board), rng, board=board) / 60.0)


def part_of_board(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A board of the right size of which something hides one whole row or column of corners, or more."""
    board = Board(columns=9, rows=6, pitch_m=0.05)
    T = pose(rng, TOF, board=board)
    image = np.asarray(picture(TOF, T, rng, board=board) / 60.0)
    grid = np.rot90(truth(TOF, T, board=board).reshape(6, 9, 2), int(rng.integers(4)))
    inner, rim = grid[:, 1], grid[:, 0]
    edge = inner + rng.uniform(0.2, 0.4) * (rim - inner)
    hidden = np.concatenate([edge + 0.8 * (edge - grid[:, -1]), (edge + 0.4 * (edge[[0]] - edge[[-1]]))[:1], edge])
    hidden = np.concatenate([hidden, edge[[-1]] + 0.4 * (edge[[-1]] - edge[[0]])])
    hull = cv2.convexHull(hidden.astype(np.float32)).astype(np.int32)
    cv2.fillConvexPoly(image, hull, rng.uniform(60, 190))
    return image


MAKERS: tuple[Maker, ...] = (
    *(windows, tiles, bricks, blinds, floor, keyboard, gingham, dots, crossed, herringbone, page),
    *(other_board, part_of_board),
)
FLAT = MAKERS[:-2]
"""Seen from the front: to be tilted."""
