"""A folder of clouds and a pose file as a recording: one file is one sweep of a lidar.

    000000.pcd 000001.pcd ...  +  poses of any published form  ->  scans of points, in order

Names of files are numbers or times, as those of a folder of frames; the poses are of the frame that the points are in
(x forward, y left, z up), which is the rig's. Points with times of their own are moved to the sweep's pose where the
poses are by time.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.clouds.cloud_columns import PointCloud
from cairn_fusion.clouds.cloud_file import cloud_suffix, read_cloud
from cairn_fusion.clouds.deskew import PointTimes, deskewed, point_times
from cairn_fusion.clouds.sweep_image import R_LIDAR_CAMERA, T_LIDAR_CAMERA, sweep_image, virtual_lidar
from cairn_fusion.recording.frame_folder import chosen_frames, frame_order, id_time_s
from cairn_fusion.recording.frame_poses import RIG, FrameKey, FramePoses, PoseOptions, read_frame_poses
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.recording import measurements_of
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_map.errors import BadInputError, NotFoundError

LIDAR = "lidar"
"""Name of the rig's one range camera."""
RASTER = virtual_lidar()
LOOSE_SUFFIXES = (".txt", ".csv", ".npy")
"""Suffixes that other files of a recording have, too: they count where there is no other cloud."""


def cloud_files(folder: Path) -> list[Path]:
    """The clouds directly in a folder, all of its most frequent suffix, in order of their names; empty if none is."""
    found = [path for path in sorted(folder.iterdir()) if path.is_file() and cloud_suffix(path) is not None]
    counts = Counter(str(cloud_suffix(path)) for path in found)
    strict = {suffix: count for suffix, count in counts.items() if suffix not in LOOSE_SUFFIXES}
    suffix = max(strict or counts, key=counts.__getitem__, default="")
    kept = [path for path in found if cloud_suffix(path) == suffix]
    return sorted(kept, key=lambda path: frame_order(_id_of(path)))


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudScan:
    """One sweep, not yet read."""

    path: Path
    time_s: float
    T_map_rig: Transform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudFolder:
    """Scans of a folder of clouds; see `recording.ScanSource`."""

    name: str
    rig: Rig
    scans: tuple[CloudScan, ...]
    stops: tuple[range, ...]
    has_times: bool
    rounding: PoseRounding
    poses: FramePoses
    is_deskewed: bool = False
    """True if the points are those of one time already, whatever times they have."""
    pose_notes: Sequence[str] = field(default_factory=tuple)

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        return map(self.scan, range(len(self.scans)))

    def measurements(self) -> Sequence[range]:
        """The scan indices of each measurement, in order; together all scans, each once."""
        return self.stops

    def place(self, index: int, /) -> tuple[float, Transform]:
        """Time and `T_map_rig` of the scan of an index; its cloud is not read."""
        return self.scans[index].time_s, self.scans[index].T_map_rig

    def scan(self, index: int, /) -> Scan:
        """One scan, its cloud read from disk now.

        Raises:
            NotFoundError: `index` is not in 0 .. len - 1.
            BadInputError: the cloud has gone, is cut off, or its points have times that are none.
        """
        if not 0 <= index < len(self.scans):
            raise NotFoundError("no_such_scan", f"{self.name} has scans 0 to {len(self) - 1}, asked for {index}")
        entry = self.scans[index]
        cloud = read_cloud(entry.path)
        points = cloud.points
        times = point_times(cloud, str(entry.path)) if self._moves_points() else None
        if times is not None:
            seen_s = times.absolute_s(entry.time_s, str(entry.path))
            points = deskewed(points, seen_s, entry.time_s, self.poses.pose_near)
        scan = Scan(
            time_s=entry.time_s,
            T_map_rig=entry.T_map_rig,
            range_camera=LIDAR,
            range_m=sweep_image(points, RASTER),
            points_m=(points @ R_LIDAR_CAMERA).astype(np.float32),
        )
        check_scan(scan, self.rig)
        return scan

    def _moves_points(self) -> bool:
        return self.has_times and self.poses.is_by_time and not self.is_deskewed


