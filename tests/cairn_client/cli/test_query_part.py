"""Questions to a server's map download the cells that they need, and have the answers of the whole map."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest
from tests.fixtures.client.served_map import served_map
from tests.fixtures.map.made import SMALL, random_evidence

from cairn_client.folders.map_folder import open_map, open_part
from cairn_client.folders.needed_cells import along_ray, near_points
from cairn_map.evidence.grid import cell_key

CELLS = [cell_key(cell) for cell in product((-2, -1, 0, 1), (-1, 0, 1), (-1, 0))]
REACH_M = 2.5 * SMALL.cell_edge_m
QUESTIONS = 20


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    cells = {key: random_evidence(n, SMALL, voxels=250) for n, key in enumerate(CELLS)}
    with served_map(tmp_path_factory.mktemp("server"), cells, SMALL, scans=8) as url:
        yield url


def test_points_rays_and_nearest_voxels_have_the_answers_of_the_whole_map(url: str) -> None:
    whole, chance = open_map(url), np.random.default_rng(29)
    assert len(whole.frozen.keys) == len(CELLS)
    hits = 0
    for n in range(QUESTIONS):
        points = chance.uniform(-REACH_M, REACH_M, (2, 3))
        # On borders of cells and voxels, too, and along axes.
        points[0] = np.round(points[0] / SMALL.cell_edge_m) * SMALL.cell_edge_m if n % 3 == 0 else points[0]
        way = np.eye(3)[n % 3] if n % 4 == 0 else chance.normal(size=3)
        range_m = math.inf if n % 2 else REACH_M / 2
        part = open_part(url, near_points(points.tolist()))
        np.testing.assert_array_equal(part.probability_at(points), whole.probability_at(points))
        np.testing.assert_array_equal(part.counts_at(points), whole.counts_at(points))
        part = open_part(url, near_points(points.tolist(), radius_m=0.1))
        for ask in ("nearest_occupied", "nearest_unknown"):
            some, all_ = (getattr(each, ask)(points, radius_m=0.1) for each in (part, whole))
            np.testing.assert_array_equal(some.distance_m, all_.distance_m)
        part = open_part(url, along_ray(points[0].tolist(), way.tolist(), range_m=range_m))
        some, all_ = (each.cast_rays(points[:1], [way], max_range_m=range_m) for each in (part, whole))
        np.testing.assert_array_equal(some.hit, all_.hit)
        np.testing.assert_array_equal(some.distance_m, all_.distance_m)
        hits += int(all_.hit[0])
    assert 3 < hits < QUESTIONS


def test_only_the_cells_that_are_needed_are_downloaded(url: str) -> None:
    middle = [0.5 * SMALL.cell_edge_m] * 3
    assert open_part(url, near_points([middle])).frozen.keys == (cell_key((0, 0, 0)),)
    assert len(open_part(url, near_points([middle], radius_m=0.5 * SMALL.cell_edge_m)).frozen.keys) == 6
    along_x = open_part(url, along_ray(middle, [-1.0, 0.0, 0.0], range_m=math.inf))
    assert set(along_x.frozen.keys) == {cell_key((i, 0, 0)) for i in (-2, -1, 0)}
    assert open_part(url, near_points([[9.0, 9.0, 9.0]])).frozen.keys == ()
