"""Flatness of a board: the view of a flat one through a lens with one radial term, and the misses of found points."""

from dataclasses import dataclass

import numpy as np

from cairn_calib.board.homography import fit_homography, map_points
from cairn_map.arrays import Floats

FLAT_RMS_PX, FLAT_RMS_CELLS = 0.5, 0.01
"""Largest root mean square miss, pixels plus cells: a lens with more radial terms bends large boards a little."""
RADIAL = (-0.4, 0.8)
"""Bounds of the radial term, in units in which the distance from the image's middle to its corner is 1."""
CENTRE_SIGMA = 0.3
"""Standard deviation of the lens's middle about the image's, in those units: images may be cut out of larger ones."""
DIFFERENCE = 1e-3
"""Step for derivatives by the radial term and by the middle."""
FARTHEST = 2.0
"""Distance from the image's middle, in units of its corner's, at which places further out are clamped."""


@dataclass(frozen=True, slots=True)
class FlatView:
    """View of a board's lattice: a homography to straight pixels p (1 + k p^2), with p from the image's middle."""

    homography: Floats
    k: float
    centre: Floats
    scale_px: float

    def pixels(self, lattice: Floats) -> Floats:
        """(N, 2) pixels at which places of the board appear."""
        # Straight place first, then bend it: the model undistorts, so the bent radius must be solved for.
        straight = map_points(self.homography, lattice)
        radius = np.linalg.norm(straight, axis=-1, keepdims=True)
        # Newton's method for r (1 + k r^2) = R; the slope's bound keeps it from running off where the lens folds.
        bent = radius.copy()
        for _ in range(8):
            step = (bent + self.k * bent**3 - radius) / np.maximum(1 + 3 * self.k * bent**2, 0.1)
            bent = np.clip(bent - step, 0, FARTHEST)
        return np.asarray(straight * bent / np.maximum(radius, 1e-12) * self.scale_px + self.centre)

    def misses_px(self, lattice: Floats, pixels: Floats) -> Floats:
        """(N, 2) straight pixels from where places of the board appear to where they were found."""
        plane = (pixels - self.centre) / self.scale_px
        straight = plane * (1 + self.k * (plane**2).sum(axis=1, keepdims=True))
        return np.asarray((straight - map_points(self.homography, lattice)) * self.scale_px)


def flat_view(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> FlatView | None:
    """View in which (N, 2) places of a board appear as found; None where they do not determine it.

    Args:
        lattice: (N, 2) places.
        pixels: (N, 2) where they were found, none of them NaN.
        shape: rows and columns of the image; the lens's middle is near its middle.
    """
    straight = straight_view(lattice, pixels, shape)
    if straight is None:
        return None
    middle, scale = straight.centre, straight.scale_px

    def view(at: Floats) -> FlatView | None:
        # In units in which the image's corner is 1 from its middle, so that k is a pure number.
        k, centre = float(at[0]), middle + scale * at[1:]
        plane = (pixels - centre) / scale
        homography = fit_homography(lattice, plane * (1 + k * (plane**2).sum(axis=1, keepdims=True)))
        return None if homography is None else FlatView(homography, k, centre, scale)

    # Gauss and Newton for k and the lens's middle; each has its own homography, so slopes are taken by differences.
    unknown = np.zeros(3)
    prior = np.diag([0.0, 1.0, 1.0]) * FLAT_RMS_PX / CENTRE_SIGMA
    for _ in range(4):
        here, *ahead = (view(unknown + step) for step in (np.zeros(3), *(DIFFERENCE * np.eye(3))))
        if here is None or any(each is None for each in ahead):
            return None
        missed = here.misses_px(lattice, pixels).ravel()
        slopes = [(each.misses_px(lattice, pixels).ravel() - missed) / DIFFERENCE for each in ahead if each]
        system = np.concatenate([np.stack(slopes, axis=1), prior])
        unknown = unknown - np.linalg.lstsq(system, np.concatenate([missed, prior @ unknown]), rcond=None)[0]
        unknown = np.clip(unknown, [RADIAL[0], -1, -1], [RADIAL[1], 1, 1])
    return view(unknown)


def straight_view(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> FlatView | None:
    """View through a lens that does not bend; arguments are those of `flat_view`."""
    middle = np.array([shape[1] - 1, shape[0] - 1]) / 2
    scale = float(np.hypot(*middle))
    homography = fit_homography(lattice, (pixels - middle) / scale)
    return None if homography is None else FlatView(homography, 0.0, middle, scale)


def flat_limit_px(cell_px: float) -> float:
    """Largest root mean square miss, pixels, of a board whose cells are `cell_px` large."""
    return FLAT_RMS_PX + FLAT_RMS_CELLS * cell_px


def flat_rms_px(lattice: Floats, pixels: Floats, shape: tuple[int, ...]) -> float:
    """Root mean square miss, pixels, of (N, 2) points in their own `flat_view`; infinite where there is none."""
    view = flat_view(lattice, pixels, shape)
    return float("inf") if view is None else float(np.sqrt((view.misses_px(lattice, pixels) ** 2).sum() / len(pixels)))
