"""Point clouds of lidars (`sensor_msgs/PointCloud2`, Livox' `CustomMsg`): their points, and the beams of these.

Points of known beams are taken to be moved to one time by the driver that published the cloud; those without rings are
moved by their own times, where they have some (`clouds.deskew`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.raster import MAX_SIDE_PX
from cairn_fusion.clouds.sweep_image import R_LIDAR_CAMERA
from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.messages import LIVOX, RosHeader, WireReader, header_of
from cairn_map.errors import BadInputError

FIELD_BYTES_MIN = 13
FIELDS_MAX = 64
LIVOX_FIELDS = {
    "offset_time": (0, "u4"),
    "x": (4, "f4"),
    "y": (8, "f4"),
    "z": (12, "f4"),
    "reflectivity": (16, "u1"),
    "tag": (17, "u1"),
    "line": (18, "u1"),
}
"""Offset and NumPy type of each member of a `CustomPoint`; the time is nanoseconds from the header's."""
LIVOX_POINT_BYTES = 19
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy types by the numbers of sensor_msgs/PointField."""
STEP_MIN_DEG = 0.01
"""Least angle between two beams; a smaller one makes them one beam."""
FIT_DEG, FIT_STEPS = 0.2, 0.25
"""Greatest angle between a point and its beam: 0.2 degrees, which a driver's correction for motion may add, or a
quarter of the step to the next beam, whichever is more. Of points anywhere between the beams half lie within it."""
FIT_SHARE_MIN = 0.75
"""Least share of a cloud's points that lie within it."""
PIXEL_SHARE_MIN = 0.4
"""Least share of points that have a pixel of their own; clouds with two returns a beam have 0.5."""
CHECKED_POINTS_MIN = 100
"""Points of the smallest cloud of which shares say something."""


@dataclass(frozen=True, slots=True)
class RosPoints:
    """Cloud with its points still as bytes."""

    header: RosHeader
    width: int
    height: int
    fields: dict[str, tuple[int, str]]
    """Offset in the point and NumPy type, by name of the field."""
    point_step: int
    row_step: int
    data: memoryview

    def column(self, name: str) -> npt.NDArray[np.generic]:
        """(N,) one field of all points.

        Raises:
            ValueError: there is no such field.
        """
        if name not in self.fields:
            raise ValueError(f"points have no field {name!r}, but {', '.join(self.fields)}")
        offset, letter = self.fields[name]
        rows = np.frombuffer(self.data, np.uint8, count=self.row_step * self.height).reshape(self.height, self.row_step)
        points = rows[:, : self.width * self.point_step].reshape(-1, self.point_step)
        dtype = np.dtype(letter)
        values: npt.NDArray[np.generic] = np.ascontiguousarray(points[:, offset : offset + dtype.itemsize]).view(dtype)
        return values[:, 0]

    def xyz(self) -> npt.NDArray[np.float64]:
        """(N, 3) metres, the cloud's frame; NaN where nothing came back."""
        return np.stack([self.column(axis).astype(np.float64) for axis in "xyz"], axis=-1)


def read_cloud(data: bytes | memoryview, wire: Wire, *, type_name: str) -> RosPoints:
    """The points of a message of one of the `CLOUDS`; ValueError for other bytes."""
    return read_livox(data, wire) if type_name in LIVOX else read_points(data, wire)


def read_livox(data: bytes | memoryview, wire: Wire) -> RosPoints:
    """A `CustomMsg` of a Livox' driver, as its `PointCloud2` would be; ValueError for other bytes.

    Its `timebase` is the header's time, or, of a lidar without synchronisation, that since its start: points' times
    count from the header's.
    """
    reader = WireReader(data, wire)
    header = header_of(reader, wire)
    reader.integer("Q")  # timebase
    reader.integer("I")  # point_num, which the length of the sequence says again
    for _ in range(4):  # lidar_id, and three bytes of nothing
        reader.integer("B")
    octets, count, step = reader.records(LIVOX_POINT_BYTES)
    # The last point may lack the bytes up to the next one.
    whole = memoryview(bytes(octets).ljust(count * step, b"\0"))
    fields = {name: (offset, reader.order + letter) for name, (offset, letter) in LIVOX_FIELDS.items()}
    return RosPoints(header, count, min(count, 1), fields, step, count * step, whole)


