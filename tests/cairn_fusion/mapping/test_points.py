"""Unordered points as evidence: what a lidar sees, real sweeps too."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.fusion.scans import BARREL, GEOMETRY, random_scan, rig_of

from cairn_calib.rig.pixel_offsets import pixel_offsets
from cairn_calib.rig.poses import Transform, inverse
from cairn_calib.rig.range_bias import RangeBias
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.mapping.beam_returns import returns_of
from cairn_fusion.mapping.integrate import Integration, Integrator, Method, integrate_scan
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan_bytes import decode_scan, encode_scan, move_scan
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, geometry_for, voxels_in_cell
from cairn_sim.robots.heads import lidar_head

TENTH = geometry_for(voxel_edge_m=0.1, channels=())
FAR = Integrator(min_range_m=0.5, max_range_m=80.0)


def occupied(diff: dict[CellKey, Evidence], geometry: Geometry) -> npt.NDArray[np.int64]:
    return np.concatenate([voxels_in_cell(e.voxels[e.counts[:, 0] > 0], key, geometry) for key, e in diff.items()])


def test_points_mean_what_the_same_points_mean_as_an_image() -> None:
    scan, rig = random_scan(BARREL, 3), rig_of(BARREL)
    limits = Integrator(min_range_m=0.3, max_range_m=3.0, method=Method.CAST)
    points = (BARREL.rays() * scan.range_m[..., None]).reshape(-1, 3)
    cloud = Integration(rig, GEOMETRY, limits)
    cloud.add_points(np.random.default_rng(1).permutation(points), scan.T_map_rig)
    image = integrate_scan(scan, rig, GEOMETRY, integrator=limits)
    one, other = (occupied(diff, GEOMETRY) for diff in (cloud.diff(), image))
    assert set(map(tuple, one.tolist())) == set(map(tuple, other.tolist()))
    assert len(returns_of(scan, rig, min_range_m=0.3, max_range_m=3.0).pixels) > len(one) > 100


def test_points_of_a_range_camera_lose_its_bias_as_its_images_do() -> None:
    scan, plain = random_scan(BARREL, 3), rig_of(BARREL)
    rng = np.random.default_rng(2)
    shape = (BARREL.height, BARREL.width)
    pattern = pixel_offsets(
        *(0.02 * rng.normal(size=shape), np.full(shape, 0.001), np.full(shape, 9)),
        pattern_sigma_m=0.02,
        noise_sigma_m=0.005,
    )
    bias = RangeBias(offset_m=0.15, scale=0.01, radial_m=0.03, pixel_offsets=pattern)
    rig = plain.model_copy(update={"cameras": {"tof": plain["tof"].model_copy(update={"range_bias": bias})}})
    limits = Integrator(min_range_m=0.3, max_range_m=3.0, method=Method.CAST)
    points = (BARREL.rays() * scan.range_m[..., None]).reshape(-1, 3)
    points[7] = 0.0  # what some drivers say for nothing
    points[8] = np.nan

    def map_of(by: Rig, range_camera: str | None) -> set[tuple[int, ...]]:
        cloud = Integration(by, GEOMETRY, limits)
        cloud.add_points(points, scan.T_map_rig @ plain["tof"].transform, range_camera=range_camera)
        return set(map(tuple, occupied(cloud.diff(), GEOMETRY).tolist()))

    scan.range_m.reshape(-1)[7:9] = np.nan
    image = set(map(tuple, occupied(integrate_scan(scan, rig, GEOMETRY, integrator=limits), GEOMETRY).tolist()))
    assert map_of(rig, "tof") == image
    assert map_of(plain, "tof") == map_of(rig, None) != image


def test_points_that_a_biased_camera_cannot_have_seen_are_refused() -> None:
    rig = rig_of(BARREL)
    bias = RangeBias(offset_m=0.15, scale=0.0, radial_m=0.0)
    biased = rig.model_copy(update={"cameras": {"tof": rig["tof"].model_copy(update={"range_bias": bias})}})
    behind = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    cloud = Integration(biased, GEOMETRY, Integrator())
    with pytest.raises(BadInputError, match="1 of 2 points are not in the image of the range camera"):
        cloud.add_points(behind, np.eye(4), range_camera="tof")
    assert cloud.diff() == {}
    cloud.add_points(behind, np.eye(4))


def test_nothing_that_came_back_is_nothing_and_what_are_no_points_is_refused() -> None:
    cloud = Integration(lidar_head(), TENTH, FAR)
    cloud.add_points(np.full((5, 3), np.nan), np.eye(4))
    cloud.add_points(np.zeros((0, 3)), np.eye(4))
    assert cloud.diff() == {}
    with pytest.raises(BadInputError, match=r"points must be \(N, 3\)"):
        cloud.add_points(np.zeros((5, 2)), np.eye(4))


def test_a_measurement_of_points_says_where_the_rig_was() -> None:
    measurement = Measurement(lidar_head(), TENTH, FAR)
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    measurement.add_points(np.array([[5.0, 0, 0]]), np.eye(4), T_map_rig=T, time_s=7.5)
    assert measurement.poses[0].t_map_rig == (1.0, 2.0, 3.0) and measurement.captured_s == (7.5, 7.5)
    assert len(measurement.diff()) > 0


def sweeps(folder: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], Transform]:
    """Clouds 400 and 401, and T_400_401."""
    first = np.loadtxt(folder / "car_cloud400.csv", delimiter=",", skiprows=1)[:, :3]
    second = np.loadtxt(folder / "car_cloud401.csv")
    line = (folder / "carCloudList.csv").read_text().splitlines()[2]
    return first, second, np.array([float(v) for v in line.split(",")[1:]]).reshape(4, 4)


@pytest.mark.slow
@pytest.mark.recording
def test_a_pose_that_is_written_over_or_is_none_spoils_no_measurement() -> None:
    measurement, T_map_rig = Measurement(lidar_head(), TENTH, FAR), np.eye(4)
    for n in range(3):  # a driver may have one array for all its poses
        T_map_rig[0, 3] = n
        measurement.add_points(np.ones((1, 3)), T_map_rig, T_map_rig=T_map_rig, time_s=float(n))
    wrong = T_map_rig.copy()
    wrong[0, 1] = np.nan
    for pose, time_s, kind in ((T_map_rig, np.nan, "bad_units"), (wrong, 3.0, "bad_transform")):
        with pytest.raises(BadInputError) as refused:
            measurement.add_points(np.ones((1, 3)), T_map_rig, T_map_rig=pose, time_s=time_s)
        assert refused.value.kind == kind
    assert [pose.t_map_rig[0] for pose in measurement.poses] == [0.0, 1.0, 2.0]
    assert measurement.captured_s == (0.0, 2.0)


def test_two_real_sweeps_agree_with_the_true_pose_and_not_with_its_inverse(test_data: Path) -> None:
    first, second, T = sweeps(test_data / "lpm_lidar")
    rig = Rig(name="car", cameras={"lidar": mount_camera(Spectrum.RANGE, lidar_head()["tof"].camera, np.eye(4))})

    def map_of(points: npt.NDArray[np.float64], T_map_sensor: Transform) -> npt.NDArray[np.int64]:
        cloud = Integration(rig, TENTH, FAR)
        cloud.add_points(points, T_map_sensor)
        return occupied(cloud.diff(), TENTH)

    base = {tuple(v) for v in map_of(first, np.eye(4)).tolist()}
    near = np.array([(x, y, z) for x in range(-2, 3) for y in range(-2, 3) for z in range(-2, 3)])

    def share(voxels: npt.NDArray[np.int64]) -> float:
        """Fraction of voxels with one of the first sweep's within 2, Chebyshev."""
        return float(np.mean([any(tuple(v) in base for v in (voxel + near).tolist()) for voxel in voxels]))

    assert share(map_of(second, T)) >= 0.75
    assert share(map_of(second, inverse(T))) < 0.35


