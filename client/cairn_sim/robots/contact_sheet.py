"""Pictures for people: the images of one head pose on one sheet, and a scene from above with a path in it."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform
from cairn_fusion.recording.scan import Scan
from cairn_map.arrays import Rgb
from cairn_sim.render.raycast_kernels import cast_each
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_format import ZERO_C_K

TILE_PX = (480, 384)
"""Width and height of one picture on the sheet."""
CAPTION_PX = 30
BACKGROUND = (24, 26, 30)
TEXT = (225, 228, 232)
NOTHING = (60, 60, 66)
"""Colour of pixels without a value: never that of cold, near or dark ones."""
PLAN_LONG_PX = 1280
PLAN_MARGIN_M = 0.5
CUT_ABOVE_M = 0.6
"""Height above the robots' heads at which the plan cuts the scene."""
ROBOT_M = 0.35
PERCENTILES = (1, 99)


def contact_sheet(scan: Scan) -> Rgb:
    """(H, W, 3) sRGB: all images of a scan, two in a row, each with its name and scale."""
    tiles = [_tile(name, image) for name, image in scan.colour.items()]
    tiles += [_scaled_tile(name, kelvin - ZERO_C_K, "C", cv2.COLORMAP_INFERNO) for name, kelvin in scan.thermal.items()]
    tiles.append(_scaled_tile(f"{scan.range_camera}: range", scan.range_m, "m", cv2.COLORMAP_TURBO))
    if scan.amplitude is not None:
        root = np.sqrt(scan.amplitude.astype(np.float32))
        tiles.append(_scaled_tile(f"{scan.range_camera}: amplitude, root of", root, "counts", cv2.COLORMAP_BONE))
    if len(tiles) % 2:
        tiles.append(_canvas(tiles[0].shape[0], tiles[0].shape[1]))
    return np.vstack([np.hstack(tiles[n : n + 2]) for n in range(0, len(tiles), 2)])


def view_from_above(scene: Scene, poses: Sequence[Transform], marked: int | None = None) -> Rgb:
    """(H, W, 3) sRGB: a scene from above, cut a little over the heads, with the robots' poses in it.

    Args:
        scene: with at least one solid that ends.
        poses: `T_map_robot`; drawn as dots with a line ahead.
        marked: the pose to emphasise.
    """
    low, high = _extent(scene, poses)
    px_per_m = PLAN_LONG_PX / float((high - low).max())
    width, height = (max(int(side * px_per_m), 1) for side in high - low)
    x = low[0] + (np.arange(width) + 0.5) / px_per_m
    y = high[1] - (np.arange(height) + 0.5) / px_per_m
    grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1).reshape(-1, 2)
    cut_m = max((float(T[2, 3]) for T in poses), default=0.0) + 1.1 + CUT_ABOVE_M
    origins = np.column_stack([grid, np.full(len(grid), cut_m)])
    _, solid, normal = cast_each(origins, np.tile([0.0, 0.0, -1.0], (len(grid), 1)), scene.shapes)
    colour = scene.surfaces.colours_srgb[solid, 0] * (0.75 + 0.25 * normal[:, 2:])
    colour[solid < 0] = BACKGROUND
    # What the cut goes through is solid there: walls stand out as an architect draws them.
    colour[scene.solid_at(origins) >= 0] = (30, 30, 34)
    picture = np.ascontiguousarray(colour.clip(0, 255).astype(np.uint8).reshape(height, width, 3))
    for number, T in enumerate(poses):
        at = [(T[0, 3] - low[0]) * px_per_m, (high[1] - T[1, 3]) * px_per_m]
        ahead = [at[0] + T[0, 0] * ROBOT_M * px_per_m, at[1] - T[1, 0] * ROBOT_M * px_per_m]
        here, there = (tuple(round(v) for v in p) for p in (at, ahead))
        ink = (255, 40, 40) if number == marked else (40, 90, 255)
        cv2.line(picture, here, there, ink, 2, cv2.LINE_AA)
        cv2.circle(picture, here, 7 if number == marked else 4, ink, -1, cv2.LINE_AA)
    _ruler(picture, px_per_m)
    return picture


def _extent(scene: Scene, poses: Sequence[Transform]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Lowest and highest x, y of what ends, and of the poses."""
    bounded = scene.shapes.bounds[np.isfinite(scene.shapes.bounds).all(axis=1)]
    at = np.array([T[:2, 3] for T in poses]).reshape(-1, 2)
    low = np.vstack([bounded[:, :2], at]).min(axis=0) - PLAN_MARGIN_M
    high = np.vstack([bounded[:, 3:5], at]).max(axis=0) + PLAN_MARGIN_M
    return low, high


def _ruler(picture: Rgb, px_per_m: float) -> None:
    """A bar of 1, 5 or 10 m in the lower left corner."""
    length_m = next((m for m in (10, 5) if m * px_per_m < picture.shape[1] / 3), 1)
    y, end = picture.shape[0] - 12, 12 + round(length_m * px_per_m)
    cv2.line(picture, (12, y), (end, y), TEXT, 3)
    _text(picture, f"{length_m} m", (12, y - 8))


def _scaled_tile(name: str, values: npt.NDArray[np.floating], unit: str, colour_map: int) -> Rgb:
    """An image of numbers in false colour; its scale leaves out the outermost percent, and is written above it."""
    known = np.isfinite(values)
    low, high = np.percentile(values[known], PERCENTILES) if known.any() else (0.0, 1.0)
    share = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-6), 0, 1)
    picture: Rgb = cv2.applyColorMap((share * 255).astype(np.uint8), colour_map)[..., ::-1].astype(np.uint8)
    picture[~known] = NOTHING
    missing = "" if known.all() else f", {100 * (1 - known.mean()):.0f} % without"
    return _tile(f"{name} {low:.1f} to {high:.1f} {unit}{missing}", picture)


def _tile(caption: str, picture: Rgb) -> Rgb:
    width, height = TILE_PX
    factor = min(width / picture.shape[1], height / picture.shape[0])
    size = round(picture.shape[1] * factor), round(picture.shape[0] * factor)
    image = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST)
    tile = _canvas(height + CAPTION_PX, width)
    left, top = (width - size[0]) // 2, CAPTION_PX + (height - size[1]) // 2
    tile[top : top + size[1], left : left + size[0]] = image
    _text(tile, caption.replace("_", " "), (8, 21))
    return tile


def _canvas(height: int, width: int) -> Rgb:
    canvas = np.empty((height, width, 3), np.uint8)
    canvas[:] = BACKGROUND
    return canvas


def _text(image: Rgb, text: str, at: tuple[int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.55, TEXT, 1, cv2.LINE_AA)
