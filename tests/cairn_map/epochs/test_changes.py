"""What changed: a door that went, a crate that came, and noise, which is no change."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.changing import CRATE, GEOMETRY, MODEL, WALL, Cells, Numbers, scans

from cairn_map.epochs.cell_history import merged
from cairn_map.epochs.changes import MapChanges, likelihood_ratio, map_changes
from cairn_map.epochs.epoch import Epoch


def together(*parts: Cells) -> Cells:
    """The sum of all parts."""
    keys = {key for part in parts for key in part}
    return {key: merged([part[key] for part in parts if key in part], GEOMETRY) for key in sorted(keys)}


def changes(*parts: Cells, since: int = 5) -> MapChanges:
    return map_changes(together(*parts), GEOMETRY, MODEL, since=Epoch(since))


def as_set(voxels: Numbers) -> set[tuple[int, ...]]:
    return {tuple(voxel) for voxel in voxels.tolist()}


def test_a_crate_that_came_has_appeared_and_one_that_went_is_gone() -> None:
    free, full = {"misses": 30}, {"hits": 12}
    came = changes(scans(CRATE, 1, **free), scans(CRATE, 9, **full))
    went = changes(scans(CRATE, 1, **full), scans(CRATE, 9, **free))
    assert as_set(came.appeared) == as_set(went.gone) == as_set(CRATE)
    assert not len(came.gone) and not len(came.moved) and not len(went.appeared)


def test_the_same_scene_seen_again_has_not_changed() -> None:
    found = changes(scans(WALL, 1, hits=8, misses=2), scans(WALL, 9, hits=6, misses=3))
    assert not any(len(getattr(found, name)) for name in ("appeared", "gone", "moved", "warmer", "colder"))


def test_noise_that_changes_readings_is_no_change() -> None:
    # Voxels at a grazed wall, each hit in half of the scans: half of the readings differ.
    rng = np.random.default_rng(1)
    parts = []
    for epoch in (1, 9):
        for hits in range(7):
            mine = WALL[rng.binomial(6, 0.33, len(WALL)) == hits]
            parts += [scans(mine, epoch, hits=hits, misses=6 - hits)] if len(mine) else []
    found = changes(*parts)
    assert len(found.appeared) + len(found.gone) + len(found.moved) < 5


def test_a_voxel_alone_or_seen_too_seldom_is_no_change() -> None:
    alone = CRATE[:1]
    assert not len(changes(scans(alone, 1, misses=30), scans(alone, 9, hits=12)).appeared)
    assert not len(changes(scans(CRATE, 1, misses=30), scans(CRATE, 9, hits=3)).appeared)


def test_a_wall_that_is_a_voxel_off_has_moved() -> None:
    shifted = WALL + np.array([0, 1, 0])
    found = changes(
        scans(WALL, 1, hits=12), scans(shifted, 1, misses=12), scans(shifted, 9, hits=12), scans(WALL, 9, misses=12)
    )
    assert as_set(found.moved) == as_set(WALL) | as_set(shifted)
    assert not len(found.appeared) and not len(found.gone)


def test_what_changed_long_after_was_first_seen_as_before() -> None:
    as_ever = [scans(CRATE, epoch, hits=8) for epoch in (1, 6, 7, 8)]
    found = changes(*as_ever, scans(CRATE, 9, misses=12))
    assert as_set(found.gone) == as_set(CRATE)


def test_what_stood_for_a_while_where_it_was_free_before_is_gone() -> None:
    visit = [scans(CRATE, 1, misses=30), *(scans(CRATE, epoch, hits=3) for epoch in (4, 6, 7, 8))]
    found = changes(*visit, scans(CRATE, 9, misses=15))
    assert as_set(found.gone) == as_set(CRATE)
    assert not len(changes(*visit, since=8).gone)


def test_a_crate_on_the_floor_has_appeared_down_to_the_floor() -> None:
    floor = np.array([[x, y, 3] for x in range(12) for y in range(4, 12)])
    ground = [scans(floor, epoch, hits=12) for epoch in (1, 9)]
    found = changes(*ground, scans(CRATE, 1, misses=30), scans(CRATE, 9, hits=12))
    assert as_set(found.appeared) == as_set(CRATE)
    assert not len(found.moved)


def test_changes_end_at_until() -> None:
    cells = together(scans(CRATE, 1, misses=30), scans(CRATE, 9, hits=12), scans(CRATE, 20, misses=60))
    come = map_changes(cells, GEOMETRY, MODEL, since=Epoch(5), until=Epoch(10))
    assert as_set(come.appeared) == as_set(CRATE)
    assert not len(map_changes(cells, GEOMETRY, MODEL, since=Epoch(5)).appeared)


def test_a_pipe_that_heats_up_is_warmer_and_then_colder() -> None:
    cold, hot = scans(CRATE, 1, hits=6, kelvin=290.0), scans(CRATE, 9, hits=6, kelvin=330.0)
    assert as_set(changes(cold, hot).warmer) == as_set(CRATE)
    cooled = scans(CRATE, 12, hits=6, kelvin=291.0)
    assert as_set(changes(cold, hot, cooled, since=10).colder) == as_set(CRATE)
    assert not len(changes(cold, cooled).warmer)


def test_cells_without_anything_new_are_not_read() -> None:
    assert not len(changes(scans(CRATE, 1, hits=12)).appeared)
    assert not len(map_changes({}, GEOMETRY, MODEL, since=Epoch(0)).gone)


@given(st.lists(st.tuples(*[st.integers(0, 60)] * 4), min_size=1, max_size=20))
def test_the_likelihood_ratio_is_the_sum_over_the_table(tables: list[tuple[int, int, int, int]]) -> None:
    rows = np.array(tables)
    for found, (a, b, c, d) in zip(likelihood_ratio(rows[:, :2], rows[:, 2:]), tables, strict=True):
        total, expected = a + b + c + d, 0.0
        for count, row, column in ((a, a + b, a + c), (b, a + b, b + d), (c, c + d, a + c), (d, c + d, b + d)):
            expected += 2 * count * np.log(count * total / (row * column)) if count else 0.0
        assert abs(found - expected) < 1e-6


def test_voxels_are_found_across_the_border_of_cells() -> None:
    border = np.array([[x, 0, z] for x in (-1, 0) for z in range(2)])  # two voxels in each of two cells
    found = changes(scans(border, 1, misses=30), scans(border, 9, hits=12))
    assert as_set(found.appeared) == as_set(border)
