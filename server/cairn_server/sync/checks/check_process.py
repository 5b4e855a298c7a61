"""Checks of small commits in a process of their own, so that the event loop can answer others meanwhile.

A small commit is checked in less than a millisecond, which was half of what the event loop did for a push. The process
checks one after the other, in order, and holds nothing of the server's (`check_nursery` has what it may be asked). It
is forked before the server has threads, and costs no start of its own. If it is killed, the server checks by itself.
"""

import asyncio
import json
import logging
import os
import signal
import socket
import traceback
from collections import deque

from cairn_server.processes import LENGTH, die_with_parent, received, send
from cairn_server.sync.checks.checking import Checked
from cairn_server.sync.checks.worker_nursery import answer_to, checked_from

log = logging.getLogger(__name__)

ANSWER_S = 60.0
"""A process that takes longer for milliseconds of work is not coming back."""


class LostCheckError(Exception):
    """The process ended, has no memory, or met an error of its own."""


class CheckProcess:
    """The server's end; used by one event loop."""

    def __init__(self, pid: int, jobs: socket.socket) -> None:
        self.pid = pid
        self._jobs = jobs
        self._opening = asyncio.Lock()
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self._asked: deque[asyncio.Future[bytes]] = deque()
        self.is_lost = False
        """Whether it will not answer any more; else a failure is of one commit."""

    async def check(self, data: bytes) -> Checked:
        """What it finds of a commit.

        Raises:
            DamagedDataError, BadInputError: what it found wrong.
            LostCheckError: it cannot answer.
        """
        if self.is_lost:
            raise LostCheckError
        async with self._opening:
            if self._writer is None:
                reader, self._writer = await asyncio.open_unix_connection(sock=self._jobs)
                self._reading = asyncio.get_running_loop().create_task(self._read(reader))
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._asked.append(answer)
        self._writer.write(LENGTH.pack(len(data)) + data)
        try:
            found = json.loads(await asyncio.wait_for(answer, ANSWER_S))
        except TimeoutError:
            self.is_lost = True
            raise LostCheckError from None
        if "broken" in found:
            log.error("the process that checks small commits met an error of its own: %s", found["broken"])
        if "memory" in found or "broken" in found:
            raise LostCheckError
        return checked_from(found)

    def close(self) -> None:
        """End it, once the event loop has ended."""
        self._jobs.close()
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        """Hand answers to those who wait, in order."""
        try:
            while True:
                head = await reader.readexactly(LENGTH.size)
                data = await reader.readexactly(LENGTH.unpack(head)[0])
                answer = self._asked.popleft()
                if not answer.done():  # whoever asked may be gone
                    answer.set_result(data)
        except (asyncio.IncompleteReadError, OSError):
            self.is_lost = True
            for answer in self._asked:
                if not answer.done():
                    answer.set_exception(LostCheckError())
            self._asked.clear()


def fork_checking() -> CheckProcess:
    """A process that checks. Only before there are threads."""
    ours, theirs = socket.socketpair()
    server = os.getpid()
    pid = os.fork()
    if pid == 0:
        ours.close()
        try:
            die_with_parent(server)
            _be_checker(theirs)
        finally:
            os._exit(0)
    theirs.close()
    return CheckProcess(pid, ours)


def _be_checker(jobs: socket.socket) -> None:
    """What the process does."""
    for number in (signal.SIGINT, signal.SIGTERM):  # of a whole group: the server first finishes what it does
        signal.signal(number, signal.SIG_IGN)
    answer_checks(jobs)


def answer_checks(jobs: socket.socket) -> None:
    """Check what the other end asks for, until it is gone."""
    while (data := received(jobs)) is not None:
        try:
            answer = answer_to(data)
        except Exception:  # noqa: BLE001 - told to the server, which logs it
            answer = {"broken": traceback.format_exc()}
        send(jobs, json.dumps(answer).encode())
