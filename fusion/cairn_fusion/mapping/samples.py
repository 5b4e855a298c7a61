"""Samples of a scan's cameras for the points that came back: one sample a voxel, channel and scan.

    points   in the range camera's frame            Eq. 1-4
    samples  colour, temperature, amplitude          Eq. 5-6 with a z-buffer: no camera samples a point hidden from it

Each voxel that was hit gets at most one sample per channel and scan: the mean of the pixels that fell on it, with
weight 1. So a voxel's weights never exceed its hits, however fine the images are, and samples stay small numbers.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.beam_returns import Returns, sigmas_of_pixels
from cairn_fusion.mapping.sample_kernels import add_pixels_into, doubt_edges_into, write_means_into
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.pixel_covariance import PlaceBounds, spread_m
from cairn_fusion.transfer.transfer import CameraPair, Label, Transfer, transfer_points
from cairn_fusion.transfer.transfer_kernels import list_doubtful_into, points_of_pixels
from cairn_map.arrays import Flags, Floats, Int32s, Ints
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.grid import Geometry

Numbers = npt.NDArray[np.integer]


@dataclass(frozen=True, slots=True)
class SampleLimits:
    """Limits within which a sample counts."""

    spread_max_m: float
    """Largest uncertainty of a sample's place, metres (`pixel_covariance`)."""
    step_max_k: float
    """Largest difference of the thermal image within the area of a range pixel, kelvin: at the edge of a hot thing it
    is unknown which side the range belongs to. Infinite: no limit."""
    hidden_behind_m: float
    """Depth behind the nearest point of a bin from which on a point is hidden, metres (`transfer_points`)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Points of the range camera, and their noise."""

    tof: Floats
    """(3, N) metres, frame of the range camera."""
    range_m: Floats
    """(N,) metres along the beam."""
    steps_m: Floats
    """(N,) slant of the surface: `depth_steps`."""
    sigma_m: Floats
    """(N,) standard deviation of the ranges."""


class Sampling:
    """Samples of one rig's scans for a map, within limits; any thread may use it."""

    def __init__(self, rig: Rig, geometry: Geometry, limits: SampleLimits) -> None:
        self.rig = rig
        self.geometry = geometry
        self.limits = limits
        self._pairs: dict[tuple[str, str], tuple[CameraPair, PlaceBounds]] = {}

    def pair(self, *, src: str, dst: str) -> tuple[CameraPair, PlaceBounds]:
        """A pair of cameras, and bounds for the samples of `dst`; computed once."""
        # Two threads at once compute equal ones.
        if (src, dst) not in self._pairs:
            bounds = PlaceBounds.of(self.rig, src=src, dst=dst)
            self._pairs[src, dst] = CameraPair.of(self.rig, src=src, dst=dst), bounds
        return self._pairs[src, dst]


