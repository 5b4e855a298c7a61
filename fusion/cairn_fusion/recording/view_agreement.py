"""View agreement: neighbouring scans of a source see the same surfaces where their poses say so, or a doubt.

    points of scan a  ->  T_b^-1 T_a  ->  pixels of scan b  ->  its range there is their distance, within 5 %

The share of points that agree is found for the poses as they are read, and for each usual mistake: the inverse poses,
and the axes of OpenGL. A mistake that agrees clearly better is a doubt. Scans that hardly move, or do not overlap,
decide nothing.
"""

from collections.abc import Callable, Iterator

import numpy as np

from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_fusion.recording.frame_poses import axes_transform
from cairn_fusion.recording.pose_files import Axes
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.scan import Scan

PAIRS_MAX = 5
POINTS_MAX = 2000
STEPS = (1, 2, 4, 8, 16)
"""Distances, in scans, at which a partner is looked for that has moved."""
MOTION_MIN = 0.03
"""Least motion of a pair: rotation in rad, or translation over the median range."""
RANGE_TOLERANCE = 0.05
AGREEMENT_MIN, ADVANTAGE_MIN = 0.3, 1.5
"""Share of points at which a mistake agrees, and how many times more than the poses as read, for a doubt."""
OVERLAP_MIN, MATCH_MIN = 0.3, 0.3
"""Share of points that fall into the other image, and share of those that agree, below which there is a doubt."""
OPENGL = axes_transform(Axes.OPENGL)

AS_READ = "as read"
READINGS: dict[str, Callable[[Transform, Transform], Transform]] = {
    AS_READ: lambda T_map_rig, T_rig_camera: T_map_rig @ T_rig_camera,
    "the inverse poses": lambda T_map_rig, T_rig_camera: inverse(T_map_rig) @ T_rig_camera,
    "the axes of OpenGL against OpenCV": lambda T_map_rig, T_rig_camera: T_map_rig @ T_rig_camera @ OPENGL,
    "the inverse poses and such axes": lambda T_map_rig, T_rig_camera: inverse(T_map_rig) @ T_rig_camera @ OPENGL,
}
"""`T_map_camera` of the poses as they are read, and of each usual mistake."""


def pose_doubt(source: ScanSource) -> str | None:
    """Sentence about poses that do not fit their scans; None if they fit, or nothing can be said."""
    shares: dict[str, list[float]] = {name: [] for name in READINGS}
    overlaps: list[float] = []
    for first, second in _pairs(source):
        for name, reading in READINGS.items():
            overlap, share = _agreement(source, first, second, reading)
            shares[name].append(share)
            if name == AS_READ:
                overlaps.append(overlap)
    if not overlaps:
        return None
    means = {name: float(np.mean(values)) for name, values in shares.items()}
    own, overlap = means[AS_READ], float(np.mean(overlaps))
    best = max(means, key=lambda name: means[name])
    if best != AS_READ and means[best] >= max(AGREEMENT_MIN, ADVANTAGE_MIN * own):
        return (
            f"doubt: neighbouring scans agree at {own:.0%} of their points with the poses as read, and at "
            f"{means[best]:.0%} with {best}: check --pose-convention and --axes"
        )
    if overlap >= OVERLAP_MIN and own < MATCH_MIN * overlap:
        return (
            f"doubt: {overlap:.0%} of the points fall into the neighbouring scan's image, and only {own:.0%} agree "
            "with it: units of poses or ranges, the intrinsics, or the frames' poses may be wrong"
        )
    return None


def _pairs(source: ScanSource) -> Iterator[tuple[Scan, Scan]]:
    """Scans over the whole source, each with a later one of the same camera that has moved."""
    starts = np.unique(np.linspace(0, max(0, len(source) - 2), PAIRS_MAX).astype(int))
    for start in starts.tolist() if len(source) > 1 else ():
        first = source.scan(start)
        seen = first.range_m[np.isfinite(first.range_m)]
        for step in STEPS:
            if start + step >= len(source) or not seen.size:
                break
            second = source.scan(start + step)
            T = inverse(first.T_map_rig) @ second.T_map_rig
            angle_rad = float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
            has_moved = max(angle_rad, float(np.linalg.norm(T[:3, 3]) / np.median(seen))) >= MOTION_MIN
            if has_moved and second.range_camera == first.range_camera:
                yield first, second
                break


def _agreement(
    source: ScanSource, first: Scan, second: Scan, reading: Callable[[Transform, Transform], Transform]
) -> tuple[float, float]:
    """Shares of the first scan's points that fall into the second's image, and that its range there confirms."""
    mounted = source.rig[first.range_camera]
    camera = mounted.camera
    # Some points of the first scan, evenly over its image.
    points = (camera.rays() * first.range_m[..., None])[np.isfinite(first.range_m)]
    points = points[:: max(1, len(points) // POINTS_MAX)]
    T_map_first, T_map_second = (reading(scan.T_map_rig, mounted.transform) for scan in (first, second))
    there = transform_points(inverse(T_map_second) @ T_map_first, points)
    # Their pixels in the second.
    pixels = camera.project(there)
    with np.errstate(invalid="ignore"):
        is_inside = np.isfinite(pixels).all(axis=-1) & camera.contains(pixels)
    there = there[is_inside]
    x, y = np.rint(pixels[is_inside]).astype(int).T
    height, width = second.range_m.shape
    measured_m = second.range_m[np.clip(y, 0, height - 1), x % width]
    if second.points_m is not None:
        # Most pixels of a raster that is not the sensor's own are empty, which says nothing.
        is_seen = np.isfinite(measured_m)
        there, measured_m = there[is_seen], measured_m[is_seen]
    distance_m = np.linalg.norm(there, axis=-1)
    with np.errstate(invalid="ignore"):
        agree = np.abs(measured_m - distance_m) <= RANGE_TOLERANCE * distance_m
    return len(there) / len(points), float(agree.sum()) / len(points)
