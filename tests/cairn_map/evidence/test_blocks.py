"""Blocks split evidence and put it together again, as sets of block numbers do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import GEOMETRIES, MIDDLE, SMALL, any_evidence, as_dict, random_evidence
from tests.naive import evidence as naive_evidence

from cairn_map.evidence.blocks import Blocks, blocks_of, of_blocks, without_blocks
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Geometry

VOXELS_OF_BLOCK = 4**3
geometries = pytest.mark.parametrize("geometry", GEOMETRIES)


def chosen(*numbers: int) -> Blocks:
    return np.array(sorted(set(numbers)), np.uint32)


@geometries
@pytest.mark.parametrize("seed", range(4))
def test_blocks_are_those_of_the_voxels(geometry: Geometry, seed: int) -> None:
    evidence = random_evidence(seed, geometry)
    corners: dict[int, list[tuple[int, int, int]]] = {}
    for place in as_dict(evidence):
        corners.setdefault(place // VOXELS_OF_BLOCK, []).append(naive_evidence.deinterleave(place))
    assert blocks_of(evidence).tolist() == sorted(corners)
    # A block is a cube: its voxels are less than four apart on every axis.
    assert all((np.ptp(np.array(voxels), axis=0) < 4).all() for voxels in corners.values())


@given(any_evidence(SMALL), st.sets(st.integers(0, 9)))
def test_the_two_parts_are_disjoint_and_make_the_whole(evidence: Evidence, numbers: set[int]) -> None:
    inside, outside = of_blocks(evidence, chosen(*numbers)), without_blocks(evidence, chosen(*numbers))
    whole = as_dict(evidence)
    assert as_dict(inside) == {place: v for place, v in whole.items() if place // VOXELS_OF_BLOCK in numbers}
    assert as_dict(outside) == {place: v for place, v in whole.items() if place // VOXELS_OF_BLOCK not in numbers}
    assert set(blocks_of(inside).tolist()) == set(blocks_of(evidence).tolist()) & numbers
    for part in (inside, outside):
        # Packed as evidence is: voxels rise, and rows of samples belong to voxels that are there.
        assert (np.diff(part.voxels.astype(np.int64)) > 0).all()
        assert (np.diff(part.sampled.astype(np.int64)) > 0).all()
        assert (part.sampled < len(part.voxels)).all() and len(part.sampled) == len(part.samples)


@geometries
def test_all_blocks_and_none_are_the_whole_and_nothing(geometry: Geometry) -> None:
    evidence = random_evidence(3, geometry)
    every, none = blocks_of(evidence), chosen()
    for whole in (of_blocks(evidence, every), without_blocks(evidence, none)):
        assert as_dict(whole) == as_dict(evidence)
    for nothing in (of_blocks(evidence, none), without_blocks(evidence, every)):
        assert as_dict(nothing) == {} and nothing.samples.shape == (0, geometry.plane_count)


def test_blocks_that_hold_nothing_take_nothing_away() -> None:
    evidence = random_evidence(1, MIDDLE, voxels=10, air=0)
    free = sorted(set(range(8**MIDDLE.depth // VOXELS_OF_BLOCK)) - set(blocks_of(evidence).tolist()))
    assert as_dict(without_blocks(evidence, chosen(*free))) == as_dict(evidence)
    assert len(of_blocks(evidence, chosen(*free))) == 0
    assert len(blocks_of(empty_evidence(MIDDLE))) == 0
    assert len(of_blocks(empty_evidence(MIDDLE), chosen(0, 7))) == 0


@given(any_evidence(SMALL), st.sets(st.integers(0, 7)), st.sets(st.integers(0, 7)))
def test_taking_blocks_twice_takes_those_of_both(evidence: Evidence, one: set[int], two: set[int]) -> None:
    after = of_blocks(of_blocks(evidence, chosen(*one)), chosen(*two))
    assert as_dict(after) == as_dict(of_blocks(evidence, chosen(*(one & two))))
    left = without_blocks(without_blocks(evidence, chosen(*one)), chosen(*two))
    assert as_dict(left) == as_dict(without_blocks(evidence, chosen(*(one | two))))
