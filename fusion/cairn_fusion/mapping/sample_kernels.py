"""Samples of an image for the voxels that a scan hit: sums of the pixels that fell on each."""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_fusion.transfer.transfer_kernels import OK, REACH_MAX_PX, UNCERTAIN
from cairn_map.arrays import Flags, Floats, Int32s, Ints, Labels, Singles
from cairn_map.evidence.channels import SAMPLE_MAX


@nb.njit(cache=True, nogil=True, error_model="numpy")
def doubt_edges_into(
    labels: Labels,
    pixels: Int32s,
    range_m: Floats,
    sigma_m: Floats,
    fixed_px: float,
    moved_px: float,
    image: Singles,
    step_max: float,
) -> None:
    """Label points UNCERTAIN if the image around their pixel differs by more than a step.

    Args:
        labels: (N,) only points labelled OK are examined.
        pixels: (2, N) x and y, where the label is OK.
        range_m: (N,)
        sigma_m: (N,) standard deviation of the ranges.
        fixed_px: reach of `pixel_covariance.PlaceBounds`, to each side, within which the point may be.
        moved_px: its part by the range's noise.
        image: (H, W); pixels that are no number do not count.
        step_max: largest difference between the least and the greatest value.
    """
    height, width = image.shape
    examined = 0
    for n in range(labels.shape[0]):
        examined += int(labels[n] == OK)
    # The reach of most points is the same: for this one all pixels of the image are examined at once, if that is less.
    usual = _whole_reach(fixed_px)
    is_tabled = examined * (2 * usual + 1) ** 2 > height * width
    uneven = _uneven(image, usual, step_max) if is_tabled else np.empty((0, 0), np.bool_)
    for n in range(labels.shape[0]):
        if labels[n] != OK:
            continue
        x, y = int(pixels[0, n]), int(pixels[1, n])
        reach = _whole_reach(fixed_px + moved_px * sigma_m[n] / (range_m[n] * range_m[n]))
        if is_tabled and reach == usual:
            is_edge = uneven[y, x]
        else:
            # Least and greatest value of the square of pixels, cut at the image's border.
            least, most = np.float32(np.inf), np.float32(-np.inf)
            for j in range(max(y - reach, 0), min(y + reach + 1, height)):
                for i in range(max(x - reach, 0), min(x + reach + 1, width)):
                    # Written so that NaN changes neither.
                    value = image[j, i]
                    least = value if value < least else least
                    most = value if value > most else most
            is_edge = most - least > step_max
        if is_edge:
            labels[n] = UNCERTAIN


@nb.njit(forceinline=True)
def _whole_reach(reach_px: float) -> int:
    """Whole pixels of a reach, 1 to `REACH_MAX_PX`."""
    return int(min(max(np.floor(reach_px), 1.0), np.float64(REACH_MAX_PX)))


@nb.njit(cache=True, nogil=True)
def _uneven(image: Singles, reach: int, step_max: float) -> Flags:
    """(H, W) true where the square of pixels that reaches so far to each side differs by more than a step."""
    height, width = image.shape
    uneven = np.empty((height, width), np.bool_)
    # With a border that changes nothing. Columns first: the least and the greatest of each, and then those of the row.
    least, most = np.empty(width + 2 * reach, np.float32), np.empty(width + 2 * reach, np.float32)
    low, high = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        least[:], most[:] = np.inf, -np.inf
        for j in range(max(y - reach, 0), min(y + reach + 1, height)):
            row, down, up = image[j], least[reach:][:width], most[reach:][:width]
            for x in range(width):
                # Written so that NaN changes neither.
                down[x] = row[x] if row[x] < down[x] else down[x]
                up[x] = row[x] if row[x] > up[x] else up[x]
        low[:], high[:] = least[:width], most[:width]
        for i in range(1, 2 * reach + 1):
            down, up = least[i:][:width], most[i:][:width]
            for x in range(width):
                low[x] = down[x] if down[x] < low[x] else low[x]
                high[x] = up[x] if up[x] > high[x] else high[x]
        out = uneven[y]
        for x in range(width):
            out[x] = high[x] - low[x] > step_max
    return uneven


@nb.njit(cache=True, nogil=True)
def add_pixels_into(
    totals: Floats,
    counts: Ints,
    image: npt.NDArray[np.generic],
    pixels: Int32s,
    labels: Labels,
    voxel_of: Int32s,
) -> None:
    """Add the pixel of each point that is labelled OK to its voxel.

    Args:
        totals: (U, C) sums of values by voxel.
        counts: (U,) pixels by voxel.
        image: (H, W, C); a number that is not finite is no value.
        pixels: (2, N) x and y, where the label is OK.
        labels: (N,)
        voxel_of: (N,)
    """
    for n in range(labels.shape[0]):
        if labels[n] != OK:
            continue
        x, y, voxel = np.uint64(pixels[0, n]), np.uint64(pixels[1, n]), np.uint64(voxel_of[n])
        # A pixel counts with all its channels, or not at all.
        valid = True
        for c in range(image.shape[2]):
            valid &= bool(np.isfinite(image[y, x, c]))
        if not valid:
            continue
        counts[voxel] += 1
        for c in range(image.shape[2]):
            totals[voxel, c] += np.float64(image[y, x, c])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def write_means_into(
    sums: Ints, first: int, last: int, totals: Floats, counts: Ints, zero: float, step: float, is_squared: bool
) -> bool:
    """Write a sample of weight 1, the mean of its pixels, to each voxel that has none yet; true if all are in range.

    Args:
        sums: (U, P)
        first: the channel's first plane.
        last: the plane of its weight.
        totals: (U, C) sums of values.
        counts: (U,) pixels.
        zero: value of the sample 0.
        step: of `cairn_map.evidence.channels.Channel.quantise`.
        is_squared: true if the square of the one value is kept too.
    """
    for n in range(counts.shape[0]):
        # The weight is 1 where an image before this one has spoken.
        if counts[n] == 0 or sums[n, last] != 0:
            continue
        for c in range(totals.shape[1]):
            # Fixed point: sums of samples commute, sums of floats do not.
            sample = np.rint((totals[n, c] / counts[n] - zero) / step)
            # A comparison with NaN is false.
            if not (sample >= 0.0 and sample <= SAMPLE_MAX):
                return False
            sums[n, first + c] = np.int64(sample)
        if is_squared:
            sums[n, first + 1] = sums[n, first] ** 2
        sums[n, last] = 1
    return True
