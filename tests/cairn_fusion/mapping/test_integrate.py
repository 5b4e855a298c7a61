"""Scans as evidence of voxels: the laws of evidence, samples, and real recordings."""

import math
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, inverse, look_at, transform_points
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.importers import open_source
from cairn_fusion.mapping.integrate import Integrator, Method, integrate_scan, integrator_from_text
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.recording import Recording
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import (
    CellKey,
    Geometry,
    centres_of_voxels,
    geometry_for,
    voxels_in_cell,
    voxels_of_points,
)

law = settings(max_examples=25, deadline=None, database=None)
DOSE = Channel(kind=ChannelKind.SCALAR, name="dose", unit="uSv/h", step=0.01)
GEOMETRY = Geometry(voxel_edge_um=50_000, depth=4, channels=(COLOUR, INTENSITY, TEMPERATURE, DOSE))
INTEGRATOR = Integrator(min_range_m=0.1, max_range_m=2.5, flying_step_m=math.inf)
"""Random images are all steps: nothing in them flies."""
TOF = Camera(width=12, height=9, focal_px=(9.0, 9.0), centre_px=(5.5, 4.0))
THERMAL = Camera(width=48, height=36, focal_px=(36.0, 36.0), centre_px=(23.5, 17.5))
KELVIN = 300.0

Floats = npt.NDArray[np.float64]
Diff = dict[CellKey, Evidence]
Voxels = dict[tuple[int, ...], tuple[int, int, tuple[int, ...]]]


def at(x_m: float, *, camera: str = "thermal") -> Transform:
    """A place next to the range camera."""
    T = np.eye(4)
    T[0, 3] = x_m
    return T


RIG = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "left": mount_camera(Spectrum.THERMAL, THERMAL, at(-0.25)),
        "right": mount_camera(Spectrum.THERMAL, THERMAL, at(0.25)),
        "colour": mount_camera(Spectrum.COLOUR, THERMAL, np.eye(4)),
    },
)
HOME = look_at((0.33, -0.41, 0.77), (1.4, 0.3, 0.9))


def scan_of(range_m: Floats, T_map_rig: Transform = HOME, **images: object) -> Scan:
    fields: dict[str, object] = {"time_s": 1.5e9, "range_camera": "tof", "range_m": range_m.astype(np.float32)}
    return Scan(T_map_rig=T_map_rig, **(fields | images))  # type: ignore[arg-type]


def random_scan(seed: int) -> Scan:
    """Ranges of every sort, all images with holes, a pose of its own."""
    rng = np.random.default_rng(seed)
    range_m = rng.uniform(0.05, 3.0, (9, 12))
    range_m[rng.random((9, 12)) < 0.2] = rng.choice([np.nan, np.inf, 0.0, -1.0])
    kelvin = rng.uniform(280, 340, (36, 48)).astype(np.float32)
    kelvin[rng.random((36, 48)) < 0.1] = np.nan
    pose = look_at(rng.uniform(-0.5, 0.5, 3), rng.uniform(2, 3, 3))
    return scan_of(
        range_m,
        pose,
        amplitude=rng.integers(0, 1000, (9, 12)).astype(np.uint16),
        thermal={"left": kelvin, "right": kelvin + 1},
        colour={"colour": rng.integers(0, 256, (36, 48, 3)).astype(np.uint8)},
        scalars={"dose": float(rng.integers(0, 100)) / 10},
    )


def integrated(scan: Scan, geometry: Geometry = GEOMETRY, *, integrator: Integrator = INTEGRATOR) -> Diff:
    return integrate_scan(scan, RIG, geometry, integrator=integrator)


def voxels_of(diff: Diff, geometry: Geometry = GEOMETRY) -> Voxels:
    """Each voxel's hits, misses and sums, by its number."""
    found: Voxels = {}
    for key, evidence in diff.items():
        samples = dict(zip(evidence.sampled.tolist(), evidence.samples.tolist(), strict=True))
        numbers = voxels_in_cell(evidence.voxels, key, geometry).tolist()
        for n, (voxel, (hits, misses)) in enumerate(zip(numbers, evidence.counts.tolist(), strict=True)):
            found[tuple(voxel)] = (hits, misses, tuple(samples.get(n, (0,) * geometry.plane_count)))
    return found