def read_points(data: bytes | memoryview, wire: Wire) -> RosPoints:
    """A `sensor_msgs/PointCloud2`; ValueError for other bytes."""
    reader = WireReader(data, wire)
    header = header_of(reader, wire)
    height, width = reader.integer("I"), reader.integer("I")
    count = reader.length(FIELD_BYTES_MIN)
    if count > FIELDS_MAX:
        raise ValueError(f"points of {count} fields, at most {FIELDS_MAX} are read")
    found = [(reader.text(), reader.integer("I"), reader.integer("B"), reader.integer("I")) for _ in range(count)]
    order = ">" if reader.integer("B") else "<"
    point_step, row_step, octets = reader.integer("I"), reader.integer("I"), reader.octets()
    # The layout that the message states must fit its bytes, before any array is made.
    fields = {name: (offset, order + TYPES[kind]) for name, offset, kind, _ in found if kind in TYPES}
    if not (width and height):
        width = height = 0  # no rows of nothing: 2^32 of them would take no bytes
    elif not point_step:
        raise ValueError("points of 0 bytes are announced")
    if any(offset + np.dtype(letter).itemsize > point_step for offset, letter in fields.values()):
        raise ValueError(f"a field lies outside its point of {point_step} bytes")
    if width * point_step > row_step or row_step * height > len(octets):
        raise ValueError(
            f"{width} x {height} points of {point_step} bytes are announced, {len(octets)} bytes are there"
        )
    return RosPoints(header, width, height, fields, point_step, row_step, octets)


def elevations_of(points: RosPoints) -> tuple[float, ...] | None:
    """Elevations of a cloud's beams, degrees, highest first: by the field `ring`, else by rows; None without both."""
    if not {"x", "y", "z"} <= points.fields.keys():
        return None
    xyz = points.xyz()
    if "ring" in points.fields:
        beams = points.column("ring").astype(np.int64)
    elif points.height > 1:
        beams = np.repeat(np.arange(points.height), points.width)
    else:
        return None
    # The median over a beam is robust against noise and against points without a direction.
    across = np.hypot(xyz[:, 0], xyz[:, 1])
    seen = np.isfinite(xyz).all(axis=1) & (across > 0)
    beams, elevations_deg = beams[seen], np.degrees(np.arctan2(xyz[seen, 2], across[seen]))
    numbers = np.unique(beams)
    if not 0 < len(numbers) <= MAX_SIDE_PX // 16:
        return None
    medians_deg = np.sort([np.median(elevations_deg[beams == number]) for number in numbers])[::-1]
    if np.any(-np.diff(medians_deg) < STEP_MIN_DEG):
        return None
    return tuple(round(float(value), 3) for value in medians_deg)


def check_beams(xyz: npt.NDArray[np.float64], lidar: SpinningLidar, name: str) -> None:
    """Refuse a cloud whose points another lidar must have measured: a wrong model maps them where nothing was.

    Args:
        xyz: (N, 3) metres, x forward, y left, z up; NaN where nothing came back.
        lidar: the raster that they are to be sorted into.
        name: name of the camera, for messages.

    Raises:
        BadInputError: kind `bad_mapping`: too few points lie on a beam, or too many share a pixel.
    """
    own = xyz[np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)] @ R_LIDAR_CAMERA
    if len(own) < CHECKED_POINTS_MIN:
        return
    beams_deg = np.array(lidar.elevations_deg)
    steps_deg = np.abs(np.diff(beams_deg)) if lidar.height > 1 else np.array([2 * FIT_DEG])
    # Each point with its nearest beam; of the two steps next to a beam the smaller one counts.
    elevations_deg = np.degrees(np.arctan2(-own[:, 1], np.hypot(own[:, 0], own[:, 2])))
    nearest = np.rint(np.interp(-elevations_deg, -beams_deg, np.arange(lidar.height))).astype(np.int64)
    off_deg = np.abs(elevations_deg - beams_deg[nearest])
    step_deg = np.minimum(np.append(steps_deg, steps_deg[-1]), np.append(steps_deg[0], steps_deg))
    fits = off_deg <= np.maximum(FIT_DEG, FIT_STEPS * step_deg[nearest])
    if (share := float(fits.mean())) < FIT_SHARE_MIN:
        raise BadInputError(
            "bad_mapping",
            f"camera {name}: elevations_deg does not describe its lidar: only {share:.0%} of a cloud's {len(own)} "
            f"points lie within {FIT_DEG:g} degrees, or {FIT_STEPS:g} of a step, of one of the {lidar.height} beams "
            f"({np.median(off_deg):.2g} degrees off in the median, {off_deg.max():.2g} at most; the points' elevations "
            f"are {elevations_deg.min():.1f} to {elevations_deg.max():.1f}). Take the beams of its data sheet, or "
            "lidar: {kind: cloud}",
        )
    pixels = lidar.project(own[fits])
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    number = np.rint(pixels[:, 1]) * lidar.width + np.rint(pixels[:, 0]) % lidar.width
    if (used := len(np.unique(number)) / max(1, len(number))) < PIXEL_SHARE_MIN:
        raise BadInputError(
            "bad_mapping",
            f"camera {name}: columns: {lidar.width} is too few: {len(number)} points of a cloud fall into "
            f"{len(np.unique(number))} pixels ({used:.0%}), and only the nearest point of each would be mapped. Take "
            "the columns of one turn of the lidar",
        )
