"""One seed's history, and what must hold during and after it."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from random import Random

import pytest
from tests.fixtures.client.made import MAP, cells_of
from tests.memory_store import map as memory_map
from tests.sync_sim.events import Events
from tests.sync_sim.joined import JoinedHistory, any_epoch, layer_of
from tests.sync_sim.layers import log_of
from tests.sync_sim.marks import (
    MarkFollower,
    any_marks,
    has_marks,
    mark_as_operator,
    marks_by_definition,
    marks_of,
)
from tests.sync_sim.network import Network, Weather
from tests.sync_sim.robot import SimRobot
from tests.sync_sim.server import FoldOnRequest, SimServer, with_more

from cairn_client.replica.server_cells import ServerCells
from cairn_client.sync.exchange import MISFIT, Exchange
from cairn_map.commits import ids
from cairn_map.commits.ids import OPERATOR, CommitId
from cairn_map.commits.mark import Mark
from cairn_map.epochs.cell_history import history_fingerprint
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import CellKey
from cairn_server import service as service_module
from cairn_server.folding import commit_work

MODES = ("high-end", "high-end", "low-end", "viewer", "high-end")
LENGTH_S = 120.0
STEPS_MAX = 50
FINAL_ROUNDS = 6
JOINED_EVERY = 4
"""Every so many seeds there are several servers, relays between them, and robots that come from one to another."""

OFTEN = ("commit", "commit", "commit", "sync", "sync", "sync", "sync", "fold", "fold")
SELDOM = (
    "amend",
    "retract",
    "weather",
    "partition",
    "back_up",
    "restore",
    "replace",
    "restart_server",
    "restart_robot",
    "save_disk",
    "roll_back_disk",
    "lose_disk",
    "forget_evidence",
    "drop_cells",
    "clock",
    "admit",
)

Log = Callable[[str], None]


class History:
    """What happens in one seed."""

    def __init__(self, seed: int, log: Log) -> None:
        self._random = Random(seed)
        self._more = Random(f"{seed} more")
        self._log = log
        self._notes = 0
        self._has_marks = has_marks(seed)
        self._follower = MarkFollower()
        self.clock_s = 1.7e9
        """What clocks are ahead of virtual time."""
        self._events = Events()
        self._layer = layer_of(seed)
        self._server = SimServer(self._layer, name=log_of(seed))
        self._network = Network(self._events, self._server, self._random)
        count = self._random.randint(2, len(MODES))
        self._robots = [SimRobot(f"r{n}", MODES[n], self._network.ask, of=self._server) for n in range(count)]
        self._mappers = [robot for robot in self._robots if robot.mode != "viewer"]
        self.may_misfit = False
        """Fingerprints may be the first to notice: bytes were damaged on their way, or a disk was rolled back, and its
        numbers name others' bytes."""
        self._weather()

    def time_s(self) -> float:
        """What clocks say."""
        return self.clock_s + self._events.now_s

    def run(self) -> None:
        """Let it happen, and check.

        Raises:
            AssertionError: something does not hold.
        """
        for _ in range(self._random.randint(1, STEPS_MAX)):
            name = self._random.choice(OFTEN if self._random.random() < 0.7 else SELDOM)
            self._events.after(self._random.random() * LENGTH_S, lambda name=name: self._step(name))  # type: ignore[misc]
        self._events.run(until_s=LENGTH_S)
        self._settle()

    def close(self) -> None:
        """End what it started."""
        for robot in self._robots:
            robot.replica.close()
        self._server.close()

    def _step(self, name: str) -> None:
        self._log(f"{self._events.now_s:6.1f} s  {name}")
        getattr(self, f"_{name}")()
        if self._has_marks:
            self._mark()
        self._check_bases()
        self._more.choice(self._robots).check_view()

    # What can happen

    def _commit(self) -> None:
        self._mapper().commit(
            self._random.randrange(60), note=self._note(), epoch=self._epoch(), marks=self._some_marks()
        )

    def _amend(self) -> None:
        robot = self._mapper()
        own = [commit for commit in robot.notes() if commit.author.robot == robot.name]
        if own:
            taken_back = with_more(str(self._random.choice(own)), map(str, own), self._more)
            seed, note, epoch = self._random.randrange(60), self._note(), self._epoch()
            robot.commit(seed, note=note, retracts=taken_back, epoch=epoch, marks=self._some_marks())

    def _sync(self) -> None:
        robot = self._random.choice(self._robots)
        robot.start_round()
        if self._random.random() < 0.3:
            self._events.after(self._random.random() * self._network.weather.delay_s, robot.start_round)

    def _fold(self) -> None:
        self._server.fold(self._random.randint(1, 5))

    def _retract(self) -> None:
        held = {commit for robot in self._robots for commit in robot.notes()}
        targets = sorted(str(c) for c in held | self._server.commits().keys() if c.author.robot != OPERATOR)
        if targets:
            self._server.retract(with_more(self._random.choice(targets), targets, self._more))

    def _weather(self) -> None:
        share = self._random.choice((0.0, 0.05, 0.3))
        self._network.weather = Weather(
            lost=share * self._random.random(),
            doubled=share * self._random.random(),
            cut=2 * share * self._random.random(),
            damaged=share * self._random.random(),
            delay_s=self._random.choice((0.1, 2.0, 7.0)),
        )
        self.may_misfit |= self._network.weather.damaged > 0

    def _partition(self) -> None:
        self._network.offline = {robot.name for robot in self._robots if self._random.random() < 0.3}

    def _back_up(self) -> None:
        self._server.back_up()

    def _restore(self) -> None:
        self._random.choice((self._server.restore, self._server.restore_under_readers))()

    def _replace(self) -> None:
        self._server.replace()

    def _restart_server(self) -> None:
        self._server.restart()

    def _restart_robot(self) -> None:
        self._random.choice(self._robots).restart()

    def _save_disk(self) -> None:
        self._random.choice(self._robots).save_disk()

    def _roll_back_disk(self) -> None:
        self.may_misfit = True
        self._random.choice(self._robots).roll_back_disk()

    def _lose_disk(self) -> None:
        self._random.choice(self._robots).lose_disk()

    def _forget_evidence(self) -> None:
        self._server.forget_evidence()

    def _drop_cells(self) -> None:
        """A robot has no room for some cells of the server any more."""
        replica = self._random.choice(self._robots).replica
        replica.drop_cells([key for key in replica.cells if self._random.random() < 0.5])

    def _clock(self) -> None:
        """Somebody sets all clocks to another time."""
        self.clock_s += self._random.uniform(-1e7, 1e7)

    def _admit(self) -> None:
        """An operator lets in the robots that lost their disks, some time after they came with another key."""
        self._server.admit_all()

    def _mark(self) -> None:
        """An operator marks, and a client that follows the marks asks what is new."""
        if self._more.random() < 0.2:
            mark_as_operator(self._server, self._more)
        if self._more.random() < 0.5:
            self._follower.follow(self._server, self._more)

    # What must hold

    def _check_bases(self) -> None:
        """Each base is the server's cell at its cursor, and what is on the disk has its fingerprint."""
        for robot in self._robots:
            for key, cell in robot.replica.cells.items():
                history = robot.replica.base_history(key)
                assert history_fingerprint(history, key, layer_word=self._layer.word) == cell.fingerprint
                if cell.cursor is not None:
                    state = self._server.states[cell.cursor]
                    assert cell.fingerprint.hex() == state.get(key, ZERO.hex())

    def _settle(self) -> None:
        """With good links all maps are soon equal, equal to the sum of all commits, and no commit is lost."""
        # An answer of a server that was replaced may still be on its way, and call stable what that one's backup had.
        for robot in self._robots:
            self._finish(robot)
        held = self._all_notes()
        sealed = {target for robot in self._robots for target in self._kept_retracts(robot)}
        self._network.weather = Weather()
        self._network.offline = set()
        for _ in range(FINAL_ROUNDS):
            for robot in self._robots:
                robot.start_round()
                self._finish(robot)
            self._server.admit_all()
            self._server.fold_all()
            self._check_bases()
        assert self._all_notes() >= held, "a commit is lost"
        assert all(self._server.is_retracted(target) for target in sealed), "what an operator took out is back"
        expected = cells_of(self._server.sum_of_commits())
        assert self._server.cells() == expected, "the server's map is not the sum of its commits"
        marks = marks_by_definition(self._server)
        if self._server.name == MAP:  # layers have none
            assert marks_of(self._server) == marks, "the server lists other marks than its commits brought"
            assert self._follower.followed(self._server) == marks, "who follows the marks has others"
        for robot in self._robots:
            assert cells_of(robot.replica.view) == expected, f"{robot.name} has another map than the server"
            assert not robot.replica.push_set(), f"{robot.name} has commits that the server did not take"
        self._log(f"settled with {len(held)} commits in {len(expected)} cells at {self._server.cursor}")

    def _finish(self, robot: SimRobot) -> None:
        self._events.run_while(lambda: robot.is_busy)

    def _all_notes(self) -> set[str]:
        """Notes of the commits that anybody has."""
        notes = set(self._server.commits().values())
        for robot in self._robots:
            notes |= set(robot.notes().values())
        return notes - {""}

    def _kept_retracts(self, robot: SimRobot) -> Iterator[CommitId]:
        """What the operator's retracts name that a robot keeps; another server would not know their seal."""
        header = robot.replica.header
        is_same_server = header is not None and header.to_cursor.log_id == self._server.cursor.log_id
        for commit in robot.replica.commits:
            if is_same_server and commit.author.robot == OPERATOR:
                kept = robot.replica.kept_commit(commit)
                assert kept is not None
                yield from kept.meta.retracted_ids

    def _mapper(self) -> SimRobot:
        return self._random.choice(self._mappers)

    def _some_marks(self) -> tuple[Mark, ...]:
        return any_marks(self._more) if self._has_marks else ()

    def _epoch(self) -> Epoch | None:
        return any_epoch(self._layer, self._more, self.time_s())

    def _note(self) -> str:
        self._notes += 1
        return f"{self._notes}"


