"""Truth of a scene that moves: at a time it is that of the scene then, and a change is the same both ways."""

import numpy as np
import pytest

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.poses import look_at
from cairn_map.errors import BadInputError
from cairn_sim.evaluation.moving_truth import changed_voxels, truths_at
from cairn_sim.evaluation.truth_grid import Truth, TruthClass, box_of_metres, solid_masks, solid_samples, truths_of
from cairn_sim.scene.movements import CLOCK_START_S, Keyframe, Movement, MovingObject
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Surface

GREY = Surface(Material())
WALL = Solid("wall", Box((0.4, 4, 4)), GREY, placed((3.0, 0, 0)))
CRATE = Solid("crate", Box((0.4, 0.4, 0.4)), GREY, placed((0, 0, 0)))
BOX = box_of_metres((0.4, -1, -1), (3.4, 1, 1), voxel_edge_um=80_000)
CAMERA = camera_from_field_of_view(24, 24, horizontal_deg=40.0)
LOOK = look_at((0, 0.01, 0.02), (3, 0.01, 0.02))


def crate_from(come_s: float, *, until_s: float) -> Scene:
    keyframes = (Keyframe(0, None), Keyframe(come_s, placed((2.0, 0.02, 0.01))), Keyframe(until_s, None))
    return scene_of([WALL], moving=[MovingObject("crate", (CRATE,), Movement(keyframes, np.eye(4)))])


def cart() -> Scene:
    keyframes = (Keyframe(0, placed((2.0, -0.6, 0))), Keyframe(60, placed((1.4, 0.55, 0.1), (0, 0, 0.7))))
    return scene_of([WALL], moving=[MovingObject("cart", (CRATE,), Movement(keyframes, np.eye(4)))])


def truth_at(scene: Scene, after_s: float, *looks_s: float) -> Truth:
    (truth,) = truths_at(
        scene,
        [BOX],
        time_s=CLOCK_START_S + after_s,
        camera=CAMERA,
        T_map_cameras=[LOOK] * len(looks_s),
        times_s=[CLOCK_START_S + look_s for look_s in looks_s],
    )
    return truth


def truth_now(scene: Scene) -> Truth:
    (truth,) = truths_of(scene, [BOX], camera=CAMERA, T_map_cameras=[LOOK])
    return truth


@pytest.mark.parametrize("after_s", [0.0, 17.0, 60.0])
def test_truth_at_a_time_is_that_of_the_scene_then(after_s: float) -> None:
    then = truth_now(cart().at(CLOCK_START_S + after_s))
    truth = truth_at(cart(), after_s, after_s)
    np.testing.assert_array_equal(truth.classes, then.classes)
    np.testing.assert_array_equal(truth.solid_samples, then.solid_samples)
    np.testing.assert_array_equal(truth.near_solid, then.near_solid)


def test_in_a_scene_that_stands_still_all_looks_count_that_came_before() -> None:
    scene = scene_of([WALL])
    np.testing.assert_array_equal(truth_at(scene, 50, 3, 70).classes, truth_now(scene).classes)
    assert not np.isin(truth_at(scene, 2, 3, 70).classes, (TruthClass.FREE, TruthClass.SURFACE)).any()


def test_a_look_says_nothing_of_what_was_put_there_later() -> None:
    scene = crate_from(100, until_s=200)
    before, after = truth_at(scene, 150, 50), truth_at(scene, 150, 50, 120)
    came = changed_voxels(scene, BOX, since_s=CLOCK_START_S + 50, until_s=CLOCK_START_S + 150).appeared
    assert came.sum() > 100
    assert not np.isin(before.classes[came], (TruthClass.FREE, TruthClass.SURFACE)).any()
    assert (after.classes[came] == TruthClass.SURFACE).sum() > 10
    # What the crate hides now was seen before it came.
    np.testing.assert_array_equal(before.classes[~came], truth_now(scene.at(CLOCK_START_S)).classes[~came])


def test_what_went_is_free_once_it_is_looked_at() -> None:
    scene = crate_from(100, until_s=200)
    went = changed_voxels(scene, BOX, since_s=CLOCK_START_S + 150, until_s=CLOCK_START_S + 250).went
    assert (truth_at(scene, 250, 150).classes[went] == TruthClass.UNSEEN).all()
    assert (truth_at(scene, 250, 150, 210).classes[went] == TruthClass.FREE).mean() > 0.9


@pytest.mark.parametrize(("one_s", "other_s"), [(0.0, 60.0), (10.0, 31.0), (59.0, 60.0)])
def test_changes_there_and_back_are_the_same(one_s: float, other_s: float) -> None:
    one, other = CLOCK_START_S + one_s, CLOCK_START_S + other_s
    there, back = (changed_voxels(cart(), BOX, since_s=a, until_s=b) for a, b in ((one, other), (other, one)))
    np.testing.assert_array_equal(there.appeared, back.went)
    np.testing.assert_array_equal(there.went, back.appeared)
    np.testing.assert_array_equal(there.near, back.near)
    np.testing.assert_array_equal(there.samples_before, back.samples_after)
    assert there.appeared.any() and there.went.any() and not (there.appeared & there.went).any()


def test_changes_are_the_difference_of_what_is_there() -> None:
    changed = changed_voxels(cart(), BOX, since_s=CLOCK_START_S + 5, until_s=CLOCK_START_S + 40)
    before, after = (solid_samples(solid_masks(cart().at(CLOCK_START_S + at_s), BOX)) for at_s in (5, 40))
    np.testing.assert_array_equal(changed.samples_before, before)
    np.testing.assert_array_equal(changed.samples_after, after)
    np.testing.assert_array_equal(changed.appeared, (before == 0) & (after > 0))


def test_a_change_is_near_itself_and_nowhere_else() -> None:
    changed = changed_voxels(cart(), BOX, since_s=CLOCK_START_S, until_s=CLOCK_START_S + 60)
    touched = np.argwhere(changed.samples_before != changed.samples_after)
    far = np.abs(np.argwhere(~changed.near)[:, None] - touched[None]).max(axis=2).min(axis=1)
    assert changed.near[tuple(touched.T)].all() and far.min() > 1


def test_what_came_and_went_between_two_times_is_no_change() -> None:
    scene = crate_from(100, until_s=200)
    changed = changed_voxels(scene, BOX, since_s=CLOCK_START_S + 50, until_s=CLOCK_START_S + 250)
    assert not (changed.appeared | changed.went | changed.near).any()


def test_a_look_without_a_time_is_refused() -> None:
    with pytest.raises(BadInputError, match="a time for each pose, got 0 for 1"):
        truths_at(cart(), [BOX], time_s=0.0, camera=CAMERA, T_map_cameras=[LOOK], times_s=[])
