"""Straightening of an image that a lens bends much: in it a board's lattice is nearly a homography.

    straight = p / (1 + bend |p|^2)      p: from the image's middle, in units of its half diagonal (Fitzgibbon 2001)

Neighbours predict a disc by a parabola (`local_map.py`), which is good where a lens bends little over two pitches. It
is not where a board of 3 x 4 discs fills the image of a lens of 150 degrees: discs that are right lie a fifth of a
pitch off, and look 1.3 times as long as wide. One number straightens such an image to some percent; parabolas follow
the rest.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cairn_calib.board.homography import fit_homography, map_points, steps_between
from cairn_map.arrays import Floats

BENDS = np.append(np.arange(-1.6, 0.0, 0.1), 0.0)
"""Bends that are tried: 0 for none, -1 for a lens that sees 90 degrees off its axis at the image's corners."""
LEAST_DENOMINATOR = 0.12
"""Least 1 + bend |p|^2 of a found disc: beyond, the straight image is far larger than the recorded one."""
MISS_MIN, MISS_RATIO = 0.02, 0.5
"""Median miss of the homography, steps, from which on an image is straightened, and its most after it, over before."""


@dataclass(frozen=True, slots=True)
class Straightening:
    """A map from an image's pixels to straight ones, which are as large as those in the image's middle."""

    middle: Floats
    """(2,) pixels."""
    scale_px: float
    """Half the image's diagonal, pixels."""
    bend: float

    def straight(self, pixels: Floats) -> Floats:
        """(N, 2) straight pixels."""
        at = (pixels - self.middle) / self.scale_px
        return np.asarray(at / self._denominator(at) * self.scale_px + self.middle)

    def jacobian(self, pixels: Floats) -> Floats:
        """(N, 2, 2) derivatives of the straight pixels by the pixels."""
        at = (pixels - self.middle) / self.scale_px
        below = self._denominator(at)[..., None]
        return np.asarray(np.eye(2) / below - 2 * self.bend * at[..., :, None] * at[..., None, :] / below**2)

    def _denominator(self, at: Floats) -> Floats:
        return np.asarray(1 + self.bend * (at**2).sum(axis=-1, keepdims=True))


class LatticeView(Protocol):
    """A map from an image's pixels to places of a board's lattice."""

    def places(self, pixels: Floats) -> Floats:
        """(N, 2) places."""
        ...

    def jacobian(self, pixels: Floats) -> Floats:
        """(N, 2, 2) derivatives of the places by the pixels."""
        ...


@dataclass(frozen=True, slots=True)
class UnbentView:
    """The image itself: places are pixels."""

    def places(self, pixels: Floats) -> Floats:
        """(N, 2) places."""
        return pixels

    def jacobian(self, pixels: Floats) -> Floats:
        """(N, 2, 2) derivatives of the places by the pixels."""
        return np.broadcast_to(np.eye(2), (len(pixels), 2, 2))


@dataclass(frozen=True, slots=True)
class BentView:
    """A map from an image's pixels to places of a board's lattice, true to some percent."""

    straightening: Straightening
    from_straight: Floats
    """(3, 3) homography."""

    def places(self, pixels: Floats) -> Floats:
        """(N, 2) places."""
        return map_points(self.from_straight, self.straightening.straight(pixels))

    def jacobian(self, pixels: Floats) -> Floats:
        """(N, 2, 2) derivatives of the places by the pixels."""
        straight = self.straightening.straight(pixels)
        depth = straight @ self.from_straight[2, :2] + self.from_straight[2, 2]
        places = map_points(self.from_straight, straight)
        slopes = self.from_straight[:2, :2] - places[:, :, None] * self.from_straight[2, :2]
        return np.asarray(slopes / depth[:, None, None] @ self.straightening.jacobian(pixels))


def bent_view(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> BentView:
    """The view that shows a lattice best; without perspective where no homography has all its places in front.

    Arguments are those of `straightening_of`.
    """
    straightening = straightening_of(lattice, pixels, shape)
    straight = straightening.straight(pixels)
    homography = fit_homography(straight, lattice)
    if homography is None or not np.isfinite(map_points(homography, straight)).all():
        # An affine map, by least squares.
        terms = np.column_stack([straight, np.ones(len(straight))])
        affine = np.linalg.lstsq(terms, lattice, rcond=None)[0].T
        homography = np.vstack([affine, [0.0, 0.0, 1.0]])
    return BentView(straightening, homography)


def straightening_of(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> Straightening:
    """The straightening that makes a lattice most nearly a homography; none where that is no clear gain.

    Args:
        lattice: (N, 2) places of discs.
        pixels: (N, 2) where they appear.
        shape: rows and columns of the image.
    """
    middle = np.array([shape[1] - 1, shape[0] - 1]) / 2
    scale = float(np.hypot(*middle))
    farthest = float(((pixels - middle) ** 2).sum(axis=1).max()) / scale**2
    tried = [Straightening(middle, scale, float(bend)) for bend in BENDS if 1 + bend * farthest > LEAST_DENOMINATOR]
    misses = [_miss(lattice, each.straight(pixels)) for each in tried]
    best = int(np.argmin(misses))
    # The last is none at all.
    return tried[best] if misses[-1] > MISS_MIN and misses[best] < MISS_RATIO * misses[-1] else tried[-1]


def _miss(lattice: Floats, straight: Floats) -> float:
    """Median distance of straight places from their homography, steps; infinite where there is none."""
    homography = fit_homography(lattice, straight)
    if homography is None:
        return np.inf
    off = np.linalg.norm(straight - map_points(homography, lattice), axis=1)
    steps = steps_between(homography, lattice)
    # Where a place goes to infinity there is no fit at all.
    if not np.isfinite(steps).all() or not np.isfinite(off).all():
        return np.inf
    return float(np.median(off / np.sqrt(np.maximum(np.abs(np.linalg.det(steps)), 1e-12))))
