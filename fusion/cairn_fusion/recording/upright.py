"""Upright: the direction that is probably up in the frame of a source's poses, from its scans alone.

    normals of surfaces  ->  share that faces an axis, from below the sensor    floors face up
    cameras              ->  mean direction of the images' upper side           they are held upright, more or less

The axis with the best product of both is a proposal: the share of floor alone cannot tell a floor from a wall, and the
cameras alone cannot tell a drone that looks down from a robot that looks ahead.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import transform_points
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.turned_source import AXES_UP, rotation_up
from cairn_map.arrays import Floats

SCANS_MAX = 8
SIDE_MAX_PX = 160
"""Pixels of the longer side that is looked at."""
BIN_RAD = 0.04
"""Width and height of the bins of a cloud, of which one point each is looked at."""
STEP_MAX = 0.1
"""Largest distance between neighbours of one surface, over their range."""
SURFACES_MIN = 100
FLOOR_ANGLE_DEG = 25.0
"""Angle between a normal and an axis up to which the surface faces the axis."""
BELOW_M = 0.05
"""Least height of the sensor above a floor."""
FLOOR_SHARE_MIN = 0.02
HELD_WEIGHT = 0.02
"""Weight of an axis towards which no camera is held: walls that face a camera outnumber the floor many times."""
HELD_MIN = 0.5
"""Least cosine between an axis and the images' upper side for a doubt: a wall ahead is no floor."""
ADVANTAGE_MIN = 1.5
"""Ratio of the best axis to z for a doubt."""


@dataclass(frozen=True, slots=True)
class Upright:
    """A proposal for the direction of up."""

    axis: str
    """One of `AXES_UP`."""
    floor_share: float
    """Share of the surfaces that face the axis, from below the sensor."""
    tilt_deg: float
    """Angle between the mean normal of these and the axis."""
    held: float
    """Cosine between the axis and the mean upper side of the images."""
    advantage: float
    """Its score over that of z."""

    def text(self) -> str:
        """The proposal in words."""
        sure = "is probably" if self.held >= HELD_MIN else "may be"
        said = f"up {sure} {self.axis}: {self.floor_share:.0%} of the surfaces seen face it from below the sensor"
        said += f", {self.tilt_deg:.0f} degrees off it" if self.tilt_deg >= 3 else ""
        return said + ("" if self.held >= HELD_MIN else ", and the cameras are not held towards it")

    def doubt(self) -> str | None:
        """Sentence for a source that is mapped with z up; None if z is as good."""
        if self.axis == "z" or self.held < HELD_MIN or self.advantage < ADVANTAGE_MIN:
            return None
        return f"doubt: {self.text()}, and the map takes z: give --up {self.axis}, or --up z if z is right"


def upright_of(source: ScanSource) -> Upright | None:
    """The axis that is probably up; None if no surface in the scans could be a floor."""
    numbers = np.unique(np.linspace(0, len(source) - 1, SCANS_MAX).astype(int)).tolist()
    found = [_surfaces(source, source.scan(number)) for number in numbers]
    normals = np.concatenate([normals for normals, _, _ in found])
    offsets = np.concatenate([offsets for _, offsets, _ in found])
    held = np.mean([upper for _, _, upper in found], axis=0)
    if len(normals) < SURFACES_MIN:
        return None
    shares, scores = {}, {}
    for axis in AXES_UP:
        up = _direction(axis)
        is_floor = _is_floor(normals, offsets, up)
        shares[axis] = float(is_floor.mean())
        scores[axis] = shares[axis] * (HELD_WEIGHT + max(0.0, float(held @ up)))
    best = max(AXES_UP, key=lambda axis: scores[axis])
    if shares[best] < FLOOR_SHARE_MIN:
        return None
    up = _direction(best)
    mean = normals[_is_floor(normals, offsets, up)].mean(axis=0)
    tilt_deg = float(np.degrees(np.arccos(np.clip(mean @ up / np.linalg.norm(mean), -1, 1))))
    return Upright(best, shares[best], tilt_deg, float(held @ up), scores[best] / max(scores["z"], 1e-9))


def _direction(axis: str) -> Floats:
    """(3,) an axis as a unit vector of the poses' frame."""
    up: Floats = rotation_up(axis)[2, :3]
    return up


def _is_floor(normals: Floats, offsets: Floats, up: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """(N,) true for surfaces that face `up` and lie below the sensor."""
    return np.asarray((normals @ up > np.cos(np.radians(FLOOR_ANGLE_DEG))) & (offsets @ up < -BELOW_M))


def _surfaces(source: ScanSource, scan: Scan) -> tuple[Floats, Floats, Floats]:
    """(N, 3) normals towards the sensor, (N, 3) places from the sensor, and (3,) the image's upper side; map frame."""
    mounted = source.rig[scan.range_camera]
    T = scan.T_map_rig @ mounted.transform
    points = _binned(scan.points_m) if scan.points_m is not None else _thinned(scan, mounted.camera.rays())
    # Triangles of neighbours that lie on one surface.
    across, down = points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        near_m = STEP_MAX * np.linalg.norm(points[:-1, :-1], axis=-1)
        is_surface = (np.linalg.norm(across, axis=-1) < near_m) & (np.linalg.norm(down, axis=-1) < near_m)
        normals = np.cross(across, down)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    here = points[:-1, :-1]
    is_surface &= np.isfinite(normals).all(axis=-1)
    normals, here = normals[is_surface], here[is_surface]
    normals *= -np.sign(np.sum(normals * here, axis=-1))[:, None]
    R = T[:3, :3]
    return normals @ R.T, transform_points(T, here) - T[:3, 3], -R[:, 1]


def _thinned(scan: Scan, rays: Floats) -> Floats:
    """(H, W, 3) some pixels' points, evenly over the image; NaN without a range."""
    stride = max(1, max(scan.range_m.shape) // SIDE_MAX_PX)
    thinned: Floats = rays[::stride, ::stride] * scan.range_m[::stride, ::stride, None].astype(np.float64)
    return thinned


def _binned(points: npt.NDArray[np.float32]) -> Floats:
    """(H, W, 3) one point of each bin of directions, camera's axes; NaN where none is."""
    own = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    across = np.hypot(own[:, 0], own[:, 2])
    column = ((np.arctan2(own[:, 0], own[:, 2]) + np.pi) / BIN_RAD).astype(int)
    row = ((np.arctan2(own[:, 1], across) + np.pi / 2) / BIN_RAD).astype(int)
    bins = np.full((int(np.pi / BIN_RAD) + 1, int(2 * np.pi / BIN_RAD) + 1, 3), np.nan)
    bins[row, column] = own
    return bins
