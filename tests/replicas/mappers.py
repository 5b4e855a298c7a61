"""Robots that map: each with a replica of the map on its disk, and each round with a random server of a site.

They note what no history of the servers may cause: a frame that only its fingerprint shows to be wrong (SYNC.md rule
15), a commit that is refused, and what is older than the state they have.
"""

import logging
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fixtures.client.made import GEOMETRY, PLAIN, cells_of, random_diff

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.sync import exchange
from cairn_client.sync.requests import Ask, GetMissing
from cairn_client.sync.sync import fetch_cells, fetch_missing, push_commits
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId, RobotName
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.errors import CairnError, ConflictError, UnreachableError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_map.wire.messages import ReplyHeader

PAUSE_S = 0.05
COMMIT_SHARE = 0.6
"""Share of the rounds before which a robot commits something."""
RETRACT_SHARE = 0.05
SETTLE_S = 60.0
"""Time in which all robots and the server come to one map."""
LOG_PAGE = 1000
ODD_END = "do not add up"
"""What a replica says where a reply's end does not fit (SYNC.md rule 8): it holds a cell that only a lost history had,
under a cursor that is not listed cell by cell. It then compares all fingerprints."""
Digests = dict[CellKey, str]


@dataclass(slots=True)
class Team:
    """What the robots of one map know together."""

    diffs: dict[CommitId, dict[CellKey, Evidence]] = field(default_factory=dict)
    """Evidence of each commit made."""
    retracted: set[CommitId] = field(default_factory=set)
    acked: set[CommitId] = field(default_factory=set)
    answers: Counter[str] = field(default_factory=Counter)
    """Count of each end of a round: `ok`, or the kind of an error."""
    kinds: Counter[str] = field(default_factory=Counter)
    """Count of the frames of each kind."""
    resets: int = 0
    """Frames by which a server doubts a robot's cursor."""
    older: int = 0
    """Replies of an older state than one that the robot was given before."""
    misfits: list[str] = field(default_factory=list)
    """Frames that only their fingerprint shows to be wrong."""
    odd_ends: int = 0
    """Replies after which a robot compared all fingerprints."""
    wrong: list[str] = field(default_factory=list)
    acked_s: float = 0.0
    """Time of the newest acknowledged commit."""
    ended_s: dict[str, float] = field(default_factory=dict)
    """Time at which the newest round with each server came to its end, by URL."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def note_acked(self, commit: CommitId) -> None:
        """Count an acknowledged commit."""
        with self.lock:
            self.acked.add(commit)
            self.acked_s = time.monotonic()

    def expected(self) -> Digests:
        """The map that is the sum of all commits."""
        total = HistoryMap(PLAIN)
        for commit, diff in self.diffs.items():
            if commit not in self.retracted:
                total.merge(diff)
        return digests_of(total)


class _WatchedLink(Link):
    """Link whose frames are counted."""

    def __init__(self, api: MapApi, map_name: str, *, branch: str, team: Team, newest: dict[bytes, int]) -> None:
        super().__init__(api, map_name, branch=branch)
        self._team = team
        self._newest = newest
        self._is_compared = False

    def _answer(self, ask: Ask[Any]) -> Any:
        if isinstance(ask, GetMissing):
            self._is_compared = ask.request.compare
        found = super()._answer(ask)
        with self._team.lock:
            if isinstance(found, ReplyHeader):
                self._note_state(found.to_cursor)
            if isinstance(found, CellFrame):
                self._team.kinds[found.kind.name.lower()] += 1
                self._team.resets += found.kind is FrameKind.RESET and not self._is_compared
        return found

    def _note_state(self, head: Cursor) -> None:
        self._team.older += head.seq < self._newest.get(head.log_id, 0)
        self._newest[head.log_id] = head.seq


class Mapper:
    """One robot, in a thread of its own until `end`."""

    def __init__(
        self, folder: Path, urls: Callable[[], list[str]], map_name: str, team: Team, number: int, *, seed: int
    ) -> None:
        """Begin to map; the fourth robot of a team has a low-end computer."""
        self.name = f"robot{number}"
        self._is_low_end = number == 3
        self._urls = urls
        self._map_name = map_name
        self._team = team
        self._random = random.Random(seed * 100 + number)
        store = ReplicaStore(folder / self.name)
        self.replica = Replica(store, robot=RobotName(self.name), map_name=map_name, geometry=GEOMETRY)
        self._apis: dict[str, MapApi] = {}
        self._newest: dict[bytes, int] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=self.name)
        self._thread.start()

    def end(self) -> None:
        """Stop mapping; rounds go on by `sync`."""
        self._ended.set()
        self._thread.join()

    def close(self) -> None:
        """Close the replica and all links."""
        self.replica.close()
        for api in self._apis.values():
            api.close()

    def sync(self) -> bool:
        """One round with a server; False if it was cut short."""
        urls = self._urls()
        if not urls:
            return False
        url = self._random.choice(urls)
        api = self._apis.setdefault(url, MapApi(url))
        link = _WatchedLink(api, self._map_name, branch=self.name, team=self._team, newest=self._newest)
        try:
            report = link.hold(push_commits(self.replica, on_push=self._team.note_acked))
            link.hold(fetch_cells(self.replica) if self._is_low_end else fetch_missing(self.replica))
        except CairnError as exc:
            self._note_error(exc)
            return False
        with self._team.lock:
            self._team.answers["ok"] += 1
            self._team.ended_s[url] = time.monotonic()
            self._team.wrong += [f"{commit}: {exc.kind}: {exc.message}" for commit, exc in report.refused.items()]
        return True

    def digests(self) -> Digests:
        """The map that this robot shows."""
        return digests_of(self.replica.view)

    def _run(self) -> None:
        while not self._ended.is_set():
            if self._random.random() < COMMIT_SHARE:
                self._map()
            self.sync()
            self._ended.wait(self._random.uniform(0.0, 2 * PAUSE_S))

    def commit(self, seed: int) -> None:
        """Commit evidence of two cells, or one of them."""
        diff = random_diff(seed)
        commit = self.replica.commit(diff, CommitFacts())
        with self._team.lock:
            self._team.diffs[commit.id] = diff

    def _map(self) -> None:
        targets = self.replica.unreplaced_commits()
        if targets and self._random.random() < RETRACT_SHARE:
            target = self._random.choice(targets)
            try:
                retract = self.replica.retract(target, CommitFacts())
            except ConflictError:  # it was taken out before
                return
            with self._team.lock:
                self._team.diffs[retract.id] = {}
                self._team.retracted.add(target)
        else:
            self.commit(self._random.getrandbits(30))

    def _note_error(self, exc: CairnError) -> None:
        with self._team.lock:
            self._team.answers[exc.kind] += 1
            # Of a map that was lost nothing is known until it is made again.
            if not isinstance(exc, UnreachableError) and exc.kind != "no_map":
                self._team.wrong.append(f"{self.name}: {exc.kind}: {exc.message}")


@contextmanager
def watched_misfits(team: Team) -> Iterator[None]:
    """Collect what replicas of this process say of frames that do not fit, for the length of a `with`."""

    class Misfits(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage()
            team.odd_ends += ODD_END in text
            if exchange.MISFIT in text:
                team.misfits.append(text)

    handler, log = Misfits(), logging.getLogger(exchange.__name__)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)


@contextmanager
def mapping(
    folder: Path, urls: Callable[[], list[str]], map_name: str, *, robots: int, seed: int
) -> Iterator[tuple[Team, list[Mapper]]]:
    """A team that maps for the length of a `with`."""
    team, mappers = Team(), list[Mapper]()
    folder.mkdir(parents=True)
    with watched_misfits(team):
        try:
            for number in range(robots):
                mappers.append(Mapper(folder, urls, map_name, team, number, seed=seed))
            yield team, mappers
        finally:
            for mapper in mappers:
                mapper.end()
            for mapper in mappers:
                mapper.close()


def settle(urls: list[str], map_name: str, team: Team, mappers: list[Mapper]) -> float:
    """Let the robots sync until all maps are equal, and note what is not; seconds that it took."""
    for mapper in mappers:
        mapper.end()
    expected, start_s = team.expected(), time.monotonic()
    while True:
        rounds = [mapper.sync() for mapper in mappers]
        is_even = all(rounds)
        maps = {mapper.name: mapper.digests() for mapper in mappers}
        if is_even:
            maps |= {url: server_digests(url, map_name) for url in urls}
        if is_even and all(found == expected for found in maps.values()):
            break
        if time.monotonic() - start_s > SETTLE_S:
            team.wrong += [f"{name} has another map" for name, found in maps.items() if found != expected]
            break
        threading.Event().wait(PAUSE_S)
    seconds = time.monotonic() - start_s
    folded = Counter(log_ids(urls[0], map_name))
    team.wrong += [f"{commit} was acknowledged and is lost" for commit in team.acked if not folded[str(commit)]]
    team.wrong += [f"{name} is in the log {count} times" for name, count in folded.items() if count > 1]
    return seconds


def digests_of(view: HistoryMap) -> Digests:
    """Digest of each cell that holds evidence."""
    return {key: digest.hex() for key, (digest, _) in cells_of(view).items()}


def server_digests(url: str, map_name: str) -> Digests:
    """The map as a server has it."""
    with MapApi(url) as api:
        index = api.cell_index(map_name)
        return {cell_key(entry.cell): entry.digest for entry in index.cells if entry.voxels}


def log_ids(url: str, map_name: str) -> Iterator[str]:
    """Ids of the folded commits."""
    with MapApi(url) as api:
        after = 0
        while page := api.log(map_name, after=after, limit=LOG_PAGE):
            yield from (entry.id for entry in page if entry.kind == "+")
            after = page[-1].seq
