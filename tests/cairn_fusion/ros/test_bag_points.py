"""Clouds of a spinning lidar, in bags."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from tests.fixtures.fusion.bags import KINDS, ROS2, Messages, Timed, pose_of, write_bag
from tests.fixtures.fusion.cloud_forms import beams, off_walls_m, pcd_binary, seen
from tests.fixtures.fusion.cloud_forms import pose_of as room_pose
from tests.fixtures.fusion.drive_mapping import MAPPING, mapping_text
from tests.fixtures.fusion.live_drive import START_S as LIVE_START_S
from tests.fixtures.fusion.live_drive import drive as live_drive
from tests.fixtures.fusion.live_drive import in_bag_order
from tests.fixtures.fusion.pose_forms import kitti

from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import Transform, transform_points
from cairn_fusion.clouds.sweep_image import R_LIDAR_CAMERA, sweep_image
from cairn_fusion.importers import open_source
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.frame_poses import PoseOptions
from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.bag_recording import survey
from cairn_fusion.ros.point_clouds import (
    RosPoints,
    check_beams,
    elevations_of,
    read_livox,
    read_points,
)
from cairn_fusion.ros.topic_mapping import mapping_from_yaml
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import geometry_for

ELEVATIONS = (10.0, 4.0, 0.0, -3.5)
LIDAR = SpinningLidar(width=90, height=4, elevations_deg=ELEVATIONS)
START_S = 1_700_000_000.0
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<u2"],
        "offsets": [0, 4, 8, 16],
        "itemsize": 20,
    }
)


def swept(seed: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """(4, 90) ranges, a tenth of them without a return."""
    rng = np.random.default_rng(seed)
    range_m = rng.uniform(1, 8, (4, 90)).astype(np.float32)
    range_m[rng.random((4, 90)) < 0.1] = np.nan
    return range_m


def cloud(make: Messages, time_s: float, range_m: np.ndarray[Any, np.dtype[np.float32]], *, flat: bool = False) -> Any:
    """The message that a driver makes of a sweep."""
    points = np.zeros((4, 90), POINT)
    xyz = (LIDAR.rays() * range_m[..., None]) @ R_LIDAR_CAMERA.T
    for n, axis in enumerate("xyz"):
        points[axis] = xyz[..., n]
    points["ring"] = np.arange(4)[:, None]
    types = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 16, 4)]
    return make.make(
        "sensor_msgs/PointCloud2",
        header=make.header(time_s, "lidar"),
        height=1 if flat else 4,
        width=360 if flat else 90,
        fields=[make.make("sensor_msgs/PointField", name=n, offset=o, datatype=t, count=1) for n, o, t in types],
        is_bigendian=False,
        point_step=20,
        row_step=20 * (360 if flat else 90),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=False,
    )


def loose_cloud(
    make: Messages,
    time_s: float,
    points: np.ndarray[Any, np.dtype[np.float32]],
    after_ns: np.ndarray[Any, np.dtype[np.uint32]] | None = None,
) -> Any:
    """A message of points without rings and rows, with times of their own if they are given."""
    types = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), *([] if after_ns is None else [("t", 12, 6)])]
    rows = np.zeros(len(points), [("xyz", "<f4", 3), *([] if after_ns is None else [("t", "<u4")])])
    rows["xyz"] = points
    if after_ns is not None:
        rows["t"] = after_ns
    return make.make(
        "sensor_msgs/PointCloud2",
        header=make.header(time_s, "lidar"),
        height=1,
        width=len(points),
        fields=[make.make("sensor_msgs/PointField", name=n, offset=o, datatype=t, count=1) for n, o, t in types],
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )


def kitti_of(folder: Path, poses: list[Transform]) -> PoseOptions:
    kitti(folder, poses)
    return PoseOptions(path=folder / "poses.txt", of="rig")


POSES = [room_pose(0.3 * n, 0.4 * n) for n in range(3)]


def drive(make: Messages) -> Iterator[Timed]:
    """Three sweeps of a robot that goes forward, its lidar half a metre above its base."""
    T_base_lidar, T_odom_base = np.eye(4), np.eye(4)
    T_base_lidar[2, 3] = 0.5
    yield START_S, "/tf_static", make.tf(make.transform(START_S, "base_link", "lidar", pose_of(T_base_lidar)))
    for n in range(3):
        T_odom_base[0, 3] = n
        time_s = START_S + 0.125 * n
        yield time_s, "/tf", make.tf(make.transform(time_s, "odom", "base_link", pose_of(T_odom_base)))
        yield time_s, "/points", cloud(make, time_s, swept(n), flat=n == 2)


@pytest.mark.parametrize("kind", KINDS)
def test_sweeps_come_out_of_a_bag_as_the_range_images_they_were(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", kind, drive)
    assert survey(path).proposal.questions == ()
    bag = open_source(path)
    camera = bag.rig["lidar"].camera
    assert isinstance(camera, SpinningLidar)
    assert camera.width == 90
    assert camera.elevations_deg == pytest.approx(ELEVATIONS, abs=1e-3)
    np.testing.assert_allclose(bag.rig["lidar"].transform[:3, 3], (0, 0, 0.5))
    for n, scan in enumerate(bag):
        np.testing.assert_allclose(scan.range_m, swept(n), rtol=1e-6)
        np.testing.assert_allclose(scan.T_map_rig[:3, 3], (n, 0, 0))


def points_of(**changes: Any) -> RosPoints:
    make = Messages(ROS2)
    message = cloud(make, START_S, swept(0))
    for name, value in changes.items():
        object.__setattr__(message, name, value)
    return read_points(bytes(ROS2.serialize_cdr(message, "sensor_msgs/msg/PointCloud2")), Wire.CDR)


def test_beams_are_told_apart_by_rings_or_rows_or_not_at_all() -> None:
    whole = points_of()
    without_ring = {name: field for name, field in whole.fields.items() if name != "ring"}
    by_rows = RosPoints(whole.header, 90, 4, without_ring, 20, 1800, whole.data)
    assert elevations_of(whole) == elevations_of(by_rows) == pytest.approx(ELEVATIONS, abs=1e-3)
    assert elevations_of(RosPoints(whole.header, 360, 1, without_ring, 20, 7200, whole.data)) is None
    assert elevations_of(RosPoints(whole.header, 90, 4, {}, 20, 1800, whole.data)) is None


def test_of_points_in_one_pixel_the_nearest_counts() -> None:
    xyz = np.array([[5.0, 0, 0], [3.0, 0, 0], [np.nan, 0, 0], [0, 0, 0], [0, 0, 9.0]])
    image = sweep_image(xyz, LIDAR)
    assert image[np.isfinite(image)].tolist() == [3.0]
    assert np.argwhere(np.isfinite(image)).tolist() in ([[2, 44]], [[2, 45]])  # straight ahead, between two columns


@pytest.mark.parametrize(
    "changes", [{"width": 91}, {"height": 5}, {"point_step": 10}, {"row_step": 5000}, {"width": 1 << 31}]
)
def test_a_cloud_that_claims_more_than_it_has_is_refused(changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"announced|outside"):
        points_of(**changes)


def test_a_damaged_cloud_is_told_with_its_topic(tmp_path: Path) -> None:
    def messages(make: Messages) -> Iterator[Timed]:
        for time_s, topic, message in drive(make):
            if topic == "/points":
                object.__setattr__(message, "width", 1000)
            yield time_s, topic, message

    with pytest.raises(DamagedDataError, match="/points at 1700000000"):
        open_source(write_bag(tmp_path / "bad", "mcap", messages))


def turned(lidar: SpinningLidar, *, up_deg: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(N, 3) points that a lidar measures on a sphere, their elevations raised by an angle."""
    beams = SpinningLidar(
        width=lidar.width, height=lidar.height, elevations_deg=tuple(e + up_deg for e in lidar.elevations_deg)
    )
    return np.asarray(8.0 * beams.rays().reshape(-1, 3) @ R_LIDAR_CAMERA.T)


