"""Pictures of a range bias as SVG: by range, and pixel by pixel."""

import numpy as np

from cairn_calib.report.solve_plots import mixed, opened
from cairn_calib.rig.range_bias import RangeBias
from cairn_map.arrays import Floats

COLUMNS_MAX = 200
"""Of a map; larger images are averaged in blocks."""
LEVELS = 21
COLD, NONE, WARM = (33, 86, 168), (247, 247, 247), (178, 24, 43)
"""Too short, nothing, too long; sRGB."""
SURE, UNSURE = (38, 30, 80), (246, 222, 90)
UNSEEN = "#c9cdd3"
WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 460, 230, 52, 36, 10
TICKS = 5


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


def bias_curve(bias: RangeBias, seen_m: tuple[float, float]) -> str:
    """What the middle of the image adds by range, millimetres, with a band of its standard deviation."""
    far_m = float(np.ceil(1.25 * seen_m[1]))
    d = np.linspace(0, far_m, 160)
    nothing = np.zeros_like(d)
    shapes = bias.terms.shapes(d, nothing, nothing)
    added = 1000 * shapes @ bias.values
    sigma = 1000 * np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", shapes, bias.covariance, shapes), 0))
    step = _step(float(np.ptp(np.concatenate([added - sigma, added + sigma, [0.0]]))))
    low = step * np.floor(min(0.0, float((added - sigma).min())) / step)
    high = step * np.ceil(max(0.0, float((added + sigma).max())) / step)

    def at(range_m: Floats | float, mm: Floats | float) -> Floats:
        x = LEFT + (WIDTH - LEFT - 8) * np.asarray(range_m) / far_m
        y = TOP + (HEIGHT - TOP - BOTTOM) * (high - np.asarray(mm)) / (high - low)
        return np.stack(np.broadcast_arrays(x, y), axis=-1)

    def line(points: Floats) -> str:
        return "L".join(f"{x:.1f} {y:.1f}" for x, y in points)

    (left, top), (right, bottom) = at(seen_m[0], high), at(seen_m[1], low)
    band = np.concatenate([at(d, added + sigma), at(d, added - sigma)[::-1]])
    parts = [
        f'<svg class="image" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Bias" style="--line:1.6px">',
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" fill="#eaf1f8"/>',
        f'<path style="fill:#9db8d6;opacity:.6" d="M{line(band)}Z"/>',
        f'<path class="miss" d="M{line(at(d, added))}"/>',
    ]
    style = 'font-size="11" font-family="system-ui, sans-serif" fill="#46505e"'
    for mm in np.arange(low, high + step / 2, step):
        (x, y), (end, _) = at(0.0, mm), at(far_m, mm)
        parts.append(f'<path style="stroke:#98a2b0;stroke-width:.5px" d="M{x:.1f} {y:.1f}H{end:.1f}"/>')
        parts.append(f'<text x="{x - 5:.1f}" y="{y + 4:.1f}" text-anchor="end" {style}>{mm:g}</text>')
    for metre in np.arange(0, far_m + 0.01, _step(far_m)):
        x, y = at(metre, low)
        parts.append(f'<text x="{x:.1f}" y="{y + 14:.1f}" text-anchor="middle" {style}>{metre:g}</text>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text x="{(LEFT + WIDTH) / 2:.0f}" y="{HEIGHT - 5}" text-anchor="middle" {style}>true range, m</text>'
    )
    parts.append(
        f'<text transform="translate(13 {middle:.0f}) rotate(-90)" text-anchor="middle" {style}>added, mm</text>'
    )
    return "".join([*parts, "</svg>"])


def _step(span: float) -> float:
    """A round step of an axis with about `TICKS` of them."""
    power = 10.0 ** np.floor(np.log10(max(span, 1e-6) / TICKS))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power * TICKS >= span))
