"""A seed's history with a base, field servers joined to it, relays in circles, and robots that go from one to another.

Robots carry others' commits, and hand them to each other where they meet. In the end all servers must have the same
map, byte for byte, with nothing lost, whatever way everything went.
"""

from collections.abc import Callable
from random import Random

from tests.fixtures.client.made import MAP, PLAIN, WITH_EPOCHS, cells_of
from tests.sync_sim.events import Events
from tests.sync_sim.layers import add_layer, has_layers, layers_by_definition, layers_of, log_of
from tests.sync_sim.marks import (
    MarkFollower,
    any_marks,
    has_marks,
    mark_as_operator,
    marks_by_definition,
    marks_of,
)
from tests.sync_sim.network import Network, Weather
from tests.sync_sim.relay import Bag, SimEnd, SimRelay
from tests.sync_sim.robot import SimRobot
from tests.sync_sim.server import SimServer, with_more

from cairn_client.sync.requests import Ask
from cairn_map.commits.ids import OPERATOR, CommitId
from cairn_map.commits.mark import Mark
from cairn_map.epochs.cell_history import history_fingerprint
from cairn_map.epochs.epoch import Epoch, epoch_of
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.fingerprint import ZERO
from cairn_server.sync.handing_over import server_key

MODES = ("high-end", "low-end", "high-end", "viewer")
LENGTH_S = 120.0
STEPS_MAX = 50
FINAL_ROUNDS = 8

OFTEN = ("commit", "commit", "commit", "sync", "sync", "sync", "fold", "fold")
RELAYED = ("hand_over", "hand_over", "hand_over", "carry")
SELDOM = (
    "amend",
    "retract",
    "weather",
    "partition",
    "move",
    "move",
    "move",
    "meet",
    "back_up",
    "restore",
    "replace",
    "restart_server",
    "restart_robot",
    "save_disk",
    "roll_back_disk",
    "lose_disk",
    "level_and_forget",
    "admit",
)


def layer_of(seed: int) -> MapLayer:
    """Of every other four seeds a map with epochs: of both kinds of history."""
    return WITH_EPOCHS if seed % 8 >= 4 else PLAIN


def any_epoch(layer: MapLayer, random: Random, now_s: float) -> Epoch | None:
    """Epoch of a commit: the present one for its author's clock, which may be one off; now and then one long past."""
    if layer.epoch_s is None or random.random() < 0.1:
        return None
    late = random.randrange(8) if random.random() < 0.3 else 0
    return Epoch(epoch_of(now_s, layer.epoch_s) + random.choice((-1, 0, 0, 1)) - late)


