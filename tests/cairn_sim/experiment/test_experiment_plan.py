"""The map from above: where voxels are drawn, which of a column is seen, and what lies around the picture."""

import base64
import re
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from cairn_map.evidence.channels import STANDARD_CHANNELS
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key, split_voxels
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.experiment.plan import HEAT, NO_TEMPERATURE, STRAY, PlanView

GEOMETRY = Geometry(voxel_edge_um=500_000, depth=3)
"""A cell of 4 m has 8 voxels along its edge."""
RED, GREEN, BLUE = (200, 10, 10), (10, 200, 10), (10, 10, 200)
COLD_K, WARM_K, HOT_K = 290.0, 300.0, 310.0
Voxel = tuple[tuple[int, int, int], tuple[int, int, int], float | None]


def evidence_of(voxels: list[Voxel]) -> Evidence:
    """Occupied voxels by number, colour and temperature, all of one cell."""
    _, places = split_voxels(np.array([at for at, _, _ in voxels]), GEOMETRY)
    samples = np.zeros((len(voxels), GEOMETRY.plane_count), np.int64)
    for row, (_, rgb, kelvin) in enumerate(voxels):
        samples[row, GEOMETRY.planes_of("colour")] = [*rgb, 1]
        if kelvin is not None:
            steps = round(kelvin / STANDARD_CHANNELS[2].step)
            samples[row, GEOMETRY.planes_of("temperature")] = [steps, steps**2, 1]
    return packed_evidence(places, np.tile([1, 0], (len(voxels), 1)), samples, GEOMETRY)


def plan_of(cells: dict[tuple[int, int, int], list[Voxel]], *, ceiling_m: float = 2.0) -> PlanView:
    plan = PlanView(GEOMETRY, ceiling_m)
    for cell, voxels in cells.items():
        plan.add(cell_key(cell), evidence_of(voxels), SensorModel())
    return plan


def picture_of(svg: str) -> npt.NDArray[np.uint8]:
    """(H, W, 3) R, G, B of the picture inside."""
    found = re.search(r'href="data:image/png;base64,([^"]+)"', svg)
    assert found is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(found.group(1)), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image[..., ::-1], dtype=np.uint8)


def test_voxels_are_drawn_north_up_and_the_highest_below_the_ceiling_is_seen() -> None:
    plan = plan_of(
        {
            (0, 0, 0): [((1, 2, 0), RED, None), ((1, 2, 3), GREEN, None), ((1, 2, 4), BLUE, None)],
            (0, 0, -1): [((1, 2, -1), BLUE, None), ((6, 7, -8), BLUE, None)],
        }
    )
    image = picture_of(plan.svg("colour", []))
    assert image.shape == (8, 8, 3)
    assert tuple(image[7 - 2, 1]) == GREEN and tuple(image[7 - 7, 6]) == BLUE
    assert (image == 255).all(axis=-1).sum() == 62


def test_the_order_of_cells_does_not_matter() -> None:
    cells: dict[tuple[int, int, int], list[Voxel]] = {
        (0, 0, 0): [((1, 2, 0), RED, HOT_K)],
        (0, 0, -1): [((1, 2, -1), BLUE, COLD_K), ((0, 0, -1), BLUE, WARM_K)],
    }
    one, other = plan_of(cells), plan_of(dict(reversed(cells.items())))
    for which in ("colour", "temperature"):
        assert one.svg(which, []) == other.svg(which, [])


def test_the_hottest_of_a_column_is_painted_and_what_no_camera_saw_is_grey() -> None:
    plan = plan_of(
        {
            (0, 0, 0): [
                ((0, 0, 0), RED, HOT_K),
                ((0, 0, 2), RED, COLD_K),
                ((3, 0, 1), RED, COLD_K),
                ((5, 5, 1), RED, None),
            ]
        }
    )
    image = picture_of(plan.svg("temperature", []))
    assert tuple(image[7, 0]) == tuple(HEAT[-1]) and tuple(image[7, 3]) == tuple(HEAT[0])
    assert tuple(image[7 - 5, 5]) == NO_TEMPERATURE
    assert plan.temperature_range_k() == pytest.approx((COLD_K + 0.2, HOT_K - 0.1), abs=0.06)


def test_stops_and_cells_are_drawn_where_the_map_has_them() -> None:
    plan = plan_of({(-1, 2, 0): [((-8, 16, 0), RED, None)], (0, 2, 0): [((0, 16, 0), RED, None)]})
    T = np.eye(4)
    T[:3, 3] = -3.0, 9.0, 1.0
    svg = ET.fromstring(plan.svg("colour", [("mole", [T])]))
    assert svg.attrib["viewBox"] == "-0.1 -0.1 8.2 4.2"
    (group,) = svg.findall("g")
    numbers = [float(v) for v in re.findall(r"-?[\d.]+", group.attrib["transform"])]
    a, b, c, d, e, f = numbers

    def on_page(x: float, y: float) -> tuple[float, float]:
        return a * x + c * y + e, b * x + d * y + f

    (circle,) = group.findall("circle")
    assert on_page(float(circle.attrib["cx"]), float(circle.attrib["cy"])) == pytest.approx((1.0, 3.0))
    corners = {on_page(float(r.attrib["x"]), float(r.attrib["y"])) for r in group.findall("rect")}
    assert corners == {(0.0, 4.0), (4.0, 4.0)}


def test_a_few_stray_voxels_far_away_do_not_make_the_building_small() -> None:
    floor: list[Voxel] = [((x, y, 0), RED, None) for x in range(8) for y in range(8)]
    assert len(floor) > STRAY
    far: list[Voxel] = [((8 * 50, 0, 0), BLUE, None)]
    assert picture_of(plan_of({(0, 0, 0): floor, (50, 0, 0): far}).svg("colour", [])).shape == (8, 8, 3)


def test_an_empty_plan_can_be_drawn() -> None:
    assert picture_of(PlanView(GEOMETRY, 1.0).svg("temperature", [])).shape == (8, 8, 3)
