"""Decoder of scans: the messages of one range image, and of the images that go with it, as arrays in metres and kelvin.

    messages of a bag, of a live robot  ->  ScanDecoder.decode  ->  Scan

The same bytes give the same scan, bit for bit, whatever door they came through.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import AnyCamera, SpinningLidar
from cairn_calib.rig.poses import inverse
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.clouds.cloud_columns import cloud_of
from cairn_fusion.clouds.deskew import deskewed, point_times
from cairn_fusion.clouds.sweep_image import R_LIDAR_CAMERA, T_LIDAR_CAMERA, sweep_image
from cairn_fusion.recording.recording_format import (
    Convention,
    decode_kelvin,
    decode_range,
    range_from_radial,
    range_from_z_depth,
)
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_fusion.ros.bag import BagMessage, Topic, Wire
from cairn_fusion.ros.bag_index import translate_message_damage, wire_of
from cairn_fusion.ros.bag_scans import BagScan, PoseAt
from cairn_fusion.ros.images import AnyImage, Pixels, amplitude_of, colour_of, depth_of, labels_of, thermal_counts_of
from cairn_fusion.ros.messages import IMAGE, read_compressed_image, read_image
from cairn_fusion.ros.point_clouds import check_beams, read_cloud
from cairn_fusion.ros.topic_mapping import BagMapping, MappedCamera

PixelsT = TypeVar("PixelsT", bound=Pixels)
MessageOf = Callable[[str], BagMessage]
"""The message of a scan, by topic."""


class ScanDecoder:
    """Decoder of the scans of one source."""

    def __init__(
        self, source: str, mapping: BagMapping, rig: Rig, topics: Mapping[str, Topic], *, is_deskewed: bool = False
    ) -> None:
        """Args: source: name in errors; topics: those of images and points; is_deskewed: clouds are of one time."""
        self._source = source
        self._mapping = mapping
        self._rig = rig
        self._topics = topics
        self._is_deskewed = is_deskewed

    def decode(self, found: BagScan, message: MessageOf, pose_at: PoseAt | None) -> Scan:
        """One scan.

        Args:
            found: its images and pose.
            message: the messages of its images.
            pose_at: way of the robot during a sweep; None: unknown.

        Raises:
            BadInputError: an image is not its camera's in size, or has an encoding that is not read.
            DamagedDataError: an image cannot be decoded.
        """
        # The range image makes the scan; of other cameras the images that `scans_of` found for its time.
        cameras = self._mapping.cameras
        own = cameras[found.camera]
        xyz = None if own.lidar is None else self._sweep(own, found, message, pose_at)
        labels = {
            name: self._pixels(camera.labels, message, labels_of)
            for name, camera in cameras.items()
            if camera.labels is not None and camera.labels in found.images
        }
        scan = Scan(
            time_s=found.time_s,
            T_map_rig=found.T_map_rig,
            range_camera=found.camera,
            range_m=self._range(own, found, message) if xyz is None else sweep_image(xyz, self._lidar(found.camera)),
            points_m=None if xyz is None or not own.is_loose else (xyz @ R_LIDAR_CAMERA).astype(np.float32),
            amplitude=self._amplitude(own, found, message),
            colour={
                name: self._pixels(topic, message, colour_of) for name, topic in self._others(Spectrum.COLOUR, found)
            },
            thermal={
                name: decode_kelvin(self._pixels(topic, message, thermal_counts_of), cameras[name].thermal_encoding)
                for name, topic in self._others(Spectrum.THERMAL, found)
            },
            labels=labels,
            label_names=self._mapping.label_names if labels else {},
        )
        check_scan(scan, self._rig)
        return scan

    def _others(self, spectrum: Spectrum, found: BagScan) -> Iterator[tuple[str, str]]:
        """Cameras of a spectrum of which a scan has an image, each with its topic."""
        for name, camera in self._mapping.cameras.items():
            if camera.spectrum is spectrum and camera.topic is not None and camera.topic in found.images:
                yield name, camera.topic

    def _range(self, camera: MappedCamera, found: BagScan, message: MessageOf) -> npt.NDArray[np.float32]:
        """(H, W) metres along the beam."""
        return _range_of(self._pixels(camera.first_topic, message, depth_of), self._rig[found.camera].camera, camera)

    def _sweep(
        self, camera: MappedCamera, found: BagScan, message: MessageOf, pose_at: PoseAt | None
    ) -> npt.NDArray[np.float64]:
        """(N, 3) the points of a lidar's cloud, metres, its own frame; of a known lidar they must lie on its beams."""
        sweep, topic = message(camera.first_topic), self._topics[camera.first_topic]
        with translate_message_damage(self._source, sweep):
            points = read_cloud(sweep.data, wire_of(topic), type_name=topic.type)
            xyz = points.xyz()
        if not camera.is_loose:
            check_beams(xyz, self._lidar(found.camera), found.camera)
            return xyz
        place = f"{self._source}: {camera.first_topic} at {found.time_s:.6f} s"
        cloud = cloud_of({name: points.column(name) for name in points.fields}, place)
        times = None if self._is_deskewed or pose_at is None else point_times(cloud, place)
        if times is None or pose_at is None:
            return cloud.points.astype(np.float64)
        # The way of the lidar, which is fixed on the base.
        T_base_lidar, way = self._rig[found.camera].transform @ inverse(T_LIDAR_CAMERA), pose_at
        moved = deskewed(
            cloud.points, times.absolute_s(found.time_s, place), found.time_s, lambda time_s: way(time_s) @ T_base_lidar
        )
        return moved.astype(np.float64)

    def _lidar(self, name: str) -> SpinningLidar:
        lidar = self._rig[name].camera
        assert isinstance(lidar, SpinningLidar)  # noqa: S101 - `_camera_of` made it so
        return lidar

    def _amplitude(self, camera: MappedCamera, found: BagScan, message: MessageOf) -> npt.NDArray[np.uint16] | None:
        has_one = camera.amplitude is not None and camera.amplitude in found.images
        return self._pixels(camera.amplitude or "", message, amplitude_of) if has_one else None

    def _pixels(self, topic: str, message_of: MessageOf, decode: Callable[[AnyImage, str], PixelsT]) -> PixelsT:
        """The pixels of a scan's image of one topic."""
        message, wire = message_of(topic), wire_of(self._topics[topic])
        with translate_message_damage(self._source, message):
            read: Callable[[bytes | memoryview, Wire], AnyImage]
            read = read_image if self._topics[topic].type == IMAGE else read_compressed_image
            image = read(message.data, wire)
            return decode(image, f"{self._source}: {topic} at {message.log_ns / 1e9:.6f} s")


def _range_of(pixels: Pixels, camera: AnyCamera, mapped: MappedCamera) -> npt.NDArray[np.float32]:
    """(H, W) float32, metres along the beam."""
    if pixels.dtype == np.uint16:
        return decode_range(pixels.astype(np.uint16, copy=False), camera, mapped.range_encoding)
    convert = range_from_z_depth if mapped.convention is Convention.Z else range_from_radial
    return convert(pixels, camera, units_per_m=1.0)
