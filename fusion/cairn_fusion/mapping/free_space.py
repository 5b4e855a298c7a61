"""Free space from a range image, projectively: a pinhole window on the camera, and the bricks that it looks through.

For any lens, the image is first resampled to a pinhole window of the same resolution (`window_of`), so that a voxel's
centre finds its pixel by one division. Hits are not decided here: they are the ends of the beams.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform
from cairn_fusion.mapping.clear_kernels import shown_in_window
from cairn_fusion.mapping.cull_kernels import (
    BRICK_VOXELS,
    LEVELS_MAX,
    cull_bricks_into,
    offsets_in_view,
    split_bricks_into,
    window_extremes_into,
)
from cairn_map.arrays import Floats, Int32s, Ints, Singles

DEPTH_SHARE_MIN = 0.2
"""Least cosine of a ray to the optical axis, 78 degrees, that a pinhole window can hold; wider lenses are cast."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Pinhole image with a camera's field of view."""

    width: int
    height: int
    lens: Floats
    """(4,) fx, fy, cx, cy of the padded window, with half a pixel added, so that rounding down finds the pixel."""
    pixel_of: Int32s
    """(height width,) number of the camera's pixel for each pixel of the window; one past the last for none."""

    def shown(self, clear_m: Singles) -> Singles:
        """(height + 2, width + 2) clear range of each pixel of the window, from (H, W) of the camera; 0 around it."""
        # The number past the last is that of pixels outside the camera's image: never clear.
        return shown_in_window(clear_m, self.pixel_of, self.height, self.width)


@lru_cache(maxsize=32)
def window_of(camera: AnyCamera) -> Window | None:
    """The window on a camera; None for a field of view too wide for a plane."""
    rays = camera.rays()
    known = np.isfinite(rays[..., 2])
    if not known.any() or rays[known][:, 2].min() < DEPTH_SHARE_MIN:
        return None
    # The field of view on the plane at distance 1, then a raster over it as fine as the camera's.
    plane = rays[..., :2] / rays[..., 2:]
    low, high = plane[known].min(axis=0), plane[known].max(axis=0)
    fx, fy = (float(f) for f in camera.focal_px)
    width, height = (int(np.ceil(span)) + 1 for span in (high - low) * (fx, fy))
    x, y = np.meshgrid(np.arange(width) / fx + low[0], np.arange(height) / fy + low[1])
    # Which pixel of the camera each pixel of the window shows: the nearest.
    pixels = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    shown = camera.contains(pixels)
    nearest = np.rint(np.where(shown[..., None], pixels, 0)).astype(np.int64)
    number = np.where(shown, nearest[..., 1] * camera.width + nearest[..., 0], camera.width * camera.height)
    # 1.5: one pixel of padding, and the half that turns rounding down into rounding.
    lens = np.array([fx, fy, 1.5 - low[0] * fx, 1.5 - low[1] * fy])
    return Window(width, height, lens, number.ravel().astype(np.int32))


@dataclass(frozen=True, slots=True, eq=False)
class Carving:
    """Bricks of a box that a view looks through, and the inputs of the kernel that counts their misses."""

    bricks: Ints
    """(K,) numbers of the bricks in the box."""
    masks: Int32s
    """(K,) octants of each brick that are free or to be tested (`cull_kernels`)."""
    squares: Singles
    """Padded image of each pixel's clear range, squared."""
    lens: Singles
    """(4,) of `Window`."""
    corners_view: Singles
    """(3, K or more) the centre of each brick's first voxel, camera frame, metres.

    Computed from whole voxel numbers, brick by brick: the box, and the number of bricks in it, must not change a bit of
    a brick's place, or the evidence would not depend on the scan alone.
    """
    offsets_view: Singles
    """(3, 512) from there to each voxel's centre, in Morton order."""
    min_square: float
    """Square of the least range that is free."""


class Scratch:
    """Memory that one thread uses for view after view: fresh memory comes page by page, and takes longer."""

    def __init__(self) -> None:
        self._extremes: Singles = np.empty((0, 0, 0), np.float32)
        self._found: Int32s = np.empty((1 << 14, 2), np.int32)

    def extremes(self, clear_m: Singles) -> Singles:
        """(L, H, 2 W) window extremes of an image (`window_extremes_into`)."""
        height, width = clear_m.shape
        # No window is larger than the image.
        levels = min(LEVELS_MAX, min(width, height).bit_length())
        if self._extremes.shape != (levels, height, 2 * width):
            self._extremes = np.empty((levels, height, 2 * width), np.float32)
        window_extremes_into(self._extremes, clear_m)
        return self._extremes

    def found(self, count: int) -> Int32s:
        """Array of at least (count, 2)."""
        if count > len(self._found):
            self._found = np.empty((2 * count, 2), np.int32)
        return self._found


def carving_of(
    clear_m: Singles,
    window: Window,
    T_map_camera: Transform,
    *,
    corner: Ints,
    dims: Ints,
    voxel_edge_m: float,
    min_range_m: float,
    scratch: Scratch,
) -> Carving:
    """The bricks of a box that a view looks through.

    Args:
        clear_m: of `Window.shown`.
        window: on the camera.
        T_map_camera: pose of the camera.
        corner: (3,) the box's first voxel.
        dims: (3,) bricks of the box.
        voxel_edge_m: of the map.
        min_range_m: nothing nearer is free.
        scratch: of this thread.
    """
    R: Floats = np.ascontiguousarray(T_map_camera[:3, :3])
    t: Floats = np.ascontiguousarray(T_map_camera[:3, 3])
    corner_m: Floats = corner.astype(np.float64) * voxel_edge_m
    # Stage 1: the bricks around the eye that the longest beam reaches, a tenth of a brick more for rounding.
    reach_m = float(clear_m.max())
    # Plain numbers: arrays of three take NumPy ten times as long.
    brick_m, from_corner_m, last = BRICK_VOXELS * voxel_edge_m, (t - corner_m).tolist(), (dims - 1).tolist()
    firsts = [math.floor((x - reach_m) / brick_m - 0.1) for x in from_corner_m]
    lasts = [math.floor((x + reach_m) / brick_m + 0.1) for x in from_corner_m]
    low = np.array([min(max(n, 0), end) for n, end in zip(firsts, last, strict=True)])
    high = np.array([min(max(n, -1), end) for n, end in zip(lasts, last, strict=True)])
    # Stage 2: cubes of bricks; again with more room if there are more bricks than rows.
    view = (corner_m - t, voxel_edge_m, R, window.lens, min_range_m, reach_m, scratch.extremes(clear_m))
    count = cull_bricks_into(scratch.found(0), low, high, dims, *view)
    if count > len(scratch.found(0)):
        cull_bricks_into(scratch.found(count), low, high, dims, *view)
    # Stage 3: octants of the bricks that are partly free.
    found, corners_view = scratch.found(count)[:count], np.empty((3, count), np.float32)
    count = split_bricks_into(found, corners_view, dims, corner, t, *view)
    return Carving(
        bricks=found[:count, 0].astype(np.int64),
        masks=found[:count, 1].copy(),
        squares=np.square(clear_m),
        lens=window.lens.astype(np.float32),
        corners_view=corners_view,
        offsets_view=offsets_in_view(MORTON_XYZ, R, voxel_edge_m),
        min_square=min_range_m**2,
    )


def _morton_xyz() -> Floats:
    """(3, 512) x, y, z of a brick's voxels in Morton order."""
    places = np.arange(512)
    return np.stack([sum((places >> (3 * b + a) & 1) << b for b in range(3)) for a in range(3)]).astype(float)


MORTON_XYZ = _morton_xyz()
