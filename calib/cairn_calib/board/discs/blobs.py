"""Candidates for discs: blobs like ellipses in an image, of every size, on any slowly changing ground.

    D = (image, blurred by s) - (image, blurred by s / 8)      > 0: darker than the ground about it

D is 0 along the outline of a disc up to about 1.3 s in radius, whatever its contrast and however the ground slopes, and
negative around it, so that each disc is an island. A ladder of s, in steps of 2, reaches every size; each step works
on a copy of the image in which s has the same number of pixels. What a blob is good for is decided by its neighbours
(`disc_lattice`): here only what cannot be a disc is left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats

Image = npt.NDArray[np.float32]

WIDE_PX, NARROW_PX = 6.4, 0.8
"""Standard deviations of the two blurs, pixels of the copy on which a step works."""
FINEST_PX = 1.6
"""Wide blur of the finest step, pixels of the image: discs from 4 px in diameter stand apart in it."""
COARSEST = 0.25
"""Wide blur of the coarsest step, at most, share of the image's shorter side: a grid of 3 x 3 discs fills the image."""
ENLARGED_MAX = 3200
"""Longest side of an enlarged copy, pixels."""
NOISE_SIGMAS = 3.0
"""Height of an island's shore above 0, standard deviations of the noise."""
PEAK_SIGMAS = 5.0
"""Height of an island, at least, standard deviations of the noise."""
AREA_MIN_PX = 14
"""Smallest area, pixels of the copy."""
ELLIPSE_SHARE_MIN = 0.86
"""Area over that of the ellipse with the same second moments: 1 for a disc, 0.95 for a square, less for others."""
AXES_RATIO_MIN = 0.17
"""Short axis over the long one, at least: tilted by 80 degrees."""
SAME_RADII = 0.5
"""Distance below which blobs of two steps are one, radii of the larger."""
BLOBS_MAX = 700
"""Blobs of one step that are kept, the highest ones."""


@dataclass(frozen=True, slots=True)
class Blobs:
    """N blobs of one image, all darker than their ground, or all brighter."""

    centres: Floats
    """(N, 2) pixels."""
    shapes: Floats
    """(N, 2, 2) symmetric: the image of the unit circle, as an ellipse about the centre, pixels."""
    heights: Floats
    """(N,) counts by which the middle differs from its surroundings."""

    def with_one(self, centre: Floats, shape: Floats, height: float) -> "Blobs":
        """These and one more, the last."""
        return Blobs(
            np.vstack([self.centres, centre]),
            np.concatenate([self.shapes, shape[None]]),
            np.append(self.heights, height),
        )

    def __len__(self) -> int:
        return len(self.centres)


def blob_ladder(signed: Image) -> Iterator[tuple[float, Blobs]]:
    """The wide blur, pixels, and the dark blobs of each step of the ladder, from usual sizes to unusual ones."""
    coarsest = COARSEST * min(signed.shape)
    steps = [FINEST_PX * 2**k for k in range(16) if FINEST_PX * 2**k <= max(coarsest, FINEST_PX)]
    # Sizes near a fortieth of the image come first: most boards end the search there.
    usual = min(signed.shape) / 40
    for wide in sorted(steps, key=lambda step: abs(np.log(step / usual))):
        yield wide, dark_blobs(signed, wide)


