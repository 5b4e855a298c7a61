"""Charts: numbers known by hand where they are drawn, sound XML, and a clear error without the libraries."""

import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cairn_calib.report.charts import bias_curve, box_plot, draw_boxes, scatter_plot, series_keys
from cairn_calib.report.page import page
from cairn_map.errors import BadInputError

SVG = "{http://www.w3.org/2000/svg}"
KNOWN = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 40.0]
"""Quartiles 3.25, 5.5, 7.75; fences -3.5 and 14.5: whiskers 1 and 9, one outlier."""


def texts(svg: str) -> list[str]:
    return ["".join(one.itertext()) for one in ET.fromstring(svg).iter(f"{SVG}text")]


@pytest.fixture
def axes() -> Iterator[Axes]:
    yield Figure().subplots()


def test_a_box_shows_median_quartiles_whiskers_and_outliers(axes: Axes) -> None:
    draw_boxes(axes, {"4 cm": {"known": KNOWN}}, logarithmic=False)
    (box,) = axes.patches
    heights = box.get_path().vertices[:, 1]
    assert (min(heights), max(heights)) == pytest.approx((3.25, 7.75))
    levels = [float(np.mean(line.get_ydata())) for line in axes.lines if len(set(line.get_ydata())) == 1]
    assert sorted(levels) == pytest.approx([1, 5.5, 9, 40])


def test_every_series_of_every_group_is_drawn_inside_the_picture(axes: Axes) -> None:
    groups = {title: {"one": KNOWN, "two <&>": [0.5, 700.0]} for title in ("8 cm", "4 cm", "2 cm")}
    draw_boxes(axes, groups, logarithmic=False)
    assert len(axes.patches) == 6
    low, high = axes.get_ylim()
    drawn = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
    assert low <= drawn.min() and drawn.max() <= high
    for logarithmic in (False, True):
        words = texts(box_plot(groups, unit="ms & more", logarithmic=logarithmic))
        assert {"8 cm", "4 cm", "2 cm", "ms & more"} <= set(words)


@pytest.mark.parametrize("values", [[0.0], [0.0, 0.0], [1e-7, 3e-7], [5.0], [99.9999, 100.0], [1e9]])
def test_any_values_have_an_axis(values: list[float], axes: Axes) -> None:
    draw_boxes(axes, {"a": {"b": values}}, logarithmic=False)
    low, high = axes.get_ylim()
    assert low == 0 and high >= max(values) and high > 0
    assert len(texts(box_plot({"a": {"b": values}}, unit="%"))) >= 3


def test_a_logarithmic_axis_holds_all_values(axes: Axes) -> None:
    draw_boxes(axes, {"a": {"b": [0.02, 3.0]}, "c": {"b": [45.0]}}, logarithmic=True)
    assert axes.get_yscale() == "log" and axes.get_ylim()[0] <= 0.02 and axes.get_ylim()[1] >= 45


def test_a_legend_names_each_series_with_a_colour_of_its_own() -> None:
    keys = series_keys(["a < b", "c"])
    assert [name for _, name in keys] == ["a < b", "c"] and len({colour for colour, _ in keys}) == 2


def test_a_scatter_plot_shows_every_point_and_its_words() -> None:
    svg = scatter_plot([1.0, 2.0, 3.0], [0.5, -0.5, 0.1], title="Fig. 9: left, x", x_label="r, px", y_label="d", band=1)
    assert {"Fig. 9: left, x", "r, px", "d"} <= set(texts(svg))
    assert sum(one.tag == f"{SVG}use" for one in ET.fromstring(svg).iter()) >= 3


def test_a_chart_without_points_is_still_a_chart() -> None:
    assert "d, px" in texts(scatter_plot([], [], title="t", x_label="x", y_label="d, px", band=0.5))


def test_the_same_values_give_the_same_bytes() -> None:
    line = np.linspace(0, 5, 30)
    once, again = (bias_curve(line, 3 * line, line, (1.0, 4.0)) for _ in range(2))
    assert once == again and "true range, m" in texts(once)


@pytest.mark.parametrize("library", ["matplotlib", "jinja2"])
def test_without_the_report_extra_the_error_names_it(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(BadInputError, match=r"cairn-robotics\[report\]") as caught:
        if library == "matplotlib":
            box_plot({"a": {"b": [1.0]}}, unit="%")
        else:
            page("page.html", package="cairn_map")
    assert caught.value.kind == "missing_extra"
