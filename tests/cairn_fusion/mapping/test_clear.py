"""Certainly clear lengths of beams: the kernel against its slow twin; noise, slant, edges and silence."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.body import Body, BodyBox
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import RangeSensing, Rig, Spectrum, mount_camera
from cairn_fusion.mapping.clear_kernels import (
    BRIDGE_STEP_M,
    EDGE_STEP_M,
    GAP_PX,
    GRAZING_MAX,
    GRAZING_SHARE,
    SLANT_SHARE,
    bridge_gaps_into,
    classify_ranges_into,
    interpolated,
    nearest_around,
    shown_in_window,
    stay_before_into,
)
from cairn_fusion.mapping.integrate import Integration, Integrator, Method, integrate_scan
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.channels import INTENSITY
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, centres_of_voxels, voxels_in_cell

EDGE_M = 0.05
GEOMETRY = Geometry(voxel_edge_um=50_000, depth=4, channels=(INTENSITY,))
CAMERA = Camera(width=40, height=30, focal_px=(60.0, 60.0), centre_px=(19.5, 14.5))
LIDAR = SpinningLidar(width=180, height=4, elevations_deg=(6.0, 2.0, -2.0, -6.0))
LIMITS = Integrator(min_range_m=0.1, max_range_m=5.0)
AHEAD = look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
"""Looks along the map's x."""

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Singles = npt.NDArray[np.float32]
Diff = dict[CellKey, Evidence]


def rig_of(camera: Camera | SpinningLidar = CAMERA, body: Body | None = None, **sensing: object) -> Rig:
    tof = mount_camera(Spectrum.RANGE, camera, np.eye(4))
    return Rig(
        name="eye", cameras={"tof": tof.model_copy(update={"sensing": RangeSensing.model_validate(sensing)})}, body=body
    )


def scan_of(range_m: Floats, **fields: object) -> Scan:
    known = {"time_s": 0.0, "T_map_rig": AHEAD, "range_camera": "tof", "range_m": range_m.astype(np.float32)}
    return Scan(**(known | fields))  # type: ignore[arg-type]


def wall(distance_m: float, slant: float = 0.0) -> Floats:
    """Ranges to a plane across the optical axis, turned about the image's upright by a slope."""
    rays = CAMERA.rays()
    return distance_m / (rays[..., 2] - slant * rays[..., 0])


def seen(diff: Diff, column: int) -> Floats:
    """(N, 3) centres of the voxels with hits (0) or misses (1)."""
    return np.concatenate(
        [
            centres_of_voxels(voxels_in_cell(e.voxels[e.counts[:, column] > 0], key, GEOMETRY), GEOMETRY)
            for key, e in diff.items()
        ]
        or [np.empty((0, 3))]
    )


def integrated(scan: Scan, rig: Rig, integrator: Integrator = LIMITS) -> Diff:
    return integrate_scan(scan, rig, GEOMETRY, integrator=integrator)


def margin_m(range_m: Floats) -> Floats:
    return 0.05 + 0.04 * range_m


def naive(seen_m: Singles, shield_m: Singles, silent_m: float, focal_px: float) -> Floats:
    height, width = seen_m.shape
    clear = np.zeros((height, width))
    padded = np.pad(shield_m.astype(np.float64), 1, constant_values=np.nan)
    for y, x in np.ndindex(height, width):
        own = silent_m if np.isinf(seen_m[y, x]) else float(seen_m[y, x])
        if not own > 0:
            continue
        middle = padded[y + 1, x + 1]
        steps = [
            np.nan_to_num(np.fmin(abs(one - middle), abs(other - middle)))
            for one, other in ((padded[y + 1, x], padded[y + 1, x + 2]), (padded[y, x + 1], padded[y + 2, x + 1]))
        ]
        nearest, margin = own, float(np.nan_to_num(margin_m(shield_m[y, x])))
        for v, u in np.ndindex(height, width):
            ring = max(abs(v - y), abs(u - x))
            near = float(shield_m[v, u])
            if ring > 2 or not near < nearest:
                continue
            is_edge = own - near > EDGE_STEP_M + 2 * SLANT_SHARE * sum(steps) and near / focal_px <= EDGE_M
            if ring <= 1 or is_edge:
                nearest, margin = near, float(margin_m(shield_m[v, u]))
        grazing = GRAZING_SHARE * math.hypot(1, math.hypot(*steps) * focal_px / own)
        clear[y, x] = max(nearest - margin * min(max(grazing, 1), GRAZING_MAX), 0)
    return clear


