"""Truth in voxels: kernels against slow, obvious twins, and walls whose voxels can be counted by hand."""

import math

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import Transform, look_at
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import cell_key, geometry_for, split_voxels, voxels_of_points
from cairn_sim.evaluation.truth_grid import (
    TruthClass,
    VoxelBox,
    box_of_cell,
    box_of_metres,
    seen_marks,
    solid_masks,
    solid_samples,
    truth_from,
    truths_of,
)
from cairn_sim.evaluation.truth_grid_kernels import GRAZE_M, HIT, PASSED, mark_seen_into
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Cylinder, Plane, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface

Floats = npt.NDArray[np.float64]

GREY = Surface(Material())
ALONG_X: Transform = look_at((0.05, 0.05, 0.05), (1, 0.05, 0.05))
ONE_RAY = Camera(width=1, height=1, focal_px=(1.0, 1.0), centre_px=(0.0, 0.0))


def solid(shape: Shape, at: tuple[float, float, float], turn: tuple[float, float, float] = (0, 0, 0)) -> Solid:
    return Solid("thing", shape, GREY, placed(at, turn))


def wall(optics: Optics = Optics.OPAQUE) -> Scene:
    """From x = 1.05 to 2, and 10 m high and wide."""
    return scene_of([Solid("wall", Box((0.95, 10, 10)), Surface(Material(optics=optics)), placed((1.525, 0, 0)))])


def random_scene(rng: np.random.Generator) -> Scene:
    """Small and large solids of all kinds, in about the metre around the origin."""

    def pose() -> Transform:
        x, y, z, a, b, c = rng.uniform(-1, 1, 6)
        return placed((x, y, z), (3 * a, 3 * b, 3 * c))

    shapes: list[Shape] = [Plane(), Box((0.01, 3.0, 2.0)), Box((1.5, 1.5, 1.5))]
    for _ in range(4):
        a, b, c = rng.uniform(0.02, 0.6, 3)
        shapes += [Box((a, b, c)), Cylinder(a / 2, b), Sphere(c / 2)]
    kept = rng.permutation(len(shapes))[: rng.integers(1, len(shapes))]
    return scene_of([Solid("thing", shapes[k], GREY, pose()) for k in kept])


def naive_masks(scene: Scene, box: VoxelBox) -> npt.NDArray[np.uint64]:
    steps = [np.arange(8 * low + 1, 8 * (low + n) + 1, 2) for low, n in zip(box.low, box.shape, strict=True)]
    samples = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1) * box.voxel_edge_um / 8e6
    X, Y, Z = box.shape
    inside = (scene.solid_at(samples) >= 0).reshape(X, 4, Y, 4, Z, 4).transpose(0, 2, 4, 1, 3, 5)
    weights = np.uint64(1) << np.arange(64, dtype=np.uint64)
    return (inside.reshape(X, Y, Z, 64) * weights).sum(axis=-1, dtype=np.uint64)


def naive_marks(
    origin: Floats, directions: Floats, range_m: Floats, max_range_m: float, box: VoxelBox
) -> npt.NDArray[np.uint8]:
    """Length of the overlap of each ray and each voxel."""
    marks = np.zeros(box.shape, np.uint8)
    voxels = np.stack(np.meshgrid(*(np.arange(n) for n in box.shape), indexing="ij"), axis=-1) + np.array(box.low)
    low, high = voxels * box.voxel_edge_um / 1e6, (voxels + 1) * box.voxel_edge_um / 1e6
    for direction, length in zip(directions, range_m, strict=True):
        if not length <= max_range_m:
            continue
        with np.errstate(divide="ignore"):
            a, b = (low - origin) / direction, (high - origin) / direction
        enter = np.maximum(np.minimum(a, b).max(axis=-1), 0)
        leave = np.minimum(np.maximum(a, b).min(axis=-1), length)
        marks[(leave - enter > GRAZE_M) & (marks == 0)] = PASSED
        end = np.floor(np.rint((origin + length * direction) * 1e9) / (box.voxel_edge_um * 1000)).astype(int) - box.low
        if ((end >= 0) & (end < box.shape)).all():
            marks[tuple(end)] = HIT
    return marks


@pytest.mark.parametrize("seed", range(24))
def test_solid_masks_agree_with_asking_the_scene_at_every_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng)
    x, y, z = rng.integers(-18, 4, 3).tolist()
    i, j, k = rng.integers(1, 22, 3).tolist()
    box = VoxelBox((x, y, z), (i, j, k), int(rng.choice([11_000, 40_000, 80_001, 160_000])))
    np.testing.assert_array_equal(solid_masks(scene, box), naive_masks(scene, box))