SIXTEEN = SpinningLidar(width=360, height=16, elevations_deg=tuple(float(e) for e in range(15, -17, -2)))


@pytest.mark.parametrize("lidar", [LIDAR, SIXTEEN, SpinningLidar(width=360, height=1, elevations_deg=(0.0,))])
@pytest.mark.parametrize("up_deg", [-0.19, 0.0, 0.19])
def test_a_cloud_fits_the_lidar_that_measured_it(lidar: SpinningLidar, up_deg: float) -> None:
    check_beams(turned(lidar, up_deg=up_deg), lidar, "lidar")
    check_beams(np.full((5, 3), np.nan), lidar, "lidar")  # nothing came back


def test_a_cloud_of_another_lidar_is_refused_with_the_number_that_is_wrong() -> None:
    three = SpinningLidar(width=360, height=3, elevations_deg=(15.0, 0.0, -15.0))
    with pytest.raises(BadInputError, match=r"elevations_deg.* only 50% of .* one of the 3 beams"):
        check_beams(turned(SIXTEEN), three, "lidar")
    with pytest.raises(BadInputError, match="elevations_deg"):
        check_beams(turned(SIXTEEN, up_deg=1.0), SIXTEEN, "lidar")
    narrow = SpinningLidar(width=90, height=16, elevations_deg=SIXTEEN.elevations_deg)
    with pytest.raises(BadInputError, match="columns: 90 is too few"):
        check_beams(turned(SIXTEEN), narrow, "lidar")


