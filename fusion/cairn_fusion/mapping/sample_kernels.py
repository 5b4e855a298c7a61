"""Samples of an image for the voxels that a scan hit: sums of the pixels that fell on each."""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_fusion.transfer.transfer_kernels import OK, UNCERTAIN
from cairn_map.arrays import Floats, Int32s, Ints
from cairn_map.evidence.channels import SAMPLE_MAX


@nb.njit(cache=True, nogil=True)
def doubt_edges_into(
    labels: npt.NDArray[np.uint8],
    pixels: Ints,
    reach_px: Int32s,
    image: npt.NDArray[np.float32],
    step_max: float,
) -> None:
    """Label points UNCERTAIN if the image around their pixel differs by more than a step.

    Args:
        labels: (N,) only points labelled OK are examined.
        pixels: (N, 2) x, y, where the label is OK.
        reach_px: (N,) pixels to each side within which the point may be.
        image: (H, W); pixels that are no number do not count.
        step_max: largest difference between the least and the greatest value.
    """
    height, width = image.shape
    for n in range(labels.shape[0]):
        if labels[n] != OK:
            continue
        # Least and greatest value of the square of pixels, cut at the image's border.
        x, y, reach = pixels[n, 0], pixels[n, 1], np.int64(reach_px[n])
        least, most = np.float32(np.inf), np.float32(-np.inf)
        for j in range(max(y - reach, 0), min(y + reach + 1, height)):
            for i in range(max(x - reach, 0), min(x + reach + 1, width)):
                # Written so that NaN changes neither.
                value = image[j, i]
                least = value if value < least else least
                most = value if value > most else most
        if most - least > step_max:
            labels[n] = UNCERTAIN


@nb.njit(cache=True, nogil=True)
def add_pixels_into(
    totals: Floats,
    counts: Ints,
    taken: npt.NDArray[np.bool_],
    image: npt.NDArray[np.generic],
    pixels: Ints,
    labels: npt.NDArray[np.uint8],
    voxel_of: Int32s,
) -> None:
    """Add each point's pixel to its voxel, except for points already taken; take those that had a value.

    Args:
        totals: (U, C) sums of values by voxel.
        counts: (U,) pixels by voxel.
        taken: (N,) points that have a value from another image.
        image: (H, W, C); a number that is not finite is no value.
        pixels: (N, 2) x, y, where the label is OK.
        labels: (N,)
        voxel_of: (N,)
    """
    for n in range(labels.shape[0]):
        if taken[n] or labels[n] != OK:
            continue
        x, y = pixels[n, 0], pixels[n, 1]
        # A pixel counts with all its channels, or not at all.
        valid = True
        for c in range(image.shape[2]):
            valid &= bool(np.isfinite(image[y, x, c]))
        if not valid:
            continue
        taken[n] = True
        counts[voxel_of[n]] += 1
        for c in range(image.shape[2]):
            totals[voxel_of[n], c] += np.float64(image[y, x, c])


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
