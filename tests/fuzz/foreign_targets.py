"""Readers of what other programs wrote: bags and their messages, cameras of calibration programs."""

import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from tests.fuzz.sections import in_folder, sections_of

from cairn_calib.exchange.rig_exchange import FORMATS, MESSAGE, format_of_text, read_cameras
from cairn_calib.rig.lidar import SpinningLidar
from cairn_fusion.clouds.sweep_image import sweep_image
from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.bag_recording import open_any_bag, survey
from cairn_fusion.ros.images import amplitude_of, colour_of, depth_of, thermal_counts_of
from cairn_fusion.ros.messages import (
    CAMERA_INFO,
    CLOUDS,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    PATH,
    POSES,
    STAMPED,
    read_camera_info,
    read_compressed_image,
    read_header,
    read_image,
    read_path,
    read_pose,
    read_transforms,
)
from cairn_fusion.ros.open_bag import is_bag
from cairn_fusion.ros.point_clouds import elevations_of, read_cloud
from cairn_fusion.ros.topic_mapping import camera_of_info, mapping_of
from cairn_map.errors import CairnError

SCANS_MAX = 2
LIDAR = SpinningLidar(width=16, height=3, elevations_deg=(10.0, 0.0, -30.0))
MAPPING = "bag.yaml"
FILES = ("lab.bag", "lab.db3", "lab.mcap")


def read_bag(data: bytes) -> None:
    """`=== lab.mcap`, then the bag; with `=== bag.yaml` it is mapped by that, else by what is proposed."""
    files = [(name, content) for name, content in sections_of(data) if name in (*FILES, MAPPING)]
    with in_folder(files) as folder, np.errstate(all="ignore"):
        path = next((folder / name for name in FILES if is_bag(folder / name)), folder)
        found = survey(path)
        assert set(found.index.topics) == {entry.topic.name for entry in found.index.topics.values()}
        mapping = mapping_of(folder / MAPPING) if (folder / MAPPING).is_file() else None
        recording = open_any_bag(path, mapping)
        for index in range(min(len(recording), SCANS_MAX)):
            recording.scan(index)


def read_ros_message(data: bytes) -> None:
    """A line `TYPE WIRE`, then the message: its fields, and what they hold as arrays."""
    head, _, message = data.partition(b"\n")
    kind, _, wire_name = head.decode("latin-1").partition(" ")
    wire = Wire.ROS1 if wire_name == Wire.ROS1 else Wire.CDR
    # ValueError: "the bytes are not that"; whoever reads bags says of which message.
    with suppress(ValueError), np.errstate(all="ignore"):
        _use_message(kind, message, wire)


def _use_message(kind: str, message: bytes, wire: Wire) -> None:
    if kind in STAMPED:
        assert np.isfinite(read_header(message, wire).time_s)
    if kind in (IMAGE, COMPRESSED):
        image = read_image(message, wire) if kind == IMAGE else read_compressed_image(message, wire)
        for pixels_of, dimensions in ((depth_of, 2), (amplitude_of, 2), (thermal_counts_of, 2), (colour_of, 3)):
            with suppress(CairnError):
                assert pixels_of(image, "it").ndim == dimensions
    elif kind == CAMERA_INFO:
        info = read_camera_info(message, wire)
        for is_rectified in (False, True):
            camera_of_info(info, is_rectified=is_rectified, name="it")
    elif kind == PATH:
        assert len(read_path(message, wire).poses) * 68 <= len(message)
    elif kind in CLOUDS:
        points = read_cloud(message, wire, type_name=kind)
        elevations_of(points)
        assert sweep_image(points.xyz(), LIDAR).shape == (LIDAR.height, LIDAR.width)
    else:
        is_pose = kind == ODOMETRY or kind in POSES
        edges = [read_pose(message, wire, type_name=kind)] if is_pose else read_transforms(message, wire)
        for edge in edges:
            assert edge.T_parent_child.shape == (4, 4)


def mutated_message(data: bytes, rng: random.Random, mutate: Callable[[bytes], bytes]) -> bytes:
    """The message changed under its line, and seldom the line."""
    head, line, message = data.partition(b"\n")
    return mutate(data) if rng.random() < 0.05 else head + line + mutate(message)


def read_camera_file(data: bytes) -> None:
    """`=== FORMAT`, then the file: what is read is written, and read again the same."""
    for name, content in sections_of(data):
        text = content.decode(errors="replace")
        with suppress(CairnError):
            format_of_text(Path("left.yaml"), text)
        if name == MESSAGE:
            with suppress(CairnError), np.errstate(all="ignore"):
                read_cameras(Path("left.yaml"), text)
        if name in FORMATS:
            with np.errstate(all="ignore"):
                _read_twice(name, text)


def _read_twice(name: str, text: str) -> None:
    each = FORMATS[name]
    found = each.read(text, name="left.yaml")
    again = each.read(each.write(found.cameras), name="left.yaml")
    assert [camera.camera for camera in again.cameras] == [camera.camera for camera in found.cameras]
    for one, other in zip(found.cameras, again.cameras, strict=True):
        assert (one.T_rig_camera is None) == (other.T_rig_camera is None)
        if one.T_rig_camera is not None and other.T_rig_camera is not None:
            np.testing.assert_allclose(one.T_rig_camera, other.T_rig_camera, rtol=1e-6, atol=1e-6)
