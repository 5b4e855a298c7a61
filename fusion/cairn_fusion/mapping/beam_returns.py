"""Returns of a scan's range camera: points of the map, and the certainly clear length of its beams.

    range_m    a hit each              without flying and saturated pixels and the robot's own body, within limits
    shield_m   nearest range           with flying pixels and the body: a neighbour may have seen a part of it
    silent     beams without a return  where the rig states that no return means empty space
    missing    beams without a return  where it does not: they have no information of their own

A pixel in none of the four has no information. The rig's range bias is subtracted first. Beams are clear up to

    carved images    nearest neighbour - max(1 voxel, k sigma)      `clear_kernels`: edges and slants widen it;
                                                                    gaps of one or two missing pixels are bridged
    single beams     range - max(1 voxel, k sigma)                  lidars: their neighbours are far apart
    silent beams     `no_return_clears_m`, where the rig states it
"""

import math
from dataclasses import dataclass, fields

import numpy as np

from cairn_calib.rig.body import Body
from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_calib.rig.rig import MountedCamera, Rig
from cairn_fusion.mapping.brick_tally_kernels import returned_points
from cairn_fusion.mapping.clear_kernels import (
    bridge_gaps_into,
    classify_ranges_into,
    interpolated,
    nearest_around,
    stay_before_into,
)
from cairn_fusion.mapping.flying_kernels import flying_pixels
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_map.arrays import Flags, Floats, Int32s, Singles

MARGIN_VOXELS = 1.0
"""Distance of a free voxel's centre from a surface, voxels: a little more than half a voxel's diagonal, 0.87."""


