"""Middle of a bright or dark blob near a place that was pointed at: a pin, a lamp, a heated dot.

The blob is what exceeds half of the contrast to its surroundings, in one piece with its extreme; its middle is the mean
of its pixels' places, weighted by how far they stand out. Either polarity: the stronger contrast counts.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.image_files import Grey
from cairn_map.arrays import Flags, Floats

CONTRAST_MIN = 6.0
"""Contrast of a blob over the noise around it, at least."""
FOOT_SHARE = 0.25
"""Share of the contrast from which on a pixel has weight: below it is the surroundings."""
SIGMA_MIN_PX = 0.03
"""Least standard deviation of a middle: no blob is known better than its shape."""
MAD_TO_SIGMA = 1.4826
REACH_MAX_PX = 200.0


@dataclass(frozen=True, slots=True)
class BlobMiddle:
    """Middle of one blob."""

    pixel: Floats
    """(2,) x, y."""
    covariance_px2: Floats
    """(2, 2) by the noise of its surroundings, which is taken as independent from pixel to pixel."""
    is_bright: bool


def blob_middle(counts: Grey, pixel: npt.ArrayLike, reach_px: float) -> BlobMiddle | str:
    """The blob whose extreme is at most `reach_px` from a pixel (x, y); or the reason why there is none."""
    x0, y0 = (float(value) for value in np.asarray(pixel, np.float64))
    height, width = counts.shape
    # 1. A window of twice the reach; what is farther than the reach from the click is the surroundings.
    side = int(np.ceil(2 * reach_px)) + 1
    left, top = max(0, round(x0) - side), max(0, round(y0) - side)
    window = counts[top : min(height, round(y0) + side + 1), left : min(width, round(x0) + side + 1)].astype(np.float64)
    if not window.size:
        return "it is outside the image"
    y, x = np.mgrid[: window.shape[0], : window.shape[1]]
    away = np.hypot(x + left - x0, y + top - y0)
    near, around = away <= reach_px, away > 1.5 * reach_px
    if near.sum() < 5 or around.sum() < 20:
        return "it is too near the image's border"
    level = float(np.median(window[around]))
    noise = MAD_TO_SIGMA * float(np.median(np.abs(window[around] - level)))
    # 2. The extreme of either polarity, by means of 3 x 3 pixels: a single bad pixel is no blob.
    smooth = _mean3(window) - level
    at = int(np.argmax(np.where(near, np.abs(smooth), -1.0)))
    extreme = float(smooth.ravel()[at])
    if abs(extreme) <= CONTRAST_MIN * noise / 3 or extreme == 0:
        return f"no blob within {reach_px:g} px stands out of the noise"
    stands_out = (window - level) * np.sign(extreme)
    # 3. The piece above half of the contrast that holds the extreme.
    piece = _piece(_mean3(stands_out) > abs(extreme) / 2, at)
    if piece[0].any() or piece[-1].any() or piece[:, 0].any() or piece[:, -1].any():
        return f"the blob there is larger than {reach_px:g} px: a larger reach would do, or it runs into another one"
    # 4. Its middle, weighted; two pixels around it are the flanks of its edge.
    weights = np.where(_grown(_grown(piece)), np.maximum(stands_out - FOOT_SHARE * abs(extreme), 0.0), 0.0)
    total = float(weights.sum())
    middle = np.array([(weights * x).sum(), (weights * y).sum()]) / total
    used = weights > 0
    spread = np.stack([x[used] - middle[0], y[used] - middle[1]])
    covariance = (noise / total) ** 2 * (spread @ spread.T) + SIGMA_MIN_PX**2 * np.eye(2)
    return BlobMiddle(np.add(middle, (left, top)), covariance, extreme > 0)


def _mean3(image: Floats) -> Floats:
    """Means of 3 x 3 pixels; the border is repeated."""
    padded = np.pad(image, 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    means: Floats = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9
    return means


def _piece(mask: Flags, at: int) -> Flags:
    """The part of a mask that is connected to the pixel of number `at`."""
    piece = np.zeros_like(mask)
    piece.ravel()[at] = True
    while True:
        larger = _grown(piece) & mask
        if (larger == piece).all():
            return piece
        piece = larger


def _grown(mask: Flags) -> Flags:
    """The mask and its four neighbours."""
    grown = mask.copy()
    grown[1:] |= mask[:-1]
    grown[:-1] |= mask[1:]
    grown[:, 1:] |= mask[:, :-1]
    grown[:, :-1] |= mask[:, 1:]
    return grown
