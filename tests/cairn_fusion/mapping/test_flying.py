"""Flying pixels are found, and nothing else is."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.poses import look_at
from cairn_fusion.mapping.flying_kernels import SLANT_SHARE, flying_pixels
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.evidence.grid import geometry_for
from cairn_sim.evaluation.scores import scores_of
from cairn_sim.evaluation.truth_grid import box_of_cell, truths_of
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, TOF, tof_head
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene import scene_of
from cairn_sim.scene.scene_file import load_scene
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Surface

STEP_M = 0.05


def naive_flying(range_m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    flying = np.zeros(range_m.shape, bool)
    for axis in (0, 1):
        lines = np.moveaxis(range_m.astype(float), axis, 1)
        a, b, c, d, e = (
            np.pad(lines, ((0, 0), (2, 2)), constant_values=np.nan)[:, n : n + lines.shape[1]] for n in range(5)
        )
        own = np.minimum(np.abs(c - b), np.abs(d - c))
        beyond = np.fmax(np.nan_to_num(np.abs(b - a)), np.nan_to_num(np.abs(e - d)))
        found = ((c - b) * (d - c) > 0) & (own > STEP_M + SLANT_SHARE * beyond)
        flying |= np.moveaxis(found, 1, axis)
    return flying


@pytest.mark.parametrize("seed", range(5))
def test_kernel_agrees_with_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    range_m = np.repeat(rng.uniform(1, 6, (12, 9)), rng.integers(1, 4), axis=1)
    range_m += rng.choice([0.0, 0.3], range_m.shape, p=[0.7, 0.3])
    range_m[rng.random(range_m.shape) < 0.1] = np.nan
    image = range_m.astype(np.float32)
    np.testing.assert_array_equal(flying_pixels(image, STEP_M), naive_flying(image))
    assert naive_flying(image).any()


def test_what_the_camera_mixes_at_an_edge_is_found_and_surfaces_at_any_slant_are_kept() -> None:
    grey = Surface(Material(reflectivity_nir=0.6))
    post = Solid("post", Box((0.3, 0.4, 2.0)), grey, placed((2.0, 0.03, 0)))
    wall = Solid("wall", Box((0.2, 20, 20)), grey, placed((4.0, 0, 0)))
    floor = Solid("floor", Box((20, 20, 0.2)), grey, placed((0, 0, -1.1)))
    scene, rig, T = scene_of([post, wall, floor]), tof_head(), look_at((0, 0, 0), (1, 0, 0))
    scan = render_scan(scene, rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=0.0, noise=Noise(1))
    points = (rig[RANGE_CAMERA].camera.rays() * scan.range_m[..., None]) @ T[:3, :3].T
    off_m = np.abs(scene.distance_m(points))
    flying = flying_pixels(scan.range_m, STEP_M)
    in_the_air = off_m > 0.15
    assert in_the_air.sum() > 30
    assert (flying & in_the_air).sum() > 0.8 * in_the_air.sum()
    assert (flying & (off_m < 0.05)).sum() < 0.006 * flying.size


def test_next_to_no_return_and_on_the_images_border_nothing_flies() -> None:
    line = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, np.nan], [2.0, 2.0, 2.0]], np.float32)
    assert flying_pixels(line, STEP_M).tolist() == [[False, True, False], [False, False, False], [False, False, False]]
    assert not flying_pixels(np.full((1, 1), 2.0, np.float32), STEP_M).any()
    assert not flying_pixels(line, math.inf).any()


def test_without_flying_pixels_fewer_voxels_hang_in_the_air() -> None:
    robot, geometry = replace(ROBOTS["tof"], scans=(6, 1)), geometry_for(voxel_edge_m=0.08, channels=())
    plan = Plan(scene=load_scene("building"), robot=robot, path="labs", truth="none", first_stop=8, last_stop=9)
    rig = robot.rig_of(1.0)
    scans = [scan for _, scan, _ in scans_of(plan, shots_of(plan), rig)]
    diffs = [
        integrate_scans(scans, rig, geometry, integrator=Integrator(flying_step_m=step_m))
        for step_m in (0.05, math.inf)
    ]
    boxes = [box_of_cell(key, geometry) for key in sorted(diffs[0])]
    poses = [scan.T_map_rig @ rig[RANGE_CAMERA].transform for scan in scans]
    truths = truths_of(plan.scene, boxes, camera=TOF.camera(), T_map_cameras=poses, fineness=1)
    without, with_them = (
        sum((scores_of(t, diff, geometry) for t in truths[1:]), scores_of(truths[0], diff, geometry)) for diff in diffs
    )
    assert without.precision > with_them.precision + 0.005
    assert without.recall > with_them.recall - 0.01
