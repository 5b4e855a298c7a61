"""Circle targets in images: a heated disc, matt black in its middle, red reflecting tape on its rim.

    threshold (Otsu) -> opening (small parts go) -> closing -> fill -> gates -> centroid

as in Kocmanova et al., V. Targets are bright in the amplitude of a time-of-flight camera (the tape returns too much
light), in the temperature, and in the excess of red over green and blue.

Two centroids. `paper`: of the filled outline's pixels. `grey`: each pixel weighs by how far its brightness is between
the ground's and the target's. A time-of-flight camera's full pixels flood their neighbours, outwards and into the dark
middle alike; where the outline bulges out on one side, the middle is dented on the same side. So there the grey
centroid is a mean of the outline's and the dark middle's. In the simulator that halves the error of the outline alone:
0.08 px against 0.16 px over targets of 20 and 30 cm at 1.1 to 5.7 m (tests/cairn_sim/study/test_study.py).
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.rig import Spectrum
from cairn_map.arrays import Bytes, Floats, Singles
from cairn_map.errors import BadInputError

Method = Literal["grey", "paper"]

SPECK_SHARE = 1.6e-4
"""Share of the image below which a part is noise: 4 pixels of a time-of-flight camera, 52 of a thermal one."""
AREA_MIN_PX = 12
"""Smallest area of a target, pixels."""
CLOSING_WIDTH_PX = 512
"""Pixels of image width for two of the closing's side: 3 up to a width of 700, 5 for 1280."""
ELLIPSE_SHARE_MIN = 0.8
"""Smallest ratio between the outline's area and that of the ellipse with the same moments, either way."""
AXES_RATIO_MIN = 0.4
"""Short axis over long one, at least: a disc tilted by 66 degrees."""
CONTRAST_SIGMAS = 5.0
"""Robust standard deviations of the image between its median and the threshold, at least."""
SOFT_PX = 3
"""Pixels beyond the outline whose brightness counts for the grey centroid."""
RIM_QUANTILE = 0.8
"""Quantile of the brightness within the outline that is the rim's, which is a third of the area or more."""
MIDDLE_SHARE = 0.4
"""Weight of the dark middle's centroid in the grey one; 0.3 and 0.5 are worse by a tenth."""


@dataclass(frozen=True, slots=True, eq=False)
class Disc:
    """One target in one image."""

    centroid: Floats
    """(2,) x, y."""
    radius_px: float
    """Radius of a disc with the outline's area."""
    pixels: npt.NDArray[np.int64]
    """(M, 2) x, y of all pixels within the outline, except the outermost."""


def brightness_of(image: npt.NDArray[np.generic], spectrum: Spectrum) -> Singles:
    """(H, W) float32, in which targets are bright: of an amplitude, a colour image, or a temperature."""
    values = np.asarray(image, np.float32)
    if spectrum is Spectrum.COLOUR:
        if values.ndim != 3 or values.shape[2] != 3:
            raise BadInputError(
                "image_type", f"targets are known by their red rim: colour is needed, got {values.shape}"
            )
        return np.asarray(values[..., 0] - np.maximum(values[..., 1], values[..., 2]), np.float32)
    seen = np.isfinite(values)
    return values if seen.all() else np.where(seen, values, np.median(values[seen]) if seen.any() else 0.0)


def find_discs(bright: Singles, spectrum: Spectrum, *, method: Method = "grey") -> list[Disc]:
    """Targets in an image of `brightness_of`, without those that the border cuts; none where nothing stands out."""
    mask = _outlines(bright)
    if mask is None:
        return []
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask)
    height, width = mask.shape
    discs = []
    for number in range(1, count):
        x, y, w, h, area = (int(v) for v in stats[number])
        if x == 0 or y == 0 or x + w == width or y + h == height or area < AREA_MIN_PX:
            continue
        low = np.maximum([x - SOFT_PX - 2, y - SOFT_PX - 2], 0)
        window = np.s_[low[1] : y + h + SOFT_PX + 2, low[0] : x + w + SOFT_PX + 2]
        part = (labels[window] == number).astype(np.uint8)
        if not _is_ellipse(part):
            continue
        centroid = np.array(centroids[number], np.float64)
        if method == "grey":
            centroid = low + _grey_centroid(np.asarray(bright[window], np.float64), part, mask[window], spectrum)
        inner = np.argwhere(cv2.erode(part, np.ones((3, 3), np.uint8)) > 0)[:, ::-1] + low
        discs.append(Disc(centroid, float(np.sqrt(area / np.pi)), inner.astype(np.int64)))
    return discs