def test_points_without_beams_are_beams_of_their_own_and_wrong_ones_end_the_reading(tmp_path: Path) -> None:
    def messages(make: Messages) -> Iterator[Timed]:
        for time_s, topic, message in drive(make):
            if topic == "/points":
                message = cloud(make, time_s, swept(0), flat=True)
                object.__setattr__(message, "fields", message.fields[:3])  # no rings, no rows
            yield time_s, topic, message

    path = write_bag(tmp_path / "flat", "mcap", messages)
    proposal = survey(path).proposal
    assert proposal.questions == ()
    loose = open_source(path)
    points = loose.scan(0).points_m
    assert points is not None
    ranges = np.linalg.norm(points, axis=1)
    expected = swept(0)[np.isfinite(swept(0))]
    np.testing.assert_allclose(np.sort(ranges[np.isfinite(ranges)]), np.sort(expected), rtol=1e-6)
    # Beams that somebody knows are taken, if the points lie on them.
    lines = proposal.text.splitlines()
    place = next(n for n, line in enumerate(lines) if "kind: cloud" in line)
    lines[place] = f"    lidar: {{columns: 90, elevations_deg: {list(ELEVATIONS)}}}"
    sweep = open_source(path, mapping=mapping_from_yaml("\n".join(lines), "bag.yaml")).scan(0)
    np.testing.assert_allclose(sweep.range_m, swept(0), rtol=1e-6)
    assert sweep.points_m is None
    lines[place] = "    lidar: {columns: 90, elevations_deg: [15, 0, -15]}"
    wrong = open_source(path, mapping=mapping_from_yaml("\n".join(lines), "bag.yaml"))
    with pytest.raises(BadInputError, match="elevations_deg does not describe its lidar"):
        wrong.scan(0)
    lines[place] = "    lidar: {kind: cloud, columns: 90}"
    with pytest.raises(BadInputError, match="one of kind cloud has neither"):
        mapping_from_yaml("\n".join(lines), "bag.yaml")


def test_packets_of_a_driver_are_told_with_the_program_that_makes_points_of_them(tmp_path: Path) -> None:
    ROS2.register(get_types_from_msg("uint8[] buf", "ouster_sensor_msgs/msg/PacketMsg"))

    def messages(make: Messages) -> Iterator[Timed]:
        for time_s, topic, message in drive(make):
            if topic != "/points":
                yield time_s, topic, message
        yield (
            START_S,
            "/ouster/lidar_packets",
            make.make("ouster_sensor_msgs/PacketMsg", buf=np.zeros(8, np.uint8)),
        )

    question, *_ = survey(write_bag(tmp_path / "packets", "mcap", messages)).proposal.questions
    assert question.startswith("/ouster/lidar_packets holds raw packets of an Ouster, no points: play the bag through ")
    assert "replay.launch.xml" in question


