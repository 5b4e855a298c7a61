"""One server's link to the database that is cut, or stands still, while robots push through it and through another one.

robots  -->  server  -->  link  -->  database      cut: every connection is reset, and none comes about
        -->  server  ----------->                  still: nothing is passed on, and nothing is said
"""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from tests.fixtures.server.deadline import until
from tests.links.proxy import FaultProxy
from tests.replicas.fault_run import Fault, FaultRun, postgres_in, push_under_faults
from tests.replicas.site import Member, Site

CUT_S = 3.0


class Breaker(FaultProxy):
    """Link that can be cut, and stopped."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self._is_going = threading.Event()

    @contextmanager
    def cut(self) -> Iterator[None]:
        """No connection for the length of a `with`."""
        self.is_down = True
        self._loop.call_soon_threadsafe(lambda: [task.cancel() for task in self._tasks])
        try:
            yield
        finally:
            self.is_down = False

    @contextmanager
    def still(self) -> Iterator[None]:
        """Nothing is passed on for the length of a `with`."""
        self._is_going.clear()
        self._loop.call_soon_threadsafe(self._is_going.wait, 60.0)
        try:
            yield
        finally:
            self._is_going.set()


def cut_link_run(folder: Path, programs: Path, *, seconds: float, robots: int, seed: int) -> FaultRun:
    """Cut one of two servers off, again and again."""
    chance, found = random.Random(seed), FaultRun()
    with postgres_in(programs) as postgres, Breaker(postgres.port) as link:
        postgres.execute("CREATE DATABASE cairn")
        site = Site(folder, postgres, "cairn")
        site.add("both")
        site.store = postgres.url("cairn").replace(f":{postgres.port}", f":{link.port}")
        faults = list(_faults(site.add("server"), link, found))
        push_under_faults(site, found, faults, chance, seconds=seconds, robots=robots)
        site.close()
    return found


def _faults(member: Member, link: Breaker, found: FaultRun) -> Iterator[Fault]:
    process = member.process
    assert process is not None and process.url is not None
    ready = f"{process.url}/readyz"

    def cut() -> None:
        with link.cut():
            threading.Event().wait(CUT_S)
            status = httpx.get(ready, timeout=30).status_code
            found.pushed.wrong += [f"/readyz says {status} without a database"] * (status != 503)
        _work_again()

    def stop() -> None:
        with link.still():
            threading.Event().wait(CUT_S)
        _work_again()

    def _work_again() -> None:
        until(lambda: httpx.get(ready, timeout=30).status_code == 200, "the server is ready again")

    yield "cut of the link of a server", cut
    yield "standstill of the link of a server", stop