class ImageTransfers:
    """Transfers of a scan's points into its images, each computed when it is needed."""

    def __init__(self, scan: Scan, returns: Returns, sampling: Sampling) -> None:
        self._scan = scan
        self._rig = sampling.rig
        self._returns = returns
        self._sampling = sampling
        self._points: _Points | None = None

    def sums(self, voxel_of: Numbers, count: int) -> Ints:
        """(count, P) sums of the scan's voxels: one sample of weight 1 for each channel that a camera saw there.

        Args:
            voxel_of: (N,) number of each point's voxel.
            count: number of voxels.
        """
        geometry = self._sampling.geometry
        sums, numbers = np.zeros((count, geometry.plane_count), np.int64), voxel_of.astype(np.int32, copy=False)
        for channel in geometry.channels:
            # The first camera counts wherever it sees; the next ones fill only voxels hidden from those before.
            spoken = np.zeros(count, np.bool_)
            for image, transfer in self._images_of(channel.kind, spoken, numbers):
                totals, counts = np.zeros((count, channel.value_count)), np.zeros(count, np.int64)
                values = image.reshape(*image.shape[:2], -1)
                add_pixels_into(totals, counts, values, transfer.pixels, transfer.labels, numbers)
                _write_means_into(sums, geometry, channel, totals, counts)
                # No further image adds to a voxel with a sample: most points need no look into the second one.
                spoken |= counts != 0
        return sums

    def _images_of(
        self, kind: ChannelKind, spoken: Flags, voxel_of: Int32s
    ) -> Iterator[tuple[npt.NDArray[np.generic], Transfer]]:
        """Images of a kind, each with the transfer of the points; arguments as for `into`."""
        scan = self._scan
        if kind is ChannelKind.INTENSITY and scan.amplitude is not None:
            # The range camera's own image: each point lies in its own pixel, and nothing there hides another.
            pixels = np.take(_pixels_of(*scan.amplitude.shape), self._returns.pixels, axis=1)
            yield scan.amplitude, Transfer(pixels, np.full(pixels.shape[1], Label.OK, np.uint8))
        images: dict[str, npt.NDArray[np.generic]] = {}
        if kind is ChannelKind.COLOUR:
            images = dict(scan.colour)
        elif kind is ChannelKind.TEMPERATURE:
            images = dict(scan.thermal)
        for name, image in images.items():
            if spoken.all():
                return
            yield image, self.into(name, spoken, voxel_of)

    def into(self, name: str, spoken: Flags, voxel_of: Int32s) -> Transfer:
        """Transfer of all points into a camera's image; points with too uncertain a place there are so labelled.

        Args:
            name: name of the camera.
            spoken: (U,) voxels that need no sample any more: none of their points is OK.
            voxel_of: (N,) number of each point's voxel.
        """
        src, limits = self._scan.range_camera, self._sampling.limits
        points, (pair, bounds) = self._seen_points(), self._sampling.pair(src=src, dst=name)
        # Stage 1: Eq. 5-6 and the z-buffer.
        transfer = transfer_points(points.tof, pair, steps_m=points.steps_m, hidden_behind_m=limits.hidden_behind_m)
        # Stage 2: the covariance of the place, only for points that a bound does not clear. Those that need no sample
        # hide others, and are examined no further.
        labels, doubtful = transfer.labels, np.empty(len(transfer.labels), np.int32)
        of_points = (points.range_m, points.sigma_m)
        spread = (bounds.baseline_m, bounds.calibration, limits.spread_max_m)
        count = list_doubtful_into(labels, doubtful, voxel_of, spoken, *of_points, *spread)
        if count:
            found = doubtful[:count]
            spread_of = spread_m(points.tof[:, found].T, points.sigma_m[found], self._rig, src=src, dst=name)
            # Written so that a spread of NaN is uncertain.
            labels[found[~(spread_of <= limits.spread_max_m)]] = Label.UNCERTAIN
        # Stage 3: edges in the thermal image, within the area that the range pixel covers there.
        if name in self._scan.thermal and limits.step_max_k < math.inf:
            image, reach = np.ascontiguousarray(self._scan.thermal[name]), (bounds.fixed_px, bounds.moved_px)
            doubt_edges_into(labels, transfer.pixels, *of_points, *reach, image, limits.step_max_k)
        return transfer

    def _seen_points(self) -> _Points:
        if self._points is None:
            mounted, returned, image_m = self._rig[self._scan.range_camera], self._returns.pixels, self._returns.range_m
            tof, range_m, steps_m = points_of_pixels(image_m, mounted.camera.rays(), returned)
            sigma_m = sigmas_of_pixels(mounted, image_m, returned, range_m)
            self._points = _Points(tof, range_m, steps_m, sigma_m)
        return self._points


def _write_means_into(sums: Ints, geometry: Geometry, channel: Channel, totals: Floats, counts: Ints) -> None:
    """Write one sample of weight 1, the mean of its pixels, for every voxel that has none of this channel yet."""
    # Weight 1 however many pixels there are: weight counts scans, and so stays below the voxel's hits.
    planes, is_squared = geometry.planes_of(channel.name), channel.kind is ChannelKind.TEMPERATURE
    ends = (planes.start, planes.stop - 1)
    if not write_means_into(sums, *ends, totals, counts, channel.zero, channel.step, is_squared):
        # A kernel raises nothing, so the value out of range is found once more, in order to name it.
        seen = counts > 0
        channel.quantise(totals[seen] / counts[seen, None])  # raises: one is out of range


@lru_cache(maxsize=32)
def _pixels_of(height: int, width: int) -> Int32s:
    """(2, height width) x and y of an image's pixels, row by row."""
    y, x = np.divmod(np.arange(height * width, dtype=np.int32), np.int32(width))
    return np.stack([x, y])