def test_a_scan_of_points_means_what_its_points_mean_and_each_is_counted_once() -> None:
    plain = rig_of(BARREL)
    limits = Integrator(min_range_m=0.3, max_range_m=3.0)
    points = np.random.default_rng(5).uniform(-2.5, 2.5, (500, 3)).astype(np.float32)
    points[0], points[1], points[2], points[3] = np.nan, 0.0, (0.1, 0.1, 0.1), (9.0, 0.0, 0.0)
    image = np.full((BARREL.height, BARREL.width), np.nan, np.float32)
    scan = replace(random_scan(BARREL, 3), range_m=image, points_m=points, amplitude=None, colour={}, thermal={})
    by_scan, by_points = Integration(plain, GEOMETRY, limits), Integration(plain, GEOMETRY, limits)
    by_scan.add(scan)
    by_points.add_points(points, scan.T_map_rig @ plain["tof"].transform, range_camera="tof")
    assert by_scan.diff().keys() == by_points.diff().keys()
    assert all(by_scan.diff()[key] == cell for key, cell in by_points.diff().items())
    counts = by_scan.counts
    assert (counts.pixels, counts.no_return, counts.too_near) == (500, 2, 1)
    assert counts.too_far == int((np.linalg.norm(points[4:], axis=1) > 3.0).sum()) + 1
    # Kept scans give the same bytes back, and a moved one takes its points along.
    again = decode_scan(encode_scan(scan))
    assert again.points_m is not None
    assert again.points_m.tobytes() == points.tobytes()
    assert move_scan(scan, np.eye(4)).points_m is points
    with pytest.raises(BadInputError, match="float32, got float64 of shape"):
        by_scan.add(replace(scan, points_m=points.astype(np.float64)))  # type: ignore[arg-type]
