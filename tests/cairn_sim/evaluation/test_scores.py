"""Scores: counts known by hand, laws, and a map that a simulated camera really made."""

import math

import numpy as np
import pytest

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, geometry_for, split_voxels
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.scores import FREE, OCCUPIED, UNKNOWN, Scores, States, map_states, scores_from, scores_of
from cairn_sim.evaluation.truth_grid import Truth, TruthClass, VoxelBox, box_of_metres, truth_from, truths_of
from cairn_sim.evaluation.truth_grid_kernels import HIT, PASSED
from cairn_sim.render.rays import cast
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Cylinder, Plane, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Surface

GEOMETRY = geometry_for(voxel_edge_m=0.08)
CAMERA = camera_from_field_of_view(88, 72, horizontal_deg=69)
EYE = (0.4, -0.3, 1.2)
VIEWS = [
    look_at(EYE, (EYE[0] + math.cos(yaw), EYE[1] + math.sin(yaw), z))
    for yaw in np.arange(0, 6.2, 0.9)
    for z in (0.6, 1.5)
]


def room() -> Scene:
    """5 x 4 m, turned against the grid, with three things in it."""
    T_map_room = placed((0.013, 0.021, 0.017), (0.0, 0.0, 0.21))

    def there(shape: Shape, x: float, y: float, z: float, yaw: float = 0.0) -> Solid:
        return Solid("thing", shape, Surface(Material()), T_map_room @ placed((x, y, z), (0, 0, yaw)))

    return scene_of(
        [
            there(Plane(), 0, 0, 0),
            there(Box((5.4, 4.4, 0.2)), 0, 0, 2.6),
            *(there(Box((0.2, 4.4, 3)), x, 0, 1.2) for x in (-2.6, 2.6)),
            *(there(Box((5.4, 0.2, 3)), 0, y, 1.2) for y in (-2.1, 2.1)),
            there(Box((0.8, 0.5, 0.7)), 1.5, 1.0, 0.35, 0.5),
            there(Cylinder(0.25, 1.3), -1.5, 0.8, 0.65),
            there(Sphere(0.3), -1.0, -1.2, 0.9),
        ]
    )


def wall_truth() -> Truth:
    """Ten rows along y: free, free, surface, solid, unseen along x; half of each surface voxel is solid."""
    masks, marks = np.zeros((7, 12, 3), np.uint64), np.zeros((7, 12, 3), np.uint8)
    masks[3], masks[4], marks[1:3], marks[3] = (1 << 32) - 1, (1 << 64) - 1, PASSED, HIT
    masks[[0, 6]] = 0
    return truth_from(VoxelBox((0, 0, 0), (5, 10, 1), 80_000), masks, marks)


def perfect_states(truth: Truth) -> States:
    of_class = np.array([UNKNOWN, FREE, OCCUPIED, UNKNOWN], np.int8)
    return of_class[truth.classes]


def test_a_perfect_map_has_recall_one_and_nothing_carved() -> None:
    (truth,) = truths_of(
        room(),
        [box_of_metres((-2.7, -2.6, -0.1), (2.7, 2.6, 1.4), voxel_edge_um=80_000)],
        camera=CAMERA,
        T_map_cameras=VIEWS,
    )
    scores = scores_from(truth, perfect_states(truth))
    assert scores.surface > 3000 and scores.free > 20_000
    assert (scores.recall, scores.carved, scores.unknown) == (1, 0, 0)
    assert (scores.recall_free, scores.false_free_half, scores.precision) == (1, 0, 1)
    assert 0 < scores.false_free < 0.01
    # That many of the surface's voxels have their solid in a corner without a sample.
    assert 0 < scores.occupied_empty < 0.3


def test_counts_of_a_wall() -> None:
    truth = wall_truth()
    states = np.zeros((5, 10, 1), np.int8)
    states[2, :6], states[2, 6:9] = OCCUPIED, FREE
    states[0, :4], states[0, 4], states[1, :2] = FREE, OCCUPIED, OCCUPIED
    states[3, 0], states[3, 1:3], states[4, :5] = OCCUPIED, FREE, FREE
    scores = scores_from(truth, states)
    assert scores == Scores(
        surface=10,
        surface_occupied=6,
        surface_free=3,
        free=20,
        free_free=4,
        free_occupied=3,
        map_free=3 + 4 + 2 + 5,
        map_free_touching=3 + 2,
        map_free_half_solid=3 + 2,
        map_occupied=6 + 1 + 2 + 1,
        map_occupied_empty=1 + 2,
        map_occupied_near=6 + 2 + 1,
    )
    assert (scores.surface_unknown, scores.free_unknown) == (1, 13)
    assert (scores.recall, scores.carved, scores.unknown) == (0.6, 0.3, 0.1)
    assert (scores.recall_free, scores.precision, scores.occupied_empty) == (0.2, 0.9, 0.3)
    assert scores.false_free == scores.false_free_half == 5 / 14


def test_half_solid_is_counted_apart_from_touching() -> None:
    masks = np.zeros((5, 3, 3), np.uint64)
    masks[1:4, 1, 1] = [1, (1 << 31) - 1, (1 << 32) - 1]
    truth = truth_from(VoxelBox((0, 0, 0), (3, 1, 1), 80_000), masks, np.zeros((5, 3, 3), np.uint8))
    scores = scores_from(truth, np.full((3, 1, 1), FREE, np.int8))
    assert (scores.map_free, scores.map_free_touching, scores.map_free_half_solid) == (3, 3, 1)


