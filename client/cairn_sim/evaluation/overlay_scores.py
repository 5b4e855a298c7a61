"""Scores of the map over a live image, against the projection of its cubes, computed without the map.

    cubes       occupied voxels at random places, all that the map has
    expected    pixels whose centre lies in the outline of a cube's image: its edges projected through the lens
    visible     drawn where the live depth is the cubes' own: where each pixel's ray enters the first of them
    map only    drawn where there is no live depth

The score is the intersection of drawn and expected pixels over their union.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform, inverse
from cairn_fusion.view.overlay import Live, OverlayMode, OverlayStyle, draw_overlay
from cairn_map.arrays import Flags, Floats, Ints
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.render.camera_rays import CameraRays, look_at
from cairn_map.render.map_render import MapRenderer

GEOMETRY = Geometry(voxel_edge_um=50_000, depth=5, channels=(TEMPERATURE,))
CUBES, REACH_VOXELS = 40, 6
"""So many, at most so far from the origin along each axis."""
AWAY_M, ASIDE_M = 0.9, 0.1
"""Distance of the eye from the origin, and of the point that it looks at, along each axis, metres."""
EDGE_STEPS = 9
"""Points along a cube's edge, which a lens bends."""


@dataclass(frozen=True, slots=True)
class OverlayScore:
    """Intersection over union of one pose, 0 to 1, by how the map is drawn."""

    visible: float
    map_only: float
    expected_px: int


def overlay_scores(
    camera: AnyCamera, *, poses: int, seed: int, style: OverlayStyle | None = None
) -> Iterator[OverlayScore]:
    """The scores of random cubes from random places around them.

    Args:
        camera: to look through.
        poses: how many, each with cubes of its own.
        seed: of both.
        style: what is drawn; None: as usual.
    """
    sight, renderer, style = CameraRays(camera.rays()), MapRenderer(), style or OverlayStyle()
    rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
    for rng in map(np.random.default_rng, np.random.SeedSequence(seed).spawn(poses)):
        cubes = np.unique(rng.integers(-REACH_VOXELS, REACH_VOXELS, (CUBES, 3)), axis=0)
        eye = rng.normal(size=3)
        T = look_at((eye / np.linalg.norm(eye) * AWAY_M).tolist(), rng.uniform(-ASIDE_M, ASIDE_M, 3).tolist())
        expected, range_m = cubes_seen(cubes, camera, T)
        snapshot = map_of_cubes(cubes)
        drawn = []
        for live_m, mode in ((range_m, OverlayMode.VISIBLE), (np.full_like(range_m, np.nan), OverlayMode.MAP_ONLY)):
            live = Live(rgb=rgb, range_m=live_m, sight=sight, T_map_camera=T)
            drawn.append(draw_overlay(renderer, snapshot, live, style).front_modes == mode)
        visible, map_only = (intersection_over_union(each, expected) for each in drawn)
        yield OverlayScore(visible, map_only, int(expected.sum()))


def map_of_cubes(cubes: Ints) -> MapSnapshot:
    """A map in which these voxels, (N, 3) numbers, all different, are occupied, and no other is known."""
    whole, (cells, places) = EvidenceMap(GEOMETRY), split_voxels(cubes, GEOMETRY)
    for key in np.unique(cells):
        own = places[cells == key]
        samples = np.zeros((len(own), GEOMETRY.plane_count), np.int64)
        whole.replace(CellKey(int(key)), packed_evidence(own, np.tile([3, 0], (len(own), 1)), samples, GEOMETRY))
    return snapshot_of(whole)


def cubes_seen(cubes: Ints, camera: AnyCamera, T_map_camera: Transform) -> tuple[Flags, npt.NDArray[np.float32]]:
    """Cubes in a camera's image; all of them are in front of it.

    Args:
        cubes: (N, 3) voxel numbers.
        camera: any lens.
        T_map_camera: where it is.

    Returns:
        (H, W) whether a pixel's centre lies in the outline of a cube's image; and (H, W) metres along its ray to
        where that enters the first cube, NaN if it enters none.
    """
    mask = np.zeros((camera.height, camera.width), np.bool_)
    range_m = np.full(mask.shape, np.inf)
    rays, T = camera.rays() @ T_map_camera[:3, :3].T, inverse(T_map_camera)
    steps = np.linspace(0, 1, EDGE_STEPS)
    places = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    on_edges = places[((places == 0) | (places == 1)).sum(axis=1) >= 2]
    for cube in cubes:
        pixels = camera.project((cube + on_edges) * GEOMETRY.voxel_edge_m @ T[:3, :3].T + T[:3, 3])
        hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
        left, top = np.maximum(np.floor(hull.min(axis=0)).astype(int) - 1, 0).tolist()
        right, bottom = np.minimum(np.ceil(hull.max(axis=0)).astype(int) + 2, mask.shape[::-1]).tolist()
        x, y = np.meshgrid(np.arange(left, max(left, right)), np.arange(top, max(top, bottom)))
        following = np.roll(hull, -1, axis=0)
        sides = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for a, b in zip(hull, following, strict=True)]
        mask[y, x] |= (np.array(sides) >= 0).all(axis=0) | (np.array(sides) <= 0).all(axis=0)
        corners = np.stack([cube, cube + 1]) * GEOMETRY.voxel_edge_m - T_map_camera[:3, 3]
        range_m[y, x] = np.minimum(range_m[y, x], _entered_m(rays[y, x], corners))
    return mask, np.where(np.isinf(range_m), np.nan, range_m).astype(np.float32)


def _entered_m(rays: Floats, corners_m: Floats) -> Floats:
    """Metres along (..., 3) unit rays from the origin to where they enter a box of (2, 3) corners; inf if they miss."""
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.sort(corners_m / rays[..., None, :], axis=-2)
    enters, leaves = crossings[..., 0, :].max(axis=-1), crossings[..., 1, :].min(axis=-1)
    return np.where((enters <= leaves) & (enters > 0), enters, np.inf)


def intersection_over_union(one: Flags, other: Flags) -> float:
    """Intersection over union of two masks of one size, 0 to 1; 0 for two empty ones."""
    return float((one & other).sum() / max(int((one | other).sum()), 1))
