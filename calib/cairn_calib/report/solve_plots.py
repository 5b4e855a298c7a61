"""Pictures of a calibration as SVG: residuals over the image, what the boards covered, heat maps of sigmas."""

from collections.abc import Sequence
from html import escape
from itertools import pairwise

import numpy as np

from cairn_calib.diagnosis.next_image import NextImage
from cairn_calib.diagnosis.view_coverage import Coverage
from cairn_map.arrays import Flags, Floats

WIDTH = 420
LOW_PX, HIGH_PX = 0.01, 10.0
"""Ends of the heat maps' logarithmic scale."""
HEAT = ((0.0, (68, 1, 84)), (0.25, (59, 82, 139)), (0.5, (33, 145, 140)), (0.75, (94, 201, 98)), (1.0, (253, 231, 37)))
"""Sure to unsure: five colours of viridis, sRGB."""
ARROW_SHARE = 0.04
"""Of the image's width: how long a residual of twice the noise is drawn."""


def quiver(size_px: tuple[int, int], corners: Floats, misses: Floats, kept: Flags, sigma_px: float) -> str:
    """Arrows from (M, 2) corners along (M, 2) misses, pixels; those that were left out in red.

    Residuals of a good fit point anywhere; neighbours that point the same way show a lens that the model cannot say.
    """
    factor = ARROW_SHARE * size_px[0] / max(2 * sigma_px, 1e-9)
    parts = [opened(size_px, f"Residuals, {factor:.0f} times enlarged")]
    for flags, kind in ((kept, "miss"), (~kept, "out")):
        ends = corners[flags] + np.clip(factor * misses[flags], -0.3 * size_px[0], 0.3 * size_px[0])
        lines = "".join(
            f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for (x, y), (u, v) in zip(corners[flags], ends, strict=True)
        )
        parts.append(f'<path class="{kind}" d="{lines}"/>' if lines else "")
    return "".join([*parts, "</svg>"])


def coverage_picture(size_px: tuple[int, int], seen: Coverage, corners: Floats, wanted: Sequence[NextImage]) -> str:
    """Parts of the image by their number of corners, the corners, and where the board should be next."""
    rows, columns = seen.counts.shape
    step_x, step_y = size_px[0] / columns, size_px[1] / rows
    most = max(int(seen.counts.max()), 1)
    parts = [opened(size_px, "Coverage")]
    for row, column in np.ndindex(rows, columns):
        count = int(seen.counts[row, column])
        shade = "#fbe3df" if count == 0 else f"rgb({mixed((226, 236, 246), (70, 125, 180), count / most)})"
        parts.append(
            f'<rect x="{column * step_x - 0.5:.1f}" y="{row * step_y - 0.5:.1f}" width="{step_x:.1f}" '
            f'height="{step_y:.1f}" fill="{shade}"><title>{count} corners</title></rect>'
        )
    # A stroke of no length with round ends is a dot.
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in corners)
    parts.append(f'<path class="dots" d="{dots}"/>')
    scale = size_px[0] / WIDTH
    for number, place in enumerate(wanted, 1):
        if place.camera == seen.camera:
            x, y = place.pixel
            parts.append(
                f'<circle class="next" cx="{x:.1f}" cy="{y:.1f}" r="{13 * scale:.1f}"/><text class="next" x="{x:.1f}" '
                f'y="{y + 5 * scale:.1f}" font-size="{15 * scale:.1f}">{number}</text>'
            )
    return "".join([*parts, "</svg>"])


def heat_map(size_px: tuple[int, int], sigmas_px: Floats, what: str) -> str:
    """A (rows, columns) map of standard deviations over an image; grey where there is none (NaN)."""
    rows, columns = sigmas_px.shape
    step_x, step_y = size_px[0] / columns, size_px[1] / rows
    parts = [opened(size_px, what)]
    for row, column in np.ndindex(rows, columns):
        sigma = float(sigmas_px[row, column])
        parts.append(
            f'<rect x="{column * step_x - 0.5:.1f}" y="{row * step_y - 0.5:.1f}" width="{step_x * 1.02:.1f}" '
            f'height="{step_y * 1.02:.1f}" fill="{heat(sigma)}"/>'
        )
    return "".join([*parts, "</svg>"])


def heat(sigma_px: float) -> str:
    """The colour of a standard deviation."""
    if not np.isfinite(sigma_px):
        return "#d9dce1"
    share = float(np.clip(np.log(max(sigma_px, 1e-9) / LOW_PX) / np.log(HIGH_PX / LOW_PX), 0, 1))
    for (low, cold), (high, warm) in pairwise(HEAT):
        if share <= high:
            return f"rgb({mixed(cold, warm, (share - low) / (high - low))})"
    return "#fde725"


def heat_legend() -> str:
    """The heat maps' scale, as HTML."""
    stops = ",".join(f"rgb({mixed(colour, colour, 0)})" for _, colour in HEAT)
    return (
        f'<p class="legend">{LOW_PX:g} px <i class="ramp" style="background:linear-gradient(90deg,{stops})"></i> '
        f"{HIGH_PX:g} px, logarithmic; sigma of one axis, in the camera's own pixels; grey: not seen</p>"
    )


def opened(size_px: tuple[int, int], what: str) -> str:
    """The head of an SVG over an image of that size."""
    width, height = size_px
    return (
        f'<svg class="image" viewBox="-0.5 -0.5 {width} {height}" role="img" aria-label="{escape(what)}" '
        f'style="--line:{width / WIDTH:.3f}px">'
    )


def mixed(one: tuple[int, int, int], other: tuple[int, int, int], share: float) -> str:
    """A colour between two, as `r,g,b`."""
    return ",".join(str(round(a + (b - a) * share)) for a, b in zip(one, other, strict=True))
