"""Any history of requests and restarts: after every step the server answers as a few dictionaries do."""

import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from tests.fixtures.map.made import PLAIN, SMALL
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read
from tests.fixtures.server.store_contract import Model
from tests.naive.asker import NaiveAsker

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import OPERATOR, Author, CommitId, Incarnation
from cairn_map.commits.version_vector import EMPTY
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.frames import frames_of
from cairn_map.wire.messages import CellIndex, CreateMap, MapInfo, Register, Retract
from cairn_server.store.store_rows import MapRow

REBORN = Author(MOLE.robot, Incarnation("00000000000000bb"))
AUTHORS = (MOLE, WREN, REBORN)
NAMES = ("lab", "yard")
names = st.sampled_from(NAMES)
authors = st.sampled_from(AUTHORS)
robots = st.sampled_from(["mole", "wren", "newt"])
numbers = st.integers(0, 30)


@dataclass
class MapModel:
    """A map: what came, who is registered, and what askers hold of it."""

    operator: Author | None
    """Author of operators' retracts; None: the map has another grid, and no robot pushes to it."""
    commits: Model = field(default_factory=Model)
    branches: dict[str, str] = field(default_factory=dict)
    askers: dict[Author, NaiveAsker] = field(default_factory=dict)

    @property
    def ids(self) -> list[CommitId]:
        """Ids of robots' commits."""
        return [commit.id for commit in self.commits.arrived if commit.id.author.robot != OPERATOR]

    def next_n(self, author: Author) -> int:
        """The number after an author's highest."""
        return max((c.id.n + 1 for c in self.commits.arrived if c.id.author == author), default=0)


