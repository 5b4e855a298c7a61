"""Box plots: numbers known by hand, where they are drawn, and that what is drawn is XML."""

import xml.etree.ElementTree as ET

import pytest

from cairn_sim.experiment.box_plot import BOTTOM, HEIGHT, TOP, box_plot, legend

SVG = "{http://www.w3.org/2000/svg}"
KNOWN = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 40.0]
"""Quartiles 3.25, 5.5, 7.75; fences -3.5 and 14.5: whiskers 1 and 9, one outlier."""


def drawn(svg: str) -> list[ET.Element]:
    """The boxes' groups."""
    return [one for one in ET.fromstring(svg).iter() if one.tag == "g"]


def value_at(y: float, top: float) -> float:
    """What stands at a height on a linear axis from 0 to `top`."""
    return (HEIGHT - BOTTOM - y) / (HEIGHT - TOP - BOTTOM) * top


def test_a_box_shows_median_quartiles_whiskers_and_outliers() -> None:
    (box,) = drawn(box_plot({"4 cm": {"known": KNOWN}}, unit="%"))
    (rect,) = box.findall("rect")
    top, height = float(rect.attrib["y"]), float(rect.attrib["height"])
    assert value_at(top, 40) == pytest.approx(7.75, abs=0.05)
    assert value_at(top + height, 40) == pytest.approx(3.25, abs=0.05)
    (median,) = (line for line in box.findall("line") if line.attrib["stroke-width"] == "2.2")
    assert value_at(float(median.attrib["y1"]), 40) == pytest.approx(5.5, abs=0.05)
    ends = [float(line.attrib["y1"]) for line in box.findall("line") if line.attrib["y1"] == line.attrib["y2"]]
    assert sorted(value_at(y, 40) for y in ends) == pytest.approx([1, 5.5, 9], abs=0.05)
    assert [value_at(float(c.attrib["cy"]), 40) for c in box.findall("circle")] == pytest.approx([40], abs=0.05)


def test_every_series_of_every_group_is_drawn_inside_the_picture() -> None:
    groups = {title: {"one": KNOWN, "two <&>": [0.5, 700.0]} for title in ("8 cm", "4 cm", "2 cm")}
    for logarithmic in (False, True):
        boxes = drawn(box_plot(groups, unit="ms & more", logarithmic=logarithmic))
        assert len(boxes) == 6
        heights = [
            float(v) for box in boxes for one in box for k, v in one.attrib.items() if k in ("y", "y1", "y2", "cy")
        ]
        assert min(heights) >= TOP - 0.1 and max(heights) <= HEIGHT - BOTTOM + 0.1


@pytest.mark.parametrize("values", [[0.0], [0.0, 0.0], [1e-7, 3e-7], [5.0], [99.9999, 100.0], [1e9]])
def test_any_values_have_an_axis(values: list[float]) -> None:
    svg = ET.fromstring(box_plot({"a": {"b": values}}, unit="%"))
    labels = [float(one.text or "x") for one in svg.findall("text")[:-2] if one.attrib.get("text-anchor") == "end"]
    assert labels[0] == 0 and labels[-1] >= max(values) and len(labels) >= 3


def test_a_logarithmic_axis_has_the_powers_of_ten_around_the_values() -> None:
    svg = ET.fromstring(box_plot({"a": {"b": [0.02, 3.0]}, "c": {"b": [45.0]}}, unit="ms", logarithmic=True))
    labels = [one.text for one in svg.findall("text") if one.attrib.get("text-anchor") == "end"]
    assert labels == ["0.01", "0.1", "1", "10", "100"]


def test_a_legend_names_what_is_compared() -> None:
    assert "a &lt; b" in legend(["a < b", "c"]) and legend(["a", "c"]).count("<i ") == 2
