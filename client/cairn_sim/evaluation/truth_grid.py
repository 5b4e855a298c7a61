"""The truth in voxels: how much of each is solid, and what a camera on its way could have known of it.

    solid_masks   4^3 samples a voxel, in a solid or not            any scene, any voxel edge
    seen_marks    dense rays without noise, each to its first surface
    truths_of     both, as one class a voxel; `scores` compares a map with it

Of a scene that moves they tell its start; `scene.at(time_s)` has the truth at a time, `moving_truth` what cameras knew
of it that looked at many.

A ray counts if its first surface, glass and mirrors too, is within the camera's range; a ray that meets nothing there
marks nothing, because a camera to which nothing comes back says nothing (`cairn_fusion.recording.scan`). Voxels and
rounding are the map's own: a point on a border belongs to the upper voxel. So a wall that lies on the grid's own lines
has its surface in full voxels or, from the other side, in empty ones; turn a scene against the grid, as reality is
turned.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform, check_transform
from cairn_calib.rig.rig import TIME_OF_FLIGHT_REACH_M
from cairn_map.arrays import Flags, Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import NANOMETRES, CellKey, Geometry, cell_of_key
from cairn_sim.evaluation.truth_grid_kernels import HIT, PASSED, TOUCH_M, add_solid_into, mark_seen_into
from cairn_sim.render.rays import cast_directions
from cairn_sim.scene.scene import Scene

Masks = npt.NDArray[np.uint64]
Marks = npt.NDArray[np.uint8]
Triple = tuple[int, int, int]

VOXELS_MAX = 1 << 28
"""Voxels of a box at most: 2 GB of masks. A cell of 5.12 m has 2^24 at 2 cm."""
SAMPLES_PER_VOXEL = 64
HALF_SOLID = SAMPLES_PER_VOXEL // 2
"""A voxel with as many samples in solids is solid."""
FINENESS = 4
"""Rays along a pixel's edge: 1.7 cm apart at 10 m for the ToF camera."""


BUNDLE_PX = 4
"""Pixels in a row whose rays are cast as one bundle."""


class TruthClass(IntEnum):
    """True class of a voxel, given the trajectory: the first of SURFACE, SOLID, FREE, UNSEEN that holds.

    So a voxel that rays pass is free only if less than half of it is solid: else a map would be asked to call free what
    is then counted as falsely free.
    """

    UNSEEN = 0
    """No ray entered, and less than half of it is solid."""
    FREE = 1
    """A ray passed and none ended."""
    SURFACE = 2
    """A ray ended here."""
    SOLID = 3
    """At least half of it is solid, and no ray ended here."""


