"""A version vector is a set of ids."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.naive import wire as naive_wire

from cairn_map.commits.ids import NUMBER_LIMIT, Author, CommitId, author_from_text, commit_id_from_text
from cairn_map.commits.version_vector import (
    AUTHORS_MAX,
    COMMITS_MAX,
    EMPTY,
    INTERVALS_MAX,
    VersionVector,
    version_vector_from_json,
)
from cairn_map.errors import BadInputError

AUTHORS = ("mole.0123456789abcdef", "ant.00000000000000ff")
IDS = st.sets(st.tuples(st.sampled_from(AUTHORS), st.integers(0, 25)), max_size=30)


def id_of(pair: tuple[str, int]) -> CommitId:
    return CommitId(author_from_text(pair[0]), pair[1])


def vector_of(ids: set[tuple[str, int]]) -> VersionVector:
    return EMPTY.with_commits(id_of(pair) for pair in ids)


@given(IDS)
def test_it_holds_what_was_added_and_nothing_else(ids: set[tuple[str, int]]) -> None:
    vector = vector_of(ids)
    assert set(vector) == {id_of(pair) for pair in ids}
    assert len(vector) == len(ids)
    everything = {(author, n) for author in AUTHORS for n in range(27)}
    assert {pair for pair in everything if id_of(pair) in vector} == ids


@given(IDS, IDS)
def test_adding_in_any_order_and_twice_gives_the_same(a: set[tuple[str, int]], b: set[tuple[str, int]]) -> None:
    one = vector_of(a).with_commits(id_of(pair) for pair in b)
    assert one == vector_of(b).with_commits(vector_of(a)) == vector_of(a | b)


@given(IDS, IDS)
def test_minus_is_that_of_sets(a: set[tuple[str, int]], b: set[tuple[str, int]]) -> None:
    assert vector_of(a).minus(vector_of(b)) == vector_of(a - b)


@given(IDS)
def test_json_is_what_its_twin_says_and_comes_back(ids: set[tuple[str, int]]) -> None:
    value = vector_of(ids).to_json()
    assert value == naive_wire.vector_of_ids(ids)
    assert naive_wire.ids_of_vector(value) == ids
    assert version_vector_from_json(value) == vector_of(ids)


@given(IDS)
def test_tip_is_the_highest_number(ids: set[tuple[str, int]]) -> None:
    for author in AUTHORS:
        numbers = [n for name, n in ids if name == author]
        assert vector_of(ids).tip(author_from_text(author)) == max(numbers, default=None)


MOLE = AUTHORS[0]


@pytest.mark.parametrize(
    "value",
    [
        {MOLE: []},
        {MOLE: [[1, 0]]},
        {MOLE: [[-1, 3]]},
        {MOLE: [[0, 1], [2, 3]]},
        {MOLE: [[5, 6], [0, 1]]},
        {MOLE: [[0, 5], [3, 9]]},
        {MOLE: [[0]]},
        {MOLE: [[0, 1, 2]]},
        {MOLE: [0, 1]},
        {MOLE: 7},
        {MOLE: [["0", "1"]]},
        {MOLE: [[0, True]]},
        {MOLE: [[0, 1.0]]},
        {MOLE: [[0, NUMBER_LIMIT]]},
        {MOLE: [[0, 10**4000]]},
        {MOLE: [[0, COMMITS_MAX]]},
        {"mole": [[0, 1]]},
        {"mole.0123456789ABCDEF": [[0, 1]]},
        {f"r{n}.0123456789abcdef": [[0, 0]] for n in range(AUTHORS_MAX + 1)},
        {MOLE: [[2 * n, 2 * n] for n in range(INTERVALS_MAX + 1)]},
        [],
        None,
    ],
    ids=lambda value: str(value)[:40],
)
def test_what_is_no_version_vector_is_refused(value: object) -> None:
    with pytest.raises(BadInputError):
        version_vector_from_json(value)  # type: ignore[arg-type]


def test_the_largest_interval_costs_nothing_until_it_is_listed() -> None:
    huge = version_vector_from_json({MOLE: [[0, COMMITS_MAX - 1]]})
    assert len(huge) == COMMITS_MAX
    assert CommitId(author_from_text(MOLE), COMMITS_MAX - 1) in huge
    assert len(huge.minus(vector_of({(MOLE, 7)}))) == COMMITS_MAX - 1


def test_minus_takes_time_in_proportion_to_the_intervals() -> None:
    """Not to their product, which for these would be minutes."""
    even = version_vector_from_json({MOLE: [[2 * n, 2 * n] for n in range(INTERVALS_MAX)]})
    wide = version_vector_from_json({MOLE: [[0, 2 * INTERVALS_MAX]]})
    assert len(wide.minus(even)) == INTERVALS_MAX + 1
    assert even.minus(wide) == EMPTY
    assert even.minus(even) == EMPTY


@given(st.text(alphabet="abz019.-_ \n", max_size=40))
def test_ids_are_read_only_in_the_form_they_are_written(text: str) -> None:
    try:
        commit = commit_id_from_text(text)
    except BadInputError:
        return
    assert str(commit) == text


def test_an_id_is_never_longer_than_its_parts_allow() -> None:
    longest = CommitId(Author("r" * 32, "f" * 16), NUMBER_LIMIT - 1)  # type: ignore[arg-type]
    assert commit_id_from_text(str(longest)) == longest
    for text in (str(longest) + "0", "r" + str(longest), str(longest) + " " * 60, str(longest) + "\n"):
        with pytest.raises(BadInputError):
            commit_id_from_text(text)
