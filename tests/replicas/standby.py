"""A standby that is seconds behind its primary, and becomes the primary when that is killed.

Servers are given both by one URL, the standby first. Before the promotion they may be answered by the primary alone: a
robot is ahead of the standby, which would doubt all of its cells. After it they go on by themselves.
"""

import shutil
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.fixtures.server.deadline import until
from tests.fixtures.server.postgres import PostgresServer
from tests.replicas.fault_run import SILENCE_MAX_S, postgres_in
from tests.replicas.lost_tail import make_map
from tests.replicas.mappers import mapping, settle
from tests.replicas.site import Site

NAME = "lab"
ROBOTS = 3


@dataclass(slots=True)
class Failover:
    """What came of a run."""

    acked: int = 0
    behind_s: float = 0.0
    """Delay with which the standby shows what the primary has."""
    resets: int = 0
    """Frames of the time before the promotion by which a server doubts a robot's cursor."""
    older: int = 0
    """Replies of that time of an older state than one given before."""
    frames: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    resumed_s: float = 0.0
    """Time from the old primary's end until each server had answered a robot."""
    misfits: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    @property
    def is_sound(self) -> bool:
        """True if no robot met a standby, and nothing was lost."""
        return not (self.resets or self.older or self.misfits or self.wrong)

    @property
    def is_timely(self) -> bool:
        """True if robots did not wait for long."""
        return self.resumed_s <= SILENCE_MAX_S

    def rows(self) -> Iterator[tuple[str, str]]:
        """Lines for people."""
        yield "acknowledged", f"{self.acked}"
        yield "frames", ", ".join(f"{count} x {kind}" for kind, count in sorted(self.frames.items()))
        yield "rounds", ", ".join(f"{count} x {kind}" for kind, count in sorted(self.answers.items()))
        yield "standby behind by", f"{self.behind_s:g} s"
        yield "reset frames, older states, before the promotion", f"{self.resets}, {self.older}"
        yield "all servers answer again after", f"{self.resumed_s:.1f} s"
        yield "wrong", f"{self.misfits[:5] + self.wrong[:10]}"


def failover_run(folder: Path, programs: Path, *, seconds: float, behind_s: float, seed: int = 0) -> Failover:
    """Let robots map on the primary for some seconds, kill it, and promote the standby."""
    found = Failover(behind_s=behind_s)
    with postgres_in(programs) as primary:
        primary.execute("CREATE DATABASE cairn")
        with standby_of(primary, programs, behind_s=behind_s) as standby:
            site = Site(folder, primary, "cairn", store=url_of_both(standby, primary))
            site.add_all("server", "both")
            make_map(site, NAME)
            with mapping(folder / "robots", site.urls, NAME, robots=ROBOTS, seed=seed) as (team, mappers):
                threading.Event().wait(seconds)
                with team.lock:
                    found.resets, found.older = team.resets, team.older
                start_s = time.monotonic()
                primary.stop(signal.SIGQUIT)
                standby.execute("SELECT pg_promote()")
                until(lambda: min(team.ended_s.get(url, 0.0) for url in site.urls()) > start_s, "all servers answer")
                found.resumed_s = time.monotonic() - start_s
                threading.Event().wait(min(seconds, 1.0))
                settle(site.urls(), NAME, team, mappers)
            site.close()
            primary.start()
    found.acked, found.frames, found.answers = len(team.acked), team.kinds, team.answers
    found.misfits, found.wrong = team.misfits, team.wrong
    return found


@contextmanager
def standby_of(primary: PostgresServer, programs: Path, *, behind_s: float) -> Iterator[PostgresServer]:
    """A standby that streams from a server, and applies what came some seconds later."""
    folder = Path(tempfile.mkdtemp(prefix="cairn-postgres-"))
    try:
        primary.copy_to(folder / "data")
        (folder / "data" / "standby.signal").touch()
        standby = PostgresServer(
            programs,
            folder,
            f"primary_conninfo={primary.url('postgres')}",
            f"recovery_min_apply_delay={round(1000 * behind_s)}ms",
        )
        yield standby
        standby.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def url_of_both(first: PostgresServer, second: PostgresServer) -> str:
    """URL of a database on two servers."""
    here, there = f"127.0.0.1:{first.port}", f"127.0.0.1:{second.port}"
    return first.url("cairn").replace(here, f"{here},{there}")
