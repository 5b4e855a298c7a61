"""A flat board seen through a lens with one radial term, as found points tell it, and how far off they lie."""

from dataclasses import dataclass

import numpy as np

from cairn_calib.board.homography import fit_homography, mapped
from cairn_map.arrays import Floats

FLAT_RMS_PX = 0.5
FLAT_RMS_CELLS = 0.01
"""A lens with more than one radial term still bends a large board a little."""
RADIAL = (-0.4, 0.8)
"""Of the term, where 1 is the distance from the image's middle to its corner."""

FARTHEST = 2.0
"""From the image's middle, in the same unit: places further out count as there, which is outside of any image."""


@dataclass(frozen=True, slots=True)
class FlatView:
    """Where a board's lattice appears: a homography of straight pixels p (1 + k p^2), p from the image's middle."""

    homography: Floats
    k: float
    centre: Floats
    scale_px: float

    def pixels(self, lattice: Floats) -> Floats:
        """(N, 2) where places of the board appear."""
        straight = mapped(self.homography, lattice)
        radius = np.linalg.norm(straight, axis=-1, keepdims=True)
        bent = radius.copy()
        for _ in range(8):
            step = (bent + self.k * bent**3 - radius) / np.maximum(1 + 3 * self.k * bent**2, 0.1)
            bent = np.clip(bent - step, 0, FARTHEST)
        return np.asarray(straight * bent / np.maximum(radius, 1e-12) * self.scale_px + self.centre)

    def misses_px(self, lattice: Floats, pixels: Floats) -> Floats:
        """(N, 2) pixels, straightened, from where places of the board appear to where they were found."""
        plane = (pixels - self.centre) / self.scale_px
        straight = plane * (1 + self.k * (plane**2).sum(axis=1, keepdims=True))
        return np.asarray((straight - mapped(self.homography, lattice)) * self.scale_px)


def flat_view(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> FlatView | None:
    """The view in which (N, 2) places of a board appear as found; None where they do not tell.

    Args:
        lattice: (N, 2) places.
        pixels: (N, 2) where they were found, none of them NaN.
        shape: of the image, whose middle is the lens's.
    """
    centre = np.array([shape[1] - 1, shape[0] - 1]) / 2
    scale = float(np.hypot(*centre))
    plane = (pixels - centre) / scale
    square = (plane**2).sum(axis=1, keepdims=True)

    def view(k: float) -> FlatView | None:
        homography = fit_homography(lattice, plane * (1 + k * square))
        return None if homography is None else FlatView(homography, k, centre, scale)

    k = 0.0
    for _ in range(3):
        here, beside = view(k), view(k + 1e-3)
        if here is None or beside is None:
            return None
        missed = here.misses_px(lattice, pixels)
        slope = (beside.misses_px(lattice, pixels) - missed) / 1e-3
        k = float(np.clip(k - (slope * missed).sum() / max(float((slope**2).sum()), 1e-12), *RADIAL))
    return view(k)


def flat_limit_px(cell_px: float) -> float:
    """The most that the points of one board may lie off, pixels (rms)."""
    return FLAT_RMS_PX + FLAT_RMS_CELLS * cell_px


def flat_rms_px(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> float:
    """Root mean square, pixels, by which (N, 2) points lie off their own `flat_view`; infinite where there is none."""
    view = flat_view(lattice, pixels, shape)
    return float("inf") if view is None else float(np.sqrt((view.misses_px(lattice, pixels) ** 2).sum() / len(pixels)))
