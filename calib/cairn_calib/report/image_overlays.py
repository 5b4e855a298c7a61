"""Pictures over a camera's image, as SVG: residuals, coverage, heat maps of sigmas, offsets of a range camera's pixels.

They are SVG elements by hand and no charts of matplotlib: a picture's unit is the image's pixel, and there are no axes.
"""

from collections.abc import Sequence
from html import escape
from itertools import pairwise

import numpy as np

from cairn_calib.diagnosis.next_image import NextImage
from cairn_calib.diagnosis.view_statistics import Coverage
from cairn_map.arrays import Flags, Floats

WIDTH = 420
LOW_PX, HIGH_PX = 0.01, 10.0
"""Ends of the heat maps' logarithmic scale."""
HEAT = ((0.0, (68, 1, 84)), (0.25, (59, 82, 139)), (0.5, (33, 145, 140)), (0.75, (94, 201, 98)), (1.0, (253, 231, 37)))
"""Sure to unsure: five colours of viridis, sRGB."""
COLUMNS_MAX = 200
"""Columns of a pixel map at most; larger images are averaged in blocks."""
LEVELS = 21
"""Colours of a pixel map."""
COLD, NONE, WARM = (33, 86, 168), (247, 247, 247), (178, 24, 43)
"""Range too short, right, too long; sRGB."""
SURE, UNSURE = (38, 30, 80), (246, 222, 90)
UNSEEN = "#c9cdd3"
ARROW_SHARE = 0.04
"""Length of a residual of twice the noise as drawn, as a share of the image's width."""


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


def heat_legend() -> dict[str, str]:
    """The heat maps' scale: its ends in pixels, and its colours as the stops of a CSS gradient."""
    stops = ",".join(f"rgb({mixed(colour, colour, 0)})" for _, colour in HEAT)
    return {"low": f"{LOW_PX:g}", "high": f"{HIGH_PX:g}", "stops": stops}


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


def offset_map(offsets_mm: Floats, limit_mm: float) -> str:
    """(H, W) offsets, blue for too short and red for too long; grey where NaN."""
    shares = np.clip(0.5 + offsets_mm / (2 * limit_mm), 0, 1)
    colours = [
        mixed(COLD, NONE, 2 * share) if share < 0.5 else mixed(NONE, WARM, 2 * share - 1)
        for share in np.linspace(0, 1, LEVELS)
    ]
    return _map(shares, colours, "Offsets of the pixels")


def sigma_map_mm(sigmas_mm: Floats, low_mm: float, high_mm: float) -> str:
    """(H, W) standard deviations, dark to yellow."""
    shares = np.clip((sigmas_mm - low_mm) / max(high_mm - low_mm, 1e-9), 0, 1)
    colours = [mixed(SURE, UNSURE, share) for share in np.linspace(0, 1, LEVELS)]
    return _map(shares, colours, "Standard deviations of the pixels' offsets")


def _map(shares: Floats, colours: list[str], what: str) -> str:
    """(H, W) shares of 0 to 1: a path for each colour, of runs of pixels in a row."""
    step = -(-shares.shape[1] // COLUMNS_MAX)
    height, width = (side // step for side in shares.shape)
    blocks = shares[: height * step, : width * step].reshape(height, step, width, step)
    known = np.isfinite(blocks)
    counts = known.sum(axis=(1, 3))
    means = np.where(known, blocks, 0.0).sum(axis=(1, 3)) / np.maximum(counts, 1)
    levels = np.where(counts > 0, np.rint(means * (len(colours) - 1)), -1).astype(np.intp)
    runs: dict[int, list[str]] = {}
    for y, row in enumerate(levels):
        starts = np.flatnonzero(np.diff(row, prepend=-2))
        for x, length in zip(starts, np.diff(starts, append=width), strict=True):
            runs.setdefault(int(row[x]), []).append(f"M{x - 0.5:g} {y}h{length}")
    paths = (
        f'<path shape-rendering="crispEdges" style="stroke-width:1;stroke:{_stroke(colours, level)}" d="{"".join(d)}"/>'
        for level, d in sorted(runs.items())
    )
    return "".join([opened((width, height), what), *paths, "</svg>"])


def _stroke(colours: list[str], level: int) -> str:
    return UNSEEN if level < 0 else f"rgb({colours[level]})"
