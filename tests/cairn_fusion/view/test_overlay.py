"""The map over a live image: where it is, what hides it, how far it may be off, and that unknown is never cold.

`OVERLAY_POSES=1000` looks from as many places (30 otherwise).
"""

import os
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.worlds import map_of
from tests.naive import sight as naive_sight

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.image_fusion.surface import AMPLITUDE_MAX, live_range
from cairn_fusion.recording.scan import Scan
from cairn_fusion.view import overlay_kernels as kernels
from cairn_fusion.view.overlay import Live, OverlayMode, OverlayStyle, draw_overlay, with_overlay_legend
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.render.camera_rays import CameraRays, look_at, pinhole
from cairn_map.render.map_picture import Ages
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.pose_spread import PoseSpread, motions
from cairn_map.render.render_picture import NO_VALUE, SCALES, Layer, palette
from cairn_sim.evaluation.overlay_scores import overlay_scores

POSES = int(os.environ.get("OVERLAY_POSES", "30"))
EDGE_M = 0.05
GRID = Geometry(voxel_edge_um=50_000, depth=5, channels=(TEMPERATURE,))
DISTORTED = Camera(
    width=160, height=120, focal_px=(130.0, 131.0), centre_px=(78.0, 61.0), distortion=(-0.25, 0.08, 0.002, -0.001, 0.0)
)
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
HOT_K = 330.0


def snapshot_with(voxels: dict[tuple[int, int, int], tuple[int, int]], *, kelvin: float | None = None) -> MapSnapshot:
    """A map of these voxels, the occupied ones with a temperature, or all without."""
    whole = map_of(GRID, voxels)
    if kelvin is None:
        return snapshot_of(whole)
    step = int(TEMPERATURE.quantise(np.array([kelvin]))[0])
    for key, evidence in whole.packed().items():
        warm = evidence.counts[:, 0] > 0
        samples = np.where(warm[:, None], np.array([[step, step**2, 1]]), 0)
        whole.replace(key, packed_evidence(evidence.voxels, evidence.counts, samples, GRID))
    return snapshot_of(whole)


def box(
    low: tuple[int, int, int], high: tuple[int, int, int], counts: tuple[int, int] = (3, 0)
) -> dict[tuple[int, int, int], tuple[int, int]]:
    spans = [range(a, b) for a, b in zip(low, high, strict=True)]
    return {(x, y, z): counts for x in spans[0] for y in spans[1] for z in spans[2]}


def image_of(sight: CameraRays, grey: int = 100) -> npt.NDArray[np.uint8]:
    return np.full((sight.height, sight.width, 3), grey, np.uint8)


def no_depth(sight: CameraRays) -> npt.NDArray[np.float32]:
    return np.full((sight.height, sight.width), np.nan, np.float32)


@pytest.mark.parametrize("seed", range(POSES))
def test_what_is_drawn_covers_the_projection_of_its_cubes_through_a_lens(seed: int) -> None:
    (score,) = overlay_scores(DISTORTED, poses=1, seed=seed, style=OverlayStyle(step_px=1))
    assert score.expected_px > 1000
    assert score.visible >= 0.98 and score.map_only >= 0.98


@pytest.mark.parametrize("seed", range(POSES))
def test_what_the_map_alone_has_is_outlined_to_the_pixel_though_looked_up_by_blocks(seed: int) -> None:
    (score,) = overlay_scores(DISTORTED, poses=1, seed=seed)
    assert score.map_only >= 0.98


