"""Turns: bounded for all and for each, and nobody waits behind another one's queue."""

import asyncio
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.errors import UnreachableError
from cairn_server.access.turns import Turns


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 3)), max_size=40), st.integers(1, 5), st.integers(1, 5)
)
def test_all_that_ask_are_served_within_the_bounds(askers: list[tuple[str, int]], places: int, share: int) -> None:
    now = Counter[str]()

    async def work(turns: Turns, who: str, steps: int) -> None:
        await turns.take(who)
        now[who] += 1
        assert now[who] <= share and now.total() <= places
        for _ in range(steps):
            await asyncio.sleep(0)
        now[who] -= 1
        turns.give_back(who)

    async def everybody() -> int:
        turns = Turns(places=places, share=share, wait_s=60)
        await asyncio.gather(*(work(turns, *asker) for asker in askers))
        return turns.taken

    assert asyncio.run(everybody()) == 0


def test_who_asks_once_comes_before_the_second_turn_of_one_that_asked_often() -> None:
    served: list[str] = []

    async def work(turns: Turns, who: str) -> None:
        await turns.take(who)
        served.append(who)
        await asyncio.sleep(0)
        turns.give_back(who)

    async def everybody() -> None:
        turns = Turns(places=2, share=1, wait_s=60)
        await asyncio.gather(*(work(turns, who) for who in ["mole"] * 20 + ["wren", "fox"]))

    asyncio.run(everybody())
    assert {"wren", "fox"} <= set(served[:5])


def test_who_waits_too_long_is_told_so_and_takes_no_place() -> None:
    async def everybody() -> int:
        turns = Turns(places=1, share=1, wait_s=0.01)
        await turns.take("mole")
        with pytest.raises(UnreachableError) as told:
            await turns.take("wren")
        assert told.value.kind == "busy" and told.value.retry_after_s
        turns.give_back("mole")
        await turns.take("fox")
        return turns.taken

    assert asyncio.run(everybody()) == 1


def test_who_is_gone_while_waiting_takes_no_place() -> None:
    async def everybody() -> int:
        turns = Turns(places=1, share=1, wait_s=60)
        await turns.take("mole")
        waiting = asyncio.create_task(turns.take("wren"))
        await asyncio.sleep(0)
        turns.give_back("mole")  # wren has it from here on, and does not know
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        return turns.taken

    assert asyncio.run(everybody()) == 0


def test_who_waits_is_refused_when_the_server_stops_and_who_works_goes_on() -> None:
    async def everybody() -> int:
        turns = Turns(places=1, share=1, wait_s=60)
        await turns.take("mole")
        waiting = asyncio.gather(*(turns.take(who) for who in "abc"), return_exceptions=True)
        await asyncio.sleep(0)
        turns.close()
        refused = [await waiting, await asyncio.gather(turns.take("late"), return_exceptions=True)]
        kinds = [exc.kind for each in refused for exc in each if isinstance(exc, UnreachableError)]
        assert kinds == ["shutting_down"] * 4
        turns.give_back("mole")
        return turns.taken

    assert asyncio.run(everybody()) == 0