def test_points_without_rings_give_the_cells_of_the_same_points_in_files(tmp_path: Path) -> None:
    sweeps = [seen(T, beams(1500, seed=n)) for n, T in enumerate(POSES)]

    def messages(make: Messages) -> Iterator[Timed]:
        yield START_S, "/tf_static", make.tf(make.transform(START_S, "base_link", "lidar", pose_of(np.eye(4))))
        for n, (T, points) in enumerate(zip(POSES, sweeps, strict=True)):
            yield START_S + n, "/tf", make.tf(make.transform(START_S + n, "odom", "base_link", pose_of(T)))
            yield START_S + n, "/points", loose_cloud(make, START_S + n, points)

    poses = kitti_of(tmp_path, POSES)
    bag = open_source(write_bag(tmp_path / "drive", "mcap", messages), poses=poses)
    (tmp_path / "clouds").mkdir()
    for n, points in enumerate(sweeps):
        pcd_binary(tmp_path / "clouds" / f"{n:03d}", points)
    folder = open_source(tmp_path / "clouds", poses=poses)
    geometry = geometry_for(voxel_edge_m=0.1, channels=())
    diffs = []
    for source in (bag, folder):
        measurement = Measurement(source.rig, geometry)
        for scan in source:
            measurement.add(scan)
        diffs.append(measurement.diff())
    assert len(diffs[0]) > 1
    assert diffs[0].keys() == diffs[1].keys()
    assert all(diffs[0][key] == diffs[1][key] for key in diffs[0])


def test_points_of_a_bag_are_moved_by_their_times(tmp_path: Path) -> None:
    """A lidar half a metre above a base that drives 2 m/s and turns 1 rad/s."""
    T_base_lidar = np.eye(4)
    T_base_lidar[2, 3] = 0.5

    def base(time_s: float) -> Transform:
        return room_pose(2.0 * (time_s - START_S) - 1.0, time_s - START_S)

    def messages(make: Messages) -> Iterator[Timed]:
        yield START_S, "/tf_static", make.tf(make.transform(START_S, "base_link", "lidar", pose_of(T_base_lidar)))
        for n in range(51):
            time_s = START_S + n / 100
            yield time_s, "/tf", make.tf(make.transform(time_s, "odom", "base_link", pose_of(base(time_s))))
            if n % 10 == 0 and n < 40:
                steps = np.arange(100)
                rays = np.split(beams(2000, seed=n), 100)
                parts = [seen(base(time_s + k / 1000) @ T_base_lidar, r) for k, r in zip(steps, rays, strict=True)]
                after_ns = np.repeat(steps * 1_000_000, 20).astype(np.uint32)
                yield time_s, "/points", loose_cloud(make, time_s, np.concatenate(parts), after_ns)

    path = write_bag(tmp_path / "drive", "mcap", messages)
    off_m = []
    for is_deskewed in (False, True):
        source = open_source(path, is_deskewed=is_deskewed)
        points = []
        for scan in source:
            assert scan.points_m is not None
            T = scan.T_map_rig @ source.rig["lidar"].transform
            points.append(transform_points(T, scan.points_m.astype(np.float64)))
        off_m.append(off_walls_m(np.concatenate(points)))
    # Half a millimetre of the grid, and half a step of a millisecond.
    assert off_m[0].max() < 0.005
    assert (off_m[1] > 0.03).mean() > 0.2


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_livox_cloud_of_its_own_message_is_that_of_its_driver_s_points(kind: str, tmp_path: Path) -> None:
    sweeps = [seen(T, beams(20, seed=n)) for n, T in enumerate(POSES)]
    sweeps[1][3:5] = 0.0  # what the driver writes where nothing came back
    after_ns = np.arange(20, dtype=np.uint32) * 5_000_000

    def messages(make: Messages, cloud_of: Callable[..., Any]) -> Iterator[Timed]:
        yield START_S, "/tf_static", make.tf(make.transform(START_S, "base_link", "lidar", pose_of(np.eye(4))))
        for n in range(40):
            T = room_pose(0.03 * n, 0.04 * n)
            yield START_S + n / 10, "/tf", make.tf(make.transform(START_S + n / 10, "odom", "base_link", pose_of(T)))
        for n, points in enumerate(sweeps):
            yield START_S + n + 0.01, "/livox/lidar", cloud_of(make, START_S + n + 0.01, points)

    def own(make: Messages, time_s: float, points: np.ndarray[Any, np.dtype[np.float32]]) -> Any:
        return make.livox(time_s, "lidar", points, after_ns)

    def plain(make: Messages, time_s: float, points: np.ndarray[Any, np.dtype[np.float32]]) -> Any:
        return loose_cloud(make, time_s, points, after_ns)

    path = write_bag(tmp_path / "own", kind, lambda make: messages(make, own))
    assert survey(path).proposal.questions == ()
    assert "lidar: {kind: cloud}" in survey(path).proposal.text
    scans = list(open_source(path))
    expected = list(open_source(write_bag(tmp_path / "plain", kind, lambda make: messages(make, plain))))
    assert len(scans) == len(expected) == 3
    for scan, other in zip(scans, expected, strict=True):
        assert scan.points_m is not None and other.points_m is not None
        assert scan.points_m.tobytes() == other.points_m.tobytes()
        assert scan.range_m.tobytes() == other.range_m.tobytes()


