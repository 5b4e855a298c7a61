"""Images without a board: noise, lookalikes, views into simulated rooms and parts of real ones, turned and changed."""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from tests.board_finding.lookalikes import FLAT, MAKERS, Floats

from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Bytes = npt.NDArray[np.uint8]

SIZES = ((176, 144), (176, 144), (320, 240), (480, 384))
SMALL = ((96, 72),)
"""Widths and heights."""
FOLDERS = ("apc_shelf_rgbd", "mm5_rgbdt", "flir_radiometric")
"""Of recordings without a chessboard."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".tiff")
SMALLEST_PX = 100
REAL_MAX = 60
ROOMS = {"small-room": "west", "building": "labs", "yard": "loop"}
"""Scenes and the paths through them."""
LOOKS = 5
"""In each of them."""


def noise(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Of each pixel by itself."""
    return rng.normal(128, rng.uniform(5, 60), (height, width))


def texture(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Noise with structures of some pixels."""
    soft = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), rng.uniform(0.8, 6))
    values = 128 + 45 * soft / soft.std()
    return np.where(values > 128, 190.0, 60.0) if rng.random() < 0.3 else np.asarray(values)


MADE = (noise, texture, *MAKERS)
KINDS = (*(maker.__name__ for maker in MADE), "room", "room", "real", "real", "real")


@cache
def real_images() -> tuple[Bytes, ...]:
    """Grey images of the data folder that show no board; none where there is no such folder."""
    folder = os.environ.get("CAIRN_TEST_DATA")
    if not folder:
        return ()
    found = [path for name in FOLDERS for path in sorted((Path(folder) / name).rglob("*")) if path.suffix in SUFFIXES]
    paths = [path for path in found if ".label" not in path.name and path.parent.name != "segm"]
    read = (cv2.imread(str(path), cv2.IMREAD_ANYDEPTH) for path in paths[:: max(1, len(paths) // REAL_MAX)])
    return tuple(_eight_bits(image) for image in read if image is not None and min(image.shape) >= SMALLEST_PX)


@cache
def room_images() -> tuple[Bytes, ...]:
    """What the colour, thermal and time-of-flight cameras of a simulated robot see in the rooms that cairn ships."""
    found = []
    robot = replace(ROBOTS["orpheus"], scans=(3, 1))
    for scene, path in ROOMS.items():
        plan = Plan(scene=load_scene(scene), robot=robot, path=path, scale=0.25, truth="none")
        shots = shots_of(plan)
        for _, scan, _ in scans_of(plan, shots[:: len(shots) // LOOKS], robot.rig_of(plan.scale), threads=1):
            seen = [*scan.colour.values(), *scan.thermal.values(), scan.amplitude]
            found += [_eight_bits(image.mean(axis=-1) if image.ndim == 3 else image) for image in seen]
    return tuple(found)


def empty_image(seed: int, *, sizes: Sequence[tuple[int, int]] = SIZES) -> tuple[str, Bytes]:
    """Kind and (H, W) image of one seed; perspective, blur and noise differ. Rooms stand for real images if need be."""
    rng = np.random.default_rng([seed, 23])
    kind = KINDS[seed % len(KINDS)]
    width, height = sizes[int(rng.integers(len(sizes)))]
    if kind in ("room", "real"):
        images = (real_images() if kind == "real" else ()) or room_images()
        image = _changed(images[int(rng.integers(len(images)))], rng, width, height)
    else:
        maker = MADE[KINDS.index(kind)]
        image = maker(rng, width, height)
        image = _tilted(image, rng) if maker in FLAT else image
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.2)) + rng.normal(0, rng.uniform(0.5, 8), image.shape)
    image = 255 - image if rng.random() < 0.5 else image
    return kind, np.clip(image, 0, 255).astype(np.uint8)


def _eight_bits(image: npt.NDArray[np.generic]) -> Bytes:
    values = np.nan_to_num(image.astype(np.float64))
    low, high = np.percentile(values, (0.5, 99.5))
    return np.clip((values - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)


def _changed(image: Bytes, rng: np.random.Generator, width: int, height: int) -> Floats:
    """A part of an image, scaled, mirrored, inverted, with other contrast."""
    share = rng.uniform(0.4, 1)
    part = (int(share * image.shape[0]), int(share * image.shape[1]))
    y, x = (int(rng.integers(0, whole - side + 1)) for whole, side in zip(image.shape, part, strict=True))
    cut = cv2.resize(image[y : y + part[0], x : x + part[1]], (width, height), interpolation=cv2.INTER_AREA)
    values = np.rot90(cut, int(rng.integers(4))).astype(np.float64)
    values = values[:, ::-1] if rng.random() < 0.5 else values
    return _tilted(128 + rng.uniform(0.3, 2) * (values - 128), rng)


def _tilted(image: Floats, rng: np.random.Generator) -> Floats:
    """Seen aslant: the corners of the image move by up to a tenth of it."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = (corners + rng.uniform(-0.1, 0.1, (4, 2)) * [width, height]).astype(np.float32)
    warped = cv2.warpPerspective(
        image, cv2.getPerspectiveTransform(corners, moved), (width, height), borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(warped, np.float64)
