"""Checks of small commits in a process of their own, so that the event loop can answer others meanwhile.

A small commit is checked in less than a millisecond, which was half of what the event loop did for a push. The process
checks one after the other, in order, and holds nothing of the server's (`check_nursery` has what it may be asked). It
is forked before the server has threads, and costs no start of its own. If it is killed, the server checks by itself.
"""

import asyncio
import json
import os
import signal
import socket
from collections import deque

from cairn_server.check_nursery import LENGTH, answer_to, checked_from, die_with_parent, received, send
from cairn_server.checking import Checked


class LostCheckError(Exception):
    """The process ended, or has no memory."""


class CheckProcess:
    """The server's end; used by one event loop."""

    def __init__(self, pid: int, jobs: socket.socket) -> None:
        self.pid = pid
        self._jobs = jobs
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self._asked: deque[asyncio.Future[bytes]] = deque()
        self._is_lost = False

    async def check(self, data: bytes) -> Checked:
        """What it finds of a commit.

        Raises:
            DamagedDataError, BadInputError: what it found wrong.
            LostCheckError: it cannot answer.
        """
        if self._is_lost:
            raise LostCheckError
        if self._writer is None:
            reader, self._writer = await asyncio.open_unix_connection(sock=self._jobs)
            self._reading = asyncio.get_running_loop().create_task(self._read(reader))
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._asked.append(answer)
        self._writer.write(LENGTH.pack(len(data)) + data)
        found = json.loads(await answer)
        if "memory" in found:
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
            self._is_lost = True
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
    """Answer until the server is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):  # of a whole group: the server first finishes what it does
        signal.signal(number, signal.SIG_IGN)
    while (data := received(jobs)) is not None:
        send(jobs, json.dumps(answer_to(data)).encode())