class AnyHistory(RuleBasedStateMachine):
    """Requests through a socket, and the same on dictionaries."""

    @initialize()
    def start(self) -> None:
        self.folder = Path(tempfile.mkdtemp())
        self.maps: dict[str, MapModel] = {}
        self.changed: set[str] = set()
        self.live = Live(self.folder)
        self.create("lab", other=False)

    def teardown(self) -> None:
        if hasattr(self, "live"):
            self.live.__exit__(None, None, None)
            shutil.rmtree(self.folder)

    # What can be asked for

    @rule(name=names, other=st.booleans())
    def create(self, name: str, other: bool) -> None:
        geometry = PLAIN if other else SMALL
        answer = self.live.http.put(f"/maps/{name}", json=CreateMap(geometry=geometry).model_dump())
        known = self.maps.get(name)
        if known is None:
            assert answer.status_code == 201
            operator = None if other else Author(OPERATOR, self.live.service.sync.retracts.commits.operator)
            self.maps[name] = MapModel(operator)
            self.changed.add(name)
        elif other == (known.operator is None):
            assert answer.status_code == 200
        else:
            assert (answer.status_code, kind_of(answer)) == (409, "map_exists")

    @rule(name=names, author=authors, seed=numbers, ahead=st.sampled_from([0, 0, 0, 0, 3]), which=st.lists(numbers))
    def push(self, name: str, author: Author, seed: int, ahead: int, which: list[int]) -> None:
        if self.is_ours(name):
            known = self.maps[name]
            n = known.next_n(author) + ahead
            named = sorted({known.ids[t % len(known.ids)] for t in which[:2]} if known.ids else set())
            self.offer(name, pushed(n, seed, author, retracts=[_Named(i) for i in named]), 201)  # type: ignore[misc]

    @rule(name=names, author=authors, seed=numbers)
    def push_a_retract_of_what_never_came_yet(self, name: str, author: Author, seed: int) -> None:
        if self.is_ours(name):
            n = self.maps[name].next_n(author)
            later = _Named(CommitId(author, n + 1 + seed % 3))
            self.offer(name, pushed(n, seed, author, cells={}, retracts=[later]), 201)  # type: ignore[list-item]

    @rule(name=names, which=numbers)
    def push_again(self, name: str, which: int) -> None:
        if self.is_ours(name) and self.maps[name].ids:
            arrived = [c for c in self.maps[name].commits.arrived if c.id.author.robot != OPERATOR]
            self.offer(name, arrived[which % len(arrived)], 200)

    @rule(name=names, which=numbers)
    def push_other_bytes(self, name: str, which: int) -> None:
        if self.is_ours(name) and self.maps[name].ids:
            taken = self.maps[name].ids[which % len(self.maps[name].ids)]
            answer = self.live.push(self.row(name), pushed(taken.n, 77, taken.author))
            assert (answer.status_code, kind_of(answer)) == (409, "id_taken")

    @rule(name=names, which=st.lists(numbers, min_size=1, max_size=3))
    def retract(self, name: str, which: list[int]) -> None:
        if self.is_ours(name) and self.maps[name].ids:
            known = self.maps[name]
            targets = list(dict.fromkeys(known.ids[w % len(known.ids)] for w in which))
            self.take_out(name, Retract(commits=[str(target) for target in targets]), targets)

    @rule(name=names, robot=robots)
    def retract_a_robot(self, name: str, robot: str) -> None:
        if self.is_ours(name):
            self.live.folded(self.row(name))
            model = self.maps[name].commits
            model.fold(1000)
            mine = [c.id for c in model.arrived if c.id.author.robot == robot and c.cells and c.id not in model.named]
            self.take_out(name, Retract(robot=robot), mine)

    @rule(name=names, robot=robots, mode=st.sampled_from(["high-end", "low-end", "viewer"]))
    def register(self, name: str, robot: str, mode: str) -> None:
        body = Register(robot=robot, mode=mode, incarnation="0" * 16).model_dump()  # type: ignore[arg-type]
        answer = self.live.http.post(f"/maps/{name}/branches", json=body)
        assert answer.status_code == (201 if name in self.maps else 404)
        if name in self.maps:
            self.maps[name].branches[robot] = mode

    @rule(name=names, robot=robots)
    def deregister(self, name: str, robot: str) -> None:
        answer = self.live.http.delete(f"/maps/{name}/branches/{robot}")
        is_there = name in self.maps and self.maps[name].branches.pop(robot, None) is not None
        assert answer.status_code == (204 if is_there else 404)

    @rule(name=names, author=authors)
    def fetch(self, name: str, author: Author) -> None:
        if self.is_ours(name):
            known = self.maps[name]
            asker = known.askers.setdefault(author, NaiveAsker(author))
            asker.own = {c.id.n: c for c in known.commits.arrived if c.id.author == author}
            self.live.folded(self.row(name))
            known.commits.fold(1000)
            assert asker.take(frames_of(self.ask(name, asker).content))
            assert asker.map() == known.commits.cells()

    @precondition(lambda self: hasattr(self, "live"))
    @rule(seeds=st.lists(numbers, max_size=3))
    def push_and_restart_at_once(self, seeds: list[int]) -> None:
        for seed in seeds:
            self.push("lab", MOLE, seed, 0, [])
        self.live.__exit__(None, None, None)
        self.live = Live(self.folder)
        self.changed |= self.maps.keys()

    # What must hold

    @invariant()
    def the_server_says_what_the_model_says(self) -> None:
        for name in sorted(self.changed):
            if self.is_ours(name):
                self.compare(name)
        for name, known in self.maps.items():
            found = self.live.http.get(f"/maps/{name}/branches").json()
            assert {branch["branch"]: branch["mode"] for branch in found} == known.branches
        self.changed.clear()

    def compare(self, name: str) -> None:
        self.live.folded(self.row(name))
        model = self.maps[name].commits
        model.fold(1000)
        http = self.live.http
        log = http.get(f"/maps/{name}/log", params={"limit": 1000}).json()
        assert [(entry["kind"], entry["id"]) for entry in log] == [(kind, str(id_)) for kind, id_ in model.log]
        index = CellIndex.model_validate_json(http.get(f"/maps/{name}/main/cells").content)
        assert index.header.coverage == EMPTY.with_commits(commit.id for commit in model.folded)
        touched = sorted({key for commit in model.folded for key in commit.cells})
        assert [entry.cell for entry in index.cells] == [cell_of_key(key) for key in touched]
        bodies: dict[int, bytes] = {key: http.get(f"/maps/{name}/main/cells/{_text(key)}").content for key in touched}
        cells = model.cells()
        assert {key: evidence for key, evidence in read(bodies).items() if evidence} == cells
        info = MapInfo.model_validate_json(http.get(f"/maps/{name}").content)
        assert (info.cells, info.commits, info.cursor) == (len(cells), len(model.arrived), index.header.to)
        stranger = NaiveAsker(None)
        assert stranger.take(frames_of(self.ask(name, stranger).content))
        assert stranger.map() == cells

    # How it is asked for

    def is_ours(self, name: str) -> bool:
        """True if there is a map of that name that commits fit to."""
        return name in self.maps and self.maps[name].operator is not None

    def row(self, name: str) -> MapRow:
        return self.live.service.store.map(name)

    def ask(self, name: str, asker: NaiveAsker) -> httpx.Response:
        answer = self.live.http.post(f"/maps/{name}/branches/any/missing", json=asker.request().model_dump())
        assert answer.status_code == 200, answer.text
        return answer

    def offer(self, name: str, commit: Commit, status: int) -> None:
        answer = self.live.push(self.row(name), commit)
        assert answer.status_code == status, answer.text
        assert self.maps[name].commits.append(commit) == (status == 201)
        self.changed.add(name)

    def take_out(self, name: str, request: Retract, targets: list[CommitId]) -> None:
        answer = self.live.http.post(f"/maps/{name}/retracts", json=request.model_dump())
        if not targets:
            assert (answer.status_code, kind_of(answer)) == (404, "nothing_to_retract")
            return
        assert answer.status_code == 201, answer.text
        assert answer.json()["commits"] == [str(target) for target in targets]
        known = self.maps[name]
        # Another one after each start.
        known.operator = Author(OPERATOR, self.live.service.sync.retracts.commits.operator)
        n = known.next_n(known.operator)
        assert answer.json()["id"] == str(CommitId(known.operator, n))
        named = [_Named(target) for target in targets]
        known.commits.append(pushed(n, 0, known.operator, cells={}, retracts=named))  # type: ignore[arg-type]
        self.changed.add(name)


@dataclass(frozen=True)
class _Named:
    """As much of a commit as a retract of it says."""

    id: CommitId


def _text(key: CellKey) -> str:
    return ",".join(map(str, cell_of_key(key)))


TestAnyHistory = pytest.mark.slow(AnyHistory.TestCase)
TestAnyHistory.settings = settings(
    max_examples=8,
    stateful_step_count=20,
    phases=[Phase.generate],  # making a failure smaller would take minutes of starting servers
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
