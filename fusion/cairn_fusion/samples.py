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
from cairn_fusion.sample_kernels import add_pixels_into
from cairn_fusion.scan import Scan
from cairn_fusion.transfer import Label, Transfer, depth_steps, points_from_range, transfer_points
from cairn_map.channels import Channel, ChannelKind
from cairn_map.grid import Geometry

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.integer]
Labels = npt.NDArray[np.uint8]


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
    sight = Sight(scan, rig, returns, spread_max_m)
    for channel in geometry.channels:
        planes = sums[:, geometry.planes_of(channel.name)]
        taken = np.zeros(len(returns.pixels), np.bool_)
        # The first camera speaks for what it sees; the next ones only fill what was hidden from those before.
        for image, pixels, labels in sight.images_of(channel.kind):
            _add_mean_samples(planes, channel, image, pixels, labels, voxel_of, taken)
    return sums


class Sight:
    """Where the points of a scan appear in its images, each found when it is asked for."""

    def __init__(self, scan: Scan, rig: Rig, returns: Returns, spread_max_m: float) -> None:
        self._scan = scan
        self._rig = rig
        self._returns = returns
        self._spread_max_m = spread_max_m
        self._points: tuple[Floats, Floats, Floats] | None = None

    def images_of(self, kind: ChannelKind) -> Iterator[tuple[npt.NDArray[np.generic], Ints, Labels]]:
        """For each image of a kind: it, and pixels (N, 2) and labels (N,) of the points."""
        scan = self._scan
        if kind is ChannelKind.INTENSITY and scan.amplitude is not None:
            rows, columns = np.divmod(self._returns.pixels.astype(np.int64), scan.amplitude.shape[1])
            yield scan.amplitude, np.stack([columns, rows], axis=1), np.full(len(rows), Label.OK, np.uint8)
        images: dict[str, npt.NDArray[np.generic]] = {}
        if kind is ChannelKind.COLOUR:
            images = dict(scan.colour)
        elif kind is ChannelKind.TEMPERATURE:
            images = dict(scan.thermal)
        for name, image in images.items():
            transfer = self._transfer(name)
            yield image, transfer.pixels, transfer.labels

    def _transfer(self, name: str) -> Transfer:
        """Where all points appear in a camera's image; those whose place there is too uncertain as out of view."""
        src = self._scan.range_camera
        points_tof, steps_m, sigma_m = self._seen_points()
        transfer = transfer_points(points_tof, self._rig, src=src, dst=name, steps_m=steps_m)
        if not is_certain(points_tof, sigma_m, self._rig, src=src, dst=name, limit_m=self._spread_max_m):
            seen = np.nonzero(transfer.ok)[0]
            spread = spread_m(points_tof[seen], sigma_m[seen], self._rig, src=src, dst=name)
            transfer.labels[seen[~(spread <= self._spread_max_m)]] = Label.OUT_OF_VIEW
        return transfer

    def _seen_points(self) -> tuple[Floats, Floats, Floats]:
        """Points (N, 3) in the range camera's frame, how steep the surface is there, and their range's sigma."""
        if self._points is None:
            mounted, range_m, returned = self._rig[self._scan.range_camera], self._returns.range_m, self._returns.pixels
            image_points = points_from_range(range_m, mounted.camera)
            self._points = (
                image_points.reshape(-1, 3)[returned],
                depth_steps(image_points).ravel()[returned],
                mounted.range_sigma_m(range_m.ravel()[returned]),
            )
        return self._points


def _add_mean_samples(
    sums: Ints,
    channel: Channel,
    image: npt.NDArray[np.generic],
    pixels: Ints,
    labels: Labels,
    voxel_of: Numbers,
    taken: npt.NDArray[np.bool_],
) -> None:
    """Write one sample of weight 1, the mean of its pixels, to every voxel that has none of this channel yet."""
    totals, counts = np.zeros((len(sums), channel.value_count)), np.zeros(len(sums), np.int64)
    add_pixels_into(totals, counts, taken, np.atleast_3d(image), pixels, labels, voxel_of.astype(np.int32, copy=False))
    free = np.nonzero((counts > 0) & (sums[:, -1] == 0))[0]
    values = channel.quantise(totals[free] / counts[free, None])
    sums[free, : channel.value_count] = values
    if channel.kind is ChannelKind.TEMPERATURE:
        sums[free, 1] = values[:, 0] ** 2
    sums[free, -1] = 1