def cdr(order: str) -> bytes:
    """A Livox cloud of two points, written by hand; with one byte of padding between them."""
    head = bytes([0, order == "<", 0, 0])
    text = struct.pack(f"{order}iII3s", 1, 5, 3, b"ab\0") + b"\0"  # 16 bytes: `timebase` follows at once
    numbers = struct.pack(f"{order}QI4BI", 7, 2, 1, 0, 0, 0, 2)
    first, second = (struct.pack(f"{order}I3f3B", n, n + 0.5, -n, 2.0, 3, 16, n) for n in (1, 2))
    return head + text + numbers + first + b"\0" + second


@pytest.mark.parametrize("order", ["<", ">"])
def test_points_of_livox_are_read_in_either_order_of_bytes(order: str) -> None:
    points = read_livox(cdr(order), Wire.CDR)
    np.testing.assert_array_equal(points.xyz(), [[1.5, -1, 2], [2.5, -2, 2]])
    assert points.column("offset_time").tolist() == [1, 2] and points.column("line").tolist() == [1, 2]
    assert points.header.frame == "ab"
    for cut in range(len(cdr(order))):
        with pytest.raises(ValueError, match=r"ends early|elements are announced|plain CDR"):
            read_livox(cdr(order)[:cut], Wire.CDR)


def test_a_livox_cloud_that_announces_more_than_it_has_takes_no_memory() -> None:
    huge = bytearray(cdr("<"))
    huge[4 + 16 + 16 : 4 + 16 + 20] = b"\xff" * 4
    with pytest.raises(ValueError, match="4294967295 elements are announced"):
        read_livox(bytes(huge), Wire.CDR)
    empty = cdr("<")[: 4 + 16 + 16] + bytes(4)
    points = read_livox(empty, Wire.CDR)
    assert points.xyz().shape == (0, 3) and elevations_of(points) is None


def test_a_cloud_next_to_cameras_is_a_scan_without_their_images(tmp_path: Path) -> None:
    points = np.random.default_rng(3).uniform(1, 4, (30, 3)).astype(np.float32)

    def messages(make: Messages) -> Iterator[Timed]:
        timed = [*live_drive(make, scans=5)]
        timed += [(t, "/points", loose_cloud(make, t, points)) for t in LIVE_START_S + np.arange(4) / 10 + 0.03]
        return in_bag_order(sorted(timed, key=lambda entry: entry[0]))

    lidar = {"spectrum": "range", "topic": "/points", "lidar": {"kind": "cloud"}, "frame": "depth_frame"}
    text = mapping_text(cameras={**MAPPING["cameras"], "lidar": lidar})
    scans = list(open_source(write_bag(tmp_path / "drive", "mcap", messages), mapping=mapping_from_yaml(text, "it")))
    loose = [scan for scan in scans if scan.range_camera == "lidar"]
    assert len(loose) == 4 and len(scans) > 7
    assert not any(scan.colour or scan.thermal for scan in loose)
    assert any(scan.colour for scan in scans if scan.range_camera == "depth")