@pytest.mark.parametrize("seed", range(6))
def test_what_is_nearest_agrees_with_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:13, :17]
    shield_m = 2.0 + 0.05 * x + 0.8 * (x > 8) - 1.2 * ((y == 5) & (x % 4 < 2)) + 0.02 * rng.standard_normal((13, 17))
    shield_m[rng.random(shield_m.shape) < 0.15] = np.nan
    seen_m = np.where(rng.random(shield_m.shape) < 0.9, shield_m, np.nan)
    seen_m[np.isnan(shield_m) & (rng.random(shield_m.shape) < 0.5)] = np.inf
    args = [a.astype(np.float32) for a in (seen_m, shield_m)]
    for focal_px in (30.0, 300.0):
        nearest_m, share = nearest_around(*args, 4.0, focal_px, EDGE_M)  # type: ignore[call-arg, arg-type]
        clear = np.maximum(nearest_m - share * margin_m(nearest_m), 0)
        np.testing.assert_allclose(clear, naive(*args, 4.0, focal_px), atol=1e-5)  # type: ignore[arg-type]
        assert (clear[np.isinf(seen_m)] > 0).any() and (clear[np.isnan(seen_m)] == 0).all()


def naive_bridged(seen_m: Singles, missing: Flags) -> Singles:
    """Rows, and then columns: each missing pixel with a known one at either end of a gap of at most `GAP_PX`."""
    for _ in range(2):
        bridged, width = seen_m.copy(), seen_m.shape[1]
        for y, first in np.ndindex(seen_m.shape):
            for end in range(first + 2, min(first + GAP_PX + 2, width)):
                gap, ends_m = slice(first + 1, end), seen_m[y, [first, end]]
                is_gap = missing[y, gap].all() and not (seen_m[y, gap] > 0).any()
                if is_gap and (ends_m > 0).all() and abs(ends_m[0] - ends_m[1]) <= BRIDGE_STEP_M:
                    bridged[y, gap] = ends_m.min()
        seen_m, missing = bridged.T.copy(), missing.T
    return seen_m


@pytest.mark.parametrize("seed", range(6))
def test_bridging_of_gaps_agrees_with_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen_m = rng.uniform(1.0, 4.0, (11, 17)).astype(np.float32)
    seen_m[rng.random(seen_m.shape) < 0.15 * seed] = np.nan
    missing = np.isnan(seen_m) & (rng.random(seen_m.shape) < 0.9)
    shield_m = np.where(np.isnan(seen_m) & ~missing & (rng.random(seen_m.shape) < 0.5), np.float32(0.5), seen_m)
    bridged, shields = seen_m.copy(), shield_m.copy()
    bridge_gaps_into(bridged, shields, missing)
    np.testing.assert_array_equal(bridged, naive_bridged(seen_m, missing))
    filled = np.isnan(seen_m) & ~np.isnan(bridged)
    np.testing.assert_array_equal(shields, np.where(filled, bridged, shield_m))
    assert filled.any() == (seed > 0)


def column_of(points: Floats) -> npt.NDArray[np.int64]:
    """(N,) the image's column that each point falls on."""
    columns: npt.NDArray[np.int64] = np.rint(19.5 - 60.0 * points[:, 1] / points[:, 0]).astype(np.int64)
    return columns


def test_an_image_with_gaps_between_its_pixels_clears_what_the_whole_one_clears() -> None:
    gappy = wall(2.02)
    gappy[::3], gappy[:, 1::3], gappy[:, 2::3] = np.nan, np.nan, np.nan
    whole, bridged = ({tuple(p) for p in seen(integrated(scan_of(r), rig_of()), 1)} for r in (wall(2.02), gappy))
    # The image's own rim has no pixel on its other side.
    assert len(bridged) > 0.85 * len(whole) > 1000
    assert len(bridged - whole) < 0.002 * len(whole)


@pytest.mark.parametrize(
    ("width", "near_m", "cleared"), [(1, 2.3, True), (2, 2.3, True), (3, 2.3, False), (2, 1.9, False)]
)
def test_a_gap_is_bridged_by_the_nearer_side_if_it_and_the_step_are_small(
    width: int, near_m: float, cleared: bool
) -> None:
    range_m = wall(3.0)
    range_m[:, :15] = wall(near_m)[:, :15]
    range_m[:, 15 : 15 + width] = np.nan
    free = seen(integrated(scan_of(range_m), rig_of()), 1)
    within = free[(column_of(free) >= 15) & (column_of(free) < 15 + width)]
    assert len(within) > 20 if cleared else len(within) == 0
    assert not cleared or within[:, 0].max() < near_m


