"""A level as a camera sees it, span by span: each is a box, and a ray meets the nearest of all boxes."""

import numpy as np

from cairn_map.arrays import Floats

Span = tuple[tuple[int, int], float, float]
"""Column, lower end and upper end, metres."""


def nearest_span(spans: list[Span], edge_m: float, start: Floats, ray: Floats, range_max_m: float) -> tuple[float, int]:
    """Range at which a ray meets its first span, and the span's index; NaN and -1 for none."""
    best, index = np.inf, -1
    for n, ((x, y), bottom, top) in enumerate(spans):
        low, high = np.array([x * edge_m, y * edge_m, bottom]), np.array([(x + 1) * edge_m, (y + 1) * edge_m, top])
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(low - start) / ray, (high - start) / ray])
        enter, leave = max(float(ends.min(axis=0).max()), 0.0), min(float(ends.max(axis=0).min()), range_max_m)
        if enter <= leave and enter < best:
            best, index = enter, n
    return (best, index) if index >= 0 else (np.nan, -1)
