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
from cairn_fusion.mapping.beam_returns import Returns
from cairn_fusion.mapping.sample_kernels import add_pixels_into, doubt_edges_into, write_means_into
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.pixel_covariance import is_certain, reach_px_of, spread_m
from cairn_fusion.transfer.transfer import (
    DEPTH_TOLERANCE_M,
    Label,
    Transfer,
    transfer_points,
)
from cairn_fusion.transfer.transfer_kernels import steps_of
from cairn_map.arrays import Flags, Floats, Ints, Labels
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.grid import Geometry

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
    step_max_k: float = math.inf,
    hidden_behind_m: float = DEPTH_TOLERANCE_M,
) -> Ints:
    """(count, P) sums of the scan's voxels: one sample of weight 1 for each channel that a camera saw there.

    Colours and temperatures whose place is uncertain by more than `spread_max_m` are left out (`pixel_covariance`); so
    are temperatures where the thermal image differs by more than `step_max_k` within the area of a range pixel: at the
    edge of a hot thing it is unknown which side the range belongs to. `hidden_behind_m` is that of `transfer_points`.
    """
    sums = np.zeros((count, geometry.plane_count), np.int64)
    limits = SampleLimits(spread_max_m, step_max_k, hidden_behind_m)
    sight, numbers = ImageTransfers(scan, rig, returns, limits), voxel_of.astype(np.int32, copy=False)
    for channel in geometry.channels:
        taken, weight = np.zeros(len(returns.pixels), np.bool_), geometry.planes_of(channel.name).stop - 1
        # The first camera counts wherever it sees; the next ones fill only voxels hidden from those before.
        for image, pixels, labels in sight.images_of(channel.kind, taken):
            totals, counts = np.zeros((count, channel.value_count)), np.zeros(count, np.int64)
            add_pixels_into(totals, counts, taken, np.atleast_3d(image), pixels, labels, numbers)
            _write_means_into(sums, geometry, channel, totals, counts)
            # No further image adds to a voxel with a sample: most points need no look into the second one.
            taken |= (sums[:, weight] != 0)[numbers]
    return sums


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Points of the range camera, and their noise."""

    tof: Floats
    """(N, 3) metres, frame of the range camera."""
    range_m: Floats
    """(N,) metres along the beam."""
    steps_m: Floats
    """(N,) slant of the surface: `depth_steps`."""
    sigma_m: Floats
    """(N,) standard deviation of the ranges."""


@dataclass(frozen=True, slots=True)
class SampleLimits:
    """Limits within which a sample counts; arguments of `sample_sums`."""

    spread_max_m: float
    step_max_k: float
    hidden_behind_m: float


class ImageTransfers:
    """Transfers of a scan's points into its images, each computed when it is needed."""

    def __init__(self, scan: Scan, rig: Rig, returns: Returns, limits: SampleLimits) -> None:
        self._scan = scan
        self._rig = rig
        self._returns = returns
        self._limits = limits
        self._points: _Points | None = None

    def images_of(self, kind: ChannelKind, taken: Flags) -> Iterator[tuple[npt.NDArray[np.generic], Ints, Labels]]:
        """Images of a kind, each with the pixels (N, 2) and labels (N,) of the points.

        Args:
            kind: of the images.
            taken: (N,) points that need no sample any more, as they are when an image comes: none of them is OK there.
        """
        scan = self._scan
        if kind is ChannelKind.INTENSITY and scan.amplitude is not None:
            # The range camera's own image: each point lies in its own pixel, and nothing there hides another.
            # `take`: indexing by rows takes ten times as long.
            pixels = np.take(_pixels_of(*scan.amplitude.shape), self._returns.pixels, axis=0)
            yield scan.amplitude, pixels, np.full(len(pixels), Label.OK, np.uint8)
        images: dict[str, npt.NDArray[np.generic]] = {}
        if kind is ChannelKind.COLOUR:
            images = dict(scan.colour)
        elif kind is ChannelKind.TEMPERATURE:
            images = dict(scan.thermal)
        for name, image in images.items():
            if taken.all():
                return
            transfer = self.into(name, taken)
            yield image, transfer.pixels, transfer.labels

    def into(self, name: str, taken: Flags) -> Transfer:
        """Transfer of all points into a camera's image; points with too uncertain a place there are so labelled."""
        src, limits = self._scan.range_camera, self._limits
        points = self._seen_points()
        # Stage 1: Eq. 5-6 and the z-buffer.
        transfer = transfer_points(
            points.tof,
            self._rig,
            src=src,
            dst=name,
            steps_m=points.steps_m,
            hidden_behind_m=limits.hidden_behind_m,
        )
        # Those that need no sample hide others, and are examined no further.
        transfer.labels[taken & transfer.ok] = Label.NO_READING
        # Stage 2: the covariance of the place, only for points that a bound does not clear.
        certain = is_certain(points.range_m, points.sigma_m, self._rig, src=src, dst=name, limit_m=limits.spread_max_m)
        doubtful = np.nonzero(transfer.ok & ~certain)[0]
        if len(doubtful):
            spread = spread_m(points.tof[doubtful], points.sigma_m[doubtful], self._rig, src=src, dst=name)
            # Written so that a spread of NaN is uncertain.
            transfer.labels[doubtful[~(spread <= limits.spread_max_m)]] = Label.UNCERTAIN
        # Stage 3: edges in the thermal image, within the area that the range pixel covers there.
        if name in self._scan.thermal and limits.step_max_k < math.inf:
            reach_px = reach_px_of(points.range_m, points.sigma_m, self._rig, src=src, dst=name)
            image = np.ascontiguousarray(self._scan.thermal[name])
            doubt_edges_into(transfer.labels, transfer.pixels, reach_px, image, limits.step_max_k)
        return transfer

    def _seen_points(self) -> _Points:
        if self._points is None:
            mounted, returned = self._rig[self._scan.range_camera], self._returns.pixels
            image_m, rays = self._returns.range_m.astype(np.float64), mounted.camera.rays()
            range_m = image_m.ravel()[returned]
            # Eq. 1-4: of the points that count, and of the whole image only the depth, because a slant takes the pixels
            # around.
            self._points = _Points(
                tof=np.take(rays.reshape(-1, 3), returned, axis=0) * range_m[:, None],
                range_m=range_m,
                steps_m=steps_of(rays[..., 2] * image_m).ravel()[returned],
                sigma_m=mounted.range_sigma_image(self._returns.range_m).ravel()[returned],
            )
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
def _pixels_of(height: int, width: int) -> Ints:
    """(height width, 2) x, y of an image's pixels, row by row."""
    y, x = np.divmod(np.arange(height * width), width)
    return np.stack([x, y], axis=1)