def merge(parts: Sequence[Blobs]) -> Blobs:
    """Blobs of several steps, finest first: each place keeps the finest of those that are about as high as the highest.

    Noise on a disc makes small, low blobs in fine steps; what is next to it bends the blob of a coarse one.
    """
    centres = np.concatenate([each.centres for each in parts])
    shapes = np.concatenate([each.shapes for each in parts])
    heights = np.concatenate([each.heights for each in parts])
    radius = np.sqrt(np.abs(np.linalg.det(shapes)))
    # Component by component: NumPy sums over an axis of two twenty times as slowly.
    x, y = centres.T
    away = np.sqrt((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2)
    near = away < SAME_RADII * np.maximum(radius, radius[:, None])
    kept = ~(near & (heights > 2 * heights[:, None])).any(axis=1)
    for n in range(len(centres)):
        if kept[n]:
            kept[n + 1 :] &= ~near[n, n + 1 :]
    return Blobs(centres[kept], shapes[kept], heights[kept])


def dark_blobs(signed: Image, wide_px: float) -> Blobs:
    """Dark blobs of up to about 1.3 `wide_px` in radius."""
    scale = min(WIDE_PX / wide_px, max(1.0, ENLARGED_MAX / max(signed.shape) / 2), 4.0)
    way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    copy = np.asarray(cv2.resize(signed, None, fx=scale, fy=scale, interpolation=way), np.float32)
    wide = scale * wide_px
    narrow = NARROW_PX * max(wide / WIDE_PX, 0.5)
    D = np.asarray(cv2.GaussianBlur(copy, (0, 0), wide) - cv2.GaussianBlur(copy, (0, 0), narrow), np.float32)
    noise = _noise(D, copy)
    islands = (NOISE_SIGMAS * noise < D).astype(np.uint8)
    contours, tree = cv2.findContours(islands, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    centres, shapes, heights = [], [], []
    for contour, links in zip(contours, np.reshape(() if tree is None else tree, (-1, 4)), strict=True):
        # Shores of lakes are no islands.
        if links[3] >= 0 or len(contour) < 8:
            continue
        found = _ellipse(np.asarray(contour, np.int32), D, wide)
        if found is not None and found[2] > PEAK_SIGMAS * noise:
            centres.append(found[0])
            shapes.append(found[1])
            heights.append(found[2])
    if not centres:
        return Blobs(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))
    order = np.argsort(-np.array(heights))[:BLOBS_MAX]
    # Pixel centres are at whole numbers, so an image's edge is at -0.5 at every scale.
    at = (np.array(centres)[order] + 0.5) / scale - 0.5
    return Blobs(at, np.array(shapes)[order] / scale, np.array(heights)[order])


def _noise(D: Image, copy: Image) -> float:
    """Standard deviation of what is no structure in D, at least that of counts being whole numbers."""
    # Differences of neighbours are noise in most places; the median of their sizes is 0.67 of a standard deviation.
    rough = np.abs(np.diff(D[::2, ::2], axis=1))
    counts = float(np.median(np.abs(np.diff(copy[::2, ::2], axis=1))))
    return max(float(np.median(rough)) / 0.95, 0.05 * counts, 1e-6 * float(np.ptp(D)), 0.02)


def _ellipse(contour: npt.NDArray[np.int32], D: Image, wide_px: float) -> tuple[Floats, Floats, float] | None:
    """Centre, shape and height of an island like an ellipse; None for any other."""
    m = cv2.moments(contour)
    area = m["m00"]
    if area < AREA_MIN_PX:
        return None
    # Squared half axes of the ellipse with the same second moments are 4 times these; its area is 4 pi their root.
    xx, xy, yy = (m[name] / area for name in ("mu20", "mu11", "mu02"))
    determinant = xx * yy - xy * xy
    if determinant <= 0 or area < ELLIPSE_SHARE_MIN * 4 * np.pi * np.sqrt(determinant):
        return None
    x, y, width, height = cv2.boundingRect(contour)
    # What the image's border cuts has no centre.
    if x <= 1 or y <= 1 or x + width >= D.shape[1] - 1 or y + height >= D.shape[0] - 1:
        return None
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    if values[0] < AXES_RATIO_MIN**2 * values[1]:
        return None
    # An outline through the outer pixels' centres leaves half a pixel out on each side.
    axes = 2 * np.sqrt(values) + 0.5
    centre = np.array([m["m10"], m["m01"]]) / area
    column, row = round(float(centre[0])), round(float(centre[1]))
    # In the middle of a disc of radius R the wide blur leaves exp(-R^2 / 2 s^2) of its contrast.
    spread = float(axes[0] * axes[1]) / wide_px**2
    return centre, (vectors * axes) @ vectors.T, float(D[row, column]) * float(np.exp(min(spread, 3.0) / 2))
