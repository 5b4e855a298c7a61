"""Fingerprints add as evidence adds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import KEY, MIDDLE, SMALL, any_evidence, as_dict, random_evidence
from tests.naive import evidence as naive_evidence

from cairn_map.errors import DamagedDataError
from cairn_map.evidence.brick_cell import difference, sum_evidence
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.fingerprint import ZERO, Fingerprint, fingerprint, fingerprint_from_bytes, fingerprint_from_hex
from cairn_map.evidence.grid import CellKey

SEEDS = st.integers(0, 10**6)
WORDS = st.integers(0, (1 << 64) - 1)


@given(SEEDS, SEEDS)
def test_the_fingerprint_of_a_sum_is_the_sum_of_fingerprints(a: int, b: int) -> None:
    x, y = random_evidence(a, MIDDLE), random_evidence(b, MIDDLE)
    assert fingerprint(sum_evidence([x, y], MIDDLE), KEY) == fingerprint(x, KEY) + fingerprint(y, KEY)
    assert fingerprint(difference(x, y, MIDDLE), KEY) == fingerprint(x, KEY) - fingerprint(y, KEY)


@given(any_evidence(SMALL, low=-(1 << 62)), st.integers(0, (1 << 63) - 1))
def test_the_fingerprint_is_what_its_twin_says(evidence: Evidence, key: int) -> None:
    found = fingerprint(evidence, CellKey(key))
    assert (found.first, found.second) == naive_evidence.fingerprint(as_dict(evidence), key)


@given(SEEDS, st.data())
def test_one_changed_number_changes_both_sums(seed: int, data: st.DataObject) -> None:
    evidence = random_evidence(seed, SMALL)
    row = data.draw(st.integers(0, len(evidence) - 1))
    bit = data.draw(st.integers(0, 31))
    counts = evidence.counts.copy()
    counts[row, bit % 2] ^= np.int32(1 - 2**31 - 1) if bit == 31 else np.int32(1 << bit)
    flipped = Evidence(evidence.voxels, counts, evidence.sampled, evidence.samples)
    before, after = fingerprint(evidence, KEY), fingerprint(flipped, KEY)
    assert before.first != after.first
    assert before.second != after.second


def test_the_same_evidence_elsewhere_has_another_fingerprint() -> None:
    evidence = random_evidence(1, SMALL)
    assert fingerprint(evidence, KEY) != fingerprint(evidence, CellKey(KEY + 1))


def test_no_evidence_has_fingerprint_zero() -> None:
    assert fingerprint(empty_evidence(SMALL), KEY) == ZERO


@given(WORDS, WORDS)
def test_fingerprints_come_back_from_bytes_and_hex(first: int, second: int) -> None:
    one = Fingerprint(first, second)
    assert fingerprint_from_bytes(one.to_bytes()) == one == fingerprint_from_hex(one.hex())
    assert one - one == ZERO


@pytest.mark.parametrize("text", ["", "00", "0" * 31, "0" * 33, "g" * 32, "é" * 32, "A" * 32, " " + "0" * 32])
def test_other_texts_are_no_fingerprint(text: str) -> None:
    with pytest.raises(DamagedDataError):
        fingerprint_from_hex(text)
