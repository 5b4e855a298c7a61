"""Maps with epochs of simulated scenes: they forget what went, keep what stands, and report what changed.

A camera of a quarter of the head's pixels, voxels of 8 cm, and few stops; `python -m tests.bench epochs` has the
figures of whole images at 4 cm.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.bench.forgetting import EPOCH_S, SCAN_S, Vanishing, evidence_of, scans_until, states_after_each, vanishing
from tests.bench.moving import AFTER_ROUND_S, ROUND_S, cut_anywhere, hour_scores, standing_layer, thin_cells, thin_trial
from tests.fixtures.fusion.slanted_room import truth_of
from tests.fixtures.sim.change_scores import ChangeScores
from tests.fixtures.sim.passes import Cells, Recorded, histories, measured, present_states, recorded, sums, with_errors

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey
from cairn_sim.evaluation.scores import OCCUPIED, Scores, scores_from
from cairn_sim.evaluation.truth_grid import box_of_cell, truths_of
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import PoseErrors
from cairn_sim.scene.scene_file import load_scene

LAYER = standing_layer(0.08)
HEAD = Rig(
    name="small",
    cameras={
        RANGE_CAMERA: mount_camera(Spectrum.RANGE, camera_from_field_of_view(88, 72, horizontal_deg=69.0), np.eye(4))
    },
)
WALLS, FREES = 40, 80
"""Scans with a panel, and then without it."""
OCTOMAPS_SCANS = 9
"""Scans that OctoMap needs, from its upper bound to below one half: `test_present.py`."""


@cache
def vanished() -> tuple[Vanishing, list[dict[CellKey, Evidence]]]:
    given = vanishing(walls=WALLS, frees=FREES, voxel_edge_m=0.08, rig=HEAD)
    return given, evidence_of(given)


@cache
def rounds(scene: str, count: int) -> Recorded:
    robot = replace(ROBOTS["tof"], rig_of=lambda _: HEAD)
    plan = Plan(scene=load_scene(scene), robot=robot, path="labs", truth="none", rounds=count, lasts_s=ROUND_S * count)
    return recorded(replace(plan, last_stop=2))


@cache
def cells(scene: str, count: int, sigma_m: float) -> Cells:
    given = with_errors(rounds(scene, count), PoseErrors(sigma_m=sigma_m))
    return histories(measured(given, LAYER), LAYER.geometry)


@pytest.mark.parametrize("lead_s", [0, 90])
def test_a_wall_that_went_is_free_after_octomaps_scans_and_what_is_left_of_the_epoch(lead_s: float) -> None:
    given, diffs = vanished()
    states = states_after_each(diffs, given.times_s(lead_s), given, given.layer)
    left = round((EPOCH_S - lead_s) / SCAN_S) if lead_s else 0
    until = scans_until(states, 0.02, walls=WALLS)
    assert until is not None and until <= left + OCTOMAPS_SCANS


def test_in_one_sum_the_wall_stays() -> None:
    given, diffs = vanished()
    states = states_after_each(diffs, given.times_s(0), given, MapLayer(geometry=LAYER.geometry))
    assert scans_until(states[: 2 * WALLS], 0.5, walls=WALLS) is None


def test_scans_in_any_order_leave_the_same_map() -> None:
    given, diffs = vanished()
    order, times_s = np.random.default_rng(4).permutation(len(diffs)), given.times_s(0)
    recorded_last = states_after_each(diffs, times_s, given, given.layer)[-1]
    shuffled = states_after_each([diffs[n] for n in order], [times_s[n] for n in order], given, given.layer)
    np.testing.assert_array_equal(shuffled[-1], recorded_last)
    assert (recorded_last != OCCUPIED).mean() > 0.98


def test_a_building_that_stands_still_is_mapped_as_well_as_in_one_sum() -> None:
    given, held = rounds("building", 3), cells("building", 3, 0.015)
    poses = [T for _, T in given.looks[: len(given.looks) // 3]]
    boxes = [box_of_cell(key, LAYER.geometry) for key in held]
    truths = truths_of(given.plan.scene, boxes, camera=HEAD[RANGE_CAMERA].camera, T_map_cameras=poses, fineness=2)
    by_epoch, one_sum = (
        sum((scores_from(t, present_states(t.box, each, LAYER.geometry)) for t in truths), Scores())
        for each in (held, sums(held, LAYER.geometry))
    )
    assert one_sum.recall > 0.5
    assert by_epoch.recall >= one_sum.recall - 0.01
    assert by_epoch.carved <= one_sum.carved + 0.01
    assert by_epoch.false_free <= one_sum.false_free + 0.01
    assert by_epoch.recall_free >= one_sum.recall_free - 0.01


def test_thin_things_are_not_lost() -> None:
    trial = thin_trial(LAYER.geometry, poses=12, rounds=2)
    held = thin_cells(trial, LAYER.geometry, sigma_m=0.03)
    for kind in ("thin/", "slanted/", "wall/"):
        truth = truth_of(trial.truth, trial.scene, kind)
        by_epoch, one_sum = (
            scores_from(truth, present_states(truth.box, each, LAYER.geometry)).recall
            for each in (held, sums(held, LAYER.geometry))
        )
        assert by_epoch >= one_sum - 0.02, kind


def test_what_changed_is_found_and_nothing_else() -> None:
    held, given = cells("moving-building", 4, 0.01), rounds("moving-building", 4)
    scores, at_guard = hour_scores(held, given, LAYER.geometry, AFTER_ROUND_S, lasts_s=3 * ROUND_S)
    assert scores.shown > 50
    assert scores.recall >= 0.9
    assert scores.false < 10
    # The guard came and went within that time.
    assert at_guard == 0


def test_nothing_has_changed_in_a_building_that_stands_still_wherever_it_is_cut() -> None:
    found = cut_anywhere(cells("building", 3, 0.01), LAYER.geometry)
    assert len(found) > 3
    assert max(appeared + gone for appeared, gone, _ in found) < 10


def test_scores_count_false_reports() -> None:
    assert (ChangeScores(shown=4, found=2, false=1) + ChangeScores(shown=4, found_moved=4)).recall_moved == 0.75
