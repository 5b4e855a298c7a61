"""Real servers behind real sockets, killed with `kill -9` while robots push, at any time or at any write.

Servers are forked from a process that has imported everything, so that a start takes no second.
"""

import io
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import apsw
import httpx
from tests.crash.lives import AUTHORS, NAME, commit_of
from tests.crash.power_cut import Disk, PowerVfs
from tests.crash.verdict import Verdict, verdict_on
from tests.fixtures.map.made import SMALL

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.wire.messages import CreateMap
from cairn_server.operations.serve import main as serve
from cairn_server.store.folder_lock import LOCK_NAME

DEADLINE_S = 60.0
COMMITS_MAX = 60
"""Of one robot while one server lives."""
STEPS_MAX = 1500
"""Writes and syncs until a server kills itself; most of 60 commits of two robots are over then."""
KILLED_AFTER_S = 0.5


class MortalDisk(Disk):
    """A disk whose user dies at a write or sync; what was written stays in the machine's memory."""

    def check(self) -> None:
        """The end."""
        if self.is_cut:
            os.kill(os.getpid(), signal.SIGKILL)


class Said(io.TextIOBase):
    """Standard output into a pipe."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def write(self, text: str) -> int:
        """Send it."""
        self._pipe.send(text)
        return len(text)


def mortal_server(folder: str, pipe: Connection, steps: int | None) -> None:
    """`cairn serve`, in a process that kills itself at its n-th write or sync, if told so."""
    for name in [name for name in os.environ if name.startswith("CAIRN_")]:
        del os.environ[name]
    sys.stdout = Said(pipe)
    # So that checkpoints come often enough to be hit.
    apsw.connection_hooks.append(lambda connection: connection.pragma("wal_autocheckpoint", 20))
    if steps is None:
        serve(["--data", folder, "--port", "0"])
        return
    disk = MortalDisk(steps=steps)
    disk.adopt(Path(folder))
    with PowerVfs(disk):
        serve(["--data", folder, "--port", "0"])


@dataclass(slots=True)
class Killed:
    """What robots know of a server that was killed again and again, and what is left of its store each time."""

    kills: int = 0
    at_start: int = 0
    """Kills before it could say where it listens."""
    acked: set[CommitId] = field(default_factory=set)
    offered: dict[CommitId, Commit] = field(default_factory=dict)
    next_n: dict[Author, int] = field(default_factory=dict)
    answers: set[int] = field(default_factory=set)
    verdicts: list[Verdict] = field(default_factory=list)


def killed_servers(seed: int, *, kills: int) -> Killed:
    """Start a server on the same store again and again, push to it, kill it, and look at what it left."""
    with tempfile.TemporaryDirectory() as folder:
        return _killed_servers(Path(folder), seed, kills)


def _killed_servers(folder: Path, seed: int, kills: int) -> Killed:
    rng = random.Random(seed)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.crash.kills"])
    done = Killed()
    store = folder / "store"
    store.mkdir()
    for n in range(kills):
        steps = None if rng.random() < 0.4 else rng.randint(1, rng.choice([100, STEPS_MAX]))
        ours, theirs = context.Pipe()
        process = context.Process(target=mortal_server, args=(str(store), theirs, steps))
        process.start()
        theirs.close()
        try:
            url = ours.recv().split()[4].rstrip(",")
            _push_until_killed(url, process, rng.uniform(0, KILLED_AFTER_S) if steps is None else None, done)
        except EOFError:
            done.at_start += 1
        ours.close()
        process.join(DEADLINE_S)
        assert process.exitcode == -signal.SIGKILL, process.exitcode
        done.kills += 1
        left = folder / f"left{n}"
        shutil.copytree(store, left, ignore=shutil.ignore_patterns(LOCK_NAME, "*-shm"))
        done.verdicts.append(verdict_on(left, NAME, acked=done.acked, offered=done.offered))
        shutil.rmtree(left)
    return done


def _push_until_killed(url: str, process: BaseProcess, after_s: float | None, done: Killed) -> None:
    threads = [threading.Thread(target=_push, args=(url, author, done)) for author in AUTHORS]
    try:
        body = CreateMap(geometry=SMALL).model_dump_json().encode()
        with httpx.Client(base_url=url, timeout=DEADLINE_S) as http:
            http.put(f"/maps/{NAME}", content=body, headers={"Content-Type": "application/json"}).raise_for_status()
    except httpx.TransportError:
        threads = []
    for thread in threads:
        thread.start()
    if after_s is not None:
        threading.Event().wait(after_s)  # not to synchronise: to kill at any point
        process.kill()
    for thread in threads:
        thread.join()
    process.kill()  # it may have survived, if this was too little to write for it


def _push(url: str, author: Author, done: Killed) -> None:
    with httpx.Client(base_url=url, timeout=DEADLINE_S) as http:
        for _ in range(COMMITS_MAX):
            n = done.next_n.get(author, 0)
            commit = commit_of(author, n)
            done.offered[commit.id] = commit
            try:
                answer = http.put(f"/maps/{NAME}/commits/{commit.id}", content=commit.data)
            except httpx.TransportError:
                return
            done.answers.add(answer.status_code)
            answer.raise_for_status()
            done.acked.add(commit.id)
            done.next_n[author] = n + 1