@dataclass(frozen=True, slots=True)
class VoxelBox:
    """X Y Z voxels of a map's grid; arrays of a box are indexed [x, y, z]."""

    low: Triple
    """Number of its first voxel."""
    shape: Triple
    voxel_edge_um: int

    def __post_init__(self) -> None:
        if min(self.shape) < 1 or self.voxel_edge_um < 1:
            raise BadInputError(
                "bad_box", f"a box has at least one voxel of 1 um, got {self.shape} of {self.voxel_edge_um} um"
            )
        x, y, z = (int(n) for n in self.shape)
        if x * y * z > VOXELS_MAX:
            raise BadInputError(
                "too_large", f"a box has at most {VOXELS_MAX} voxels, got {x} x {y} x {z}; take several"
            )

    @property
    def voxel_edge_m(self) -> float:
        """Edge of a voxel, metres."""
        return self.voxel_edge_um / 1e6

    @property
    def bounds_m(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner, (3,) each, map frame."""
        low = np.array(self.low, dtype=np.float64)
        return low * self.voxel_edge_um / 1e6, (low + self.shape) * self.voxel_edge_um / 1e6

    def grown(self, voxels: int) -> "VoxelBox":
        """The box with so many voxels more on each of the six sides."""
        x, y, z = (at - voxels for at in self.low)
        i, j, k = (n + 2 * voxels for n in self.shape)
        return VoxelBox((x, y, z), (i, j, k), self.voxel_edge_um)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Truth of each voxel of a box; (X, Y, Z) arrays."""

    box: VoxelBox
    classes: Marks
    """`TruthClass`"""
    solid_samples: Marks
    """0 to 64 of the samples in solids."""
    near_solid: Flags
    """True where the voxel, or one of its 26 neighbours, touches a solid or holds an end point."""

    @property
    def solid_fraction(self) -> npt.NDArray[np.float32]:
        """Solid share of each voxel, 0 to 1."""
        return self.solid_samples.astype(np.float32) / np.float32(SAMPLES_PER_VOXEL)


def box_of_cell(key: CellKey, geometry: Geometry) -> VoxelBox:
    """All voxels of a map's cell."""
    i, j, k = (index * geometry.side for index in cell_of_key(key))
    return VoxelBox((i, j, k), (geometry.side, geometry.side, geometry.side), geometry.voxel_edge_um)


def box_of_metres(low_m: npt.ArrayLike, high_m: npt.ArrayLike, *, voxel_edge_um: int) -> VoxelBox:
    """All voxels with a part between two corners, (3,) each, map frame.

    Raises:
        BadInputError: the box is empty, endless or too large.
    """
    low, high = np.asarray(low_m, dtype=np.float64), np.asarray(high_m, dtype=np.float64)
    if not (np.abs(np.stack([low, high])) < 1e9).all():  # also catches NaN
        raise BadInputError("bad_box", f"a box needs two finite corners, got {low.tolist()} and {high.tolist()}")
    edge_nm = max(1, voxel_edge_um) * 1000
    first = np.rint(low * NANOMETRES).astype(np.int64) // edge_nm
    behind = -(-np.rint(high * NANOMETRES).astype(np.int64) // edge_nm)
    x, y, z = first.tolist()
    i, j, k = (behind - first).tolist()
    return VoxelBox((x, y, z), (i, j, k), voxel_edge_um)


def solid_masks(scene: Scene, box: VoxelBox) -> Masks:
    """(X, Y, Z) which samples of each voxel lie in a solid: sample (i, j, k) along x, y, z is bit 16 i + 4 j + k.

    A sample is the centre of one of the 4^3 cubes of a voxel; within a nanometre of a surface it is inside.
    """
    masks = np.zeros(box.shape, np.uint64)
    first_m = (2 * np.array(box.low, dtype=np.float64) + 1) * (box.voxel_edge_um / 2e6)
    low_m, _ = box.bounds_m
    shapes = scene.shapes
    for k, solid in enumerate(scene.solids):
        if k in scene.gone:
            continue
        lowest, highest = solid.bounds_m()
        start = np.clip(np.floor((lowest - TOUCH_M - low_m) / box.voxel_edge_m), 0, box.shape).astype(np.int64)
        stop = np.clip(np.ceil((highest + TOUCH_M - low_m) / box.voxel_edge_m), 0, box.shape).astype(np.int64)
        if (start < stop).all():
            add_solid_into(
                int(shapes.kind[k]), shapes.frame[k], shapes.half_m[k], first_m, box.voxel_edge_m, start, stop, masks
            )
    return masks


def solid_samples(masks: Masks) -> Marks:
    """(X, Y, Z) how many of the 64 samples of each voxel are in solids."""
    counts: Marks = np.bitwise_count(masks)
    return counts


def seen_marks(
    scene: Scene,
    boxes: Sequence[VoxelBox],
    *,
    camera: AnyCamera,
    T_map_cameras: Sequence[Transform],
    max_range_m: float = TIME_OF_FLIGHT_REACH_M,
    fineness: int = FINENESS,
) -> list[Marks]:
    """Marks of the voxels that a camera could have seen in each box: (X, Y, Z) 0, PASSED or HIT.

    Rays are cast once for all boxes. Where several cameras went, take the largest of their marks.

    Args:
        scene: the truth.
        boxes: whose voxels to mark.
        camera: its lens.
        T_map_cameras: poses, each (4, 4).
        max_range_m: surfaces beyond it are not seen, nor the way there.
        fineness: rays along a pixel's edge, so that each pixel is seen through the square of it.

    Raises:
        BadInputError: a camera stands inside a solid, or the numbers make no sense.
    """
    if not (fineness >= 1 and 0 < max_range_m < np.inf):
        raise BadInputError(
            "bad_view", f"expected a finite range above 0 and a fineness of at least 1, got {max_range_m} m, {fineness}"
        )
    finer = _finer_rays(camera, fineness)
    marks = [np.zeros(box.shape, np.uint8) for box in boxes]
    for given in T_map_cameras:
        T = check_transform(given, name="T_map_camera")
        origin = np.ascontiguousarray(T[:3, 3])
        inside = int(scene.solid_at(origin))
        if inside >= 0:
            raise BadInputError(
                "camera_in_solid", f"a camera must be in free space, got one in {scene.solids[inside].name}"
            )
        near = [n for n, box in enumerate(boxes) if _distance_m(origin, box) <= max_range_m]
        if not near:
            continue
        hits = cast_directions(scene, finer, T, bundle=BUNDLE_PX * fineness**2, opaque=False)
        directions = finer @ T[:3, :3].T
        for n in near:
            low = np.array(boxes[n].low, dtype=np.int64)
            mark_seen_into(origin, directions, hits.range_m, max_range_m, low, boxes[n].voxel_edge_um * 1000, marks[n])
    return marks


def truths_of(
    scene: Scene,
    boxes: Sequence[VoxelBox],
    *,
    camera: AnyCamera,
    T_map_cameras: Sequence[Transform],
    max_range_m: float = TIME_OF_FLIGHT_REACH_M,
    fineness: int = FINENESS,
) -> list[Truth]:
    """The truth about each box for one camera's trajectory; the arguments are those of `seen_marks`."""
    rims = [box.grown(1) for box in boxes]
    marks = seen_marks(
        scene, rims, camera=camera, T_map_cameras=T_map_cameras, max_range_m=max_range_m, fineness=fineness
    )
    return [truth_from(box, solid_masks(scene, rim), mark) for box, rim, mark in zip(boxes, rims, marks, strict=True)]


def truth_from(box: VoxelBox, masks: Masks, marks: Marks) -> Truth:
    """The truth about a box from masks and marks of `box.grown(1)`."""
    inner = (slice(1, -1),) * 3
    samples, seen = solid_samples(masks[inner]), marks[inner]
    classes = np.full(box.shape, TruthClass.UNSEEN, np.uint8)
    classes[seen == PASSED] = TruthClass.FREE
    classes[samples >= HALF_SOLID] = TruthClass.SOLID
    classes[seen == HIT] = TruthClass.SURFACE
    return Truth(box, classes, samples, near_flags((masks != 0) | (marks == HIT)))


def _finer_rays(camera: AnyCamera, fineness: int) -> Floats:
    """(H W n n, 3) unit rays through the middles of n x n parts of each pixel, pixel by pixel, camera frame."""
    part = (np.arange(fineness) + 0.5) / fineness - 0.5
    y, x, b, a = np.meshgrid(np.arange(camera.height), np.arange(camera.width), part, part, indexing="ij")
    return camera.unproject(np.stack([x + a, y + b], axis=-1).reshape(-1, 2))


def near_flags(flags: Flags) -> Flags:
    """Flags dilated by one voxel in all 26 directions; of all voxels but the outermost."""
    flags = flags[:-2] | flags[1:-1] | flags[2:]
    flags = flags[:, :-2] | flags[:, 1:-1] | flags[:, 2:]
    near: Flags = flags[:, :, :-2] | flags[:, :, 1:-1] | flags[:, :, 2:]
    return near


def _distance_m(point: Floats, box: VoxelBox) -> float:
    low, high = box.bounds_m
    return float(np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0)))
