"""Metres to voxels to cells and back."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.naive import evidence as naive_evidence

from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR, INTENSITY, STANDARD_CHANNELS, TEMPERATURE, Channel, ChannelKind
from cairn_map.evidence.grid import (
    CELL_LIMIT,
    Cell,
    Geometry,
    cell_from_text,
    cell_key,
    cell_of_key,
    centres_of_voxels,
    geometry_for,
    split_voxels,
    voxels_in_cell,
    voxels_of_points,
)

FIVE_CM = Geometry(voxel_edge_um=50_000, depth=4)
INDEX = st.integers(-CELL_LIMIT, CELL_LIMIT - 1)
CELLS = st.tuples(INDEX, INDEX, INDEX)


def voxel_along_x(x_m: float, geometry: Geometry = FIVE_CM) -> int:
    return int(voxels_of_points(np.array([[x_m, 0.0, 0.0]]), geometry)[0, 0])


@pytest.mark.parametrize(
    ("x_m", "voxel"), [(0.15, 3), (0.1499999, 2), (0.0, 0), (-0.0, 0), (-0.05, -1), (-0.15, -3), (-0.1500001, -4)]
)
def test_a_point_on_a_border_belongs_to_the_upper_voxel(x_m: float, voxel: int) -> None:
    assert voxel_along_x(x_m) == voxel


@given(st.integers(-(10**6), 10**6), st.sampled_from([1000, 20_000, 40_000, 50_000, 80_000, 333_333]))
def test_every_border_written_in_metres_is_found(voxel: int, edge_um: int) -> None:
    geometry = Geometry(voxel_edge_um=edge_um, depth=8)
    assert voxel_along_x(voxel * edge_um / 1e6, geometry) == voxel


@given(st.floats(-5e4, 5e4))
def test_voxels_are_floors_of_whole_nanometres(x_m: float) -> None:
    assert voxel_along_x(x_m) == round(x_m * 1e9) // 50_000_000
    assert abs(Fraction(x_m) - Fraction(voxel_along_x(x_m), 20)) < Fraction(6, 100)


@pytest.mark.parametrize("x_m", [float("nan"), float("inf"), -float("inf"), 1e30, 0.8 * CELL_LIMIT, -0.8 * CELL_LIMIT])
def test_points_outside_the_numbered_space_are_refused(x_m: float) -> None:
    with pytest.raises(BadInputError, match="points must be finite"):
        voxel_along_x(x_m)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_furthest_points_still_have_a_cell(side: int) -> None:
    point = np.full((1, 3), side * 0.799999 * (CELL_LIMIT - 1))
    cells, _ = split_voxels(voxels_of_points(point, FIVE_CM), FIVE_CM)
    assert all(-CELL_LIMIT <= v < CELL_LIMIT for v in cell_of_key(int(cells[0])))


@given(st.lists(st.tuples(*[st.integers(-(10**7), 10**7)] * 3), min_size=1, max_size=30))
def test_joining_undoes_splitting(voxels: list[tuple[int, int, int]]) -> None:
    array = np.array(voxels, np.int64)
    cells, places = split_voxels(array, FIVE_CM)
    joined = [voxels_in_cell(places[n : n + 1], int(cells[n]), FIVE_CM)[0].tolist() for n in range(len(array))]
    assert joined == array.tolist()


@given(st.tuples(*[st.integers(-(10**7), 10**7)] * 3))
def test_splitting_is_what_its_twin_says(voxel: tuple[int, int, int]) -> None:
    cells, places = split_voxels(np.array([voxel]), FIVE_CM)
    i, j, k = (v // 16 for v in voxel)
    assert (int(cells[0]), int(places[0])) == (
        naive_evidence.cell_number((i, j, k)),
        naive_evidence.interleave(*(v % 16 for v in voxel)),
    )


@given(CELLS)
def test_a_cell_comes_back_from_its_number_and_from_its_text(cell: tuple[int, int, int]) -> None:
    key = cell_key(cell)
    assert 0 <= key < 1 << 63
    assert cell_of_key(key) == cell
    assert cell_from_text(str(Cell(*cell))) == cell


def test_cells_beyond_the_numbered_space_are_refused() -> None:
    with pytest.raises(BadInputError, match="cell indices"):
        cell_key((CELL_LIMIT, 0, 0))
    with pytest.raises(BadInputError, match="cell indices"):
        cell_from_text(f"0,0,{-CELL_LIMIT - 1}")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1,2",
        "1,2,3,4",
        " 1,2,3",
        "1,2,3\n",
        "+1,2,3",
        "01,2,3",
        "-0,0,0",
        "1_0,2,3",
        "٣,2,3",
        "a,b,c",
        "9" * 5000 + ",0,0",
    ],
)
def test_a_cell_has_one_text_only(text: str) -> None:
    with pytest.raises(BadInputError):
        cell_from_text(text)


@given(st.tuples(*[st.integers(-(10**6), 10**6)] * 3))
def test_a_centre_lies_in_its_voxel(voxel: tuple[int, int, int]) -> None:
    centres = centres_of_voxels(np.array([voxel]), FIVE_CM)
    assert voxels_of_points(centres, FIVE_CM).tolist() == [list(voxel)]


@pytest.mark.parametrize(("edge_m", "depth"), [(0.08, 6), (0.04, 7), (0.02, 7), (0.01, 7), (1.0, 3), (0.05, 6)])
def test_the_papers_cells_are_5_12_m_and_none_has_more_than_128_voxels_along_an_edge(edge_m: float, depth: int) -> None:
    assert geometry_for(voxel_edge_m=edge_m).depth == depth


@given(st.integers(1000, 1_000_000))
def test_a_geometry_without_a_depth_has_the_cells_of_its_voxels(edge_um: int) -> None:
    alike = geometry_for(voxel_edge_m=edge_um / 1e6)
    assert Geometry(voxel_edge_um=edge_um) == alike
    assert Geometry.model_validate_json(f'{{"voxel_edge_um": {edge_um}}}') == alike
    assert Geometry.model_validate_json(alike.model_dump_json()) == alike
    assert Geometry(voxel_edge_um=edge_um, depth=8).depth == 8


def test_cells_with_more_samples_than_the_standard_channels_have_are_smaller() -> None:
    dose = Channel(kind=ChannelKind.SCALAR, name="dose", unit="uSv/h", step=0.01)
    assert geometry_for(voxel_edge_m=0.04, channels=(*STANDARD_CHANNELS, dose)).depth == 6
    assert geometry_for(voxel_edge_m=0.04, channels=(dose, COLOUR, TEMPERATURE)).depth == 7


@pytest.mark.parametrize("edge_m", [0.0, -1.0, 1.1, 0.0001])
def test_voxels_of_other_sizes_are_refused(edge_m: float) -> None:
    with pytest.raises(BadInputError):
        geometry_for(voxel_edge_m=edge_m)


def test_channels_must_have_different_names() -> None:
    with pytest.raises(ValueError, match="differ"):
        Geometry(channels=(COLOUR, COLOUR))
    with pytest.raises(ValueError, match="differ"):
        Geometry(channels=(Channel(kind=ChannelKind.SCALAR, name="occupancy"),))


def test_the_order_of_channels_is_part_of_the_digest() -> None:
    assert Geometry(channels=(COLOUR, INTENSITY)).digest() != Geometry(channels=(INTENSITY, COLOUR)).digest()


def test_equal_geometries_have_equal_digests_although_one_says_minus_zero() -> None:
    made = [Geometry(channels=(Channel(kind=ChannelKind.SCALAR, name="dose", zero=z),)) for z in (0.0, -0.0)]
    assert made[0] == made[1]
    assert made[0].digest() == made[1].digest()


def test_planes_of_a_channel_that_is_not_there_are_an_error() -> None:
    with pytest.raises(BadInputError, match="no channel 'dose'"):
        FIVE_CM.planes_of("dose")


def test_a_changed_copy_of_a_geometry_has_a_digest_of_its_own() -> None:
    one = Geometry()
    other = one.model_copy(update={"depth": 5}) if one.digest() else one
    assert other.digest() == Geometry(depth=5).digest() != one.digest()
    assert other.plane_count == one.plane_count