def test_inside_an_outline_the_middle_of_each_block_is_looked_up() -> None:
    """So that what is shown there is off by at most half a block, and to no side more than to the other."""
    snapshot, sight = snapshot_with(box((20, -5, -5), (22, 5, 5)), kelvin=HOT_K), pinhole(80, 61, focal_px=100)
    live = Live(rgb=image_of(sight), range_m=no_depth(sight), sight=sight, T_map_camera=look_at((0, 0, 0), (1, 0, 0)))
    fine, coarse = (draw_overlay(MapRenderer(), snapshot, live, OverlayStyle(step_px=step)) for step in (1, 3))
    np.testing.assert_array_equal(coarse.front_modes, fine.front_modes)
    np.testing.assert_array_equal(coarse.picture, fine.picture)
    is_alone = fine.front_modes == OverlayMode.MAP_ONLY
    assert 0 < (coarse.front.hit & is_alone).sum() < is_alone.sum() / 2
    rows, columns = (np.minimum(np.arange(size) // 3 * 3 + 1, size - 1) for size in is_alone.shape)
    middles = fine.rest.range_m[np.ix_(rows, columns)]
    np.testing.assert_array_equal(coarse.rest.range_m, middles[::3, ::3])


def test_an_outline_fades_with_age_as_the_inside_does() -> None:
    snapshot, sight = snapshot_with(box((20, -5, -5), (22, 5, 5)), kelvin=HOT_K), pinhole(80, 61, focal_px=100)
    live = Live(rgb=image_of(sight), range_m=no_depth(sight), sight=sight, T_map_camera=look_at((0, 0, 0), (1, 0, 0)))
    cells = {key: np.zeros(8 ** (GRID.depth - 2)) for key in snapshot.frozen.keys}
    now, later = (
        draw_overlay(MapRenderer(), snapshot, live, OverlayStyle(), Ages(now=now, changes=cells)).picture
        for now in (0.0, 3600.0)
    )
    changed = (now != later).any(axis=-1)
    shown = (now != live.rgb).any(axis=-1)
    assert (changed == shown).mean() > 0.99 and shown.any()


def test_what_is_hidden_is_never_drawn_as_visible() -> None:
    """From random places, with things in the way that the map does not know, and things in the map that are gone."""
    mapped = box((-12, -8, -8), (-11, 8, 8)) | box((-2, -2, -2), (2, 2, 2)) | box((6, -8, -8), (8, -2, 0))
    gone = box((-6, 3, -3), (-4, 6, 3))
    unknown = box((3, -1, -3), (5, 3, 3)) | box((-8, -8, -2), (-6, -4, 4))
    snapshot, renderer = snapshot_with(mapped | gone, kelvin=HOT_K), MapRenderer()
    in_map, there = np.array([*mapped, *gone]), np.array([*mapped, *unknown])
    rng, sight, style = (
        np.random.default_rng(11),
        pinhole(12, 8, focal_px=10),
        OverlayStyle(tolerance_m=0.06, step_px=1),
    )
    object.__setattr__(sight, "pixel_rad", 1e-4)  # voxels, no nodes
    counted = np.zeros(4, np.int64)
    for _ in range(POSES):
        eye = rng.normal(size=3)
        T = look_at((eye / np.linalg.norm(eye) * rng.uniform(0.9, 2)).tolist(), rng.uniform(-0.4, 0.4, 3).tolist())
        origin = np.rint(T[:3, 3] * 1e9) / 50_000_000
        rays = sight.rays.reshape(-1, 3) @ T[:3, :3].T
        live = np.array([naive_sight.first_cut(origin, ray, there, 0, 400)[0] for ray in rays]) * EDGE_M
        live_m = live.reshape(8, 12).astype(np.float32)
        drawn = draw_overlay(
            renderer, snapshot, Live(rgb=image_of(sight), range_m=live_m, sight=sight, T_map_camera=T), style
        )
        for ray, range_m, mode in zip(rays, live_m.ravel(), drawn.front_modes.ravel(), strict=True):
            if np.isnan(range_m):
                row = naive_sight.first_cut(origin, ray, in_map, 0, 400)[1]
                assert mode == (OverlayMode.MAP_ONLY if row >= 0 else OverlayMode.NOTHING)
                continue
            start = max(float(np.float32(range_m - np.float32(0.06))), 0) / EDGE_M
            end = float(np.float32(range_m + np.float32(0.06))) / EDGE_M
            agrees = naive_sight.first_cut(origin, ray, in_map, start, end)[1] >= 0
            assert mode == (OverlayMode.VISIBLE if agrees else OverlayMode.NOTHING)
        counted += np.bincount(drawn.modes.ravel(), minlength=4)
    assert counted[OverlayMode.VISIBLE] > 5 * POSES
    assert counted[OverlayMode.NOTHING] > POSES
    assert counted[OverlayMode.MAP_ONLY] > 0


def test_a_thing_behind_a_wall_shines_through_it_in_stripes() -> None:
    wall, room = box((20, -16, -16), (22, 16, 16)), box((22, -16, -16), (40, 16, 16), (0, 3))
    thing = box((32, -3, -3), (36, 3, 3))
    snapshot, sight = snapshot_with(wall | room | thing, kelvin=HOT_K), pinhole(80, 60, focal_px=80)
    T = look_at((0, 0, 0), (1, 0, 0))
    live = Live(rgb=image_of(sight), range_m=(1 / sight.rays[..., 2]).astype(np.float32), sight=sight, T_map_camera=T)
    drawn = draw_overlay(MapRenderer(), snapshot, live, OverlayStyle())
    assert (drawn.front_modes == OverlayMode.VISIBLE).mean() > 0.9
    middle, edge = (30, 40), (5, 5)
    assert drawn.through[middle]
    assert not drawn.through[edge]
    assert drawn.rest.depth_m[10, 13] == pytest.approx(1.6, abs=0.01)
    stripes = np.add.outer(np.arange(26, 34), np.arange(36, 44)) % kernels.STRIPES_PX < kernels.STRIPE_PX
    part = drawn.picture[26:34, 36:44].astype(int)
    assert (part[stripes] == part[stripes][0]).all()
    assert (part[~stripes] == part[~stripes][0]).all()
    assert (part[stripes][0] != part[~stripes][0]).any()
    # Fainter when it is old, and not at all where nothing is known of its age.
    key_of = {key: np.full(8**3, 0.0) for key in snapshot.frozen.keys}
    old = draw_overlay(MapRenderer(), snapshot, live, OverlayStyle(), Ages(key_of, now=7200.0))
    fresh = draw_overlay(MapRenderer(), snapshot, live, OverlayStyle(), Ages({}, now=7200.0))
    hot = palette(Layer.TEMPERATURE)[-1].astype(int)
    off = [int(np.abs(d.picture[26:34, 36:44][stripes][0] - hot).sum()) for d in (drawn, fresh, old)]
    assert off[0] == off[1] < off[2]


@pytest.mark.parametrize("kelvin", [None, HOT_K, 200.0])
def test_no_temperature_is_grey_and_never_cold(kelvin: float | None) -> None:
    snapshot, sight = snapshot_with(box((20, -16, -16), (22, 16, 16)), kelvin=kelvin), pinhole(40, 30, focal_px=60)
    T, live_m = look_at((0, 0, 0), (1, 0, 0)), (1 / pinhole(40, 30, focal_px=60).rays[..., 2]).astype(np.float32)
    live = Live(rgb=image_of(sight, NO_VALUE[0]), range_m=live_m, sight=sight, T_map_camera=T)
    picture = draw_overlay(MapRenderer(), snapshot, live, OverlayStyle()).picture.astype(int)
    ends = palette(Layer.TEMPERATURE).astype(int)
    mixed = {None: np.array(NO_VALUE), HOT_K: ends[-1], 200.0: ends[0]}[kelvin]
    expected = mixed if kelvin is None else mixed * kernels.VISIBLE_COVER + NO_VALUE[0] * (1 - kernels.VISIBLE_COVER)
    assert np.abs(picture - expected).max() <= 1.5
    assert with_overlay_legend(picture.astype(np.uint8), SCALES[Layer.TEMPERATURE]).shape[0] > 30


def test_an_error_of_the_pose_moves_the_overlay_as_far_as_predicted() -> None:
    """1 degree and 2 cm, about and along random axes, of plates seen from random places through a lens."""
    rng, renderer, snapshot = np.random.default_rng(5), MapRenderer(), snapshot_with(box((-1, -3, -3), (0, 3, 3)))
    sight, off, moves = CameraRays(DISTORTED.rays()), [], []
    for _ in range(POSES):
        eye = rng.normal(size=3) * np.array([0.1, 0.4, 0.4]) + np.array([-2.0, 0, 0])
        T = look_at(eye.tolist(), rng.uniform(-0.05, 0.05, 3).tolist())
        # Not upright, so that no edge of the plate lies along a row.
        T = T @ transform_from_vector(np.array([0, 0, rng.uniform(0.2, 1.3), 0, 0, 0]))
        turn, step = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
        motion = np.concatenate([np.radians(1) * turn, 0.02 * step])
        seen = renderer.nearest(snapshot, sight, T, range_max_m=5)
        again = renderer.nearest(snapshot, sight, T @ transform_from_vector(motion), range_max_m=5)
        before, after = (np.argwhere(each.hit).mean(axis=0)[::-1] for each in (seen, again))
        predicted = np.nanmean((motions(sight, seen.range_m) @ motion)[seen.hit], axis=0)
        off.append(after - before - predicted)
        moves.append(np.linalg.norm(predicted))
    assert np.median(moves) > 1.5
    # Of whole pixels, and of a plate that has sides: at most half of one, of 1 000.
    assert np.abs(off).max() < 0.7
    assert np.sqrt(np.square(off).mean()) < 0.1


def test_what_is_behind_is_in_stripes_however_uncertain_the_pose_is() -> None:
    """A hot thing behind a wall must not look like a hot place on the wall."""
    wall, room = box((20, -16, -16), (22, 16, 16)), box((22, -16, -16), (40, 16, 16), (0, 3))
    snapshot = snapshot_with(wall | room | box((32, -3, -3), (36, 3, 3)), kelvin=HOT_K)
    sight, T = pinhole(80, 60, focal_px=80), look_at((0, 0, 0), (1, 0, 0))
    wall_m = (1 / sight.rays[..., 2]).astype(np.float32)
    wall_m[:, 60:] = np.nan
    sharp, blurred = (
        draw_overlay(
            MapRenderer(),
            snapshot,
            Live(rgb=image_of(sight), range_m=wall_m, sight=sight, T_map_camera=T, spread=spread),
            OverlayStyle(),
        )
        for spread in (PoseSpread.of_sigmas(), PoseSpread.of_sigmas(0.02, 0.02))
    )
    stripes = np.add.outer(np.arange(60), np.arange(80)) % kernels.STRIPES_PX < kernels.STRIPE_PX
    middle = np.zeros_like(stripes)
    middle[26:34, 36:44] = True
    pictures = [each.picture.astype(int) for each in (sharp, blurred)]
    steps = [np.abs(p[middle & stripes].mean(axis=0) - p[middle & ~stripes].mean(axis=0)).sum() for p in pictures]
    assert steps[1] > 0.3 * steps[0] > 10
    # Where nothing is behind it the wall is as even as it was; where there is no live depth there are dots.
    assert pictures[1][25:35, 8:18].std(axis=(0, 1)).max() < 3
    assert (pictures[1][28:32, 64:68].reshape(-1, 3).std(axis=0) > 5).any()
    assert np.abs(pictures[0] - pictures[1]).max() > 20


def test_a_pose_that_is_too_uncertain_withholds_the_map_and_says_why() -> None:
    snapshot, sight = snapshot_with(box((20, -16, -16), (22, 16, 16)), kelvin=HOT_K), pinhole(320, 40, focal_px=200)
    shown = {
        "range_m": (1 / sight.rays[..., 2]).astype(np.float32),
        "sight": sight,
        "T_map_camera": look_at((0, 0, 0), (1, 0, 0)),
    }
    for spread, is_drawn in (
        (PoseSpread.of_sigmas(0.02, 0.01), True),
        (PoseSpread.of_sigmas(0.5, 0.0), False),
        (PoseSpread.of_sigmas(0, 0.1), False),
    ):
        live = Live(rgb=image_of(sight), spread=spread, **shown)  # type: ignore[arg-type]
        drawn = draw_overlay(MapRenderer(), snapshot, live, OverlayStyle())
        assert (drawn.withheld is None) == is_drawn
        assert (drawn.picture[30, 160] != 100).any() == is_drawn
        assert is_drawn or "uncertain" in str(drawn.withheld)


def test_the_other_cameras_depth_is_that_of_the_surface() -> None:
    """A plane before a rig whose colour camera is finer and stands aside."""
    tof = Camera(width=88, height=72, focal_px=(90.0, 90.0), centre_px=(43.5, 35.5))
    T = np.eye(4)
    T[0, 3] = 0.08
    rig = Rig(
        name="two",
        cameras={
            "tof": mount_camera(Spectrum.RANGE, tof, np.eye(4)),
            "colour": mount_camera(Spectrum.COLOUR, DISTORTED, T),
        },
    )
    wall_m = 2.0
    range_m = (wall_m / tof.rays()[..., 2]).astype(np.float32)
    range_m[:20, :30] = np.nan
    scan = Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=range_m)
    found, true = live_range(scan, rig, camera="colour"), wall_m / DISTORTED.rays()[..., 2]
    known = ~np.isnan(found)
    assert 0.5 < known.mean() < 0.95
    assert np.abs(found - true)[known].max() < 0.05
    assert np.isnan(found[10, 20])
    assert live_range(scan, rig, camera="tof") is not None
    # Neither where too much light came back, nor where a pixel is of two surfaces at once.
    amplitude, mixed_m = np.full(range_m.shape, 1000, np.uint16), range_m.copy()
    amplitude[40:60, 40:60] = AMPLITUDE_MAX
    mixed_m[:, 70], mixed_m[:, 71:] = 1.5, 1.0
    for name in ("tof", "colour"):
        less = live_range(replace(scan, amplitude=amplitude, range_m=mixed_m), rig, camera=name)
        with_all = live_range(replace(scan, range_m=np.where(mixed_m == 1.5, np.nan, mixed_m)), rig, camera=name)
        lost = np.isnan(less) & ~np.isnan(with_all)
        assert lost.any() and (np.isnan(less) | (less == with_all)).mean() > 0.99
        assert not (np.abs(less - 1.5) < 0.1).any()


def test_ink_is_what_the_modes_say() -> None:
    rng = np.random.default_rng(3)
    front, rest = (rng.integers(0, 256, (*size, 3)).astype(np.uint8) for size in ((12, 17), (6, 9)))
    modes = rng.choice([OverlayMode.NOTHING, OverlayMode.VISIBLE, OverlayMode.MAP_ONLY], (12, 17)).astype(np.uint8)
    rest_modes = rng.choice([OverlayMode.NOTHING, OverlayMode.SEE_THROUGH, OverlayMode.MAP_ONLY], (6, 9)).astype(
        np.uint8
    )
    covers, rest_covers = (rng.random(size).astype(np.float32) for size in ((12, 17), (6, 9)))
    covers[rng.random(covers.shape) < 0.5] = 0
    ink = np.empty((12, 17, 4), np.uint8)
    kernels.ink_into(front, covers, modes, rest, rest_covers, rest_modes, 2, ink)
    for y in range(12):
        for x in range(17):
            is_dot = x % kernels.DOTS_PX < kernels.DOT_PX and y % kernels.DOTS_PX < kernels.DOT_PX
            there = y // 2, x // 2
            cover, colour = 0.0, front[y, x]
            if rest_modes[there] == OverlayMode.SEE_THROUGH and (x + y) % kernels.STRIPES_PX < kernels.STRIPE_PX:
                cover, colour = rest_covers[there], rest[there]
            elif modes[y, x] == OverlayMode.MAP_ONLY:
                cover, colour = (covers[y, x], front[y, x]) if covers[y, x] else (rest_covers[there], rest[there])
                cover *= kernels.DOT_COVER if is_dot else kernels.BETWEEN_COVER
            elif modes[y, x] == OverlayMode.VISIBLE:
                cover = covers[y, x] * kernels.VISIBLE_COVER
            assert np.abs(ink[y, x] - np.array([*(colour * cover), 255 * cover])).max() <= 0.51


def test_images_of_another_size_are_refused() -> None:
    sight = pinhole(40, 30, focal_px=60)
    with pytest.raises(BadInputError) as caught:
        Live(rgb=image_of(sight)[1:], range_m=no_depth(sight), sight=sight, T_map_camera=np.eye(4))
    assert caught.value.kind == "image_size"
