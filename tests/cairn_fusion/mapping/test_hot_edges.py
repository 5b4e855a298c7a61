"""Hot things do not bleed on what is behind them, nor that on them: temperatures at edges are left out of the map."""

import math

import numpy as np
import pytest

from cairn_calib.rig.poses import look_at
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.mapping.sample_kernels import doubt_edges_into
from cairn_fusion.transfer.transfer import Label
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import geometry_for
from cairn_sim.evaluation.temperature_scores import (
    BEHIND_GLASS,
    IN_MIRROR,
    OTHERS,
    apparent_k,
    is_body,
    is_pipe,
    temperature_scores,
)
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, thermal_and_tof_head
from cairn_sim.scene.scene import scene_of
from cairn_sim.scene.solids import Box, Cylinder, Shape, Solid, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface


@pytest.mark.parametrize("count", [5, 60, 400])
@pytest.mark.parametrize("usual", [1, 2])
def test_doubted_points_are_those_with_a_step_around_them(usual: int, count: int) -> None:
    """With few points each looks around itself; with many all pixels do at once, for the usual reach."""
    rng = np.random.default_rng(count + usual)
    image = (290 + 3 * rng.random((12, 15))).astype(np.float32)
    image[4:7, 5:9], image[10, 2], image[0:5, 11:] = 310, np.nan, np.nan
    pixels = np.stack([rng.integers(0, 15, count), rng.integers(0, 12, count)]).astype(np.int32)
    labels, more_px = rng.choice([0, 0, 0, 1, 2], count).astype(np.uint8), rng.choice([0, 0, 1, 3, 20], count)
    expected = labels.copy()
    for n, (x, y) in enumerate(pixels.T.tolist()):
        # At least one pixel, at most 16.
        r = int(np.clip(usual - 1 + more_px[n], 1, 16))
        around = image[max(y - r, 0) : y + r + 1, max(x - r, 0) : x + r + 1]
        if labels[n] == Label.OK and not np.isnan(around).all() and np.nanmax(around) - np.nanmin(around) > 4.0:
            expected[n] = Label.UNCERTAIN
    range_m = rng.uniform(0.5, 5.0, count)
    # Half a pixel more, so that rounding decides nothing.
    sigma_m = (more_px + 0.25) * range_m**2 / 7.0
    doubt_edges_into(labels, pixels, range_m, sigma_m, usual - 0.75, 7.0, image, 4.0)
    np.testing.assert_array_equal(labels, expected)
    assert count == 5 or 0.05 < (labels == Label.UNCERTAIN).mean() < 0.6


def test_a_hot_pipe_before_a_wall_keeps_its_temperature_and_the_wall_its_own() -> None:
    def solid(name: str, shape: Box | Cylinder, at: tuple[float, float, float], celsius: float) -> Solid:
        return Solid(name, shape, Surface(Material(temperature_k=celsius + 273.15)), placed(at))

    wall = solid("wall", Box((0.2, 6, 4)), (2.1, 0, 0), 19.0)
    scene = scene_of([wall, solid("hot pipe", Cylinder(0.08, 3.0), (1.88, 0.1, 0), 65.0)])
    rig, geometry = thermal_and_tof_head(), geometry_for(voxel_edge_m=0.04)
    scans = [
        render_scan(
            scene,
            rig,
            T_map_rig=look_at((0.3 * n, 0.2 * n - 0.3, 0), (2, 0.1 * n, 0)),
            range_camera=RANGE_CAMERA,
            time_s=float(n),
            noise=Noise(1),
            number=n,
        )
        for n in range(3)
    ]
    found = {}
    groups = {"pipe": is_pipe, "wall": lambda name: name == "wall"}
    for step_k in (4.0, math.inf):
        diff = integrate_scans(scans, rig, geometry, integrator=Integrator(temperature_step_k=step_k))
        found[step_k] = temperature_scores(scene, diff, geometry, groups=groups)
    kept, all_of_them = found[4.0], found[math.inf]
    assert all_of_them["pipe"].p95_k > 5 and kept["pipe"].p95_k < 2.0 and kept["pipe"].median_k < 0.5
    assert kept["wall"].p95_k < 0.5
    assert (all_of_them["wall"].errors_k > 5).sum() > 20 * (kept["wall"].errors_k > 5).sum()
    assert kept["pipe"].known > 0.5 and all_of_them["pipe"].known > 0.9
    assert kept["all"].without + len(kept["all"].errors_k) == all_of_them["all"].without + len(
        all_of_them["all"].errors_k
    )


