"""Memory for bodies: never more than all of it, and no caller keeps another one out."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.errors import UnreachableError
from cairn_server.access.body_budget import BodyBudget

LIMIT = 1000


def taken_by(budget: BodyBudget, caller: str, size: int) -> bool:
    try:
        budget.take(caller, size)
    except UnreachableError as exc:
        assert exc.kind == "busy" and exc.retry_after_s
        return False
    return True


@given(st.lists(st.tuples(st.sampled_from("abcde"), st.integers(1, LIMIT)), max_size=60))
def test_after_any_greed_of_others_one_more_caller_has_its_share(asks: list[tuple[str, int]]) -> None:
    budget = BodyBudget(LIMIT)
    held = [(caller, size) for caller, size in asks if taken_by(budget, caller, size)]
    assert budget.held_bytes == sum(size for _, size in held) < LIMIT
    assert taken_by(budget, "new", (LIMIT - budget.held_bytes) // 2)
    budget.give_back("new", (LIMIT - sum(size for _, size in held)) // 2)
    for caller, size in held:
        budget.give_back(caller, size)
    assert budget.held_bytes == 0


def test_one_caller_fills_half_a_byte_at_a_time_or_at_once() -> None:
    budget = BodyBudget(LIMIT)
    assert sum(taken_by(budget, "mole", 1) for _ in range(LIMIT)) == LIMIT // 2
    with pytest.raises(UnreachableError):
        budget.check("mole", 1)
    budget.check("wren", LIMIT // 4)
    assert not taken_by(budget, "wren", LIMIT // 2)