def run_seed(seed: int, log: Log = lambda text: None) -> None:
    """One history from its seed alone.

    Raises:
        AssertionError: something does not hold.
    """
    history: History | JoinedHistory | None = None
    with _seeded(seed) as patch:
        misfits = _misfits(patch)
        try:
            history = JoinedHistory(seed, log) if seed % JOINED_EVERY == JOINED_EVERY - 1 else History(seed, log)
            patch.setattr(time, "time", history.time_s)
            history.run()
            if isinstance(history, History):
                assert history.may_misfit or not misfits, "only fingerprints kept a frame from the wrong cell"
        finally:
            if history is not None:
                history.close()


def failures(seeds: range) -> list[tuple[int, str]]:
    """The seeds that went wrong, and why."""
    found = []
    for seed in seeds:
        try:
            run_seed(seed)
        except Exception as exc:  # noqa: BLE001 - whatever it is, the seed is wanted
            found.append((seed, f"{type(exc).__name__}: {str(exc).splitlines()[0] if str(exc) else ''}"))
    return found


def _misfits(patch: pytest.MonkeyPatch) -> list[CellKey]:
    """The cells, as time goes on, whose frames only the fingerprint keeps from being applied."""
    found: list[CellKey] = []
    ask_whole = Exchange._ask_whole

    def heard(exchange: Exchange, base: ServerCells, key: CellKey, why: str) -> None:
        if why == MISFIT:
            found.append(key)
        ask_whole(exchange, base, key, why)

    patch.setattr(Exchange, "_ask_whole", heard)
    return found


@contextmanager
def _seeded(seed: int) -> Iterator[pytest.MonkeyPatch]:
    """Random numbers of the program itself from the seed, and no folding thread."""
    random = Random(~seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ids.secrets, "token_hex", lambda size: random.randbytes(size).hex())
        patch.setattr(memory_map.secrets, "token_bytes", random.randbytes)
        patch.setattr(service_module, "FoldThread", FoldOnRequest)
        # What a commit takes out is taken out one by one, and anything may happen in between.
        patch.setattr(commit_work, "PART_NAMES_MAX", 1)
        yield patch
