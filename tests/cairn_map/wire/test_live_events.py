"""Live events and lists of commits: what is written is read, and what is no id has no position."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.fixtures.map.made import ROBOT, made_cursor

from cairn_map.commits.ids import author_from_text, commit_id_from_text
from cairn_map.commits.version_vector import version_vector_from_json
from cairn_map.errors import BadInputError
from cairn_map.wire.live_events import (
    CHAIN_DIGITS,
    LIVE_EVENT,
    Beat,
    CellsEvent,
    EventPosition,
    HeadMoved,
    Hello,
    LiveEvent,
    LogGrew,
    RobotHeard,
    RobotSign,
    position_from_text,
)
from cairn_map.wire.relay_peer import SUM_BYTES, CommitList, Held, commit_list, held_from_list, sum_of_shas

SIGN = RobotSign(branch="mole", mode="high-end", time_s=1.5e9, cursor=str(made_cursor()), gone=True)
ID = "7.0123abcd.3"
EVENTS: list[LiveEvent] = [
    Hello(id=ID, map="lab", cursor=str(made_cursor()), resumed=True, robots=[SIGN], beat_s=15.0),
    CellsEvent(id=ID, cells=[(0, -1, 2, 9)]),
    CellsEvent(id=ID, cells="many"),
    LogGrew(id=ID, entries=[], left_out=4),
    HeadMoved(id=ID, cursor=str(made_cursor())),
    RobotHeard(id=ID, robot=SIGN),
    Beat(id=ID, time_s=1.5e9),
]
chains = st.text("0123456789abcdef", min_size=CHAIN_DIGITS, max_size=CHAIN_DIGITS)
shas = st.lists(st.binary(min_size=32, max_size=32), max_size=6)


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.type)
def test_an_event_comes_back_from_its_json_as_what_it_is(event: LiveEvent) -> None:
    again = LIVE_EVENT.validate_json(event.model_dump_json())
    assert again == event and type(again) is type(event)


@pytest.mark.parametrize("text", ['{"type": "news", "id": "1"}', '{"id": "1"}', '{"type": "beat", "id": "1", "x": 2}'])
def test_what_is_no_event_is_refused(text: str) -> None:
    with pytest.raises(ValidationError):
        LIVE_EVENT.validate_json(text)


@given(st.integers(0, 1 << 62), chains, st.integers(0, 1 << 62))
def test_a_position_comes_back_from_its_text(seq: int, chain: str, tick: int) -> None:
    position = EventPosition(seq, chain, tick)
    assert position_from_text(str(position)) == position


@given(st.text(max_size=80) | st.from_regex(r"[0-9\-+. ²]{1,6}\.[0-9a-f]{7,9}\.[0-9\-+²]{1,6}", fullmatch=True))
def test_any_text_is_an_id_that_says_the_same_or_none(text: str) -> None:
    position = position_from_text(text)
    if position is not None:
        seq, chain, tick = text.split(".")
        assert (position.seq, position.chain, position.tick) == (int(seq), chain, int(tick))
        assert min(position.seq, position.tick) >= 0


def test_a_list_of_commits_comes_back_from_its_json() -> None:
    held = Held(
        vector=version_vector_from_json({ROBOT: [[0, 4], [6, 9]], "wren.00000000000000aa": [[3, 3]]}),
        wanted=(commit_id_from_text(f"{ROBOT}.2"),),
        sums={author_from_text(ROBOT): bytes(range(SUM_BYTES))},
    )
    text = commit_list(held).model_dump_json()
    assert held_from_list(CommitList.model_validate_json(text)) == held
    with pytest.raises(BadInputError):
        held_from_list(CommitList(vector={"nobody": [[0, 1]]}))


@given(shas, shas)
def test_sums_do_not_depend_on_the_order_and_go_on_from_one_another(one: list[bytes], two: list[bytes]) -> None:
    nothing = bytes(SUM_BYTES)
    whole = sum_of_shas(nothing, one + two)
    assert len(whole) == SUM_BYTES
    assert (
        whole == sum_of_shas(nothing, [*reversed(two), *reversed(one)]) == sum_of_shas(sum_of_shas(nothing, one), two)
    )
    expected = sum(int(sha[:SUM_BYTES].hex(), 16) for sha in one + two) % (1 << 128)
    assert whole.hex() == f"{expected:032x}"
