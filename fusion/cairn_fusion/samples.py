"""What the cameras of a scan say about the points that came back: one sample a voxel, channel and scan.

    points   in the range camera's frame            Eq. 1-4
    samples  colour, temperature, amplitude          Eq. 5-6 with a z-buffer; only what a camera really saw

Each voxel that was hit gets at most one sample per channel and scan: the mean of the pixels that fell on it, with
weight 1. So a voxel's weights never exceed its hits, however fine the images are, and samples stay small numbers.
"""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from cairn_calib.rig import Rig
from cairn_fusion.certainty import is_certain, spread_m
from cairn_fusion.returns import Returns
from cairn_fusion.scan import Scan
from cairn_fusion.transfer import depth_steps, points_from_range, transfer_points
from cairn_map.channels import Channel, ChannelKind
from cairn_map.grid import Geometry

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.integer]


def sample_sums(
    scan: Scan,
    rig: Rig,
    geometry: Geometry,
    returns: Returns,
    voxel_of: Numbers,
    count: int,
    *,
    spread_max_m: float = math.inf,
) -> Ints:
    """(count, P) sums of the scan's voxels: one sample of weight 1 for each channel that a camera saw there.

    Colours and temperatures whose place is uncertain by more than `spread_max_m` are left out (`certainty`).
    """
    sums = np.zeros((count, geometry.plane_count), np.int64)
    for channel, values, at in _samples(scan, rig, geometry, returns, spread_max_m):
        _add_mean_samples(sums[:, geometry.planes_of(channel.name)], channel, values, voxel_of[at])
    return sums


def _samples(
    scan: Scan, rig: Rig, geometry: Geometry, returns: Returns, spread_max_m: float
) -> Iterator[tuple[Channel, Floats, Ints]]:
    """For each channel of the map: values (M, C) and the points (M,) that they belong to."""
    returned = returns.pixels
    # Needed by images alone: found when the first one comes.
    image_points: Floats | None = None
    points_tof, steps_m, sigma_m = np.empty((0, 3)), np.empty(0), np.empty(0)
    for channel in geometry.channels:
        if channel.kind is ChannelKind.COLOUR:
            images: dict[str, npt.NDArray[np.generic]] = dict(scan.colour)
        elif channel.kind is ChannelKind.TEMPERATURE:
            images = dict(scan.thermal)
        elif channel.kind is ChannelKind.INTENSITY and scan.amplitude is not None:
            yield channel, scan.amplitude.reshape(-1, 1)[returned].astype(np.float64), np.arange(len(returned))
            continue
        else:
            continue
        if images and image_points is None:
            image_points = points_from_range(returns.range_m, rig[scan.range_camera].camera)
            points_tof = image_points.reshape(-1, 3)[returned]
            steps_m = depth_steps(image_points).ravel()[returned]
            sigma_m = rig[scan.range_camera].range_sigma_m(returns.range_m.ravel()[returned])
        waiting = np.arange(len(returned))
        # The first camera speaks for what it sees; the next ones only fill what was hidden from those before.
        for name, image in images.items():
            transfer = transfer_points(
                points_tof[waiting], rig, src=scan.range_camera, dst=name, steps_m=steps_m[waiting]
            )
            values = transfer.sample(image).astype(np.float64).reshape(-1, channel.value_count)
            valid = np.isfinite(values).all(axis=1)
            seen = waiting[transfer.ok]
            of = (points_tof[seen], sigma_m[seen], rig)
            if not is_certain(*of, src=scan.range_camera, dst=name, limit_m=spread_max_m):
                valid &= spread_m(*of, src=scan.range_camera, dst=name) <= spread_max_m
            found = seen[valid]
            yield channel, values[valid], found
            waiting = np.setdiff1d(waiting, found, assume_unique=True)


def _add_mean_samples(sums: Ints, channel: Channel, values: Floats, voxel_of: Numbers) -> None:
    """Write one sample of weight 1, the mean of its values, to every voxel that has none of this channel yet."""
    pixels = np.bincount(voxel_of, minlength=len(sums))
    free = (pixels > 0) & (sums[:, -1] == 0)
    for c in range(channel.value_count):
        totals = np.bincount(voxel_of, weights=values[:, c], minlength=len(sums))
        sums[free, c] = channel.quantise(totals[free] / pixels[free])
    if channel.kind is ChannelKind.TEMPERATURE:
        sums[free, 1] = sums[free, 0] ** 2
    sums[free, -1] = 1
