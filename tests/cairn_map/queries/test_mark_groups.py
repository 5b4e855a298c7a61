"""Groups of marks: the same after any shuffle, equal to a slow twin, of one kind, bounded by the radius."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.commits.mark import MILLIMETRES_MAX, Mark
from cairn_map.errors import BadInputError
from cairn_map.queries.mark_groups import MarkGroup, group_marks
from cairn_map.wire.mark_messages import MarkEntry

ROBOTS = ("mole.1f2e3d4c5b6a7988", "wren.00112233445566aa")
small = st.integers(-60, 60)
far = st.integers(-MILLIMETRES_MAX, MILLIMETRES_MAX)


def entry(
    n: int, *place_mm: int, kind: str = "door", time_ms: int = 0, robot: str = ROBOTS[0], by: str = ""
) -> MarkEntry:
    x, y, z = place_mm
    mark = Mark(kind=kind, name=f"{kind} {n}", place_mm=(x, y, z), time_ms=time_ms, by=by)
    return MarkEntry(key=f"{robot}.{n}:0", mark=mark)


def naive_groups(entries: list[MarkEntry], radius_mm: int) -> list[MarkGroup]:
    """The same as the definition says it: every mark against every group."""
    groups: list[list[MarkEntry]] = []
    for each in sorted(entries, key=lambda each: (each.mark.time_ms, each.mark_key)):
        best: tuple[int, list[MarkEntry]] | None = None
        for group in groups:
            first = group[0]
            squared = sum((a - b) ** 2 for a, b in zip(first.mark.place_mm, each.mark.place_mm, strict=True))
            if first.mark.kind == each.mark.kind and squared <= radius_mm**2 and (best is None or squared < best[0]):
                best = squared, group
        if best is None:
            groups.append([each])
        else:
            best[1].append(each)
    return [MarkGroup(tuple(group)) for group in groups]


@st.composite
def histories(draw: st.DrawFn) -> list[MarkEntry]:
    places = draw(st.lists(st.tuples(small, small, small) | st.tuples(far, far, far), max_size=30))
    return [
        entry(
            n,
            *place,
            kind=draw(st.sampled_from(("door", "lamp"))),
            time_ms=draw(st.integers(0, 3)),
            robot=draw(st.sampled_from(ROBOTS)),
        )
        for n, place in enumerate(places)
    ]


@given(histories(), st.integers(0, 80), st.randoms(use_true_random=False))
def test_any_order_of_arrival_gives_the_same_groups_as_a_slow_twin(
    entries: list[MarkEntry], radius_mm: int, chance: random.Random
) -> None:
    expected = naive_groups(entries, radius_mm)
    assert group_marks(entries, radius_m=radius_mm / 1000) == expected
    shuffled = [*entries, *entries[:3]]
    chance.shuffle(shuffled)
    found = group_marks(shuffled, radius_m=radius_mm / 1000)
    assert found == expected
    assert sorted(each.key for group in found for each in group.entries) == sorted(each.key for each in entries)


def test_detections_of_one_thing_are_one_group_with_its_newest_name() -> None:
    seen = [
        entry(0, 0, 0, 0, time_ms=5),
        entry(1, 90, 0, 0, time_ms=9, robot=ROBOTS[1]),
        entry(2, 0, 91, 0, time_ms=7, by="ada"),
        entry(3, 1, 0, 0, time_ms=6, kind="lamp"),
        entry(4, 400, 0, 0, time_ms=8),
    ]
    door, lamp, far_door = group_marks(seen, radius_m=0.1)
    assert [each.mark.name for each in door.entries] == ["door 0", "door 2", "door 1"]
    assert (door.kind, door.name, door.authors, door.time_ms) == ("door", "door 1", ("ada", "mole", "wren"), (5, 9))
    assert (door.place_mm, door.place_m) == ((30, 30, 0), (0.03, 0.03, 0.0))
    assert (lamp.name, far_door.name) == ("lamp 3", "door 4")


def test_a_mark_joins_the_nearest_group() -> None:
    one, two, between = entry(0, 0, 0, 0), entry(1, 150, 0, 0, time_ms=1), entry(2, 80, 0, 0, time_ms=2)
    assert [len(group.entries) for group in group_marks([between, two, one], radius_m=0.1)] == [1, 2]


def test_without_marks_there_are_no_groups_and_with_no_radius_only_equal_places() -> None:
    assert group_marks([], radius_m=1.0) == []
    seen = [entry(0, 0, 0, 0), entry(1, 0, 0, 0, time_ms=1), entry(2, 1, 0, 0, time_ms=2)]
    assert [len(group.entries) for group in group_marks(seen, radius_m=0.0)] == [2, 1]


@pytest.mark.parametrize("radius_m", [-0.1, float("nan"), float("inf"), 1e12])
def test_a_radius_that_is_no_length_is_refused(radius_m: float) -> None:
    with pytest.raises(BadInputError) as refused:
        group_marks([], radius_m=radius_m)
    assert refused.value.kind == "bad_option"
