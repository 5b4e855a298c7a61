"""A live robot at the full rate of its cameras: the door alone, and every scan mapped at 5 cm.

A bridge in a process of its own sends 90 MB/s at 15 Hz: depth 640 x 480, colour 1280 x 960, thermal 640 x 512, a cloud
of 65 536 points, three CameraInfo, and tf at 50 Hz. The head turns in the middle of a ball of 3 m, so that the same
images are right at any time. Depth and cloud are scans of their own: 30 a second come. Stamps are the times of sending.
"""

import json
import multiprocessing
import statistics
import struct
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from tests.fixtures.client.bridge import a_bridge
from tests.fixtures.fusion.bags import ROS2, Messages, Timed
from tests.fixtures.fusion.live_drive import wire_of

from cairn_calib.rig.camera import Camera
from cairn_client.live.foxglove_source import FoxgloveSource
from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.live_opening import open_live
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.ros.live_scans import ReadyScan
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import mapping_from_yaml
from cairn_map.evidence.channels import COLOUR, TEMPERATURE
from cairn_map.evidence.grid import geometry_for

Row = tuple[str, str, str]
NOWHERE = "http://127.0.0.1:9/maps/bench"
RATE_HZ, TF_EVERY_S = 15.0, 0.02
RADIUS_M, TURN_RAD_PER_S = 3.0, 0.3
TAKE_S = 0.1
CAMERAS = {
    "depth": Camera(width=640, height=480, focal_px=(460.0, 460.0), centre_px=(319.5, 239.5)),
    "colour": Camera(width=1280, height=960, focal_px=(920.0, 920.0), centre_px=(639.5, 479.5)),
    "warm": Camera(width=640, height=512, focal_px=(600.0, 600.0), centre_px=(319.5, 255.5)),
}
OPTICAL = [-0.5, 0.5, -0.5, 0.5]
STAMP = struct.Struct("<iI")
STAMP_AT = 4
"""Place of the time in a message whose first member is a header, after the head of CDR."""
MAPPING = {
    "name": "bench",
    "frames": {"map": "odom", "base": "base_link"},
    "poses": {"topic": "/tf", "max_gap_s": 1.0},
    "time_tolerance_s": 0.04,
    "cameras": {
        "depth": {"spectrum": "range", "topic": "/depth/image", "info": "/depth/info"},
        "colour": {"spectrum": "colour", "topic": "/colour/image", "info": "/colour/info"},
        "warm": {"spectrum": "thermal", "topic": "/warm/image", "info": "/warm/info"},
        "lidar": {"spectrum": "range", "topic": "/points", "lidar": {"kind": "cloud"}},
    },
}


def live_mapping_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    seconds = 4.0 if smoke else 30.0
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    sender = context.Process(target=_send, args=(theirs,), daemon=True)
    sender.start()
    url = str(ours.recv())
    try:
        yield from _door_rows(url, seconds)
        yield from _mapping_rows(url, seconds)
    finally:
        ours.close()
        sender.join()


def _door_rows(url: str, seconds: float) -> Iterator[Row]:
    source = FoxgloveSource(url)
    source.open(lambda topic: True)
    source.take(within_s=5.0)
    first, start_s, cpu_s = source.counts, time.perf_counter(), time.process_time()
    size_bytes = 0
    while time.perf_counter() < start_s + seconds:
        size_bytes += sum(len(message.data) for message in source.take(within_s=TAKE_S))
    took_s, cpu_s = time.perf_counter() - start_s, time.process_time() - cpu_s
    images_hz = (source.counts["/depth/image"] - first["/depth/image"]) / took_s
    source.close()
    yield "live door alone, depth, colour, thermal and cloud", f"{100 * cpu_s / took_s:.0f}", "% of a core (at most 25)"
    yield "  what came", f"{size_bytes / took_s / 1e6:.0f}", f"MB/s, {images_hz:.1f} depth images/s"


def _mapping_rows(url: str, seconds: float) -> Iterator[Row]:
    mapping = mapping_from_yaml(json.dumps(MAPPING), "bench.yaml")
    source = FoxgloveSource(url)
    opened = open_live(source, mapping, within_s=30.0)
    grid = geometry_for(voxel_edge_m=0.05, channels=(COLOUR, TEMPERATURE))
    taken: list[tuple[float, float]] = []

    def note(ready: ReadyScan) -> None:
        """Note a scan's stamp, and the time at which it was evidence."""
        taken.append((ready.found.time_s, time.time()))

    with tempfile.TemporaryDirectory() as folder:
        robot = Robot(opened.rig, NOWHERE, directory=Path(folder) / "r", name="r", geometry=grid, stay=True)
        decoder = ScanDecoder(url, mapping, opened.rig, opened.topics)
        live = LiveMapping(robot, opened.scans, decoder, ScanGate(None), on_taken=note)
        with robot:
            # Kernels are read with the first scans.
            _run(live, source, seconds / 4)
            taken.clear()
            arrived, dropped, commits = opened.scans.arrived.total(), live.dropped, live.commits
            start_s, cpu_s, durable_s = time.perf_counter(), time.process_time(), list[float]()
            while time.perf_counter() < start_s + seconds:
                _run(live, source, 0.0)
                if live.commits > commits and len(taken) > 1:
                    # The scan that ended the measurement is of the next one.
                    durable_s.append(time.time() - taken[-2][0])
                commits = live.commits
            took_s, cpu_s = time.perf_counter() - start_s, time.process_time() - cpu_s
            arrived, dropped = opened.scans.arrived.total() - arrived, live.dropped - dropped
            source.close()
    late_s = [done_s - stamp_s for stamp_s, done_s in taken]
    came = f"of {arrived / took_s:.1f} that came, {dropped} dropped"
    yield "live mapping, 5 cm, every scan", f"{len(taken) / took_s:.1f}", f"scans/s {came} (at least 10)"
    yield "  its work", f"{1e3 * cpu_s / max(1, len(taken)):.0f}", "CPU ms a scan, door and decoding included"
    if late_s:
        yield "  image to the robot's own map, p95", f"{_p95(late_s):.2f}", "s (below 1)"
    if durable_s:
        yield "  a commit's last image to the durable commit, p95", f"{_p95(durable_s):.2f}", "s (below 1)"