def test_solids_beyond_the_box_and_all_around_it() -> None:
    box = VoxelBox((-9, -9, -9), (18, 18, 18), 40_000)
    assert not solid_masks(scene_of([solid(Sphere(1.0), (3, 0, 0)), solid(Plane(), (0, 0, -1))]), box).any()
    for shape in (Box((9, 9, 9)), Cylinder(9, 9), Sphere(9)):
        assert (solid_samples(solid_masks(scene_of([solid(shape, (0, 0, 0), (1, 2, 3))]), box)) == 64).all()
    assert (solid_samples(solid_masks(scene_of([solid(Plane(), (0, 0, 1), (0.3, 0, 0))]), box)) == 64).all()


@pytest.mark.parametrize(
    ("thick_m", "samples"), [(0.005, 0), (0.01, 16), (0.02, 16), (0.03, 32), (0.05, 48), (0.08, 64)]
)
def test_samples_of_a_wall_on_the_grid_are_counted_whatever_the_rounding(thick_m: float, samples: int) -> None:
    for row in (-7, 0, 12345):
        at = row * 0.08
        scene = scene_of([solid(Box((thick_m, 10, 10)), (at + thick_m / 2, 0, 0), (math.pi, 0, 0))])
        counts = solid_samples(solid_masks(scene, VoxelBox((row - 1, 0, 0), (3, 2, 2), 80_000)))
        assert counts[:, 1, 1].tolist() == [0, samples, 0]


def test_sample_numbers_run_along_z_first() -> None:
    box = VoxelBox((0, 0, 0), (1, 1, 1), 80_000)
    for axis, bit in enumerate((16, 4, 1)):
        at = [0.01, 0.01, 0.01]
        at[axis] += 0.02
        masks = solid_masks(scene_of([solid(Sphere(0.001), (at[0], at[1], at[2]))]), box)
        assert int(masks[0, 0, 0]) == 1 << bit


@pytest.mark.parametrize("seed", range(12))
def test_marks_agree_with_the_overlap_of_every_ray_and_every_voxel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, z = rng.integers(-9, 3, 3).tolist()
    box = VoxelBox((x, y, z), (7, 9, 5), 70_000)
    low_m, high_m = box.bounds_m
    for _ in range(4):
        origin = rng.uniform(low_m - 0.2, high_m + 0.2)
        directions = np.concatenate([rng.standard_normal((12, 3)), np.eye(3), -np.eye(3), [[1, 1, 0], [0, -1, 1]]])
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        range_m = rng.uniform(0, 1.2, len(directions))
        range_m[rng.random(len(range_m)) < 0.1] = np.inf
        range_m[rng.random(len(range_m)) < 0.1] = np.nan
        marks = np.zeros(box.shape, np.uint8)
        mark_seen_into(origin, directions, range_m, 1.0, np.array(box.low), box.voxel_edge_um * 1000, marks)
        np.testing.assert_array_equal(marks, naive_marks(origin, directions, range_m, 1.0, box))


@pytest.mark.parametrize(
    ("from_m", "to_m", "row"),
    [
        (0.05, 0.55, "111112000000"),
        (0.55, 0.05, "211111000000"),
        # An end on a border belongs to the upper voxel; the lower one is not passed on, nor is it entered from above.
        (0.05, 0.30, "111200000000"),
        (0.55, 0.30, "000211000000"),
        (0.30, 0.55, "000112000000"),
        (0.30, 0.05, "211000000000"),
        (-5.0, 5.00, "111111111111"),
        (-5.0, -1.0, "000000000000"),
        (1.15, 5.00, "000000000001"),
    ],
)
def test_voxels_along_an_axis(from_m: float, to_m: float, row: str) -> None:
    marks = np.zeros((12, 1, 1), np.uint8)
    origin, direction = np.array([from_m, 0.05, 0.05]), np.array([[math.copysign(1.0, to_m - from_m), 0, 0]])
    mark_seen_into(origin, direction, np.array([abs(to_m - from_m)]), 99.0, np.zeros(3, np.int64), 100_000_000, marks)
    assert "".join(map(str, marks.ravel())) == row


def test_hit_wins_over_pass_in_both_orders() -> None:
    directions, range_m = np.array([[1.0, 0, 0]] * 2), np.array([0.5, 0.9])
    for order in ([0, 1], [1, 0]):
        marks = np.zeros((12, 1, 1), np.uint8)
        origin, low = np.array([0.05, 0.05, 0.05]), np.zeros(3, np.int64)
        mark_seen_into(origin, directions[order], range_m[order], 9.0, low, 100_000_000, marks)
        assert "".join(map(str, marks.ravel())) == "111112111200"


