"""Servers with wrong clocks, three robots and a relay: no epoch of a wrong time is taken, and no commit is lost.

The clocks are set by hand, everything else is real: servers on loopback, their stores, what robots learn of the time.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.fixtures.clocks import DAY_S, NOW_S, HandClocks
from tests.fixtures.map.histories import LAYER
from tests.fixtures.map.made import random_evidence
from tests.fixtures.server.live import Live

from cairn_client.http.api import MapApi
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import REST_S, RelayReport, Undelivered, relay_round
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.server_clock import ServerClock
from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import Author, CommitId, RobotName
from cairn_map.commits.signature import SigningKey, signatures_to_text
from cairn_map.epochs.epoch import BASE, Epoch, epoch_of
from cairn_map.errors import NotFoundError, UnreachableError
from cairn_map.evidence.grid import cell_key
from cairn_map.wire.messages import CreateMap, RobotStatus
from cairn_server.store.sqlite.store import SqliteStore

MAP, EPOCH_S = "lab", 120
KEY = cell_key((0, 0, 0))


class Base:
    """A server that may be switched off and on."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.clocks = HandClocks()
        self.start()
        self.live.service.maps.create(MAP, CreateMap(geometry=LAYER.geometry, epoch_s=EPOCH_S))

    def start(self) -> None:
        self.live = Live(self._folder, store=SqliteStore(self._folder, self.clocks.of_store()))

    def stop(self) -> None:
        self.live.__exit__(None, None, None)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.live.port}"

    def epochs(self) -> dict[CommitId, Epoch]:
        """Epochs of all commits that are kept."""
        store = self.live.service.store
        row = store.map(MAP)
        held = self.live.service.sync.held.of(row).vector
        return {commit: found.epoch for commit in held if (found := store.commit(row, commit)) is not None}


