"""Morton numbers against their slow twins."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.naive import evidence as naive_evidence

from cairn_map.kernels.morton_kernels import deinterleave, interleave

INDEX = st.integers(0, (1 << 21) - 1)


@given(st.lists(st.tuples(INDEX, INDEX, INDEX), max_size=20))
def test_interleave_is_what_its_twin_says(triples: list[tuple[int, int, int]]) -> None:
    codes = interleave(np.array(triples, np.int64).reshape(-1, 3))
    assert codes.tolist() == [naive_evidence.interleave(*triple) for triple in triples]


@given(st.lists(st.integers(0, (1 << 63) - 1), max_size=20))
def test_deinterleave_is_what_its_twin_says(codes: list[int]) -> None:
    triples = deinterleave(np.array(codes, np.uint64))
    assert [tuple(row) for row in triples.tolist()] == [naive_evidence.deinterleave(code) for code in codes]


@given(st.lists(st.integers(0, (1 << 63) - 1), max_size=20))
def test_interleave_undoes_deinterleave(codes: list[int]) -> None:
    assert interleave(deinterleave(np.array(codes, np.uint64))).tolist() == codes


def test_siblings_are_neighbours_with_x_in_the_lowest_bit() -> None:
    assert interleave(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0]])).tolist() == [1, 2, 4, 8]
