"""Scatter plots as SVG, as the paper's Figs 9 to 16: differences by where they were measured, a band about zero."""

import math
from collections.abc import Sequence
from html import escape

WIDTH, HEIGHT = 460, 250
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 26, 40
POINT, BAND = "#2563a8", "#e07b00"
TICKS = 6


def scatter_plot(x: Sequence[float], y: Sequence[float], *, title: str, x_label: str, y_label: str, band: float) -> str:
    """An SVG element.

    Args:
        x: from 0.
        y: as many; the axis is symmetric about 0.
        title: of the plot.
        x_label: with unit.
        y_label: with unit.
        band: orange lines at plus and minus this, in units of y.
    """
    x_top, x_step = _rounded(max(x, default=1.0))
    y_top, y_step = _rounded(max([abs(v) for v in y] + [1.15 * band]))

    def at(value_x: float, value_y: float) -> tuple[float, float]:
        px = LEFT + (WIDTH - LEFT - RIGHT) * value_x / x_top
        py = TOP + (HEIGHT - TOP - BOTTOM) * (0.5 - value_y / (2 * y_top))
        return px, py

    label = f"{title}: {y_label} against {x_label}"
    parts = [f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(label)}">']
    parts.append(f'<text class="title" x="{LEFT}" y="16">{escape(title)}</text>')
    for n in range(round(x_top / x_step) + 1):
        px, py = at(n * x_step, -y_top)
        parts.append(f'<text x="{px:.1f}" y="{py + 15:.1f}" text-anchor="middle">{n * x_step:g}</text>')
        parts.append(f'<line class="grid" x1="{px:.1f}" x2="{px:.1f}" y1="{TOP}" y2="{py:.1f}"/>')
    half = round(y_top / y_step)
    for n in range(-half, half + 1):
        px, py = at(0, n * y_step)
        parts.append(f'<text x="{px - 6:.1f}" y="{py + 4:.1f}" text-anchor="end">{n * y_step:g}</text>')
        kind = "axis" if n == 0 else "grid"
        parts.append(f'<line class="{kind}" x1="{px:.1f}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>')
    for edge in (band, -band):
        px, py = at(0, edge)
        parts.append(
            f'<line x1="{px:.1f}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}" stroke="{BAND}" stroke-width="1.6"/>'
        )
    for vx, vy in zip(x, y, strict=True):
        px, py = at(vx, vy)
        parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="2.4" fill="{POINT}" fill-opacity="0.65"/>')
    middle_x, middle_y = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{middle_x:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(
        f'<text transform="translate(13 {middle_y:.0f}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>'
    )
    return "".join([*parts, "</svg>"])


def _rounded(top: float) -> tuple[float, float]:
    """A round number at or above the largest, and the step of the axis up to it."""
    top = max(top, 1e-9)
    step = 10.0 ** math.floor(math.log10(top / TICKS))
    step = next(step * times for times in (1, 2, 5, 10, 20) if step * times * TICKS >= top)
    return math.ceil(top / step - 1e-9) * step, step