@pytest.mark.parametrize("cause", ["full", "near", "far"])
def test_a_pixel_that_saw_something_is_no_gap(cause: str) -> None:
    range_m, amplitude = wall(3.0), np.full((30, 40), 500, np.uint16)
    range_m[:, 15] = {"full": np.nan, "near": 0.02, "far": 9.0}[cause]
    amplitude[:, 15] = 1000 if cause == "full" else 500
    free = seen(integrated(scan_of(range_m, amplitude=amplitude), rig_of(saturated_amplitude=1000)), 1)
    assert len(free) > 1000 and not (column_of(free) == 15).any()


@pytest.mark.parametrize(("sigma_m", "k", "kept_m"), [(0.001, 2.0, EDGE_M), (0.1, 2.0, 0.2), (0.1, 0.0, EDGE_M)])
@pytest.mark.parametrize("camera", [CAMERA, LIDAR])
def test_free_space_keeps_from_a_surface_by_a_voxel_and_by_its_noise(
    camera: Camera | SpinningLidar, sigma_m: float, k: float, kept_m: float
) -> None:
    rig = rig_of(camera, sigma_m=((0.0, sigma_m),))
    rays = camera.rays() @ AHEAD[:3, :3].T
    with np.errstate(divide="ignore"):
        range_m = np.where(rays[..., 0] > 0.5, 2.02 / rays[..., 0], np.nan)
    free = seen(integrated(scan_of(range_m), rig, replace(LIMITS, noise_sigmas=k)), 1)
    near_axis = np.abs(free[:, 1:]).max(axis=1) < 0.08
    farthest_m = free[near_axis, 0].max()
    # A ray's last voxel is the one before that in which it stops; a voxel's centre is half a voxel off its faces.
    assert 2.02 - kept_m - 1.6 * EDGE_M <= farthest_m <= 2.02 - kept_m + 0.5 * EDGE_M


def test_noise_that_grows_with_range_keeps_farther_from_what_is_farther() -> None:
    rig = rig_of(sigma_m=((1.0, 0.001), (4.0, 0.1)))
    off_m = [d - seen(integrated(scan_of(wall(d)), rig), 1)[:, 0].max() for d in (1.02, 4.02)]
    assert off_m[0] < 0.1 and off_m[1] > 0.18


def test_a_grazing_surface_keeps_its_margin_across_it() -> None:
    slope = 6.0
    scan = scan_of(wall(3.0, -slope))
    across_m = {}
    for name, share in (("carve", Method.CARVE), ("cast", Method.CAST)):
        free = seen(integrated(scan, rig_of(), replace(LIMITS, method=share, flying_step_m=math.inf)), 1)
        # The plane z - slant x = 3 of the camera; its x is the map's -y, its z the map's x.
        across_m[name] = ((3.0 - free[:, 0] + slope * free[:, 1]) / math.hypot(1, slope)).min()
    assert across_m["carve"] > 0.4 * EDGE_M > across_m["cast"]


def edge_scan() -> Floats:
    """A post 1 m ahead, its right half of the image; the pixel next to it mixed; a wall at 3 m."""
    range_m = np.full((30, 40), 3.0)
    range_m[:, 20:] = 1.0
    range_m[:, 19] = 1.6
    return range_m


def test_a_mixed_pixel_is_no_hit_but_still_shields_its_neighbour() -> None:
    diff = integrated(scan_of(edge_scan()), rig_of())
    hits, free = seen(diff, 0), seen(diff, 1)
    assert not ((hits[:, 0] > 1.2) & (hits[:, 0] < 2.5)).any()
    # Column u is at y = -(u - 19.5) / 60 of the depth: the second next to the post is 18, free from 17 on.
    beyond = free[free[:, 0] > 1.2]
    assert len(beyond) > 100
    assert (beyond[:, 1] / beyond[:, 0]).min() > 1.9 / 60
    without = integrated(scan_of(edge_scan()[:, ::1]), rig_of(), replace(LIMITS, flying_step_m=math.inf))
    assert seen(without, 0)[:, 0].max() > 1.5


