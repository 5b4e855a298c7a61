"""Range of validity of a camera's calibration: where in its image and how far away boards were seen.

Between the corners a lens is interpolated, beyond them it is extrapolated: there the numbers hold only if the model
does, and no residual shows whether it does. The stated sigmas assume the model everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.diagnosis.probe_points import image_grid
from cairn_calib.diagnosis.view_statistics import ViewResiduals
from cairn_calib.diagnosis.world_uncertainty import sigma_map
from cairn_calib.report.image_overlays import opened
from cairn_calib.report.page import Figure
from cairn_map.arrays import Flags, Floats

COLUMNS = 24
RANGES_M = (1.0, 2.0, 5.0, 20.0)
"""Distances at which certainty is stated, next to those of the nearest and the farthest board."""
SEEN, EXTRAPOLATED = "#3b7d4f", "#c2570c"


@dataclass(frozen=True, slots=True)
class Validity:
    """Range of validity of one camera."""

    camera: str
    hull_px: Floats
    """(H, 2) corners of the convex part of the image between all corners that count, clockwise as seen."""
    image_share: float
    """Share of the image in it."""
    nearest_m: float
    """Distance of the nearest board's middle."""
    farthest_m: float
    """Distance of the farthest board's middle."""
    by_range: tuple[tuple[float, float, float], ...]
    """Distance, then the median sigma inside and, outside, the largest, pixels of one axis; NaN where there is none."""

    def is_seen(self, range_m: float) -> bool:
        """True if boards were at that distance."""
        return self.nearest_m <= range_m <= self.farthest_m

    def to_json(self) -> dict[str, object]:
        """The same as plain data."""
        return {
            "hull_px": np.round(self.hull_px, 2).tolist(),
            "image_share": self.image_share,
            "nearest_m": self.nearest_m,
            "farthest_m": self.farthest_m,
            "by_range": [
                {"range_m": far, "is_seen": self.is_seen(far), "inside_sigma_px": inside, "outside_sigma_px": outside}
                for far, inside, outside in self.by_range
            ],
        }


def validity(seen: Examination, camera: str, residuals: Sequence[ViewResiduals]) -> Validity:
    """Range of validity of a camera, by the residuals of its images."""
    kept = np.concatenate([each.pixels[each.kept] for each in residuals if each.camera == camera])
    hull = convex_hull(kept)
    width, height = seen.solution.views.sizes_px[camera]
    rows = max(1, round(COLUMNS * height / width))
    inside = is_inside(hull, image_grid(width, height, COLUMNS, rows)).reshape(rows, COLUMNS)
    by_range = []
    covered = next(each for each in seen.coverage if each.camera == camera)
    for far in sorted({*RANGES_M, covered.nearest_m, covered.farthest_m}):
        sigmas = sigma_map(seen.solution, seen.rig, camera, far, columns=COLUMNS)
        within, beyond = sigmas[inside & np.isfinite(sigmas)], sigmas[~inside & np.isfinite(sigmas)]
        by_range.append(
            (
                far,
                float(np.median(within)) if within.size else float("nan"),
                float(beyond.max()) if beyond.size else float("nan"),
            )
        )
    share = hull_area(hull) / (width * height)
    return Validity(camera, hull, share, covered.nearest_m, covered.farthest_m, tuple(by_range))


def validity_figure(size_px: tuple[int, int], known: Validity) -> Figure:
    """The image with the part in which corners were seen, and the rest, in which the lens is extrapolated."""
    width, height = size_px
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in known.hull_px)
    svg = (
        f'{opened(size_px, "Range of validity")}<rect x="-0.5" y="-0.5" width="{width}" height="{height}" '
        f'fill="{EXTRAPOLATED}" fill-opacity="0.25"/><polygon points="{path}" fill="#ffffff"/>'
        f'<polygon points="{path}" fill="{SEEN}" fill-opacity="0.3" stroke="{SEEN}" '
        f'stroke-width="{width / 250:.2f}"/></svg>'
    )
    return Figure(
        svg,
        f"Range of validity: green, {known.image_share:.0%} of the image, is between corners that were seen; outside "
        f"it the lens is extrapolated. Boards were {known.nearest_m:.2f} to {known.farthest_m:.2f} m away",
    )


def validity_rows(known: Validity) -> list[list[str]]:
    """Table rows: certainty by distance, inside and outside of what was seen."""
    rows = []
    for far, inside, outside in known.by_range:
        beyond = "nearer than any" if far < known.nearest_m else "farther than any"
        rows.append([f"{far:.3g} m", "seen" if known.is_seen(far) else beyond, _px(inside), _px(outside)])
    return rows


def convex_hull(points: Floats) -> Floats:
    """(H, 2) corners of the convex hull of (N, 2) points, in order (Andrew's monotone chain)."""
    ordered = np.unique(points, axis=0)
    if len(ordered) < 3:
        return ordered
    return np.array([*_chain(ordered)[:-1], *_chain(ordered[::-1])[:-1]])


def _chain(points: Floats) -> list[Floats]:
    kept: list[Floats] = []
    for point in points:
        # A corner that does not turn to the same side as all others is none.
        while len(kept) > 1 and _cross(kept[-1] - kept[-2], point - kept[-2]) <= 0:
            kept.pop()
        kept.append(point)
    return kept


def _cross(one: Floats, other: Floats) -> float:
    return float(one[0] * other[1] - one[1] * other[0])


def hull_area(hull: Floats) -> float:
    """Area of a convex hull, pixels squared (the shoelace formula)."""
    x, y = hull[:, 0], hull[:, 1]
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


def is_inside(hull: Floats, points: Floats) -> Flags:
    """(N,) True for each of (N, 2) points in a convex hull of `convex_hull`."""
    edges = np.roll(hull, -1, axis=0) - hull
    towards = points[:, None] - hull
    left = edges[:, 0] * towards[..., 1] - edges[:, 1] * towards[..., 0]
    inside: Flags = np.min(left, axis=1) >= 0
    return inside


def _px(sigma: float) -> str:
    return f"{sigma:.2g}" if np.isfinite(sigma) else ""
