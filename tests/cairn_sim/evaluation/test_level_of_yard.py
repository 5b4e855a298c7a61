"""The yard as a level against its truth: the open ground, what is below things, and an honest sigma."""

import io

import numpy as np
import pytest
from rich.console import Console
from tests.fixtures.sim.yard import mapped, scans_of_yard

from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.queries.level.elevation import Elevation
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_sim.demo.yard import BELOW, GRASS, LASTS_S, OPEN, SCENE, require_true_ground
from cairn_sim.evaluation.ground_truth import ground_errors, ground_errors_below
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import load_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENE)


@pytest.fixture(scope="module")
def ground(scene: Scene) -> Elevation:
    """As a lidar on its way round the yard with the bridge sees it."""
    plan = Plan(scene=scene, robot=ROBOTS["lidar"], path="round", truth="none", lasts_s=LASTS_S)
    return snapshot_of(mapped(plan, scans_of_yard(plan))).elevation()


def test_the_open_ground_is_known_to_two_centimetres_with_an_honest_sigma(scene: Scene, ground: Elevation) -> None:
    errors = ground_errors(scene.at(CLOCK_START_S + LASTS_S), ground, without=(GRASS,))
    assert len(errors.error_m) > 10_000
    assert errors.median_m <= 0.02
    assert errors.within_three >= 0.99
    assert OPEN.is_kept(errors)


@pytest.mark.parametrize("name", BELOW)
def test_the_ground_is_known_below_a_bridge_in_grass_and_where_a_person_stood(
    scene: Scene, ground: Elevation, name: str
) -> None:
    errors = ground_errors_below(scene, ground, name)
    assert errors.largest_m <= 0.12
    assert BELOW[name].is_kept(errors)


def test_errors_are_those_of_the_heights(scene: Scene, ground: Elevation) -> None:
    known = np.isfinite(ground.height_m)
    lifted = Elevation(
        **{name: getattr(ground, name) for name in Elevation.__slots__ if name != "height_m"},
        height_m=ground.height_m + 0.5,
    )
    for name in BELOW:
        true, higher = (ground_errors_below(scene, each, name).error_m for each in (ground, lifted))
        np.testing.assert_allclose(higher - true, 0.5)
    assert len(ground_errors(scene, lifted).error_m) <= known.sum()
    require_true_ground(scene, ground, Console(file=io.StringIO()))
    with pytest.raises(DamagedDataError, match="open ground: expected"):
        require_true_ground(scene, lifted, Console(file=io.StringIO()))


def test_a_thing_that_is_not_there_is_refused(scene: Scene, ground: Elevation) -> None:
    with pytest.raises(BadInputError, match="no solid named 'drawbridge'"):
        ground_errors_below(scene, ground, "drawbridge")