def weights(voxel: tuple[int, int, tuple[int, ...]]) -> dict[str, int]:
    return {c.name: voxel[2][GEOMETRY.planes_of(c.name)][-1] for c in GEOMETRY.channels}


def summed(*diffs: Diff) -> Diff:
    total = EvidenceMap(GEOMETRY)
    for diff in diffs:
        total.merge(diff)
    return total.packed()


seeds = st.integers(0, 10_000)


@law
@given(seeds)
def test_a_scan_gives_each_voxel_one_count_at_most_and_samples_only_with_a_hit(seed: int) -> None:
    scan = random_scan(seed)
    at_rig = tuple(voxels_of_points(scan.T_map_rig[:3, 3], GEOMETRY)[0].tolist())
    for number, voxel in voxels_of(integrated(scan)).items():
        hits, misses, _ = voxel
        found = weights(voxel)
        dose = found.pop("dose")
        assert dose == (number == at_rig)
        assert hits + misses == 1 or (number == at_rig and hits + misses == 0)
        assert all(weight in (0, hits) for weight in found.values())


@law
@given(seeds)
def test_every_return_is_a_hit_where_it_lies(seed: int) -> None:
    scan = random_scan(seed)
    range_m = scan.range_m.astype(np.float64)
    valid = (range_m >= INTEGRATOR.min_range_m) & (range_m <= INTEGRATOR.max_range_m)
    points = transform_points(scan.T_map_rig, TOF.rays()[valid] * range_m[valid][:, None])
    voxels = voxels_of(integrated(scan))
    expected = {tuple(v) for v in voxels_of_points(points, GEOMETRY).tolist()}
    assert {number for number, (hits, _, _) in voxels.items() if hits} == expected


