"""Shared places: whatever others put, each asker keeps its newest, as many as its share."""

from collections import defaultdict

from hypothesis import given
from hypothesis import strategies as st

from cairn_server.access.shared_places import SharedPlaces

PUTS = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 6)), max_size=40)


@given(most=st.integers(1, 8), puts=PUTS)
def test_each_asker_keeps_the_newest_of_its_share(most: int, puts: list[tuple[str, int]]) -> None:
    places = SharedPlaces[int, int](most)
    put: defaultdict[str, dict[int, int]] = defaultdict(dict)
    for n, (asker, key) in enumerate(puts):
        places.put(asker, key, n)
        put[asker].pop(key, None)
        put[asker][key] = n
    held = {asker: [key for key in of if places.get(asker, key) is not None] for asker, of in put.items()}
    assert sum(map(len, held.values())) == len(list(places.values())) == min(most, sum(map(len, put.values())))
    for asker, of in put.items():
        newest = list(of)[-(most // len(put)) :] if most >= len(put) else []
        assert set(newest) <= set(held[asker])
        assert {key: places.get(asker, key) for key in held[asker]} == {key: of[key] for key in held[asker]}


@given(puts=PUTS, key=st.integers(0, 6))
def test_what_came_is_wanted_by_no_asker(puts: list[tuple[str, int]], key: int) -> None:
    places = SharedPlaces[int, None](8)
    for asker, put in puts:
        places.put(asker, put, None)
    before = set(places.keys())
    places.remove(key)
    assert set(places.keys()) == before - {key}