def test_silence_clears_nothing_unless_the_rig_says_so() -> None:
    for camera in (CAMERA, LIDAR):
        nothing = scan_of(np.full((camera.height, camera.width), np.nan))
        assert integrated(nothing, rig_of(camera)) == {}
        free = seen(integrated(nothing, rig_of(camera, no_return_clears_m=2.0)), 1)
        assert 1.85 < np.linalg.norm(free, axis=1).max() < 2.05
        short = replace(LIMITS, max_range_m=1.0)
        nearer = seen(integrated(nothing, rig_of(camera, no_return_clears_m=2.0), short), 1)
        assert np.linalg.norm(nearer, axis=1).max() < 1.05


@pytest.mark.parametrize("nothing", [np.inf, 0.0, -1.0, 7.0])
def test_a_range_out_of_limits_is_not_silence(nothing: float) -> None:
    assert integrated(scan_of(np.full((30, 40), nothing)), rig_of(no_return_clears_m=2.0)) == {}


def test_a_full_pixel_gives_no_range_and_clears_nothing() -> None:
    amplitude = np.full((30, 40), 500, np.uint16)
    amplitude[:, 20:] = 1000
    for range_m in (wall(2.02), np.full((30, 40), np.nan)):
        rig = rig_of(saturated_amplitude=1000, no_return_clears_m=2.0)
        diff = integrated(scan_of(range_m, amplitude=amplitude), rig)
        free = seen(diff, 1)
        assert (free[:, 1] > -0.03).all() and len(free) > 500
        assert (seen(diff, 0)[:, 1] > -0.03).all()
    both = integrated(scan_of(wall(2.02), amplitude=amplitude), rig_of())
    assert seen(both, 0)[:, 1].min() < -0.3


ARM = Body(frame="robot", boxes=(BodyBox(name="arm", low_m=(0.5, -1.0, -1.0), high_m=(0.8, 0.0, 1.0)),))
"""Ahead of the camera, to the right of its axis, when the body stands where the map does."""