def import_clouds(
    folder: str | Path,
    *,
    poses: PoseOptions | None,
    frames: Sequence[str] | None = None,
    scans_per_measurement: int = 1,
    is_deskewed: bool = False,
) -> CloudFolder:
    """A folder of clouds as a recording; clouds are read when asked for.

    Args:
        folder: the folder that the files are in.
        poses: pose file; without `of` and with `T_body_sensor` the sensor is the frame of the points.
        frames: only these ids (names without suffix), and ranges of them by number.
        scans_per_measurement: group scans by this count.
        is_deskewed: as `CloudFolder.is_deskewed`.

    Raises:
        BadInputError: no clouds, no pose file, a cloud without a pose, or the first cloud cannot be read.
    """
    root = Path(folder).resolve()
    own = None if poses is None else poses.path.resolve()
    files = {_id_of(path): path for path in cloud_files(root) if path != own}
    if not files:
        raise BadInputError("no_frames", f"{root} holds no clouds of points")
    if poses is None:
        raise BadInputError(
            "bad_option",
            f"{root} holds {len(files)} clouds of points, {next(iter(files.values())).name} the first, and no poses: "
            "give --poses FILE of a published form",
        )
    if poses.of is None and poses.T_body_sensor is not None:
        poses = poses.model_copy(update={"of": RIG})
    rig = Rig(name=root.name[:64] or "clouds", cameras={LIDAR: mount_camera(Spectrum.RANGE, RASTER, T_LIDAR_CAMERA)})
    found = read_frame_poses(poses, rig)
    # The first cloud is read now, so that one of a wrong form is refused before a map is made.
    ids = list(files)
    first = read_cloud(files[ids[0]])
    times = point_times(first, str(files[ids[0]])) if found.is_by_time else None
    wanted = set(ids) if frames is None else chosen_frames(ids, frames, root)
    keys = [_key(root, n, files[one], found, times) for n, one in enumerate(ids) if one in wanted]
    placed = found.of_frames(keys)
    scans = tuple(
        CloudScan(path=files[one], time_s=float(n) if key.time_s is None else key.time_s, T_map_rig=T)
        for (n, one), key, T in zip([(n, one) for n, one in enumerate(ids) if one in wanted], keys, placed, strict=True)
        if T is not None
    )
    return CloudFolder(
        name=root.name,
        rig=rig,
        scans=scans,
        stops=measurements_of(len(scans), scans_per_measurement),
        has_times=keys[0].time_s is not None,
        rounding=found.rounding,
        poses=found,
        is_deskewed=is_deskewed,
        pose_notes=(*found.report(), *([] if is_deskewed else _note_of(first, times, found))),
    )


def _key(root: Path, n: int, path: Path, poses: FramePoses, times: PointTimes | None) -> FrameKey:
    """Key of a cloud's pose: its number, its name, and the time that the name is or that its points have."""
    name = _id_of(path)
    time_s = id_time_s(name)
    if time_s is None and poses.is_by_time and times is not None and times.is_absolute:
        own = times if n == 0 else point_times(read_cloud(path), str(path))
        if own is None or not own.is_absolute:
            raise BadInputError("bad_times", f"{path}: its points have no absolute times, those of other clouds have")
        time_s = float(np.nanmin(own.seconds))
    return FrameKey(
        label=f"cloud {path.name} of {root}",
        number=int(name) if name.isdecimal() else None,
        time_s=time_s,
        names=(name,),
    )


def _note_of(cloud: PointCloud, times: PointTimes | None, poses: FramePoses) -> list[str]:
    """Sentence about the times of points."""
    if times is not None:
        return [
            f"points have times ({times.text}): each is moved to the pose of its sweep (--deskewed: they are already)"
        ]
    if cloud.times is not None and not poses.is_by_time:
        return [f"points have times (field {cloud.time_field}), and are not moved: the poses are not by time"]
    return []


def _id_of(path: Path) -> str:
    """Name without the suffix of a cloud, which may have two parts."""
    return path.name[: -len(cloud_suffix(path) or "")]