def test_classes_of_a_wall_seen_by_one_ray() -> None:
    box = VoxelBox((0, -1, 0), (20, 3, 1), 100_000)
    (truth,) = truths_of(wall(), [box], camera=ONE_RAY, T_map_cameras=[ALONG_X], fineness=1)
    assert truth.classes[:, 1, 0].tolist() == [TruthClass.FREE] * 10 + [TruthClass.SURFACE] + [TruthClass.SOLID] * 9
    # Off the ray nothing is seen; voxel 10 is exactly half solid.
    assert truth.classes[:, 0, 0].tolist() == truth.classes[:, 2, 0].tolist() == [0] * 10 + [3] * 10
    assert truth.solid_samples[9:12, 1, 0].tolist() == [0, 32, 64]
    assert truth.solid_fraction[9:12, 1, 0].tolist() == [0, 0.5, 1]
    assert truth.near_solid[:, 1, 0].tolist() == [False] * 9 + [True] * 11


def test_surface_wins_over_solid_and_solid_over_free() -> None:
    box = VoxelBox((0, 0, 0), (3, 3, 1), 40_000)
    masks, marks = np.zeros((5, 5, 3), np.uint64), np.zeros((5, 5, 3), np.uint8)
    masks[2, 1:4, 1], masks[3, 1:4, 1] = (1 << 31) - 1, (1 << 32) - 1
    marks[1:4, 2, 1], marks[1:4, 3, 1] = PASSED, HIT
    truth = truth_from(box, masks, marks)
    assert truth.classes[:, :, 0].tolist() == [[0, 1, 2], [0, 1, 2], [3, 3, 2]]
    assert truth.solid_samples[:, :, 0].tolist() == [[0] * 3, [31] * 3, [32] * 3]


def test_voxels_beside_the_box_count_as_near() -> None:
    scene = scene_of([solid(Sphere(0.03), (0.05, 0.05, 0.05))])
    for low, near in (((1, 1, 1), True), ((2, 0, 0), False), ((-1, 0, 1), True), ((0, 0, -2), False)):
        (truth,) = truths_of(scene, [VoxelBox(low, (1, 1, 1), 100_000)], camera=ONE_RAY, T_map_cameras=[])
        assert truth.near_solid.item() is near
        assert truth.classes.item() == TruthClass.UNSEEN


@pytest.mark.parametrize("optics", [Optics.GLASS, Optics.MIRROR])
def test_glass_and_mirrors_are_surfaces(optics: Optics) -> None:
    box = VoxelBox((0, 0, 0), (20, 1, 1), 100_000)
    (marks,) = seen_marks(wall(optics), [box], camera=ONE_RAY, T_map_cameras=[ALONG_X], fineness=1)
    assert marks.ravel().tolist() == [PASSED] * 10 + [HIT] + [0] * 9


def test_a_surface_beyond_the_range_shows_nothing_not_even_the_way_there() -> None:
    box = VoxelBox((0, 0, 0), (20, 1, 1), 100_000)
    for max_range_m, count in ((0.99, 0), (1.01, 11)):
        (marks,) = seen_marks(
            wall(), [box], camera=ONE_RAY, T_map_cameras=[ALONG_X], fineness=1, max_range_m=max_range_m
        )
        assert np.count_nonzero(marks) == count


def test_a_box_at_the_end_of_the_range_is_seen() -> None:
    box = VoxelBox((9, 0, 0), (3, 1, 1), 100_000)
    away: Transform = look_at((-8.9, 0.05, 0.05), (1, 0.05, 0.05))
    (marks,) = seen_marks(wall(), [box], camera=ONE_RAY, T_map_cameras=[away], fineness=1)
    assert marks.ravel().tolist() == [PASSED, HIT, 0]


def test_boxes_are_parts_of_one_world() -> None:
    scene = random_scene(np.random.default_rng(5))
    camera = camera_from_field_of_view(24, 18, horizontal_deg=80)
    eyes = [p for p in np.random.default_rng(6).uniform(-3, 3, (40, 3)) if scene.distance_m(p) > 0.01][:1]
    poses = [look_at(eye, (0, 0, 0)) for eye in eyes]
    whole = VoxelBox((-8, -8, -8), (16, 16, 16), 100_000)
    parts = [VoxelBox((x, y, -8), (8, 8, 16), 100_000) for x in (-8, 0) for y in (-8, 0)]
    far = VoxelBox((1000, 0, 0), (8, 8, 8), 100_000)
    one, *many, nothing = truths_of(scene, [whole, *parts, far], camera=camera, T_map_cameras=poses)
    assert {*np.unique(one.classes).tolist()} == {0, 1, 2, 3}
    for field in ("classes", "solid_samples", "near_solid"):
        a, b, c, d = (getattr(part, field) for part in many)
        joined = np.concatenate([np.concatenate([a, b], axis=1), np.concatenate([c, d], axis=1)])
        np.testing.assert_array_equal(getattr(one, field), joined)
    assert not (nothing.classes == TruthClass.FREE).any()