def test_an_empty_map_knows_nothing_and_has_no_ratio_of_nothing() -> None:
    scores = scores_of(wall_truth(), {}, GEOMETRY)
    assert (scores.unknown, scores.recall, scores.carved, scores.recall_free) == (1, 0, 0, 0)
    assert math.isnan(scores.precision) and math.isnan(scores.false_free)
    assert "unknown 100.0% of 10;" in str(scores)
    assert scores + Scores() == scores


def test_states_are_the_sign_of_the_log_odds_in_every_cell_that_the_box_touches() -> None:
    rng = np.random.default_rng(4)
    numbers = np.stack(np.meshgrid(*[np.arange(-9, 9)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = rng.integers(0, 4, (len(numbers), 2))
    # A cell has 8 voxels along its edge: the box below touches 27 of the map's 64 and ends inside of them.
    geometry = Geometry(voxel_edge_um=80_000, depth=3)
    cells, places = split_voxels(numbers, geometry)
    no_samples = np.zeros((len(numbers), geometry.plane_count), np.int64)
    evidence_map = EvidenceMap(geometry)
    for key in np.unique(cells):
        mine = cells == key
        evidence = packed_evidence(places[mine], counts[mine], no_samples[mine], geometry)
        evidence_map.merge({CellKey(int(key)): evidence})
    box = VoxelBox((-9, -5, -12), (12, 14, 15), 80_000)
    states = map_states(box, evidence_map.packed(), geometry, model=SensorModel())
    # 0.85 a hit, -0.41 a miss: no sum of up to three is zero but none at all.
    expected = np.zeros((40, 40, 40), np.int8)
    expected[tuple((numbers + 20).T)] = np.sign(counts[:, 0] * 0.847 - counts[:, 1] * 0.405)
    np.testing.assert_array_equal(states, expected[11:23, 15:29, 8:23])


def test_a_map_of_other_voxels_is_refused() -> None:
    with pytest.raises(BadInputError, match="map's voxels are 40000 um") as refused:
        scores_of(wall_truth(), {}, geometry_for(voxel_edge_m=0.04))
    assert refused.value.kind == "bad_geometry"


def measured(noise_m: float) -> Measurement:
    """The room, seen by a range camera and integrated at 8 cm."""
    eye = mount_camera(Spectrum.RANGE, CAMERA, look_at((0.05, 0, 0), (0.05, 0, 1), up=(0, -1, 0)))
    rig = Rig(name="eye", cameras={"tof": eye})
    measurement = Measurement(rig, GEOMETRY)
    rng = np.random.default_rng(2)
    for n, T_map_camera in enumerate(VIEWS):
        range_m = cast(room(), CAMERA, T_map_camera).range_m + noise_m * rng.standard_normal(
            CAMERA.width * CAMERA.height
        )
        image = np.where(np.isfinite(range_m), range_m, np.nan).astype(np.float32).reshape(CAMERA.height, CAMERA.width)
        T_map_rig = T_map_camera @ np.linalg.inv(eye.transform)
        measurement.add(Scan(time_s=float(n), T_map_rig=T_map_rig, range_camera="tof", range_m=image))
    return measurement


def test_a_measured_map_is_nearly_true_and_its_scores_add_up() -> None:
    whole = box_of_metres((-3.2, -3.2, -0.16), (3.2, 3.2, 2.72), voxel_edge_um=80_000)
    halves = [VoxelBox((x, *whole.low[1:]), (40, *whole.shape[1:]), 80_000) for x in (-40, 0)]
    truth, *parts = truths_of(room(), [whole, *halves], camera=CAMERA, T_map_cameras=VIEWS)
    diff = measured(0.0).diff()
    scores = scores_of(truth, diff, GEOMETRY)
    assert scores == sum((scores_of(part, diff, GEOMETRY) for part in parts), Scores())
    assert scores.surface == np.count_nonzero(truth.classes == TruthClass.SURFACE)
    assert scores.surface == scores.surface_occupied + scores.surface_free + scores.surface_unknown
    assert scores.free == scores.free_free + scores.free_occupied + scores.free_unknown
    # Without noise every hit of the map is a hit of the truth but for rounding of the ranges to 32 bits.
    assert scores.precision > 0.9999
    assert scores.recall > 0.85 and scores.carved < 0.12
    assert scores.recall_free > 0.9
    assert scores.false_free_half < 0.005 and scores.false_free < 0.02


def test_noise_costs_precision_and_puts_hits_before_the_wall() -> None:
    box = box_of_metres((-3.2, -3.2, -0.16), (3.2, 3.2, 2.72), voxel_edge_um=80_000)
    (truth,) = truths_of(room(), [box], camera=CAMERA, T_map_cameras=VIEWS)
    exact, noisy, wild = (scores_of(truth, measured(sigma_m).diff(), GEOMETRY) for sigma_m in (0.0, 0.01, 0.2))
    assert exact.occupied_empty < noisy.occupied_empty < wild.occupied_empty
    assert noisy.precision > 0.999 > wild.precision
