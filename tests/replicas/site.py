"""Processes of one site: a database, servers that answer, and processes that fold."""

import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from tests.fixtures.server.live import Process, until
from tests.fixtures.server.postgres import PostgresServer

OPTIONS = {"server": ("--no-fold",), "folder": ("--fold-only",), "both": ()}


@dataclass(slots=True)
class Member:
    """One process of cairn, started again after each end."""

    role: str
    number: int
    process: Process | None = None
    starts: int = 0


@dataclass(slots=True)
class Site:
    """A database and the processes over it."""

    folder: Path
    postgres: PostgresServer
    database: str
    options: tuple[str, ...] = ()
    store: str | None = None
    """URL of the store, if it is not that of the database alone."""
    members: list[Member] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, role: str) -> Member:
        """Start one more process."""
        member = Member(role, len(self.members))
        self.members.append(member)
        self.start(member)
        return member

    def add_all(self, *roles: str) -> None:
        """Start several processes at once."""
        members = [Member(role, len(self.members) + n) for n, role in enumerate(roles)]
        self.members += members
        with ThreadPoolExecutor() as pool:
            list(pool.map(self.start, members))

    def start(self, member: Member) -> None:
        """Start a process in a new folder: it keeps nothing there."""
        member.starts += 1
        folder = self.folder / f"{member.role}{member.number}-{member.starts}"
        store = self.store or self.postgres.url(self.database)
        process = Process(folder, "--store", store, *OPTIONS[member.role], *self.options)
        assert process.url, process.end()
        with self._lock:
            member.process = process

    def urls(self) -> list[str]:
        """Of the servers that were started and not ended."""
        with self._lock:
            answering = [each.process for each in self.members if each.process and each.role != "folder"]
        return [process.url for process in answering if process.url]

    def end(self, member: Member, number: signal.Signals) -> int:
        """Send a signal that ends a process, and wait for it; its exit code."""
        with self._lock:
            process, member.process = member.process, None
        assert process is not None
        process.send(number)
        return process.end()[0]

    def close(self) -> list[int]:
        """End all; their exit codes."""
        return [self.end(member, signal.SIGTERM) for member in self.members if member.process]


def kill_and_start(site: Site, member: Member) -> Callable[[], None]:
    """`kill -9`, and a new process at once."""

    def act() -> None:
        site.end(member, signal.SIGKILL)
        site.start(member)

    return act


def stop_and_start(site: Site, member: Member) -> Callable[[], None]:
    """SIGTERM in an upgrade: the next one runs before the old one ends."""

    def act() -> None:
        old = member.process
        site.start(member)
        assert old is not None
        old.send(signal.SIGTERM)
        code, said = old.end()
        assert code in (0, -signal.SIGTERM), (code, said[-2000:])

    return act


def sleep_through(member: Member, seconds: float) -> Callable[[], None]:
    """SIGSTOP for longer than a claim lasts, then SIGCONT."""

    def act() -> None:
        process = member.process
        assert process is not None
        process.send(signal.SIGSTOP)
        threading.Event().wait(seconds)
        process.send(signal.SIGCONT)

    return act


def crash_database(site: Site) -> Callable[[], None]:
    """The database ends without a word, and comes back."""

    def act() -> None:
        site.postgres.stop(signal.SIGQUIT)
        site.postgres.start()

    return act


def wait_until_folded(site: Site, waits: Callable[[], bool]) -> None:
    """Wait until nothing is left to be folded."""
    until(lambda: not waits(), f"{len(site.members)} processes fold all")