def test_finer_rays_find_all_voxels_that_the_pixels_find_and_more() -> None:
    camera = camera_from_field_of_view(9, 7, horizontal_deg=60)
    box = VoxelBox((0, -10, -10), (11, 20, 20), 100_000)
    hits = [seen_marks(wall(), [box], camera=camera, T_map_cameras=[ALONG_X], fineness=n)[0] == HIT for n in (1, 3, 9)]
    # Three rays along a pixel's edge include the one through its middle.
    assert (hits[0] <= hits[1]).all() and (hits[1] <= hits[2]).all()
    assert np.count_nonzero(hits[0]) < np.count_nonzero(hits[1])
    # 60 degrees at a metre are 1.15 m wide; on the wall's face no voxel in the picture's middle is left out.
    assert hits[2][10, 6:15, 7:14].all() and not hits[2][:10].any()


def test_a_lidar_sees_all_around() -> None:
    lidar = SpinningLidar(width=90, height=3, elevations_deg=(4, 0, -4))
    scene = scene_of(
        [solid(Box((9, 9, 1)), (0, 0, -2)), solid(Cylinder(0.3, 4), (1, 0, 0)), solid(Sphere(0.4), (-1, 1, 0))]
    )
    box = box_of_metres((-2, -2, -0.5), (2, 2, 0.5), voxel_edge_um=50_000)
    (truth,) = truths_of(scene, [box], camera=lidar, T_map_cameras=[look_at((0, 0, 0), (0, 1, 0))])
    at = np.argwhere(truth.classes == TruthClass.SURFACE)
    assert (at[:, 0] > 40).any() and (at[:, 0] < 40).any()


def test_the_box_of_a_cell_holds_its_voxels() -> None:
    geometry = geometry_for(voxel_edge_m=0.08)
    box = box_of_cell(cell_key((-1, 0, 2)), geometry)
    assert (box.low, box.shape, box.voxel_edge_um) == ((-64, 0, 128), (64, 64, 64), 80_000)
    low_m, high_m = box.bounds_m
    points = np.random.default_rng(0).uniform(low_m, high_m, (99, 3))
    assert {*split_voxels(voxels_of_points(points, geometry), geometry)[0].tolist()} == {cell_key((-1, 0, 2))}


def test_a_box_of_metres_holds_every_voxel_between_the_corners() -> None:
    # 0.15 / 0.05 is 2.9999999999999996 in floating point.
    box = box_of_metres((0.15, -0.15, 0), (0.3, 0.15, 0.01), voxel_edge_um=50_000)
    assert box == VoxelBox((3, -3, 0), (3, 6, 1), 50_000)
    assert box.grown(2) == VoxelBox((1, -5, -2), (7, 10, 5), 50_000)


def test_boxes_and_views_that_cannot_be_are_refused() -> None:
    with pytest.raises(BadInputError, match="at most 268435456") as refused:
        VoxelBox((0, 0, 0), (1 << 40, 1 << 40, 1), 1000)
    assert refused.value.kind == "too_large"
    with pytest.raises(BadInputError, match="at least one voxel"):
        VoxelBox((0, 0, 0), (1, 0, 1), 1000)
    with pytest.raises(BadInputError, match="at least one voxel"):
        box_of_metres((0, 0, 0), (-1, 1, 1), voxel_edge_um=1000)
    with pytest.raises(BadInputError, match="finite corners"):
        box_of_metres((0, 0, 0), (math.inf, 1, 1), voxel_edge_um=1000)
    box = VoxelBox((0, 0, 0), (1, 1, 1), 1000)
    with pytest.raises(BadInputError, match="one in wall"):
        seen_marks(wall(), [box], camera=ONE_RAY, T_map_cameras=[look_at((1.5, 0, 0), (9, 0, 0))])
    for max_range_m, fineness in ((0.0, 1), (math.inf, 1), (1.0, 0)):
        with pytest.raises(BadInputError, match="fineness of at least 1"):
            seen_marks(wall(), [box], camera=ONE_RAY, T_map_cameras=[], max_range_m=max_range_m, fineness=fineness)