@pytest.mark.parametrize("camera", [CAMERA, LIDAR])
@pytest.mark.parametrize("silence_m", [None, 2.0])
def test_the_robots_own_body_is_no_evidence(camera: Camera | SpinningLidar, silence_m: float | None) -> None:
    rays = camera.rays() @ AHEAD[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(rays[..., 0] > 0.7, 2.02 / rays[..., 0], np.nan)
        arm = np.where((rays[..., 0] > 0.7) & (rays[..., 1] < -0.01), 0.6 / rays[..., 0], ahead)
    arm[: camera.height // 2] = np.where(arm < 1, np.nan, arm)[: camera.height // 2]  # half of it is black
    where = {"T_map_rig": AHEAD, "T_map_body": np.eye(4), "amplitude": np.full(arm.shape, 7, np.uint16)}
    with_body, without = (
        integrated(scan_of(arm, **where), rig_of(camera, body, no_return_clears_m=silence_m)) for body in (ARM, None)
    )
    assert (np.abs(seen(without, 0)[:, 0] - 0.6) < 0.06).any()
    hits, free = seen(with_body, 0), seen(with_body, 1)
    assert len(hits) > 20 and not (hits[:, 0] < 1.5).any()
    in_shadow = (free[:, 1] < -0.03 * free[:, 0] - EDGE_M) & (np.abs(np.arctan2(free[:, 1], free[:, 0])) < 0.7)
    assert not in_shadow.any() and len(free) > 200


def test_without_its_pose_the_body_is_in_the_rigs_frame() -> None:
    rig = rig_of(CAMERA, Body(frame="head", boxes=(BodyBox(name="hood", low_m=(-1, -1, 0.4), high_m=(1, 1, 0.6)),)))
    assert integrated(scan_of(wall(0.5), T_map_rig=look_at((3, 4, 5), (9, 2, 1))), rig) == {}
    elsewhere = scan_of(wall(0.5), T_map_rig=look_at((3, 4, 5), (9, 2, 1)), T_map_body=np.eye(4))
    assert len(integrated(elsewhere, rig)) > 0


def test_points_without_order_leave_the_body_out_and_keep_from_surfaces() -> None:
    points = np.array([[0.6, -0.3, 0.0], [2.02, 0.3, 0.0]])
    body = {"T_map_body": np.eye(4)}
    found = []
    for fields in ({}, body, {"range_camera": "tof"} | body):
        cloud = Integration(rig_of(CAMERA, ARM, sigma_m=((0.0, 0.2),)), GEOMETRY, LIMITS)
        cloud.add_points(points, np.eye(4), **fields)  # type: ignore[arg-type]
        found.append(cloud.diff())
    assert [len(seen(diff, 0)) for diff in found] == [2, 1, 1]
    assert seen(found[1], 1)[:, 0].max() > 1.85 and 1.5 < seen(found[2], 1)[:, 0].max() < 1.65


def test_the_text_of_an_integrator_names_all_that_it_does() -> None:
    others = ({"noise_sigmas": 3.0}, {"method": Method.CAST}, {"sample_spread_voxels": 0.5}, {"flying_step_m": 1.0})
    assert len({str(LIMITS), *(str(replace(LIMITS, **other)) for other in others)}) == 5  # type: ignore[arg-type]


@pytest.mark.parametrize("nodes", [((0.0, 0.02),), ((0.0, 0.005), (3.0, 0.01), (6.0, 0.03)), ((1.0, 0.1), (1.5, 0.0))])
def test_noise_between_nodes_is_that_of_numpy_to_the_last_bit(nodes: tuple[tuple[float, float], ...]) -> None:
    given = np.random.default_rng(1).uniform(-1, 9, 200).astype(np.float32)
    given[:9] = np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, 1.5, 3.0, 6.0
    x, y = np.array(nodes).T.copy()
    found = interpolated(given, np.array([x, y]))
    # NumPy has a number for NaN where there is a single node.
    assert np.isnan(found[0])
    np.testing.assert_array_equal(found[1:], np.interp(given[1:], x, y))


def test_pixels_are_sorted_by_what_came_back() -> None:
    rng = np.random.default_rng(2)
    true_m = rng.choice(np.array([np.nan, np.inf, 0.0, 0.05, 0.1, 0.5, 3.0, 10.0, 10.5], np.float32), (9, 13))
    full, flying = rng.random((2, 9, 13)) < 0.3
    with np.errstate(invalid="ignore"):
        near, far, void = true_m < np.float32(0.1), true_m > 10, np.isnan(true_m)
    within = ~(near | far | void | full)
    for is_clear in (False, True):
        range_m, shield_m, silent, missing = (np.empty((9, 13), kind) for kind in (np.float32, np.float32, bool, bool))
        counts = classify_ranges_into(
            range_m, shield_m, silent, missing, true_m, full, flying, np.float32(0.1), np.float32(10), is_clear
        )
        np.testing.assert_array_equal(shield_m, np.where(within, true_m, np.nan))
        np.testing.assert_array_equal(range_m, np.where(within & ~flying, true_m, np.nan))
        np.testing.assert_array_equal(silent, void & ~full & is_clear)
        np.testing.assert_array_equal(missing, void & ~full & (not is_clear))
        causes = [within & ~flying, void & ~full, full, near & ~full, far & ~full, within & flying]
        assert counts == tuple(int(cause.sum()) for cause in causes)
        assert sum(counts) == true_m.size


def test_clear_ranges_end_a_margin_before_the_nearest_one() -> None:
    rng = np.random.default_rng(3)
    nearest_m, share = rng.uniform(0, 0.4, (2, 7, 5)).astype(np.float32) * np.float32(5)
    sigma_m = rng.uniform(0, 0.1, (7, 5))
    margin_m = np.maximum(0.04, 2.0 * sigma_m).astype(np.float32)
    expected = np.maximum(nearest_m - share * margin_m, np.float32(0))
    stay_before_into(nearest_m, share, sigma_m, 0.04, 2.0)
    np.testing.assert_array_equal(nearest_m, expected)
    assert (nearest_m == 0).any() and (nearest_m > 0).any()


def test_a_window_shows_the_pixels_of_the_camera_and_nothing_around_them() -> None:
    clear_m = np.arange(1, 7, dtype=np.float32).reshape(2, 3)
    pixel_of = np.array([6, 0, 5, 2, 2, 6], np.int32)  # 6: outside the camera's image
    shown = shown_in_window(clear_m, pixel_of, 3, 2)
    np.testing.assert_array_equal(shown[1:-1, 1:-1], [[0, 1], [6, 3], [3, 0]])
    assert shown.shape == (5, 4) and shown.sum() == shown[1:-1, 1:-1].sum()
