"""A failover that loses the newest commits, under servers and robots that go on: an older copy of the database is put
in its place.

    robots map   |----------|-----------------|              |-----------|  all maps are compared
    database     |---- copy made -------------|  copy put back  |
    servers      |---------------------------------------------------------->

In every fourth turn the map itself is lost with the rest, and made again. In every second one the robots take turns:
what is lost comes again in the opposite order, so that cells come to sums that they had before, by other commits.
"""

import random
import shutil
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from tests.fixtures.client.made import GEOMETRY
from tests.fixtures.server.deadline import until
from tests.replicas.fault_run import SILENCE_MAX_S, postgres_in
from tests.replicas.mappers import Mapper, Team, mapping, settle
from tests.replicas.site import Site

from cairn_map.wire.messages import CreateMap

LOST_MAP_EVERY, ORDERED_EVERY = 4, 2
ROBOTS = 4
BOTH_CELLS = 2
"""Least seed of a commit of both cells; all others are more by multiples of 3."""
FOLD_ROUNDS, FOLD_S = 3, 0.15
"""Rounds, and the time between two, in which what was pushed is folded."""


@dataclass(slots=True)
class LostTails:
    """What came of a run."""

    turns: int = 0
    acked: int = 0
    frames: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    odd_ends: int = 0
    """Replies whose end did not fit, since a robot had a cell that only the lost history had."""
    misfits: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    silence_s: float = 0.0
    """Longest time from the database's start until a commit was acknowledged."""
    settled_s: float = 0.0
    """Longest time until all maps were equal."""

    @property
    def is_sound(self) -> bool:
        """True if nothing was lost, and nothing of a lost history was sent."""
        return not (self.misfits or self.wrong)

    @property
    def is_timely(self) -> bool:
        """True if robots did not wait for long."""
        return self.silence_s <= SILENCE_MAX_S

    def rows(self) -> Iterator[tuple[str, str]]:
        """Lines for people."""
        yield "turns", f"{self.turns}"
        yield "acknowledged", f"{self.acked}"
        yield "frames", ", ".join(f"{count} x {kind}" for kind, count in sorted(self.frames.items()))
        yield "rounds", ", ".join(f"{count} x {kind}" for kind, count in sorted(self.answers.items()))
        yield "longest time until a commit was acknowledged again", f"{self.silence_s:.1f} s"
        yield "all maps equal after", f"{self.settled_s:.1f} s at most"
        yield "ends of replies that did not add up", f"{self.odd_ends}"
        yield "frames that only a fingerprint caught", f"{len(self.misfits)} {self.misfits[:5]}"
        yield "wrong", f"{self.wrong[:10]}"


def lost_tail_run(folder: Path, programs: Path, *, seeds: range) -> LostTails:
    """Lose the newest commits once for each seed, under the same servers."""
    found = LostTails()
    with postgres_in(programs) as postgres:
        postgres.execute("CREATE DATABASE cairn")
        site = Site(folder, postgres, "cairn")
        site.add_all("server", "both")
        for seed in seeds:
            _lose_once(site, folder / f"robots{seed}", seed, found)
        site.close()
    return found


def _lose_once(site: Site, folder: Path, seed: int, found: LostTails) -> None:
    name, copy = f"lab{seed}", Path(tempfile.mkdtemp(prefix="cairn-copy-"))
    lose = _lose_map if seed % LOST_MAP_EVERY == 0 else _lose_order if seed % ORDERED_EVERY else _lose_newest
    if lose is _lose_map:
        site.postgres.copy_to(copy / "data")
    make_map(site, name)
    try:
        with mapping(folder, site.urls, name, robots=ROBOTS, seed=seed) as (team, mappers):
            turn = _Turn(site, name, copy / "data", team, mappers, random.Random(seed))
            lose(turn)
            found.settled_s = max(found.settled_s, settle(site.urls(), name, team, mappers))
    finally:
        shutil.rmtree(copy)
        shutil.rmtree(folder, ignore_errors=True)
    found.turns += 1
    found.silence_s = max(found.silence_s, turn.silence_s)
    found.acked += len(team.acked)
    found.frames += team.kinds
    found.answers += team.answers
    found.odd_ends += team.odd_ends
    found.misfits += [f"seed {seed}: {text}" for text in team.misfits]
    found.wrong += [f"seed {seed}: {text}" for text in team.wrong]


@dataclass(slots=True)
class _Turn:
    site: Site
    name: str
    copy: Path
    team: Team
    mappers: list[Mapper]
    chance: random.Random
    silence_s: float = 0.0

    def wait(self, least_s: float, most_s: float) -> None:
        threading.Event().wait(self.chance.uniform(least_s, most_s))

    def put_back(self) -> None:
        """Put the copy in the database's place."""
        self.site.postgres.put_back(self.copy, self.chance.choice([signal.SIGQUIT, signal.SIGINT]))
        make_map(self.site, self.name)


def _lose_map(turn: _Turn) -> None:
    turn.wait(0.5, 1.5)
    _lose(turn)


def _lose_newest(turn: _Turn) -> None:
    turn.wait(0.2, 1.2)
    turn.site.postgres.copy_to(turn.copy)
    turn.wait(0.3, 1.5)
    _lose(turn)


def _lose(turn: _Turn) -> None:
    turn.put_back()
    start_s = time.monotonic()
    until(lambda: turn.team.acked_s > start_s, "a commit is acknowledged")
    turn.silence_s = turn.team.acked_s - start_s
    turn.wait(0.3, 1.2)


def _lose_order(turn: _Turn) -> None:
    """Lose one commit of each robot; all robots hear of each before the next one comes, in both histories."""
    turn.wait(0.2, 0.5)
    urls, order = turn.site.urls(), turn.chance.sample(turn.mappers, ROBOTS)
    settle(urls, turn.name, turn.team, turn.mappers)
    turn.site.postgres.copy_to(turn.copy)
    for mapper in order:
        mapper.commit(BOTH_CELLS + 3 * turn.chance.getrandbits(20))
        settle(urls, turn.name, turn.team, turn.mappers)
    turn.put_back()
    for here in range(1, ROBOTS + 1):
        # Those that have not come yet would push at once: only the others ask.
        present = order[-here:]
        for _ in range(FOLD_ROUNDS):
            for mapper in reversed(present):
                mapper.sync()
            turn.wait(FOLD_S, FOLD_S)


def make_map(site: Site, name: str) -> None:
    """Make a map, or find that there is one, as soon as a server can."""
    body = CreateMap(geometry=GEOMETRY).model_dump_json()

    def is_made() -> bool:
        try:
            answer = httpx.put(
                f"{site.urls()[0]}/maps/{name}", content=body, headers={"Content-Type": "application/json"}, timeout=30
            )
        except httpx.TransportError:
            return False
        assert answer.status_code in (200, 201, 503), answer.text
        return answer.is_success

    until(is_made, f"map {name} is there")
