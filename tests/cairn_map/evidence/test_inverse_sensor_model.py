"""Counts to probabilities, when they are read."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import PLAIN

from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.evidence import COUNT_MAX, packed_evidence
from cairn_map.evidence.inverse_sensor_model import SensorModel, known, log_odds

NAN = math.nan
MODEL = SensorModel()
COUNT = st.integers(0, COUNT_MAX)


def probability(hits: int, misses: int, model: SensorModel = MODEL) -> float:
    return float(model.probability(np.array([[hits, misses]]))[0])


def test_unknown_is_nan_and_not_one_half() -> None:
    assert math.isnan(probability(0, 0))
    assert not known(np.array([[0, 0]]))[0]
    assert not MODEL.occupied(np.array([[0, 0]]))[0]


def test_one_hit_and_one_miss_are_the_models_own_numbers() -> None:
    assert probability(1, 0) == pytest.approx(0.7)
    assert probability(0, 1) == pytest.approx(0.4)


@given(COUNT, COUNT)
def test_every_known_probability_lies_between_the_clamps(hits: int, misses: int) -> None:
    if hits or misses:
        assert 0.12 - 1e-12 <= probability(hits, misses) <= 0.97 + 1e-12


@given(st.integers(0, 100), st.integers(0, 100))
def test_more_hits_never_make_a_voxel_less_probable(hits: int, misses: int) -> None:
    if hits or misses:
        assert probability(hits + 1, misses) >= probability(hits, misses) >= probability(hits, misses + 1)


def test_counts_are_clamped_when_read_and_never_when_merged() -> None:
    seen = packed_evidence(np.array([1], np.uint32), np.array([[1000, 0]]), np.zeros((1, 0), np.int64), PLAIN)
    missed = packed_evidence(np.array([1], np.uint32), np.array([[0, 3000]]), np.zeros((1, 0), np.int64), PLAIN)
    assert MODEL.probability(seen.counts)[0] == pytest.approx(0.97)
    both = sum_evidence([seen, missed], PLAIN)
    assert both.counts.tolist() == [[1000, 3000]]
    assert MODEL.probability(both.counts)[0] == pytest.approx(0.12)


def test_the_model_may_be_chosen_anew_for_the_same_counts() -> None:
    careful = SensorModel(p_hit=0.55, p_miss=0.49)
    assert probability(1, 0, careful) == pytest.approx(0.55)


def test_occupied_is_above_the_threshold() -> None:
    counts = np.array([[1, 0], [0, 1], [1, 2], [2, 2], [0, 0]])
    assert MODEL.occupied(counts).tolist() == [True, False, True, True, False]


@pytest.mark.parametrize(
    "fields",
    [
        {"p_hit": 0.5},
        {"p_miss": 0.5},
        {"p_min": 0.6},
        {"p_max": 0.4},
        {"p_hit": 1.0},
        {"p_miss": 0.0},
        {"p_hit": math.nan},
    ],
)
def test_models_that_contradict_themselves_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="p_"):
        SensorModel(**fields)


def test_log_odds_of_one_half_is_zero() -> None:
    assert log_odds(0.5) == 0