def _outlines(bright: Singles) -> Bytes | None:
    """(H, W) 1 within each outline; None where nothing stands out."""
    low, high = float(np.percentile(bright, 1)), float(bright.max())
    if not high > low:
        return None
    # Threshold: Otsu's, but well above the noise.
    stretched = np.clip((bright - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    level, _ = cv2.threshold(stretched, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    middle = float(np.median(stretched))
    spread = 1.4826 * float(np.median(np.abs(stretched.astype(np.float32) - middle)))
    # Otsu's threshold halves the noise where targets are a small share of the image.
    level = max(level, middle + CONTRAST_SIGMAS * max(spread, 1.0))
    mask = (stretched > level).astype(np.uint8)
    # Opening, closing, filling.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    is_large = stats[:, cv2.CC_STAT_AREA] >= SPECK_SHARE * bright.size
    mask = (mask * is_large[np.asarray(labels, np.intp)]).astype(np.uint8)
    side = max(3, 2 * round(bright.shape[1] / CLOSING_WIDTH_PX) + 1)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)), np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(filled, outlines, -1, 1, cv2.FILLED)
    return filled


def _is_ellipse(part: Bytes) -> bool:
    """True if a mask's area is about that of the ellipse with its moments, and that ellipse is no line."""
    m = cv2.moments(part, binaryImage=True)
    # A pixel is a square: a twelfth of its area is its own second moment.
    xx, xy, yy = (m[name] / m["m00"] + own for name, own in (("mu20", 1 / 12), ("mu11", 0.0), ("mu02", 1 / 12)))
    short, long = (float(v) for v in np.linalg.eigvalsh([[xx, xy], [xy, yy]]))
    share = m["m00"] / (4 * np.pi * np.sqrt(long * short))
    return short > AXES_RATIO_MIN**2 * long and ELLIPSE_SHARE_MIN < share < 1 / ELLIPSE_SHARE_MIN


def _grey_centroid(bright: Floats, part: Bytes, all_parts: Bytes, spectrum: Spectrum) -> Floats:
    """(2,) grey-weighted centroid of one part, pixels of the window."""
    # Ground: a ring beyond the soft edge, away from other parts. Top: the rim's brightness.
    near, beyond = (_grow(part, reach) for reach in (SOFT_PX, SOFT_PX + 1))
    others = _grow((all_parts > 0) & (part == 0), 1)
    ground = float(np.median(bright[beyond & ~near & ~others] if (beyond & ~near & ~others).any() else bright[~near]))
    inside = part > 0
    top = float(np.quantile(bright[inside], RIM_QUANTILE))
    soft = np.clip((bright - ground) / max(top - ground, 1e-9), 0, 1)
    # The outline's centroid: whole pixels inside, soft ones about the edge.
    core = cv2.erode(part, np.ones((3, 3), np.uint8)) > 0
    outline = _mean_place(np.where(core, 1.0, soft * (near & ~others)))
    if spectrum is not Spectrum.RANGE:
        return outline
    # A range camera's full pixels flood both ways: average with the dark middle.
    dark = np.where(inside, np.clip(0.5 - (bright - ground) / max(top - ground, 1e-9), 0, None), 0.0)
    return outline if dark.sum() <= 0 else (1 - MIDDLE_SHARE) * outline + MIDDLE_SHARE * _mean_place(dark)


def _grow(part: npt.NDArray[np.generic], reach: int) -> npt.NDArray[np.bool_]:
    side = 2 * reach + 1
    return np.asarray(cv2.dilate(part.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _mean_place(weight: Floats) -> Floats:
    y, x = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.asarray(np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum())
