"""Whatever happens to links and disks, all maps end equal and no commit is lost."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.client.made import cells_of
from tests.fixtures.client.world import MODES, PUSHES, Fault, World, quick
from tests.fixtures.lengths import length

Step = Callable[[World], None]

faults = st.none() | st.builds(
    Fault,
    call=st.integers(0, 3),
    kind=st.sampled_from(["before", "after", "twice", "cut"]),
    frames=st.integers(0, 4),
)
robots = st.integers(0, len(MODES) - 1)
mappers = st.sampled_from(PUSHES)
numbers = st.integers(0, 60)
commits = st.tuples(st.just("commit"), mappers, numbers)
syncs = st.tuples(st.just("sync"), robots, faults)
folds = st.tuples(st.just("fold"), st.integers(1, 5))
rare = st.one_of(
    st.tuples(st.just("amend"), mappers, numbers),
    st.tuples(st.just("retract"), numbers),
    st.tuples(st.just("forget_evidence")),
    st.tuples(st.just("sync_box"), robots, st.integers(0, 1)),
    st.tuples(st.just("restart_server")),
    st.tuples(st.just("back_up")),
    st.tuples(st.just("restore")),
    st.tuples(st.just("restart_robot"), robots),
    st.tuples(st.just("save_disk"), robots),
    st.tuples(st.just("roll_back_disk"), robots),
    st.tuples(st.just("lose_disk"), robots),
)
histories = st.lists(st.one_of(commits, syncs, syncs, folds, rare, rare), max_size=40)


@pytest.fixture(scope="module", autouse=True)
def no_flush_and_no_threads() -> object:
    with pytest.MonkeyPatch.context() as patch:
        quick(patch)
        yield


@pytest.mark.slow
@settings(max_examples=length(50, long=100))
@given(histories)
def test_after_any_history_all_maps_are_equal_and_no_commit_is_lost(history: list[tuple]) -> None:  # type: ignore[type-arg]
    with tempfile.TemporaryDirectory() as folder, World(Path(folder)) as world:
        for name, *arguments in history:
            getattr(world, name)(*arguments)
        world.check()


@settings(max_examples=20)
@given(st.lists(numbers, max_size=12), st.integers(1, 4))
def test_a_robot_that_was_offline_ends_equal_to_one_that_never_was(seeds: list[int], group: int) -> None:
    with tempfile.TemporaryDirectory() as folder, World(Path(folder), ("high-end",) * 3) as world:
        for seed in seeds:
            world.commit(0, seed)
            world.sync(0)
            world.fold(group)
            world.sync(1)
        world.fold(1000)
        for robot in (1, 2):  # the one that listened all the time, and the one that did not
            world.sync(robot)
        assert cells_of(world.robots[1].view) == cells_of(world.robots[2].view) == cells_of(world.robots[0].view)


@settings(max_examples=20)
@given(st.lists(numbers, min_size=1, max_size=6))
def test_pushing_twice_changes_nothing(seeds: list[int]) -> None:
    with tempfile.TemporaryDirectory() as folder, World(Path(folder), ("high-end",)) as world:
        for seed in seeds:
            world.commit(0, seed)
            world.sync(0, Fault(0, "twice"))
            world.sync(0, Fault(0, "after"))
        world.check()
        before = world.service.store.map("lab"), cells_of(world.robots[0].view)
        world.sync(0, Fault(0, "twice"))
        world.check()
        assert (world.service.store.map("lab"), cells_of(world.robots[0].view)) == before


@pytest.mark.parametrize("mode", ["high-end", "low-end"])
def test_an_operator_s_retract_survives_the_restore_of_a_backup_from_before_it(mode: str) -> None:
    with tempfile.TemporaryDirectory() as folder, World(Path(folder), (mode, mode)) as world:
        for seed in (1, 2):
            world.commit(0, seed)
        world.sync(0)
        world.fold(9)
        world.back_up()
        world.retract(0)
        world.fold(9)
        for robot in range(2):
            world.sync(robot)
        once = cells_of(world.robots[0].view)
        world.restore()
        world.settle()
        assert all(cells_of(robot.view) == once for robot in world.robots)
        world.check()
