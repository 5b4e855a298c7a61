"""Upkeep by a clock of the test: evidence goes when its time is over, deleted maps in parts, room back to the disk."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import pushed
from tests.memory_store.store import MemoryStore

from cairn_map.errors import UnreachableError
from cairn_server.store.store_age import Clocks
from cairn_server.store.store_rows import MapRow
from cairn_server.upkeep import LEAST_LOOK_S, LOOK_EVERY_S, RETRY_S, Upkeep

FOREVER_S = float("inf")


@dataclass
class Clock:
    """Both clocks of a machine, set by hand."""

    now_s: float = 1000.0
    slept_s: list[float] = field(default_factory=list)

    def __call__(self) -> float:
        return self.now_s

    def clocks(self) -> Clocks:
        return Clocks(lambda: self.now_s + 1e9, self)


def upkeep_of(store: MemoryStore, clock: Clock, *, keep_evidence_s: float) -> Upkeep:
    return Upkeep(store, keep_evidence_s=keep_evidence_s, may_forget_s=lambda name: FOREVER_S, steady_s=clock)


def is_gone(store: MemoryStore, row: MapRow) -> bool:
    found = store.commit(row, pushed(0, 0).id)
    assert found is not None
    return found.gone


@pytest.mark.parametrize("keep_s", [0.0, 0.5, 15.0, 59.0, 600.0])
def test_evidence_goes_when_its_time_is_over_and_not_before(keep_s: float) -> None:
    clock = Clock()
    store = MemoryStore(clock.clocks())
    upkeep = upkeep_of(store, clock, keep_evidence_s=keep_s)
    assert upkeep.work()
    row = folded_map(store, pushed(0, 0))
    folded_s = clock.now_s
    while not is_gone(store, row):
        assert clock.now_s <= folded_s + keep_s + min(LOOK_EVERY_S, max(keep_s, LEAST_LOOK_S)) + 0.01
        # As the thread does: it waits until a duty is due, and nothing wakes it.
        clock.now_s += max(upkeep.wait_s(), 0.001)
        assert upkeep.work()
    assert clock.now_s > folded_s + keep_s or keep_s == 0.0
    assert upkeep.wait_s() <= LOOK_EVERY_S


def test_a_server_forgets_while_it_runs_and_no_robot_comes(tmp_path: Path) -> None:
    with Live(tmp_path, keep_evidence_s=0.1) as live:
        row = live.new_map()
        live.push(row, pushed(0, 0))
        path = f"/maps/{row.name}/commits/{pushed(0, 0).id}"
        until(lambda: live.http.get(path).status_code == 409, "the evidence is gone")


def test_a_duty_that_fails_is_tried_again_and_the_others_go_on() -> None:
    clock, asked = Clock(), []

    class Failing(MemoryStore):
        def clear_deleted(self, *, size_bytes_max: int) -> bool:
            asked.append(clock.now_s)
            if len(asked) == 1:
                raise UnreachableError("disk_full", "no room")
            return len(asked) < 5

    store = Failing(clock.clocks())
    upkeep = upkeep_of(store, clock, keep_evidence_s=0.0)
    row = folded_map(store, pushed(0, 0))
    clock.now_s += 1.0
    assert not upkeep.work()
    assert is_gone(store, row)
    clock.now_s += RETRY_S
    for _ in range(4):  # the steps take no time by this clock: no rest after them
        assert upkeep.work()
    assert len(asked) == 5
    assert upkeep.work() and len(asked) == 5
    upkeep.hurry()
    assert upkeep.wait_s() == 0.0
    assert upkeep.work() and len(asked) == 6
