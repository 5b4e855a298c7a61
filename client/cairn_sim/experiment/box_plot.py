"""Box plots as SVG, as the paper's Figs 22 and 23: median, quartiles, whiskers to 1.5 times their distance, outliers.

group   what stands side by side over one tick: a resolution
series  what is compared in every group, one colour each: a coding, or occupied and known
"""

import math
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

WIDTH, HEIGHT = 460, 300
LEFT, RIGHT, TOP, BOTTOM = 62, 10, 12, 34
WHISKER = 1.5
"""Times the distance of the quartiles, as Tukey drew it."""
SERIES_COLOURS = ("#2563a8", "#c2570c", "#3b7d4f", "#7a4fa3", "#8a6d1a", "#555f6b")
TICKS = 5

Group = Mapping[str, Sequence[float]]
"""Values by series."""


def box_plot(groups: Mapping[str, Group], *, unit: str, logarithmic: bool = False) -> str:
    """An SVG element.

    Args:
        groups: by their labels; every series at least one value, above 0 where the axis is logarithmic.
        unit: of all values; labels the axis.
        logarithmic: whether the axis has powers of ten.
    """
    values = [value for group in groups.values() for series in group.values() for value in series]
    low, high, ticks = _log_axis(values) if logarithmic else _axis(values)

    def y(value: float) -> float:
        share = (math.log10(value) if logarithmic else value) - low
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share / (high - low)

    parts = [f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Box plot, {escape(unit)}">']
    for tick in ticks:
        at = y(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text transform="translate(14 {middle:.0f}) rotate(-90)" text-anchor="middle">{escape(unit)}</text>')
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    room = (WIDTH - LEFT - RIGHT) / max(1, len(groups))
    for n, (label, group) in enumerate(groups.items()):
        centre = LEFT + room * (n + 0.5)
        parts.append(f'<text x="{centre:.1f}" y="{HEIGHT - 12}" text-anchor="middle">{escape(label)}</text>')
        step = room * 0.8 / max(1, len(names))
        for name, series in group.items():
            number = names.index(name)
            x = centre + (number - (len(names) - 1) / 2) * step
            box = {key: y(value) for key, value in _box(series).items()}
            outliers = [y(value) for value in _outliers(series)]
            colour = SERIES_COLOURS[number % len(SERIES_COLOURS)]
            parts += _drawn(x, min(step * 0.7, 34), box, outliers, colour, f"{label}, {name}")
    return "".join([*parts, "</svg>"])


def legend(names: Sequence[str]) -> str:
    """What the colours mean, as HTML."""
    colours = [SERIES_COLOURS[n % len(SERIES_COLOURS)] for n in range(len(names))]
    keys = (
        f'<span class="key"><i style="background:{colour}"></i>{escape(name)}</span>'
        for name, colour in zip(names, colours, strict=True)
    )
    return f'<p class="legend">{"".join(keys)}</p>'


def _box(values: Sequence[float]) -> dict[str, float]:
    lower, middle, upper = (float(v) for v in np.percentile(values, [25, 50, 75]))
    inside = [v for v in values if lower - WHISKER * (upper - lower) <= v <= upper + WHISKER * (upper - lower)]
    return {"least": min(inside), "lower": lower, "middle": middle, "upper": upper, "most": max(inside)}


def _outliers(values: Sequence[float]) -> list[float]:
    box = _box(values)
    return [value for value in values if not box["least"] <= value <= box["most"]]


def _drawn(
    x: float, width: float, at: Mapping[str, float], outliers: Sequence[float], colour: str, label: str
) -> list[str]:
    left, right = x - width / 2, x + width / 2

    def line(x1: float, x2: float, y1: float, y2: float, stroke: float) -> str:
        return (
            f'<line x1="{x1:.1f}" x2="{x2:.1f}" y1="{y1:.1f}" y2="{y2:.1f}" stroke="{colour}" stroke-width="{stroke}"/>'
        )

    return [
        f"<g><title>{escape(label)}</title>",
        line(x, x, at["most"], at["upper"], 1.2),
        line(x, x, at["lower"], at["least"], 1.2),
        *(line(x - width / 4, x + width / 4, at[end], at[end], 1.2) for end in ("least", "most")),
        f'<rect x="{left:.1f}" y="{at["upper"]:.1f}" width="{width:.1f}" '
        f'height="{max(0.5, at["lower"] - at["upper"]):.1f}" fill="{colour}" fill-opacity="0.18" stroke="{colour}"/>',
        line(left, right, at["middle"], at["middle"], 2.2),
        *(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" fill="none" stroke="{colour}"/>' for y in outliers),
        "</g>",
    ]


def _axis(values: Sequence[float]) -> tuple[float, float, list[float]]:
    """From 0 to a round number above the largest, and round numbers between."""
    top = max(values) or 1.0
    step = 10.0 ** math.floor(math.log10(top / TICKS))
    step = next(step * times for times in (1, 2, 5, 10) if step * times * TICKS >= top)
    count = math.ceil(top / step)
    return 0.0, count * step, [round(n * step, 12) for n in range(count + 1)]


def _log_axis(values: Sequence[float]) -> tuple[float, float, list[float]]:
    """From a power of ten to a power of ten."""
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    high = max(high, low + 1)
    return float(low), float(high), [10.0**n for n in range(low, high + 1)]
