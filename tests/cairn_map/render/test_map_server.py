"""Files for map servers, loaded back by a reader written from Nav2's."""

from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.map.nav2_reader import load_map

from cairn_map.errors import BadInputError
from cairn_map.queries.floor_grid import FREE, OCCUPIED, UNKNOWN, FloorGrid
from cairn_map.render.map_server import map_files, pgm_of, write_map_files


@pytest.mark.parametrize("edge_m", [0.04, 0.05, 0.16])
@pytest.mark.parametrize("name", ["floor1", "the 2nd: floor #1", "no"])
def test_nav2_loads_the_very_grid_that_was_written(tmp_path: Path, edge_m: float, name: str) -> None:
    values = np.random.default_rng(1).choice(np.array([FREE, OCCUPIED, UNKNOWN], np.int8), (7, 11))
    grid = FloorGrid(values, (-5.12, 10 * edge_m), edge_m, 0.0)
    write_map_files(tmp_path / name, grid)
    loaded = load_map(tmp_path / f"{name}.yaml")
    np.testing.assert_array_equal(loaded.data, values)
    assert loaded.resolution_m == edge_m
    assert loaded.origin == (-5.12, 10 * edge_m, 0.0)


def test_the_first_byte_is_the_upper_left_pixel_and_bytes_are_those_of_ros() -> None:
    values = np.array([[FREE, OCCUPIED], [UNKNOWN, FREE]], np.int8)
    assert pgm_of(FloorGrid(values, (0.0, 0.0), 0.05, 0.0)) == b"P5\n2 2\n255\n" + bytes([205, 254, 254, 0])


@pytest.mark.parametrize("name", ["", ".", "..", "/", "floors/.."])
def test_a_folder_is_no_name_of_a_map(name: str) -> None:
    with pytest.raises(BadInputError, match="need a name"):
        map_files(Path(name))
