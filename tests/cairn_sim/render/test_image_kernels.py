"""The image kernels against their slow twins, on the shipped scenes and on ugly input; and what light obeys."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from tests.naive.images import (
    naive_colours,
    naive_edge_pixels,
    naive_finer_rays,
    naive_returns,
    naive_surface_values,
    naive_wave,
)

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.poses import Transform, look_at
from cairn_map.arrays import Floats
from cairn_sim.render.image_kernels import (
    bloomed,
    colours,
    edge_pixels,
    finer_rays,
    mixed_waves,
    returns,
    surface_values,
)
from cairn_sim.render.raycast_kernels import Hits
from cairn_sim.render.rays import cast_directions, tiles
from cairn_sim.render.render import AMBIENT, LIGHT, render_scan
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, tof_head
from cairn_sim.robots.trajectories import path_names, stops
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.scene_file import SHIPPED, load_scene
from cairn_sim.scene.solids import Box, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface

SKY = np.array([10, 200, 30], np.float32)
PANES = "panes and mirrors"
SCENES = (*SHIPPED, PANES)
WRAP_M = 10.0


@dataclass(frozen=True)
class Look:
    """A small image of a scene; some of its pixels may have no ray."""

    scene: Scene
    camera: Camera
    rays: Floats
    hits: Hits


def panes_and_mirrors() -> Scene:
    """A shell of panes and mirrors of two materials around the origin, balls behind it, and gaps into nothing."""
    rng = np.random.default_rng(4)
    solids = []
    for n in range(60):
        optics = (Optics.GLASS, Optics.MIRROR, Optics.OPAQUE)[n % 3]
        one, two = (
            Material(
                (int(rng.integers(256)), int(rng.integers(256)), int(rng.integers(256))),
                rng.uniform(250, 350),
                gloss_nir=rng.uniform(),
                retroreflection=rng.choice([1, 300]),
                optics=optics,
            )
            for _ in range(2)
        )
        out = rng.standard_normal(3)
        at = out / np.linalg.norm(out) * (2 + n % 3)
        shape = Sphere(0.6) if optics is Optics.OPAQUE else Box((1.2, 1.2, 0.05))
        surface = Surface(one, two, (0.3, 0.2), grain=0.5)
        solids.append(Solid(f"solid {n}", shape, surface, placed(tuple(at), tuple(rng.uniform(-3, 3, 3)))))
    return scene_of(solids)


def eye(scene: Scene, rng: np.random.Generator) -> Transform:
    """Somewhere along a path, looking anywhere."""
    at = np.zeros(3)
    if scene.name in SHIPPED:
        standing = stops(scene, str(rng.choice(path_names(scene.name))))
        at = standing[rng.integers(len(standing))][:3, 3] + [0, 0, 1.0]
    return look_at(at, at + rng.standard_normal(3))


@cache
def look(name: str, seed: int, *, opaque: bool = False, blind: float = 0.0, size: tuple[int, int] = (48, 36)) -> Look:
    """A random look at a scene by an image of which a share is blind."""
    rng = np.random.default_rng(seed)
    scene = panes_and_mirrors() if name == PANES else load_scene(name)
    camera = camera_from_field_of_view(*size, horizontal_deg=80.0)
    rays = camera.rays().copy()
    rays[rng.random(rays.shape[:2]) < blind] = np.nan
    hits = cast_directions(scene, rays.reshape(-1, 3), eye(scene, rng), bundle=8, opaque=opaque)
    return Look(scene, camera, rays, hits)


def ugly(one: Look, seed: int) -> Hits:
    """Hits as no scene gives them: seen from behind, edge-on, through too many panes, without an incidence."""
    rng, n = np.random.default_rng(seed), len(one.hits.seen)
    return one.hits._replace(
        seen=rng.integers(-1, len(one.scene.solids), n).astype(np.int32),
        second=rng.integers(0, 2, n).astype(np.uint8),
        path_m=rng.uniform(1e-3, 200, n),
        incidence=rng.choice([-1, -0.5, -0.0, 0, 1e-30, 0.019999, 0.02, 0.5, 1], n).astype(np.float32),
        passes=rng.integers(0, 10, n).astype(np.uint8),
        way=rng.integers(0, 4, n).astype(np.uint8),
    )


def all_hits(name: str) -> list[tuple[Look, Hits]]:
    """Looks at a scene with all that may happen: as it is, in the far infrared, half blind, and ugly."""
    clear = [look(name, seed) for seed in range(6)]
    others = [look(name, 7, opaque=True), look(name, 8, blind=0.5), look(name, 9, size=(1, 1))]
    return [*((one, one.hits) for one in (*clear, *others)), *((one, ugly(one, 1)) for one in (clear[0], others[0]))]


@pytest.mark.slow
def test_the_looks_show_all_that_may_happen() -> None:
    ways = {name: {int(w) for one, _ in all_hits(name)[:6] for w in one.hits.way} for name in SCENES}
    assert ways[PANES] == {0, 1, 2, 3} and 1 in ways["building"]
    nothing = [name for name in SCENES if any((one.hits.seen < 0).any() for one, _ in all_hits(name)[:6])]
    assert nothing == ["yard", "moving-yard", "bridge-yard", PANES]


@pytest.mark.parametrize("name", SCENES)
def test_edge_pixels_are_those_of_the_slow_twin_in_the_order_given(name: str) -> None:
    for one, hits in all_hits(name):
        width, height = one.camera.width, one.camera.height
        for order in (tiles(width, height)[0], np.arange(width * height, dtype=np.int32)[::-1], np.zeros(0, np.int32)):
            got = edge_pixels(hits, width, height, order)
            assert got.dtype == np.int64 and got.tolist() == naive_edge_pixels(hits, width, height, order)


def test_an_image_of_one_pixel_and_one_of_an_even_wall_have_no_edges() -> None:
    assert len(edge_pixels(look("yard", 3, size=(1, 1)).hits, 1, 1, np.zeros(1, np.int32))) == 0
    one = look("small-room", 1)
    hits = Hits._make(np.broadcast_to(field[:1], field.shape).copy() for field in one.hits)
    assert len(edge_pixels(hits, 48, 36, tiles(48, 36)[0])) == 0


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_finer_rays_are_those_of_the_slow_twin_beside_pixels_without_a_ray_too(n: int) -> None:
    for one in (look("building", 1), look("building", 8, blind=0.5), look("yard", 3, size=(1, 1))):
        pixels = np.random.default_rng(n).permutation(one.camera.width * one.camera.height)[:400]
        got = finer_rays(one.rays, pixels, n)
        np.testing.assert_allclose(got, naive_finer_rays(one.rays, pixels, n), rtol=0, atol=1e-14)
        assert finer_rays(one.rays, pixels[:0], n).shape == (0, 3)
    for line in (one.rays[:1], one.rays[:, :1]):
        np.testing.assert_allclose(finer_rays(line, np.zeros(1, np.int64), n), naive_finer_rays(line, np.array([0]), n))


@pytest.mark.parametrize("n", [2, 3, 4])
def test_finer_rays_divide_a_pixel_evenly_and_no_two_share_a_row_or_a_column(n: int) -> None:
    camera = camera_from_field_of_view(5, 5, horizontal_deg=1.0)
    pixels = camera.project(finer_rays(camera.rays(), np.array([12]), n)) - camera.project(camera.rays()[2, 2])
    even = (np.arange(n * n) + 0.5) / (n * n) - 0.5
    for axis in (0, 1):
        np.testing.assert_allclose(np.sort(pixels[:, axis]), even, atol=1e-4)
    places = np.floor((pixels + 0.5) * n).astype(int)
    assert len({tuple(place) for place in places.tolist()}) == n * n


@pytest.mark.parametrize("name", SCENES)
def test_colours_are_those_of_the_slow_twin(name: str) -> None:
    for one, hits in all_hits(name):
        srgb, grains = one.scene.surfaces.colours_srgb, one.scene.shapes.texture[:, 4].copy()
        got = colours(hits, srgb, grains, SKY, LIGHT, AMBIENT)
        assert got.dtype == np.float32
        np.testing.assert_allclose(
            got, naive_colours(hits, srgb, grains, SKY, LIGHT, AMBIENT), rtol=1e-6, atol=1e-5, equal_nan=False
        )


@pytest.mark.parametrize("name", SCENES)
def test_surface_values_are_those_of_the_slow_twin(name: str) -> None:
    values = np.random.default_rng(1).uniform(0, 1e5, (1000, 2)).astype(np.float32)
    for one, hits in all_hits(name):
        own = values[: len(one.scene.solids)].copy()
        np.testing.assert_array_equal(surface_values(hits, own, 7.0), naive_surface_values(hits, own, 7.0))
        assert np.isnan(surface_values(hits, own, np.nan)).sum() == (hits.seen < 0).sum()


@pytest.mark.parametrize("name", SCENES)
def test_returned_light_is_that_of_the_slow_twin(name: str) -> None:
    for one, hits in all_hits(name):
        s = one.scene.surfaces
        got = returns(hits, s.reflectivity_nir, s.gloss_nir, s.retroreflection)
        assert got.dtype == np.float32 and got[hits.seen < 0].sum() == 0
        np.testing.assert_allclose(
            got, naive_returns(hits, s.reflectivity_nir, s.gloss_nir, s.retroreflection), rtol=2e-6, atol=1e-30
        )


@pytest.mark.parametrize("n", [1, 4, 16])
def test_mixed_waves_are_the_sum_of_the_slow_twins(n: int) -> None:
    rng = np.random.default_rng(n)
    path_m, strength = rng.uniform(0, 35, 500 * n), rng.uniform(0, 1e4, 500 * n).astype(np.float32)
    dark = rng.random(500 * n) < 0.3
    path_m[dark], strength[dark] = np.inf, 0
    strength[: 5 * n] = 0
    range_m, total = mixed_waves(path_m, strength, n, WRAP_M)
    wave = naive_wave(path_m, strength, n, WRAP_M)
    lit = np.abs(wave) > 0
    assert not lit[:5].any() and np.isinf(range_m[~lit]).all() and not total[~lit].any()
    assert ((range_m[lit] >= 0) & (range_m[lit] <= WRAP_M)).all()
    got = total[lit] * np.exp(2j * np.pi * range_m[lit] / WRAP_M)
    np.testing.assert_allclose(got, wave[lit], rtol=1e-6, atol=1e-2)


def test_waves_of_one_length_keep_it_and_opposite_ones_of_equal_strength_leave_little() -> None:
    strength = np.full(4, 2.0, np.float32)
    range_m, total = mixed_waves(np.full(4, 3.25), strength, 4, WRAP_M)
    assert (range_m[0], total[0]) == (pytest.approx(3.25), pytest.approx(2.0))
    _, total = mixed_waves(np.array([1.0, 6.0, 2.0, 7.0]), strength, 4, WRAP_M)
    assert total[0] < 1e-6


def test_no_pixels_give_no_waves() -> None:
    none, dark = np.zeros(0), np.zeros(0, np.float32)
    assert [len(a) for a in mixed_waves(none, dark, 16, WRAP_M)] == [0, 0]
    assert [len(a) for a in bloomed(none, dark, dark, 1, WRAP_M)] == [0, 0]


def test_a_single_full_pixel_keeps_what_it_has() -> None:
    range_m, strength = bloomed(np.array([2.0]), np.array([9.0], np.float32), np.array([5.0], np.float32), 1, WRAP_M)
    assert (range_m[0], strength[0]) == (2.0, 9.0)


def facing(normal: Floats, surface: Surface) -> Scene:
    """A wall across a line of sight along minus its normal, 2 m from the origin."""
    T = look_at((0, 0, 0), -normal)
    T[:3, 3] = -2.5 * normal
    return scene_of([Solid("wall", Box((500, 500, 1)), surface, T)])


def test_a_wall_is_brighter_the_more_it_faces_the_light() -> None:
    rig, grey = full_head(scale=0.05, ideal=True), Surface(Material((100, 100, 100)))
    rng = np.random.default_rng(2)
    across = np.cross(LIGHT, rng.standard_normal(3))
    across /= np.linalg.norm(across)
    levels = []
    for angle_rad in np.linspace(0, np.pi, 7):
        normal = np.cos(angle_rad) * LIGHT + np.sin(angle_rad) * across
        T = look_at((0, 0, 0), -normal)
        scan = render_scan(facing(normal, grey), rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=0.0)
        assert np.ptp(scan.colour["colour_left"]) <= 1
        levels.append(float(scan.colour["colour_left"].mean()))
    assert np.diff(levels).max() < -1
    np.testing.assert_allclose(levels, 100 * (AMBIENT + (1 - AMBIENT) * np.cos(np.linspace(0, np.pi, 7))), atol=0.6)


def test_gloss_shows_head_on_alone() -> None:
    matt = Material(reflectivity_nir=0.4)
    rig = tof_head(ideal=True)

    def amplitude(gloss: float, aim: Floats) -> Floats:
        scene = facing(np.array([-1.0, 0, 0]), Surface(replace(matt, gloss_nir=gloss)))
        scan = render_scan(scene, rig, T_map_rig=look_at((0, 0, 0), aim), range_camera=RANGE_CAMERA, time_s=0.0)
        assert scan.amplitude is not None
        return scan.amplitude.astype(np.float64)

    ahead, aside = np.array([1.0, 0, 0]), np.array([0.5, 0.8660, 0])
    gain = amplitude(0.4, ahead) - amplitude(0.0, ahead)
    middle = gain[71:73, 87:89].mean()
    assert middle == pytest.approx(0.4 * 20_000 / 2**2, rel=0.01)
    # A pixel is 0.45 degrees wide: half of it is left 9 degrees aside, nothing at the image's corner.
    assert gain[72, 88 + 20] == pytest.approx(middle / 2, rel=0.1)
    assert gain[0, 0] <= 1
    half = amplitude(0.4, aside)[72, 88:] - amplitude(0.0, aside)[72, 88:]
    assert np.abs(half[:40]).max() <= 1