@dataclass
class Mapper:
    """A robot, as far as time is concerned."""

    name: str
    folder: Path
    clocks: HandClocks = field(default_factory=lambda: HandClocks(wall_s=500.0, steady_s=50.0))
    key: SigningKey = field(default_factory=SigningKey.drawn)
    waiting: list[Commit] = field(default_factory=list)
    taken: dict[CommitId, float] = field(default_factory=dict)
    """Times at which commits were measured, in truth."""

    def __post_init__(self) -> None:
        self.store = ReplicaStore(self.folder)
        self._clock = ServerClock(ReplicaState(self.store), self.clocks.of_machine())

    def measure(self, right_s: float) -> Commit:
        """Commit a scan of now, as `Robot.commit` does."""
        self._clock.look()
        time_s = self.clocks.wall_s
        commit_id = CommitId(Author(RobotName(self.name), self.key.incarnation), len(self.taken))
        epoch = self._clock.epoch_of((time_s, time_s), EPOCH_S)
        pose = ScanPose(time_s=time_s, t_map_rig=(0.0, 0.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
        stated = {"layers": LAYER.identities, "epoch": epoch, "captured_s": (time_s, time_s), "scans": (pose,) * 8}
        meta = CommitMeta(id=str(commit_id), **stated)
        evidence = random_evidence(len(self.taken), LAYER.geometry, voxels=6, air=1)
        commit = make_commit(meta, {KEY: evidence}, LAYER)
        self.waiting.append(commit)
        self.taken[commit_id] = right_s
        return commit

    def register(self, base: Base) -> None:
        """Register at a server, and learn its time."""
        body = {"robot": self.name, "incarnation": self.key.incarnation}
        headers = {"Cairn-Format": "2"}
        base.live.http.post(f"/maps/{MAP}/branches", json=body, headers=headers).raise_for_status()
        self.sync(base)

    def sync(self, base: Base) -> int:
        """One round with a server; the number of commits that it does not take yet."""
        with MapApi(base.url, steady_s=self.clocks.since_boot_s) as api:
            left = []
            for commit in self.waiting:
                try:
                    api.push(MAP, commit, signatures=signatures_to_text([self.key.sign(MAP, commit.sha)]))
                except UnreachableError as exc:
                    assert exc.kind == "bad_clock"
                    left.append(commit)
            self.waiting = left
            with suppress(NotFoundError):  # a guest, who has no branch there
                api.put_status(MAP, self.name, RobotStatus(time_s=abs(self.clocks.wall_s)))
            self._clock.learn(api.take_time())
        return len(left)


class World:
    """Two servers, three robots, and time that goes by for all of them."""

    def __init__(self, folder: Path) -> None:
        self.right_s = NOW_S
        self.here, self.there = Base(folder / "here"), Base(folder / "there")
        self.mole, self.wren, self.toad = (Mapper(name, folder / name) for name in ("mole", "wren", "toad"))
        self._steady_s = 0.0
        self._resting = Undelivered(clock_s=lambda: self._steady_s)

    def pass_s(self, seconds: float) -> None:
        self.right_s += seconds
        self._steady_s += seconds
        for one in (self.here, self.there, self.mole, self.wren, self.toad):
            one.clocks.pass_s(seconds)

    def relay(self) -> RelayReport:
        """Rounds of a relay between both servers until nothing moves."""
        with ExitStack() as stack:
            ends = [ServerEnd(stack.enter_context(RelayApi(base.url)), MAP) for base in (self.here, self.there)]
            while True:
                report = hold_between(relay_round(self._resting), *ends)
                assert not report.refused and report.cut is None
                if not any(report.moved.values()):
                    return report

    def check(self) -> None:
        """Whatever a server has is of the time at which it was measured, or of none."""
        taken = self.mole.taken | self.wren.taken | self.toad.taken
        for base in (self.here, self.there):
            for commit, epoch in base.epochs().items():
                assert epoch in (BASE, epoch_of(taken[commit], EPOCH_S))

    def check_all_there(self) -> None:
        """Nothing is lost: both servers have everything in the end."""
        self.pass_s(REST_S + 1)
        for robot, base in ((self.mole, self.here), (self.wren, self.there), (self.toad, self.here)):
            assert robot.sync(base) == 0
        self.relay()
        self.relay()
        self.check()
        taken = self.mole.taken | self.wren.taken | self.toad.taken
        assert self.here.epochs() == self.there.epochs()
        assert set(self.here.epochs()) == set(taken)


@contextmanager
def at_work(folder: Path) -> Iterator[World]:
    """Mole at one server and wren at the other have learnt the time, and measured."""
    world = World(folder)
    try:
        for robot, base in ((world.mole, world.here), (world.wren, world.there)):
            robot.register(base)
        for _ in range(3):
            world.pass_s(203.7)
            for robot, base in ((world.mole, world.here), (world.wren, world.there)):
                robot.measure(world.right_s)
                assert robot.sync(base) == 0
        assert world.relay().is_all_there
        world.check()
        assert BASE not in world.here.epochs().values()
        yield world
    finally:
        world.here.stop()
        world.there.stop()
        for robot in (world.mole, world.wren, world.toad):
            robot.store.close()


@pytest.mark.parametrize("jump_s", [40 * DAY_S, -400 * DAY_S])
def test_forty_days_for_a_minute(jump_s: float, tmp_path: Path) -> None:
    with at_work(tmp_path) as world:
        world.here.clocks.wall_s += jump_s
        world.pass_s(30.0)
        # Who knew the right time before goes on; who comes only now gets none, and measures without.
        world.mole.measure(world.right_s)
        assert world.mole.sync(world.here) == 0
        world.toad.register(world.here)
        assert world.toad.measure(world.right_s).meta.row == BASE
        assert world.toad.sync(world.here) == 0
        # Whose time this server cannot judge waits, whoever brings it.
        late = world.wren.measure(world.right_s)
        assert world.wren.sync(world.here) == 1 and world.wren.sync(world.there) == 0
        world.relay()
        assert late.id not in world.here.epochs() and late.id in world.there.epochs()
        world.check()
        world.here.clocks.wall_s -= jump_s
        world.pass_s(30.0)
        world.toad.sync(world.here)
        assert world.toad.measure(world.right_s).meta.row == epoch_of(world.right_s, EPOCH_S)
        world.check_all_there()


def test_1970_until_the_clock_is_set(tmp_path: Path) -> None:
    with at_work(tmp_path) as world:
        world.here.stop()
        world.here.clocks.reboot(wall_s=12.0)
        world.here.start()
        world.pass_s(300.0)
        world.mole.measure(world.right_s)
        assert world.mole.sync(world.here) == 0, "it registered before"
        world.toad.register(world.here)
        assert world.toad.measure(world.right_s).meta.row == BASE
        late = world.wren.measure(world.right_s)
        assert world.wren.sync(world.there) == 0
        world.relay()
        assert late.id not in world.here.epochs()
        world.check()
        world.here.clocks.wall_s = world.right_s
        world.check_all_there()


def test_a_robots_own_clock_is_never_believed(tmp_path: Path) -> None:
    with at_work(tmp_path) as world:
        for wall_s in (0.0, NOW_S + 40 * DAY_S, NOW_S - 40 * DAY_S, 2e9):
            world.mole.clocks.wall_s = wall_s
            world.pass_s(50.0)
            assert world.mole.measure(world.right_s).meta.row == epoch_of(world.right_s, EPOCH_S)
            assert world.mole.sync(world.here) == 0
        world.check_all_there()


def test_what_a_server_with_a_wrong_clock_let_its_robots_measure_is_taken_nowhere_else(tmp_path: Path) -> None:
    with at_work(tmp_path) as world:
        ahead_s = 40 * DAY_S
        world.there.clocks.wall_s += ahead_s
        world.there.live.service.clock.trust(by="somebody who is wrong")
        world.wren.sync(world.there)
        wrong = world.wren.measure(world.right_s)
        assert wrong.meta.row == epoch_of(world.right_s + ahead_s, EPOCH_S)
        assert world.wren.sync(world.there) == 0
        world.relay()
        assert wrong.id not in world.here.epochs()
        # Its time comes; and until then it holds nothing up.
        world.mole.measure(world.right_s)
        assert world.mole.sync(world.here) == 0
        world.relay()
        assert set(world.mole.taken) <= set(world.there.epochs())
        world.pass_s(ahead_s)
        world.relay()
        world.relay()
        assert world.here.epochs() == world.there.epochs() and wrong.id in world.here.epochs()