@dataclass(frozen=True, slots=True)
class ReturnCounts:
    """Count of the pixels of range images, by what became of them; each is counted once, by the first cause."""

    used: int = 0
    """Pixels with a range that counts."""
    no_return: int = 0
    """Pixels to which nothing came back."""
    saturated: int = 0
    """Pixels to which too much light came back."""
    too_near: int = 0
    """Pixels below `min_range_m`."""
    too_far: int = 0
    """Pixels beyond `max_range_m`."""
    flying: int = 0
    """Pixels that mix a near and a far surface."""
    own_body: int = 0
    """Pixels on the robot itself."""

    def __add__(self, other: "ReturnCounts") -> "ReturnCounts":
        return ReturnCounts(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))

    @property
    def pixels(self) -> int:
        """Count of all pixels."""
        return sum(getattr(self, one.name) for one in fields(self))

    def __str__(self) -> str:
        """Such as `0 of 4800 pixels used, 4800 too far`."""
        causes = [(getattr(self, one.name), one.name.replace("_", " ")) for one in fields(self)[1:]]
        return ", ".join(
            [f"{self.used} of {self.pixels} pixels used", *(f"{count} {cause}" for count, cause in causes if count)]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """N points that came back to the range camera of a scan, and its other information about space."""

    T_map_tof: Transform
    range_m: Singles
    """(H, W) metres along the beam, within limits; NaN elsewhere."""
    shield_m: Singles
    """(H, W) as `range_m`, with flying pixels and the robot's body: nothing behind their neighbours is free."""
    silent: Flags
    """(H, W) true where nothing came back although the camera sees any surface within `silent_m`."""
    silent_m: float
    """Clear length of silent beams, metres."""
    missing: Flags
    """(H, W) true where nothing came back and the rig does not say what that means."""
    pixels: Int32s
    """(N,) numbers of the pixels with a range, row by row."""
    points_map: Floats
    """(N, 3) metres, map frame."""
    counts: ReturnCounts
    reach_m: float
    """Length of the longest beam with information, metres; 0 without any."""


def returns_of(
    scan: Scan, rig: Rig, *, min_range_m: float, max_range_m: float | None, flying_step_m: float = math.inf
) -> Returns:
    """Returns of a scan (Eq. 1-5).

    Args:
        scan: one scan.
        rig: its cameras.
        min_range_m: least range of a return, metres.
        max_range_m: greatest range of a return, metres; None: that of a usual sensor of the range camera's kind.
        flying_step_m: as `Integrator.flying_step_m`.

    Raises:
        BadInputError: an image does not fit its camera.
    """
    check_scan(scan, rig)
    mounted = rig[scan.range_camera]
    max_range_m = mounted.usual_reach_m if max_range_m is None else max_range_m
    true_m = np.ascontiguousarray(mounted.true_ranges(scan.range_m, scan.amplitude)).view()
    # Read-only, as the images of kept scans are: one kind of array, and one kernel to compile.
    true_m.flags.writeable = False
    T_map_tof = scan.T_map_rig @ mounted.transform
    # Hits: within limits, not saturated; `shield_m` is taken before flying pixels and the body are left out.
    is_flying = flying_pixels(true_m, flying_step_m) if flying_step_m < math.inf else np.zeros(true_m.shape, bool)
    # Silence means empty space only where the rig states it, and not where too much light returned.
    silent_m = min(mounted.known_sensing.no_return_clears_m or 0.0, max_range_m)
    range_m, shield_m = np.empty(true_m.shape, np.float32), np.empty(true_m.shape, np.float32)
    silent, missing = np.empty(true_m.shape, bool), np.empty(true_m.shape, bool)
    whole, no_return, saturated, too_near, too_far, flying = classify_ranges_into(
        range_m,
        shield_m,
        silent,
        missing,
        true_m,
        full_pixels(scan, mounted),
        is_flying,
        np.float32(min_range_m),
        np.float32(max_range_m),
        silent_m > 0,
    )
    if rig.body is not None:
        T_body_tof = mounted.transform if scan.T_map_body is None else inverse(scan.T_map_body) @ T_map_tof
        range_m[_on_body(rig.body, range_m, mounted, T_body_tof)] = np.nan
        if silent.any():
            # A beam that the body stops may return nothing.
            beams = mounted.camera.rays() @ T_body_tof[:3, :3].T
            silent &= ~rig.body.stops(T_body_tof[:3, 3], beams, silent_m)
    pixels, points_map, farthest_m = returned_points(range_m, mounted.camera.rays(), T_map_tof)
    counts = ReturnCounts(
        used=len(pixels),
        no_return=no_return,
        saturated=saturated,
        too_near=too_near,
        too_far=too_far,
        flying=flying,
        own_body=whole - len(pixels),
    )
    reach_m = max(farthest_m if len(pixels) else 0.0, silent_m if silent.any() else 0.0)
    return Returns(T_map_tof, range_m, shield_m, silent, silent_m, missing, pixels, points_map, counts, reach_m)


def full_pixels(scan: Scan, mounted: MountedCamera) -> Flags:
    """(H, W) true where too much light returned for a range."""
    limit = mounted.known_sensing.saturated_amplitude
    if limit is None or scan.amplitude is None:
        return np.zeros(scan.range_m.shape, bool)
    return np.asarray(scan.amplitude >= limit)


def _on_body(body: Body, range_m: Singles, mounted: MountedCamera, T_body_tof: Transform) -> Flags:
    """(H, W) true where the point lies on the robot itself."""
    points_tof = mounted.camera.rays() * range_m[..., None].astype(np.float64)
    return body.holds(transform_points(T_body_tof, points_tof))


def margins_m(sigma_m: Floats, *, voxel_edge_m: float, noise_sigmas: float) -> Floats:
    """(...) margins before surfaces, metres, by the standard deviation of their range; NaN for NaN."""
    return np.asarray(np.maximum(MARGIN_VOXELS * voxel_edge_m, noise_sigmas * sigma_m))


def clear_image(returns: Returns, mounted: MountedCamera, *, voxel_edge_m: float, noise_sigmas: float) -> Singles:
    """(H, W) clear range of each pixel of an image without gaps between its pixels, metres; 0 for unknown."""
    seen_m, shield_m = returns.range_m, returns.shield_m
    if returns.silent_m > 0:
        seen_m = np.where(returns.silent, np.float32(np.inf), seen_m)
    elif returns.missing.any():
        seen_m, shield_m = seen_m.copy(), shield_m.copy()
        bridge_gaps_into(seen_m, shield_m, returns.missing)
    nearest_m, share = nearest_around(
        seen_m,
        shield_m,
        returns.silent_m,
        float(max(mounted.camera.focal_px)),
        voxel_edge_m,
    )
    stay_before_into(nearest_m, share, sigma_image(mounted, nearest_m), MARGIN_VOXELS * voxel_edge_m, noise_sigmas)
    return nearest_m


def sigma_image(mounted: MountedCamera, range_m: Singles) -> Floats:
    """(H, W) standard deviation of an image's ranges, metres: the values of `MountedCamera.range_sigma_image`."""
    if mounted.range_bias is not None:
        return mounted.range_sigma_image(range_m)
    return interpolated(range_m.ravel(), mounted.range_noise_nodes).reshape(range_m.shape)


def sigmas_of_pixels(mounted: MountedCamera, image_m: Singles, pixels: Int32s, range_m: Floats) -> Floats:
    """(N,) standard deviation of the ranges of some of an image's pixels, metres.

    Args:
        mounted: the range camera.
        image_m: (H, W) its image, metres.
        pixels: (N,) numbers of the pixels.
        range_m: (N,) their ranges, metres.
    """
    if mounted.range_bias is None:
        return interpolated(range_m, mounted.range_noise_nodes)
    return np.asarray(mounted.range_sigma_image(image_m).ravel()[pixels])
