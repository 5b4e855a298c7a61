"""The rays of a camera in a scene: what each pixel's centre meets, and what is visible from elsewhere."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform, check_transform, inverse, transform_points
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_map.arrays import Floats, Int32s
from cairn_map.errors import BadInputError
from cairn_sim.render.raycast_kernels import Hits, cast_rays
from cairn_sim.scene.scene import Scene

TILE_PX = 8
"""Side of the squares of pixels that share a bundle; 8 and 16 are equally fast at 1280 x 960, 8 at 176 x 144."""
POINTS_OF_BUNDLE = 32
VISIBLE_SLACK_M = 1e-6
"""A surface hides a point that is farther than this behind it."""


def cast(scene: Scene, camera: AnyCamera, T_map_camera: Transform, *, opaque: bool = False) -> Hits:
    """Hits of the rays through the centres of a camera's pixels, N = H W, row by row.

    Args:
        scene: to look at.
        camera: its lens.
        T_map_camera: where it is.
        opaque: whether glass and mirrors stop a ray, as in the far infrared.

    Raises:
        BadInputError: the camera stands inside a solid.
    """
    T = check_transform(T_map_camera, name="T_map_camera")
    inside = int(scene.solid_at(T[:3, 3]))
    if inside >= 0:
        raise BadInputError(
            "camera_in_solid",
            f"a camera at {np.round(T[:3, 3], 2).tolist()} m is inside {scene.solids[inside].name}; move the robot",
        )
    order, starts = tiles(camera.width, camera.height)
    return cast_rays(
        T[:3, 3].copy(), T[:3, :3].copy(), camera.rays().reshape(-1, 3), order, starts, scene.shapes, opaque
    )


@lru_cache(maxsize=32)
def tiles(width: int, height: int) -> tuple[Int32s, Int32s]:
    """The pixels of an image by squares of `TILE_PX`, as `cast_rays` wants its bundles; read-only."""
    y, x = np.divmod(np.arange(width * height, dtype=np.int32), np.int32(width))
    tile = (y // TILE_PX) * -(-width // TILE_PX) + x // TILE_PX
    order = np.argsort(tile, kind="stable").astype(np.int32)
    starts = np.flatnonzero(np.diff(tile[order], prepend=-1, append=-1)).astype(np.int32)
    order.setflags(write=False)
    starts.setflags(write=False)
    return order, starts


def cast_directions(scene: Scene, directions: Floats, T_map_camera: Transform, *, bundle: int, opaque: bool) -> Hits:
    """Hits of (N, 3) unit rays of the camera's frame; each `bundle` of them should have about the same direction."""
    order = np.arange(len(directions), dtype=np.int32)
    starts = np.append(order[::bundle], np.int32(len(directions)))
    T = T_map_camera
    return cast_rays(T[:3, 3].copy(), T[:3, :3].copy(), directions, order, starts, scene.shapes, opaque)


def visible_from(
    scene: Scene, points_map: Floats, rig: Rig, camera: str, *, T_map_rig: Transform
) -> npt.NDArray[np.bool_]:
    """(...) whether a camera of the rig sees each (..., 3) surface point of the map: in view, and nothing before it.

    Through glass counts, where the camera's spectrum passes it; round a mirror does not. False for NaN.
    """
    mounted = rig[camera]
    T_map_camera = T_map_rig @ mounted.transform
    points = points_map.reshape(-1, 3)
    own = transform_points(inverse(T_map_camera), points)
    seen = mounted.camera.contains(mounted.camera.project(own))
    distance_m = np.linalg.norm(own[seen], axis=-1)
    directions = own[seen] / distance_m[:, None]
    opaque = mounted.spectrum is Spectrum.THERMAL
    hits = cast_directions(scene, directions, T_map_camera, bundle=POINTS_OF_BUNDLE, opaque=opaque)
    seen[seen] = hits.straight_m >= distance_m - VISIBLE_SLACK_M
    return np.asarray(seen.reshape(points_map.shape[:-1]))
