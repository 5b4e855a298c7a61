"""Charts of reports as SVG, drawn by matplotlib: scatter plots, box plots, a curve with its band.

Pictures that lie over a camera's image (residuals, coverage, heat maps) are `image_overlays`'. Text stays text in the
SVG, so that it can be searched and copied; the same values give the same bytes.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from importlib.resources import as_file, files
from typing import TYPE_CHECKING

import numpy as np

from cairn_calib.report.page import HERE, missing_extra
from cairn_map.arrays import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_INCHES = (5.1, 2.9)
POINT, BAND = "#2563a8", "#e07b00"
SERIES_COLOURS = ("#2563a8", "#c2570c", "#3b7d4f", "#7a4fa3", "#8a6d1a", "#555f6b")
WHISKER = 1.5
"""Length of a whisker at most, as a multiple of the distance between the quartiles (Tukey's)."""


def scatter_plot(x: Sequence[float], y: Sequence[float], *, title: str, x_label: str, y_label: str, band: float) -> str:
    """SVG of differences by where they were measured, as the paper's Figs 9 to 16.

    Args:
        x: from 0.
        y: as many; the axis is symmetric about 0.
        title: of the plot.
        x_label: with unit.
        y_label: with unit.
        band: half width of the band about zero, two orange lines, in units of y.
    """
    with _axes() as (figure, axes):
        axes.axhline(0.0, color="#7b8794", linewidth=0.8)
        for edge in (band, -band):
            axes.axhline(edge, color=BAND, linewidth=1.2)
        axes.scatter(x, y, s=9, color=POINT, alpha=0.65, linewidths=0)
        top = 1.08 * max([abs(value) for value in y] + [1.15 * band])
        axes.set(xlim=(0, 1.03 * max([*x, 1e-9])), ylim=(-top, top), title=title, xlabel=x_label, ylabel=y_label)
        return _svg(figure, f"{title}: {y_label} against {x_label}")


Group = Mapping[str, Sequence[float]]
"""Values by series: what is compared, a colour each."""


def box_plot(groups: Mapping[str, Group], *, unit: str, logarithmic: bool = False) -> str:
    """SVG of box plots, as the paper's Figs 22 and 23: median, quartiles, whiskers, outliers as rings.

    Args:
        groups: series that stand side by side over one tick, by the tick's label; every series has at least one
            value, above 0 where the axis is logarithmic.
        unit: of all values; labels the axis.
        logarithmic: True for an axis of powers of ten.
    """
    with _axes() as (figure, axes):
        draw_boxes(axes, groups, logarithmic=logarithmic)
        axes.set_ylabel(unit)
        return _svg(figure, f"Box plot, {unit}")


def draw_boxes(axes: Axes, groups: Mapping[str, Group], *, logarithmic: bool) -> None:
    """Draw the boxes of `box_plot`: groups at 0, 1, 2, ... along x, each as wide as 0.8."""
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    step = 0.8 / max(1, len(names))
    if logarithmic:
        axes.set_yscale("log")
    for number, name in enumerate(names):
        colour = SERIES_COLOURS[number % len(SERIES_COLOURS)]
        held = [(at, group[name]) for at, group in enumerate(groups.values()) if name in group]
        axes.boxplot(
            [list(values) for _, values in held],
            positions=[at + (number - (len(names) - 1) / 2) * step for at, _ in held],
            widths=min(0.7 * step, 0.3),
            whis=WHISKER,
            patch_artist=True,
            manage_ticks=False,
            boxprops={"facecolor": f"{colour}2e", "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 1.8},
            whiskerprops={"color": colour},
            capprops={"color": colour},
            flierprops={"marker": "o", "markersize": 3, "markerfacecolor": "none", "markeredgecolor": colour},
        )
    axes.set_xticks(range(len(groups)), list(groups))
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.grid(visible=False, axis="x")
    if not logarithmic:
        highest = max(value for group in groups.values() for series in group.values() for value in series)
        axes.set_ylim(0.0, 1.05 * highest or 1.0)


def series_keys(names: Sequence[str]) -> list[tuple[str, str]]:
    """Colour and name of each series, for a legend next to the plots."""
    return [(SERIES_COLOURS[number % len(SERIES_COLOURS)], name) for number, name in enumerate(names)]


def bias_curve(range_m: Floats, added_mm: Floats, sigma_mm: Floats, seen_m: tuple[float, float]) -> str:
    """SVG of what a range camera adds to a range, with a band of one standard deviation; tinted where boards were."""
    with _axes() as (figure, axes):
        axes.axvspan(*seen_m, color="#eaf1f8")
        axes.fill_between(range_m, added_mm - sigma_mm, added_mm + sigma_mm, color="#9db8d6", alpha=0.6, linewidth=0)
        axes.plot(range_m, added_mm, color=POINT, linewidth=1.4)
        axes.set(xlim=(0.0, float(np.max(range_m))), xlabel="true range, m", ylabel="added, mm")
        return _svg(figure, "Bias by range")


@contextmanager
def _axes() -> Iterator[tuple[Figure, Axes]]:
    """One set of axes in the reports' style.

    Figures are made without pyplot: it keeps every figure in a state of the whole process.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ModuleNotFoundError as exc:
        raise missing_extra(exc) from exc
    with as_file(files(HERE) / "templates" / "charts.mplstyle") as style, rc_context(fname=style):
        figure = Figure(figsize=SIZE_INCHES)
        yield figure, figure.subplots()


def _svg(figure: Figure, label: str) -> str:
    """The figure as an SVG element to be put into a page."""
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = file.getvalue()
    # The XML declaration and the document type belong to a file of its own, not into HTML.
    _, _, element = text.partition("<svg ")
    return f'<svg role="img" aria-label="{escape(label)}" {element.strip()}'
