"""A map of several cells."""

import numpy as np
import pytest
from tests.fixtures.map.made import SMALL, random_evidence

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import COUNT_MAX, Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey

A, B, C = CellKey(5), CellKey(3), CellKey(9)


def hit_often() -> Evidence:
    samples = np.zeros((1, SMALL.plane_count), np.int64)
    return packed_evidence(np.array([0], np.uint32), np.array([[COUNT_MAX, 0]]), samples, SMALL)


def test_cells_come_rising_in_number_and_empty_ones_not_at_all() -> None:
    world = EvidenceMap(SMALL)
    diff = {A: random_evidence(1, SMALL), B: random_evidence(2, SMALL)}
    world.merge(diff)
    world.merge({C: empty_evidence(SMALL)})
    assert list(world.packed()) == [B, A]
    assert world.packed() == diff
    assert world.evidence(CellKey(77)) == empty_evidence(SMALL)


def test_unmerging_everything_leaves_nothing() -> None:
    world = EvidenceMap(SMALL)
    world.merge({A: random_evidence(1, SMALL)})
    world.unmerge({A: random_evidence(1, SMALL)})
    assert world.packed() == {}


@pytest.mark.parametrize("order", [(A, B, C), (B, A, C), (C, B, A)])
def test_a_diff_that_overflows_in_one_cell_changes_none(order: tuple[CellKey, ...]) -> None:
    world = EvidenceMap(SMALL)
    world.merge({A: random_evidence(1, SMALL), B: hit_often()})
    before, cells = world.packed(), list(world)
    with pytest.raises(BadInputError):
        world.merge({key: hit_often() if key == B else random_evidence(7, SMALL) for key in order})
    assert world.packed() == before
    assert list(world) == cells


def test_unmerging_what_would_overflow_changes_nothing() -> None:
    world = EvidenceMap(SMALL)
    world.unmerge({B: hit_often()})
    before, cells = world.packed(), list(world)
    with pytest.raises(BadInputError):
        world.unmerge({A: random_evidence(1, SMALL), B: hit_often()})
    assert world.packed() == before
    assert list(world) == cells


def test_replacing_forgets_what_was() -> None:
    world = EvidenceMap(SMALL)
    world.merge({A: random_evidence(1, SMALL)})
    world.replace(A, random_evidence(2, SMALL))
    assert world.evidence(A) == random_evidence(2, SMALL)
    assert A in world
    assert len(world) == 1
    world.clear()
    assert len(world) == 0
