"""One run of faults against a site, and the verdict on its store."""

import random
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from tests.crash.verdict import Verdict, compare
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.live import until
from tests.fixtures.server.postgres import PostgresServer
from tests.replicas.robots import Pushed, Pusher
from tests.replicas.site import Site, crash_database, kill_and_start, sleep_through, stop_and_start

from cairn_map.wire.messages import CreateMap
from cairn_server.folding.store_check import check_map
from cairn_server.store.objects.cold_bytes import ColdReads
from cairn_server.store.postgres.store import PgStore

SILENCE_MAX_S = 15.0
"""Longest time that robots may wait for any answer to a push after a fault."""
FAULT_EVERY_S = 5.0
ACKED_LEAST = 100
"""Commits of a run, however slow the machine is."""
SLEEP_S = 8.0
"""More than `store.LEASE_S`."""
Fault = tuple[str, Callable[[], None]]


@dataclass(slots=True)
class FaultRun:
    """What came of a run."""

    pushed: Pushed = field(default_factory=Pushed)
    faults: Counter[str] = field(default_factory=Counter)
    verdict: Verdict = field(default_factory=Verdict)
    seconds: float = 0.0
    folded_after_s: float = 0.0
    """Time from the last push until all was folded."""
    reads: Counter[str] = field(default_factory=Counter)
    """Count of each answer to a reader, where there are any."""
    cold: dict[str, int] = field(default_factory=dict)
    """Count of what is in an object store in the end."""

    @property
    def is_sound(self) -> bool:
        """True if nothing was lost."""
        return self.verdict.is_sound and not self.pushed.wrong

    @property
    def is_timely(self) -> bool:
        """True if robots did not wait for long."""
        return self.pushed.silence_s <= SILENCE_MAX_S

    def rows(self) -> Iterator[tuple[str, str]]:
        """Lines for people."""
        pushed = self.pushed
        yield "acknowledged", f"{len(pushed.acked)} in {self.seconds:.0f} s"
        yield "faults", ", ".join(f"{count} x {what}" for what, count in sorted(self.faults.items()))
        yield "answers", ", ".join(f"{count} x {what}" for what, count in sorted(pushed.answers.items()))
        if self.reads:
            yield "cells that were read meanwhile", ", ".join(f"{n} x {what}" for what, n in sorted(self.reads.items()))
        if self.cold:
            yield "in the object store in the end", ", ".join(f"{n} {what}" for what, n in self.cold.items())
        yield "longest time without an acknowledgement", f"{pushed.silence_s:.1f} s"
        yield "folded after the last push", f"{self.folded_after_s:.1f} s"
        yield "lost, wrong", f"{len(self.verdict.lost)}, {self.verdict.wrong + pushed.wrong[:5]}"


@contextmanager
def postgres_in(programs: Path, *settings: str) -> Iterator[PostgresServer]:
    """A server of PostgreSQL in a folder of its own, with more settings."""
    folder = Path(tempfile.mkdtemp(prefix="cairn-postgres-"))
    try:
        server = PostgresServer(programs, folder, *settings)
        yield server
        server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def fault_run(
    folder: Path, programs: Path, *, seconds: float, robots: int, seed: int, folders: int = 2, servers: int = 2
) -> FaultRun:
    """Push through servers that are killed, and look at the store."""
    chance, found = random.Random(seed), FaultRun()
    with postgres_in(programs) as postgres:
        postgres.execute("CREATE DATABASE cairn")
        site = Site(folder, postgres, "cairn")
        for role in ("server",) * servers + ("folder",) * folders:
            site.add(role)
        faults = list(faults_of(site))
        chance.shuffle(faults)
        push_under_faults(site, found, faults, chance, seconds=seconds, robots=robots)
        site.close()
    return found


def push_under_faults(
    site: Site,
    found: FaultRun,
    faults: list[Fault],
    chance: random.Random,
    *,
    seconds: float,
    robots: int,
    objects: ColdReads | None = None,
) -> None:
    """Push into a new map of a site that suffers faults, one after the other, and look at its store."""
    map_url = f"{site.urls()[0]}/maps/lab"
    body = CreateMap(geometry=SMALL).model_dump_json()
    httpx.put(map_url, content=body, headers={"Content-Type": "application/json"}).raise_for_status()
    _push(site, found, faults, chance, seconds=seconds, robots=robots)
    _judge(site, found, objects)


def _push(
    site: Site, found: FaultRun, faults: list[Fault], chance: random.Random, *, seconds: float, robots: int
) -> None:
    ended, start_s = threading.Event(), time.monotonic()
    found.pushed.last_s = start_s
    pushers = [Pusher(site, found.pushed, number, ended) for number in range(robots)]
    try:
        for what, act in (faults * 1000)[: max(1, int(seconds / FAULT_EVERY_S))]:
            threading.Event().wait(FAULT_EVERY_S * chance.uniform(0.3, 0.8))
            act()
            found.pushed.go_on(what)
            found.faults[what] += 1
            if time.monotonic() - start_s > seconds:
                break
        threading.Event().wait(min(FAULT_EVERY_S, max(0.5, seconds - (time.monotonic() - start_s))))
        until(lambda: len(found.pushed.acked) >= ACKED_LEAST, "robots push enough")
    finally:
        ended.set()
        for pusher in pushers:
            pusher.thread.join()
    found.seconds = time.monotonic() - start_s


def faults_of(site: Site) -> Iterator[Fault]:
    """Faults of each process, and of the database."""
    for member in site.members:
        yield f"kill -9 of a {member.role}", kill_and_start(site, member)
        if member.role == "folder":
            yield f"SIGSTOP of a {member.role}", sleep_through(member, SLEEP_S)
        else:
            yield f"replaced {member.role}", stop_and_start(site, member)
    yield "crash of the database", crash_database(site)


def _judge(site: Site, found: FaultRun, objects: ColdReads | None) -> None:
    store = PgStore(site.postgres.url(site.database), objects=objects)
    try:
        row, last_s = store.map("lab"), time.monotonic()
        until(lambda: not store.waiting_maps(), "all is folded")
        found.folded_after_s = time.monotonic() - last_s
        compare(store, row, list(found.pushed.acked), found.pushed.offered, found.verdict)
        found.verdict.wrong += [str(each) for each in check_map(store, row, lambda done, total: None).findings]
    finally:
        store.close()
