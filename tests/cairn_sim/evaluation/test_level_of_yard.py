"""The yard as a level against its truth: heights of the open ground, and an honest sigma."""

from tests.fixtures.sim.yard import mapped, scans_of_yard

from cairn_map.queries.map_snapshot import snapshot_of
from cairn_sim.evaluation.ground_truth import ground_errors
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene


def test_the_open_ground_is_known_to_two_centimetres_with_an_honest_sigma() -> None:
    scene = load_scene("yard")
    plan = Plan(scene=scene, robot=ROBOTS["lidar"], path="loop", truth="none", last_stop=12)
    ground = snapshot_of(mapped(plan, scans_of_yard(plan))).elevation()
    errors = ground_errors(scene, ground)
    assert len(errors.error_m) > 10_000
    assert errors.median_m <= 0.02
    assert errors.within_three >= 0.99