class JoinedHistory:
    """What happens in one seed."""

    def __init__(self, seed: int, log: Callable[[str], None]) -> None:
        self._random = Random(seed)
        self._more = Random(f"{seed} more")
        self._log = log
        self._notes = 0
        self._has_marks = has_marks(seed)
        self._has_layers = has_layers(seed)
        self._follower = MarkFollower()
        self._has_forgotten = False
        self._keys: dict[str, None] = {}
        self._events = Events()
        self._weather_now = Weather()
        self._layer = layer_of(seed)
        self._servers = [SimServer(self._layer, name=log_of(seed)) for _ in range(self._random.randint(2, 3))]
        self._share_states()
        self._trust()
        self._networks = [Network(self._events, server, self._random) for server in self._servers]
        count = self._random.randint(2, len(MODES))
        self._robots = [SimRobot(f"r{n}", MODES[n], self._ask, of=self._servers[0]) for n in range(count)]
        self._places = {robot.name: self._random.randrange(len(self._servers)) for robot in self._robots}
        self._bags = {robot.name: Bag() for robot in self._robots}
        ends = [SimEnd(server) for server in self._servers]
        # The base is the first; one field server has the other, or the base, for another upstream, in a circle.
        pairs = [(n, 0) for n in range(1, len(ends))] + [(0, 1), (len(ends) - 1, 1)]
        self._relays = [self._relay(ends[a], ends[b]) for a, b in pairs if a != b]
        self._carriers = {
            (robot.name, n): self._relay(self._bags[robot.name], end)
            for robot in self._robots
            for n, end in enumerate(ends)
        }
        self._mappers = [robot for robot in self._robots if robot.mode != "viewer"]
        self._weather()

    def time_s(self) -> float:
        """What clocks say."""
        return 1.7e9 + self._events.now_s

    def run(self) -> None:
        """Let it happen, and check.

        Raises:
            AssertionError: something does not hold.
        """
        for _ in range(self._random.randint(1, STEPS_MAX)):
            name = self._random.choice((OFTEN, OFTEN, RELAYED, SELDOM)[self._random.randrange(4)])
            self._events.after(self._random.random() * LENGTH_S, lambda name=name: self._step(name))  # type: ignore[misc]
        self._events.run(until_s=LENGTH_S)
        self._settle()

    def close(self) -> None:
        """End what it started."""
        for robot in self._robots:
            robot.replica.close()
        for server in self._servers:
            server.close()

    def _step(self, name: str) -> None:
        self._log(f"{self._events.now_s:6.1f} s  {name}")
        getattr(self, f"_{name}")()
        if self._has_marks:
            self._mark()
        if self._has_layers and self._more.random() < 0.2:
            add_layer(self._more.choice(self._servers), self._more)
        self._check_bases()
        self._more.choice(self._robots).check_view()

    # What can happen

    def _commit(self) -> None:
        robot, seed = self._random.choice(self._mappers), self._random.randrange(60)
        robot.commit(seed, note=self._note(), epoch=self._epoch(), marks=self._some_marks())

    def _amend(self) -> None:
        robot = self._random.choice(self._mappers)
        own = [commit for commit in robot.notes() if commit.author.robot == robot.name]
        if own:
            taken_back = with_more(str(self._random.choice(own)), map(str, own), self._more)
            seed, note, epoch = self._random.randrange(60), self._note(), self._epoch()
            robot.commit(seed, note=note, retracts=taken_back, epoch=epoch, marks=self._some_marks())

    def _sync(self) -> None:
        self._random.choice(self._robots).start_round()

    def _hand_over(self) -> None:
        self._random.choice(self._relays).start()

    def _fold(self) -> None:
        self._random.choice(self._servers).fold(self._random.randint(1, 5))

    def _carry(self) -> None:
        name = self._random.choice(self._robots).name
        self._carriers[name, self._places[name]].start()

    def _meet(self) -> None:
        """Two robots hand over what they carry; it is a moment."""
        one, two = self._random.sample(self._robots, 2)
        meeting = self._relay(self._bags[one.name], self._bags[two.name])
        meeting.start()

    def _move(self) -> None:
        """A robot goes to another server, and its round breaks off."""
        robot = self._random.choice(self._robots)
        robot.stop()
        self._carriers[robot.name, self._places[robot.name]].stop()
        self._places[robot.name] = self._random.randrange(len(self._servers))

    def _retract(self) -> None:
        held = {commit for robot in self._robots for commit in robot.notes()}
        held |= {commit for server in self._servers for commit in server.commits()}
        targets = sorted(str(commit) for commit in held if commit.author.robot != OPERATOR)
        if targets:
            server = self._random.choice(self._servers)
            server.retract(with_more(self._random.choice(targets), targets, self._more))

    def _weather(self) -> None:
        share = self._random.choice((0.0, 0.05, 0.3))
        self._set_weather(
            Weather(
                lost=share * self._random.random(),
                doubled=share * self._random.random(),
                cut=2 * share * self._random.random(),
                damaged=share * self._random.random(),
                delay_s=self._random.choice((0.1, 2.0, 7.0)),
            )
        )

    def _partition(self) -> None:
        offline = {robot.name for robot in self._robots if self._random.random() < 0.3}
        for network in self._networks:
            network.offline = offline

    def _back_up(self) -> None:
        self._random.choice(self._servers).back_up()

    def _restore(self) -> None:
        server = self._random.choice(self._servers)
        self._random.choice((server.restore, server.restore_under_readers))()

    def _replace(self) -> None:
        """Another server in the place of one: empty, or, where evidence is not kept for ever, from a copy."""
        one, other = self._random.sample(self._servers, 2)
        if self._has_forgotten:
            one.copy_of(other)
        else:
            one.replace()
            self._share_states()
        self._trust()

    def _restart_server(self) -> None:
        self._random.choice(self._servers).restart()

    def _restart_robot(self) -> None:
        self._random.choice(self._robots).restart()

    def _save_disk(self) -> None:
        self._random.choice(self._robots).save_disk()

    def _roll_back_disk(self) -> None:
        self._random.choice(self._robots).roll_back_disk()

    def _lose_disk(self) -> None:
        robot = self._random.choice(self._robots)
        robot.lose_disk()
        self._bags[robot.name].commits.clear()

    def _level_and_forget(self) -> None:
        """All servers have the same commits, in backups, too; then some forget their evidence."""
        for _ in range(len(self._servers)):
            self._level()
        vectors = [end.held().vector for end in map(SimEnd, self._servers)]
        if any(vector != vectors[0] for vector in vectors):
            return
        for server in self._servers:
            server.back_up()
        self._has_forgotten = True
        for server in self._servers:
            if self._random.random() < 0.5:
                server.forget_evidence()

    def _admit(self) -> None:
        """An operator of one server lets in the robots that came to it with another key."""
        self._random.choice(self._servers).admit_all()

    def _mark(self) -> None:
        """An operator of some server marks, and a client that follows the marks of any server asks what is new."""
        if self._more.random() < 0.2:
            mark_as_operator(self._more.choice(self._servers), self._more)
        if self._more.random() < 0.5:
            self._follower.follow(self._more.choice(self._servers), self._more)

    # What must hold

    def _check_bases(self) -> None:
        """Each base is some server's cell at its cursor, and what is on the disk has its fingerprint."""
        for robot in self._robots:
            for key, cell in robot.replica.cells.items():
                history = robot.replica.base_history(key)
                assert history_fingerprint(history, key, layer_word=self._layer.word) == cell.fingerprint
                if cell.cursor is not None:
                    state = self._servers[0].states[cell.cursor]
                    assert cell.fingerprint.hex() == state.get(key, ZERO.hex())

    def _settle(self) -> None:
        """With good links all maps are soon equal, equal to the sum of all commits, and no commit is lost."""
        for relay in (*self._relays, *self._carriers.values()):
            relay.stop()
        for robot in self._robots:
            self._finish(robot)
        held = self._all_notes()
        self._set_weather(Weather())
        for network in self._networks:
            network.offline = set()
        taken_out = {target for server in self._servers for target in server.retracted()}
        self._rounds()
        split = self._split_ids()
        if split:  # what the relays complain of, and what they advise
            reports = [relay.report for relay in self._relays if relay.report]
            named = {author for report in reports for author in report.split}
            assert named >= {commit.author for commit in split}, "a relay did not notice other bytes under one id"
            self._log(f"other bytes under the same ids: {sorted(map(str, split))}")
            held -= {server.commits()[commit] for server in self._servers for commit in split}
            for commit in split:
                self._servers[0].retract([str(commit)])
            self._rounds()
        assert self._all_notes() >= held, "a commit is lost"
        assert all(server.is_retracted(target) for server in self._servers for target in taken_out)
        expected = cells_of(self._servers[0].sum_of_commits())
        for n, server in enumerate(self._servers):
            assert server.cells() == expected, f"server {n} has another map than the sum of commits"
            if server.name != MAP:  # marks and layers are the map's
                continue
            marks = marks_by_definition(server)
            assert marks_of(server) == marks == marks_of(self._servers[0]), f"server {n} has other marks"
            assert self._follower.followed(server) == marks, "who follows the marks has others"
            layers = layers_by_definition(server)
            assert layers_of(server) == layers == layers_of(self._servers[0]), f"server {n} has other layers"
        for robot in self._robots:
            assert cells_of(robot.replica.view) == expected, f"{robot.name} has another map than the servers"
        self._log(f"settled with {len(held)} commits in {len(expected)} cells")

    def _rounds(self) -> None:
        for _ in range(FINAL_ROUNDS):
            for robot in self._robots:
                robot.start_round()
                self._finish(robot)
            for server in self._servers:
                server.admit_all()
            self._level()
            self._check_bases()
        reports = [relay.report for relay in self._relays if relay.report is not None]
        assert len(reports) == len(self._relays)
        for report in reports:
            assert not (report.refused or report.kept_back or report.cut or any(report.moved.values()))

    def _level(self) -> None:
        """Every relay once with good links, everything folded."""
        weather = self._weather_now
        self._set_weather(Weather())
        for relay in self._relays:
            relay.stop()
            relay.start()
            self._events.run_while(lambda relay=relay: relay.is_busy)  # type: ignore[misc]
            for server in self._servers:
                server.fold_all()
        self._set_weather(weather)

    def _split_ids(self) -> set[CommitId]:
        """Ids under which servers have other commits."""
        shas: dict[CommitId, set[str]] = {}
        for server in self._servers:
            for commit, sha in server.shas().items():
                shas.setdefault(commit, set()).add(sha)
        return {commit for commit, found in shas.items() if len(found) > 1}

    def _all_notes(self) -> set[str]:
        """Notes of the commits that any server or robot has."""
        notes = {note for server in self._servers for note in server.commits().values()}
        for robot in self._robots:
            notes |= set(robot.notes().values())
        return notes - {""}

    def _ask(self, robot: SimRobot, number: int, ask: Ask[object]) -> None:
        self._networks[self._places[robot.name]].ask(robot, number, ask)

    def _relay(self, here: object, there: object) -> SimRelay:
        return SimRelay(self._events, self._random, lambda: self._weather_now, here, there)  # type: ignore[arg-type]

    def _set_weather(self, weather: Weather) -> None:
        self._weather_now = weather
        for network in self._networks:
            network.weather = weather

    def _share_states(self) -> None:
        """A cursor says which history it is of, so that all servers' states are in one book."""
        states = {cursor: state for server in self._servers for cursor, state in server.states.items()}
        for server in self._servers:
            server.states = states

    def _trust(self) -> None:
        """All servers obey all operators."""
        self._keys |= dict.fromkeys(server_key(server.row).public_key.hex() for server in self._servers)
        for server in self._servers:
            server.trust(" ".join(self._keys))

    def _finish(self, robot: SimRobot) -> None:
        self._events.run_while(lambda: robot.is_busy)

    def _some_marks(self) -> tuple[Mark, ...]:
        return any_marks(self._more) if self._has_marks else ()

    def _epoch(self) -> Epoch | None:
        return any_epoch(self._layer, self._more, self.time_s())

    def _note(self) -> str:
        self._notes += 1
        return f"{self._notes}"