def _run(live: LiveMapping, source: FoxgloveSource, seconds: float) -> None:
    """Map for some seconds, one step at least."""
    end_s = time.perf_counter() + seconds
    while True:
        live.step(source.take(within_s=0.0 if live.is_behind else TAKE_S))
        if time.perf_counter() >= end_s:
            return


def _p95(values: list[float]) -> float:
    return statistics.quantiles(values, n=20, method="inclusive")[-1] if len(values) > 1 else values[0]


# The robot, in a process of its own


def _send(link: "Connection[Any, Any]") -> None:
    """Say the bridge's URL, and send until the other end closes."""
    make = Messages(ROS2)
    images = [bytearray(wire_of(message)) for _, _, message in _images(make)]
    topics = [topic for _, topic, _ in _images(make)]
    with a_bridge() as bridge:
        bridge.offer_all([*_images(make), _turned(make, 0.0)])
        static = _fixed(make)
        bridge.offer(static[1], "tf2_msgs/msg/TFMessage")
        bridge.latch(static)
        link.send(bridge.url)
        due_s = next_s = time.time()
        while not link.poll(max(0.0, next_s - time.time())):
            now_s = time.time()
            bridge.send(_turned(make, now_s))
            next_s = max(next_s + TF_EVERY_S, now_s)
            if now_s < due_s:
                continue
            due_s = max(due_s + 1 / RATE_HZ, now_s - 1 / RATE_HZ)
            for topic, data in zip(topics, images, strict=True):
                STAMP.pack_into(data, STAMP_AT, int(now_s), int(now_s % 1 * 1e9))
                bridge.relay(topic, bytes(data))


def _images(make: Messages) -> Iterator[Timed]:
    """The images of the head in the middle of a ball, and what belongs to them."""
    rng = np.random.default_rng(5)
    for name, camera in CAMERAS.items():
        yield 0.0, f"/{name}/info", make.info(0.0, f"{name}_frame", camera)
    mm = np.rint(1000 * RADIUS_M * CAMERAS["depth"].rays()[..., 2] + rng.normal(0, 5, (480, 640))).astype(np.uint16)
    yield 0.0, "/depth/image", make.image(0.0, "depth_frame", mm, "16UC1")
    bgr = rng.integers(0, 255, (960, 1280, 3)).astype(np.uint8)
    yield 0.0, "/colour/image", make.image(0.0, "colour_frame", bgr, "bgr8")
    centikelvin = rng.integers(29_300, 29_500, (512, 640)).astype(np.uint16)
    yield 0.0, "/warm/image", make.image(0.0, "warm_frame", centikelvin, "mono16")
    points = rng.normal(size=(65_536, 4)).astype(np.float32)
    points[:, :3] *= RADIUS_M / np.linalg.norm(points[:, :3], axis=1, keepdims=True)
    names = ("x", "y", "z", "intensity")
    yield (
        0.0,
        "/points",
        make.make(
            "sensor_msgs/PointCloud2",
            header=make.header(0.0, "lidar_frame"),
            height=1,
            width=len(points),
            fields=[
                make.make("sensor_msgs/PointField", name=name, offset=4 * n, datatype=7, count=1)
                for n, name in enumerate(names)
            ],
            is_bigendian=False,
            point_step=16,
            row_step=points.nbytes,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        ),
    )


def _fixed(make: Messages) -> Timed:
    frames = [(f"{name}_frame", [0, 0.02 * n, 0, *OPTICAL]) for n, name in enumerate(CAMERAS)]
    frames.append(("lidar_frame", [0, 0, 0.1, 0, 0, 0, 1]))
    return 0.0, "/tf_static", make.tf(*(make.transform(0.0, "base_link", frame, pose) for frame, pose in frames))


def _turned(make: Messages, time_s: float) -> Timed:
    """The head's pose at a time."""
    half = TURN_RAD_PER_S * (time_s % 1e4) / 2
    pose = [0, 0, 0, 0, 0, np.sin(half), np.cos(half)]
    return time_s, "/tf", make.tf(make.transform(time_s, "odom", "base_link", pose))
