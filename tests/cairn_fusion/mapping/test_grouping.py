"""Grouping of scans into measurements: all scans, in order, each group within its bounds and as large as they allow."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_calib.rig.poses import Transform
from cairn_fusion.mapping.grouping import Grouping, OpenGroup, measurements_by
from cairn_map.errors import BadInputError

STEPS = st.lists(st.tuples(st.floats(-0.5, 3), st.floats(0, 1.5)), max_size=60)
GROUPINGS = st.builds(Grouping, st.integers(1, 9), st.none() | st.floats(0, 6), st.floats(0, 4))


def track(steps: list[tuple[float, float]]) -> list[tuple[float, Transform]]:
    found: list[tuple[float, Transform]] = []
    time_s, x_m = 1.5e9, 0.0
    for later_s, farther_m in steps:
        time_s, x_m = time_s + later_s, x_m + farther_m
        T_map_rig = np.eye(4)
        T_map_rig[0, 3] = x_m
        found.append((time_s, T_map_rig))
    return found


def is_within(group: list[tuple[float, Transform]], grouping: Grouping) -> bool:
    times, places = [time_s for time_s, _ in group], [T[0, 3] for _, T in group]
    return (
        len(group) <= grouping.scans_max
        and times == sorted(times)
        and (grouping.seconds_max is None or times[-1] - times[0] <= grouping.seconds_max)
        and all(abs(place - places[0]) <= grouping.metres_max for place in places)
    )


@given(STEPS, GROUPINGS)
def test_groups_are_all_scans_in_order_each_within_its_bounds_and_none_smaller_than_they_ask(
    steps: list[tuple[float, float]], grouping: Grouping
) -> None:
    scans = track(steps)
    groups = measurements_by(grouping, scans)
    assert [index for group in groups for index in group] == list(range(len(scans)))
    for group in groups:
        assert is_within([scans[index] for index in group], grouping)
    for group, after in pairwise(groups):
        assert not is_within([scans[index] for index in (*group, after.start)], grouping)


@given(STEPS, GROUPINGS)
def test_a_live_robot_that_asks_scan_by_scan_gets_the_groups_of_its_recording(
    steps: list[tuple[float, float]], grouping: Grouping
) -> None:
    scans, group = track(steps), OpenGroup(grouping)
    starts = [index for index, scan in enumerate(scans) if group.ends_before(*scan) or index == 0]
    assert starts == [found.start for found in measurements_by(grouping, scans)]


@pytest.mark.parametrize("bounds", [(0, 5.0, 2.0), (30, -1.0, 2.0), (30, 5.0, -0.1)])
def test_bounds_below_one_scan_are_refused(bounds: tuple[int, float, float]) -> None:
    with pytest.raises(BadInputError):
        Grouping(*bounds)
