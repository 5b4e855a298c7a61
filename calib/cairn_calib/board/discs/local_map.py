"""Local map from a board's lattice to the image: a parabola about each place, which follows any lens.

A homography and one radial term do not make a lens of 110 degrees; over two pitches any lens is nearly a parabola. The
map of a place is fitted to the points around it, weighted by their distance, with the curvature held near 0 where too
few points tell it.
"""

import numpy as np

from cairn_map.arrays import Floats

REACH_STEPS = 1.1
"""Standard deviation of the weights, steps."""
CURVATURE_SIGMA = 0.2
"""Prior standard deviation of the curvature, steps a step squared, against misses of `MISS_STEPS`."""
MISS_STEPS = 0.02
LEAST_WEIGHT = 1e-4
PAIRS_MAX = 1 << 16
"""Places times known points that are fitted at once: some 20 MB, whatever the board."""


def local_map(lattice: Floats, pixels: Floats, places: Floats, *, step: float = 1.0) -> tuple[Floats, Floats]:
    """Pixels (M, 2) of places, and steps (M, 2, 2) in the image for one unit along x, and along y.

    Args:
        lattice: (N, 2) places of known points, N >= 4.
        pixels: (N, 2) where they appear.
        places: (M, 2) places of the lattice that are asked for.
        step: distance of neighbours on the lattice.
    """
    # Part by part: each place is fitted alone, to all known points.
    at_once = max(1, PAIRS_MAX // max(len(lattice), 1))
    found, steps = np.empty((len(places), 2)), np.empty((len(places), 2, 2))
    for start in range(0, len(places), at_once):
        part = slice(start, start + at_once)
        away = (lattice[None] - places[part, None]) / step
        found[part], steps[part] = _fitted(away, pixels, np.ones(away.shape[:2]), step)
    return found, steps


def predicted_by_others(lattice: Floats, pixels: Floats, *, step: float = 1.0) -> Floats:
    """(N, 2) pixels of each point by the other points alone."""
    away = (lattice[None] - lattice[:, None]) / step
    return _fitted(away, pixels, 1.0 - np.eye(len(lattice)), step)[0]


def _fitted(away: Floats, pixels: Floats, counts: Floats, step: float) -> tuple[Floats, Floats]:
    x, y = away[..., 0], away[..., 1]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    weight = counts * (np.exp(-0.5 * (x * x + y * y) / REACH_STEPS**2) + LEAST_WEIGHT)
    weighted = terms * weight[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ terms
    # A curvature of `CURVATURE_SIGMA` steps counts as much as a miss of `MISS_STEPS`.
    normal[:, [3, 4, 5], [3, 4, 5]] += (MISS_STEPS / CURVATURE_SIGMA) ** 2
    normal += 1e-12 * np.eye(6)
    solved = np.asarray(np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ pixels), np.float64)
    return solved[:, 0], solved[:, 1:3] / step
