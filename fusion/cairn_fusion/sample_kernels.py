"""What an image says of the voxels that a scan hit: sums of the pixels that fell on each."""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_fusion.transfer_kernels import OK

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Index = npt.NDArray[np.int32]


@nb.njit(cache=True, nogil=True)
def add_pixels_into(
    totals: Floats,
    counts: Ints,
    taken: npt.NDArray[np.bool_],
    image: npt.NDArray[np.generic],
    pixels: Ints,
    labels: npt.NDArray[np.uint8],
    voxel_of: Index,
) -> None:
    """Add each point's pixel to its voxel, but for points that are taken already, and take those that had a value.

    Args:
        totals: (U, C) sums of values by voxel.
        counts: (U,) pixels by voxel.
        taken: (N,) points that another image spoke for.
        image: (H, W, C); what is not finite is no value.
        pixels: (N, 2) x, y, where the label is OK.
        labels: (N,)
        voxel_of: (N,)
    """
    for n in range(labels.shape[0]):
        if taken[n] or labels[n] != OK:
            continue
        x, y = pixels[n, 0], pixels[n, 1]
        valid = True
        for c in range(image.shape[2]):
            valid &= bool(np.isfinite(image[y, x, c]))
        if not valid:
            continue
        taken[n] = True
        counts[voxel_of[n]] += 1
        for c in range(image.shape[2]):
            totals[voxel_of[n], c] += np.float64(image[y, x, c])