def test_what_stands_behind_glass_is_counted_by_itself() -> None:
    """A range camera looks through the pane, a thermal camera sees it: nothing in a scan says so."""
    cold = Surface(Material(temperature_k=290.0))
    glass = Surface(Material(temperature_k=290.0, optics=Optics.GLASS))
    pane = Solid("pane", Box((0.01, 1.0, 4)), glass, placed((1, -0.5, 0)))
    pipe = Solid("hot pipe", Box((0.2, 2.0, 0.3)), Surface(Material(temperature_k=330.0)), placed((1.9, 0, 0)))
    scene = scene_of([Solid("wall", Box((0.2, 6, 4)), cold, placed((2.1, 0, 0))), pane, pipe])
    rig, geometry, T = thermal_and_tof_head(), geometry_for(voxel_edge_m=0.04), look_at((0, 0, 0), (2, 0, 0))
    scan = render_scan(scene, rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=0.0)
    diff = integrate_scans([scan], rig, geometry, integrator=Integrator())
    found = temperature_scores(scene, diff, geometry, groups={"pipes": is_pipe}, eyes_m=[T[:3, 3]])
    behind, others = found[BEHIND_GLASS], found[OTHERS]
    assert behind.median_k > 20 and others.p95_k < 1.0
    assert len(behind.errors_k) > 50 < len(others.errors_k)
    assert len(behind.errors_k) + len(others.errors_k) == len(found["all"].errors_k)


def test_what_a_mirror_puts_on_a_thing_behind_it_is_counted_by_itself() -> None:
    """A mirror before a pipe shows the wall behind the camera just where the pipe is."""
    cold, warm = Surface(Material(temperature_k=290.0)), Surface(Material(temperature_k=330.0))
    mirror = Surface(Material(temperature_k=290.0, optics=Optics.MIRROR, reflectivity_nir=0.1))
    parts: list[tuple[str, Shape, tuple[float, float, float], Surface]] = [
        ("back", Box((0.2, 6, 4)), (0.1, 0, 0), cold),
        ("mirror", Box((0.02, 1.0, 4)), (1.01, -0.5, 0), mirror),
        ("hot pipe", Box((0.2, 2.0, 0.3)), (1.9, 0, 0), warm),
        ("wall", Box((0.2, 6, 4)), (2.1, 0, 0), cold),
    ]
    scene = scene_of([Solid(name, shape, surface, placed(at)) for name, shape, at, surface in parts])
    rig, geometry, T = thermal_and_tof_head(), geometry_for(voxel_edge_m=0.04), look_at((0.5, 0, 0), (2, 0, 0))
    scan = render_scan(scene, rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=0.0)
    diff = integrate_scans([scan], rig, geometry, integrator=Integrator())
    found = temperature_scores(scene, diff, geometry, groups={"pipes": is_pipe}, eyes_m=[T[:3, 3]])
    mirrored, others = found[IN_MIRROR], found[OTHERS]
    assert mirrored.median_k > 20 and others.p95_k < 1.0
    assert len(mirrored.errors_k) > 50 < len(others.errors_k)
    assert not len(found[BEHIND_GLASS].errors_k)


def test_bodies_and_pipes_are_known_by_name_and_bare_metal_mirrors() -> None:
    assert is_body("technician/leg left") and is_body("waiting person/hair") and not is_body("hot pipe")
    assert is_pipe("lab hot pipe") and is_pipe("bare riser") and not is_pipe("person in the corridor/head")
    metal = Surface(Material(temperature_k=333.15, emissivity=0.2))
    scene = scene_of([Solid("pipe", Box((1, 1, 1)), metal, placed((0, 0, 0)))])
    shown = apparent_k(scene, np.array([[0.5, 0.0, 0.0]]), np.zeros(1, np.int32))[0]
    assert scene.ambient_k < shown < scene.ambient_k + 0.35 * (333.15 - scene.ambient_k)


def test_limits_that_are_none_are_refused() -> None:
    for name in ("temperature_step_k", "hidden_behind_m"):
        with pytest.raises(BadInputError, match=name):
            Integrator(**{name: 0.0})
