"""Log-odds in 16 bits: no state is lost to rounding, the model's bounds are exact, all else is right to a step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.evidence.brick_odds import STEPS_MAX, BrickOdds, odds_of_steps, steps_of_odds
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, SensorModel, log_odds

MODELS = st.builds(
    lambda p_min, p_occupied, p_max: SensorModel(p_min=p_min, p_occupied=p_occupied, p_max=p_max),
    st.floats(0.001, 0.3),
    st.one_of(st.just(0.5), st.floats(0.31, 0.69)),
    st.floats(0.7, 0.999),
)


@given(MODELS, st.lists(st.one_of(st.floats(-8, 8), st.sampled_from([0.0, 1e-9, -1e-9, 4e-4, 6e-4, -6e-4]))))
def test_states_and_bounds_are_exact_and_all_else_is_right_to_a_step(model: SensorModel, raw: list[float]) -> None:
    zero, low, high = (log_odds(p) for p in (model.p_occupied, model.p_min, model.p_max))
    # Around the threshold, too: values as far from it as from 0.
    odds = np.clip(np.array([*raw, *(value + zero for value in raw), low, high]), low, high)
    steps = steps_of_odds(odds, model)
    back = odds_of_steps(steps, model)
    assert ((steps > 0) == (odds > zero)).all()
    assert ((back > zero) == (odds > zero)).all()
    assert (np.abs(back - odds) <= LOG_ODDS_STEP).all()
    assert (back[odds == low] == low).all()
    assert (back[odds == high] == high).all()


def test_log_odds_beyond_16_bits_end_at_the_last_step() -> None:
    model = SensorModel(p_min=1e-30, p_max=1 - 1e-16)
    steps = steps_of_odds(np.array([log_odds(model.p_min), log_odds(model.p_max)]), model)
    assert steps.tolist() == [-STEPS_MAX, STEPS_MAX]


def test_a_reading_is_not_read_under_another_model() -> None:
    odds = BrickOdds(SensorModel(), 1)
    odds.check_model(SensorModel())
    with pytest.raises(ValueError, match="cannot be read under"):
        odds.check_model(SensorModel(p_hit=0.8))