@law
@given(st.lists(seeds, min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_the_order_of_scans_and_their_grouping_change_nothing(some: list[int], random: object) -> None:
    scans = [random_scan(seed) for seed in some]
    one = Measurement(RIG, GEOMETRY, INTEGRATOR)
    for scan in scans:
        one.add(scan)
    shuffled = list(scans)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    cut = len(scans) // 2
    groups = [Measurement(RIG, GEOMETRY, INTEGRATOR), Measurement(RIG, GEOMETRY, INTEGRATOR)]
    for n, scan in enumerate(shuffled):
        groups[n < cut].add(scan)
    assert one.diff() == summed(*(group.diff() for group in groups))
    for hits, misses, _ in voxels_of(one.diff()).values():
        assert hits + misses <= len(scans)


@law
@given(seeds)
def test_the_same_scan_twice_adds_exactly_double(seed: int) -> None:
    diff = integrated(random_scan(seed))
    twice = voxels_of(summed(diff, diff))
    for number, (hits, misses, sums) in voxels_of(diff).items():
        assert twice[number] == (2 * hits, 2 * misses, tuple(2 * n for n in sums))


@law
@given(seeds, st.sampled_from([3, 5, 7]))
def test_where_cells_end_changes_nothing(seed: int, depth: int) -> None:
    scan = random_scan(seed)
    other = GEOMETRY.model_copy(update={"depth": depth})
    diff = integrated(scan, other)
    assert voxels_of(diff, other) == voxels_of(integrated(scan))
    assert len(diff) > 1 or depth == 7  # the scan does lie across borders


@pytest.mark.parametrize("nothing", [np.nan, np.inf, 0.0, -2.0, 0.099, 2.501, 60.0])
def test_a_range_that_is_no_return_is_no_evidence_not_even_of_free_space(nothing: float) -> None:
    assert integrated(scan_of(np.full((9, 12), nothing))) == {}


def test_a_pixel_without_return_takes_nothing_from_its_neighbours() -> None:
    range_m = np.full((9, 12), np.nan)
    range_m[4, 5] = 2.0
    voxels = voxels_of(integrated(scan_of(range_m)))
    (end,) = voxels_of_points(transform_points(HOME, TOF.rays()[4, 5] * 2.0), GEOMETRY)
    assert [number for number, (hits, _, _) in voxels.items() if hits] == [tuple(end.tolist())]
    assert sum(misses for _, misses, _ in voxels.values()) >= 20


def test_a_voxel_that_one_ray_hits_and_another_passes_is_hit() -> None:
    range_m = np.full((9, 12), np.nan)
    range_m[4, 5], range_m[4, 6] = 1.0, 2.4  # neighbours: both pass the same voxels near the sensor
    near = voxels_of_points(transform_points(HOME, TOF.rays()[4, 5] * 1.0), GEOMETRY)[0]
    coarse = GEOMETRY.model_copy(update={"voxel_edge_um": 400_000})
    voxels = voxels_of(integrated(scan_of(range_m), coarse), coarse)
    number = tuple((near // 8).tolist())
    assert voxels[number][:2] == (1, 0)


def test_a_sample_is_the_mean_of_the_pixels_in_its_voxel() -> None:
    coarse = Geometry(voxel_edge_um=1_000_000, depth=3, channels=(INTENSITY,))
    amplitude = np.arange(108).reshape(9, 12).astype(np.uint16)
    pose = look_at((0.5, 0.5, 0.5), (0.5, 9.5, 0.5))
    integrator = Integrator(max_range_m=10.0)
    scan = scan_of(np.full((9, 12), 0.2), pose, amplitude=amplitude)
    (voxel,) = voxels_of(integrate_scan(scan, RIG, coarse, integrator=integrator), coarse).values()
    assert voxel == (1, 0, (round(amplitude.mean()), 1))


def wall_behind_a_post() -> tuple[Floats, Floats]:
    """Ranges to a post 0.8 m ahead and a wall at 2 m, and x of each point at the wall's depth."""
    rays = TOF.rays()
    post = np.abs(rays[..., 0] / rays[..., 2] * 0.8) < 0.12
    return np.where(post, 0.8, 2.0) / rays[..., 2], rays[..., 0] / rays[..., 2] * 2.0


def temperatures(**thermal: float) -> dict[float, float]:
    """Temperature of the wall's voxels by x in metres, where cameras that see one temperature each look at it."""
    range_m, _ = wall_behind_a_post()
    images = {name: np.full((36, 48), kelvin, np.float32) for name, kelvin in thermal.items()}
    pose = np.eye(4)
    pose[:3, 3] = 0.025
    diff = integrate_scan(scan_of(range_m, pose, thermal=images), RIG, GEOMETRY, integrator=INTEGRATOR)
    planes = GEOMETRY.planes_of("temperature")
    found: dict[float, float] = {}
    for (x, _, z), (hits, _, sums) in voxels_of(diff).items():
        total, _, weight = sums[planes]
        if hits and z * 0.05 > 1.5:
            found[x * 0.05] = total * TEMPERATURE.step if weight else np.nan
    return found


def test_temperature_lands_only_where_the_camera_saw_the_point() -> None:
    left = temperatures(left=KELVIN)
    hidden = [x for x, kelvin in left.items() if np.isnan(kelvin)]
    # Seen from 0.25 m to the left, the post's shadow on the wall is 0.08 to 0.68 m; the image ends at 1.1 m.
    assert all(0 < x < 0.8 or x > 1.0 for x in hidden)
    assert {round(x, 2) for x in left if 0.2 < x < 0.55} <= {round(x, 2) for x in hidden}
    assert all(kelvin == KELVIN for kelvin in left.values() if not np.isnan(kelvin))


def test_a_second_camera_fills_what_the_first_did_not_see_and_no_more() -> None:
    left = temperatures(left=KELVIN)
    both = temperatures(left=KELVIN, right=KELVIN + 20)
    filled = {x for x, kelvin in both.items() if kelvin == KELVIN + 20}
    assert filled
    assert filled <= {x for x, kelvin in left.items() if np.isnan(kelvin)}
    assert all(both[x] == kelvin for x, kelvin in left.items() if not np.isnan(kelvin))


def test_what_the_first_camera_sees_still_hides_what_is_behind_it_from_the_second() -> None:
    twin = RIG.model_copy(update={"cameras": {**RIG.cameras, "right": RIG["left"]}})
    range_m, _ = wall_behind_a_post()
    kelvin = np.full((36, 48), KELVIN, np.float32)
    alone, both = (
        integrate_scan(scan_of(range_m, thermal=thermal), twin, GEOMETRY, integrator=INTEGRATOR)
        for thermal in ({"left": kelvin}, {"left": kelvin, "right": kelvin + 20})
    )
    assert both == alone


def test_a_pixel_without_temperature_leaves_its_voxel_without() -> None:
    range_m, _ = wall_behind_a_post()
    scan = scan_of(range_m, thermal={"left": np.full((36, 48), np.nan, np.float32)})
    assert all(weights(voxel)["temperature"] == 0 for voxel in voxels_of(integrated(scan)).values())


def test_a_reading_lands_in_the_voxel_of_the_rig_even_without_a_return() -> None:
    scan = scan_of(np.full((9, 12), np.nan), scalars={"dose": 1.23})
    rig_voxel = tuple(voxels_of_points(HOME[:3, 3], GEOMETRY)[0].tolist())
    ((number, (hits, misses, sums)),) = voxels_of(integrated(scan)).items()
    assert (number, hits, misses) == (rig_voxel, 0, 0)
    assert sums[GEOMETRY.planes_of("dose")] == (123, 1)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("scalars", {"gas": 1.0}),
        ("scalars", {"temperature": 300.0}),
        ("scalars", {"dose": np.nan}),
        ("range_camera", "left"),
        ("range_camera", "nobody"),
        ("thermal", {"colour": np.zeros((36, 48), np.float32)}),
        ("thermal", {"left": np.zeros((48, 36), np.float32)}),
        ("thermal", {"left": np.zeros((36, 48), np.float64)}),
        ("colour", {"colour": np.zeros((36, 48), np.uint8)}),
    ],
)
def test_what_does_not_fit_the_rig_or_the_map_is_refused_and_changes_nothing(field: str, value: object) -> None:
    measurement = Measurement(RIG, GEOMETRY, INTEGRATOR)
    measurement.add(random_scan(1))
    before = measurement.diff()
    with pytest.raises(BadInputError):
        measurement.add(scan_of(np.full((9, 12), 1.0), **{field: value}))
    assert measurement.diff() == before
    assert len(measurement) == 1


def test_a_measurement_says_when_and_where_its_scans_were_taken() -> None:
    measurement = Measurement(RIG, GEOMETRY, INTEGRATOR)
    assert measurement.captured_s is None
    for time_s in (7.0, 3.0, 5.0):
        measurement.add(scan_of(np.full((9, 12), 1.0), time_s=time_s))
    assert measurement.captured_s == (3.0, 7.0)
    np.testing.assert_allclose(measurement.poses[0].t_map_rig, HOME[:3, 3])


@pytest.mark.parametrize("limits", [(-1.0, 1.0), (1.0, 1.0), (0.1, np.inf), (np.nan, 1.0)])
def test_limits_that_leave_nothing_are_refused(limits: tuple[float, float]) -> None:
    with pytest.raises(BadInputError):
        Integrator(*limits)


# Real recordings: what the numbers were when the integrator was made stands next to each bound.


def mapped(source: Recording, scans: list[int], geometry: Geometry) -> Diff:
    measurement = Measurement(source.rig, geometry)
    for n in scans:
        measurement.add(source.scan(n))
    return measurement.diff()


def occupied(diff: Diff, geometry: Geometry) -> tuple[npt.NDArray[np.int64], Floats]:
    """Voxels (N, 3) with more evidence for than against, at OctoMap's weights; kelvin (N,), NaN where unknown."""
    voxels: list[npt.NDArray[np.int64]] = []
    kelvins: list[Floats] = []
    for key, evidence in diff.items():
        full = evidence.counts @ np.array([np.log(0.7 / 0.3), np.log(0.4 / 0.6)]) > 0
        kelvin = np.full(len(evidence), np.nan)
        if "temperature" in [channel.name for channel in geometry.channels]:
            sums = evidence.samples[:, geometry.planes_of("temperature")]
            seen = sums[:, -1] > 0
            kelvin[evidence.sampled[seen]] = sums[seen, 0] / sums[seen, -1] * TEMPERATURE.step
        voxels.append(voxels_in_cell(evidence.voxels[full], key, geometry))
        kelvins.append(kelvin[full])
    return np.concatenate(voxels), np.concatenate(kelvins)


def share_near(voxels: npt.NDArray[np.int64], others: npt.NDArray[np.int64], *, reach: int) -> float:
    """Share of voxels that have one of the others within some voxels (Chebyshev)."""
    low = np.minimum(voxels.min(axis=0), others.min(axis=0)) - reach
    size = np.maximum(voxels.max(axis=0), others.max(axis=0)) + reach + 1 - low
    near = np.zeros(size, bool)
    near[tuple((others - low).T)] = True
    for axis in range(3):
        near = np.logical_or.reduce([np.roll(near, step, axis) for step in range(-reach, reach + 1)])
    return float(near[tuple((voxels - low).T)].mean())


@pytest.mark.recording
def test_two_halves_of_a_real_recording_agree(test_data: Path) -> None:
    source = open_source(test_data / "apc_shelf_rgbd")
    geometry = geometry_for(voxel_edge_m=0.01, channels=())
    frames = list(range(len(source)))

    def seen(scans: list[int]) -> npt.NDArray[np.int64]:
        return occupied(mapped(source, scans, geometry), geometry)[0]

    assert share_near(seen(frames[::2]), seen(frames[1::2]), reach=2) >= 0.93  # 0.943
    half = len(frames) // 2
    assert share_near(seen(frames[:half]), seen(frames[half:]), reach=2) >= 0.78  # 0.822


HOT_CUP = 13
"""Class in the label images."""


def in_cups(
    voxels: npt.NDArray[np.int64], source: Recording, folder: Path, frames: list[str], geometry: Geometry
) -> npt.NDArray[np.bool_]:
    """(N,) which voxels' centres lie in a hot cup's label, and at the range that was measured there."""
    centres = centres_of_voxels(voxels, geometry)
    found = np.zeros(len(voxels), bool)
    for n, frame in enumerate(frames):
        labels = cv2.imread(str(folder / f"{frame}.label.png"), cv2.IMREAD_UNCHANGED)
        scan, camera = source.scan(n), source.rig["depth"].camera
        points = transform_points(inverse(scan.T_map_rig), centres)
        pixels = camera.project(points)
        seen = np.nonzero(camera.contains(pixels))[0]
        x, y = np.rint(pixels[seen]).astype(int).T
        is_there = np.abs(scan.range_m[y, x] - np.linalg.norm(points[seen], axis=1)) < 0.02
        found[seen] |= (labels[y, x] == HOT_CUP) & is_there
    return found


def test_an_integrator_is_read_from_the_text_that_commits_state() -> None:
    for integrator in (Integrator(), INTEGRATOR, Integrator(method=Method.CAST, max_range_m=7.25, noise_sigmas=0)):
        assert integrator_from_text(str(integrator)) == integrator
    older = "cairn-carve 4 min_range_m=0.2 max_range_m=usual"
    assert integrator_from_text(older) == Integrator(min_range_m=0.2)
    for foreign in ("", "other 1 min_range_m=0.2", "cairn-carve 6 min_range_m=near", "cairn-carve 6 min_range_m=-1"):
        assert integrator_from_text(foreign) is None


@pytest.mark.slow
@pytest.mark.recording
def test_hot_cups_are_where_their_labels_are_and_are_seen_through_when_they_are_gone(test_data: Path) -> None:
    folder = test_data / "mm5_rgbdt"
    frames = ["000098", "000099", "000100"]
    source = open_source(folder, frames=frames)
    geometry = geometry_for(voxel_edge_m=0.01, channels=(TEMPERATURE,))
    voxels, kelvin = occupied(mapped(source, [0, 1, 2], geometry), geometry)
    cups = in_cups(voxels, source, folder / "frames/A", frames, geometry)
    assert cups[np.nanargmax(kelvin)]
    assert np.nanmedian(kelvin[cups]) >= np.nanmedian(kelvin) + 30

    everything = open_source(folder)
    later, _ = occupied(mapped(everything, list(range(len(everything))), geometry), geometry)
    still = {tuple(voxel) for voxel in later.tolist()}
    gone = [tuple(voxel) not in still for voxel in voxels[cups].tolist()]
    assert np.mean(gone) > 0.5
