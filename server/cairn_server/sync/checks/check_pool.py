"""Pool of worker processes that check expensive commits, each within its processor time and memory.

Workers are made when they are first needed, and replaced when one was killed, exceeded its limit or grew large. A
caller waits for a free one, within bounds: a commit that cannot be checked soon is refused with "later", never left
waiting.
"""

import json
import logging
import os
import queue
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Hashable
from contextlib import suppress
from pathlib import Path
from typing import IO

from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.kernels.program import command_of
from cairn_server.processes import LENGTH, received, send
from cairn_server.sync.checks.checking import Checked
from cairn_server.sync.checks.worker_nursery import checked_from

log = logging.getLogger(__name__)

WAITING_MAX = 8
"""Most requests that wait for a worker or its answer; each holds one of the web server's forty threads."""
WAIT_S = 10.0
"""Longest wait for a free worker."""
START_S = 120.0
"""Longest wait for a new worker: milliseconds, but for the first one on a machine without compiled kernels."""
LOOK_S = 0.05
"""Time between two looks at a worker's processor time."""
STALL_FACTOR = 20.0
"""Multiple of its limit, by the clock, after which a worker that got little of the processor is given up."""
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class _LostError(Exception):
    """The worker ended before it answered."""


class _Worker:
    """One worker process and the socket to it."""

    def __init__(self, jobs: socket.socket) -> None:
        self.jobs = jobs
        jobs.settimeout(START_S)
        # The worker's first word is its process number: from itself, so that it surely runs.
        hello = jobs.recv(LENGTH.size)
        if len(hello) < LENGTH.size:
            raise _LostError
        self.pid = int(LENGTH.unpack(hello)[0])

    def answer(self, data: bytes, limit_s: float) -> dict[str, object]:
        """Answer of the worker to a commit.

        Raises:
            BadInputError: kind `too_costly`: it took more processor time.
            UnreachableError: kind `check_failed`: it was hardly given any.
            _LostError: it ended before it answered.
        """
        # Limited by the worker's processor time: `too_costly` is final, and must not depend on how busy the server is.
        start_s, end_s = self._cpu_s(), time.monotonic() + STALL_FACTOR * limit_s
        self.jobs.settimeout(end_s - time.monotonic())
        # The clock bounds what processor time does not: a worker that is hardly ever run.
        try:
            send(self.jobs, data)
            while not self._is_readable():
                if self._cpu_s() - start_s > limit_s:
                    raise _too_costly(f"more than {limit_s:g} s of processor time")
                if time.monotonic() > end_s:
                    raise UnreachableError("check_failed", "the server is too busy to check this", retry_after_s=30.0)
            answer = received(self.jobs)
        except OSError as exc:
            raise _LostError from exc
        if answer is None:
            raise _LostError
        found: dict[str, object] = json.loads(answer)
        return found

    def kill(self) -> None:
        """Kill the worker; an open socket shows that its number is still its own."""
        with self.jobs, suppress(OSError):
            self.jobs.settimeout(0)
            try:
                is_there = bool(self.jobs.recv(1, socket.MSG_PEEK))
            except BlockingIOError:
                is_there = True
            # The kernel buries dead workers at once, and then gives their number to others.
            if is_there:
                os.kill(self.pid, signal.SIGKILL)

    def _is_readable(self) -> bool:
        self.jobs.settimeout(LOOK_S)
        try:
            # Only looked at: the byte stays for `received`.
            self.jobs.recv(1, socket.MSG_PEEK)
        except TimeoutError:
            return False
        finally:
            self.jobs.settimeout(START_S)
        return True

    def _cpu_s(self) -> float:
        """Processor time of the worker so far; it may have ended."""
        try:
            fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError as exc:
            raise _LostError from exc
        # utime and stime: fields 14 and 15 of proc_pid_stat(5), of which the first two are cut off.
        return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


class CheckPool:
    """Pool of workers; called from many threads."""

    def __init__(self, *, workers: int, limit_s: float, memory_bytes: int) -> None:
        self._limit_s = limit_s
        self._memory_bytes = memory_bytes
        self._lock = threading.Lock()
        self._closed = False
        self._nursery: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._places = workers + WAITING_MAX
        self._taken: Counter[Hashable] = Counter()
        """Places taken, by holder."""
        # Last in, first out: the same few workers serve a small load, and no others are made for it.
        self._idle: queue.LifoQueue[_Worker | None] = queue.LifoQueue()
        for _ in range(workers):
            self._idle.put(None)  # a place for a worker, made when it is needed

    def check(self, data: bytes, holder: Hashable) -> Checked:
        """Check a commit in a worker, in a place of the holder of a token, who has as many as it leaves free.

        Raises:
            BadInputError: kind `too_costly`, or what the worker found wrong.
            DamagedDataError: what the worker found wrong.
            UnreachableError: kind `busy`: too many wait; kind `check_failed`: workers were killed, or starved;
                kind `shutting_down`.
        """
        # More would take the web server's threads from robots whose commits are cheap.
        self._take_place(holder)
        try:
            for _ in range(2):  # a worker killed from outside costs one more try
                with suppress(_LostError):
                    return self._checked(data)
                log.warning("a worker that checked a commit of %d bytes was killed", len(data))
            raise UnreachableError(
                "check_failed", "the processes that check commits are being killed", retry_after_s=30.0
            )
        finally:
            self._leave_place(holder)

    def _take_place(self, holder: Hashable) -> None:
        """Take a place, while others are left half of what is free, as with bodies (`access.body_budget`)."""
        with self._lock:
            if self._taken[holder] >= self._places - self._taken.total():
                self._taken += Counter()  # drops zeros: else every holder ever seen would stay
                raise UnreachableError("busy", "many large commits are being checked", retry_after_s=5.0)
            self._taken[holder] += 1

    def _leave_place(self, holder: Hashable) -> None:
        with self._lock:
            self._taken[holder] -= 1
            self._taken += Counter()

    def close(self) -> None:
        """End all workers; checks under way fail. May be called twice."""
        with self._lock:
            self._closed = True
            nursery, control = self._nursery, self._control
            self._nursery = self._control = None
        # With `_closed` set no nursery is started any more, so this is the last one.
        if control is not None:
            control.close()
        # Its workers die with it.
        if nursery is not None:
            nursery.kill()
            nursery.wait()
        with suppress(queue.Empty):
            while True:
                worker = self._idle.get_nowait()
                if worker is not None:
                    worker.jobs.close()

    def _checked(self, data: bytes) -> Checked:
        # The place that is taken here goes back in every case, with a worker in it or without.
        try:
            worker = self._idle.get(timeout=WAIT_S)
        except queue.Empty:
            raise UnreachableError("busy", "all workers check other commits", retry_after_s=5.0) from None
        try:
            worker = worker or self._new_worker()
            answer = worker.answer(data, self._limit_s)
            if answer["retires"]:
                worker.jobs.close()
                worker = None
        except BaseException:
            # Refused or lost in the middle of a commit: its process is in no known state.
            if worker is not None:
                worker.kill()
                worker = None
            raise
        finally:
            self._idle.put(worker)
        return self._read(answer)

    def _read(self, answer: dict[str, object]) -> Checked:
        if "memory" in answer:
            raise _too_costly(f"more than the {self._memory_bytes} bytes of memory that this server has for one check")
        return checked_from(answer)

    def _new_worker(self) -> _Worker:
        # The nursery forks a worker for the other end of the pair, and the worker says its number through it.
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                self._ask_for_worker(theirs)
                return _Worker(ours)
            except (OSError, _LostError) as exc:
                ours.close()
                raise _LostError from exc
            except BaseException:
                ours.close()
                raise

    def _ask_for_worker(self, theirs: socket.socket) -> None:
        with self._lock:
            if self._closed:
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            control = self._control
            # A nursery that was killed is replaced by the first commit that needs one.
            if control is None or self._nursery is None or self._nursery.poll() is not None:
                control = self._start_nursery()
            socket.send_fds(control, [b"w"], [theirs.fileno()])

    def _start_nursery(self) -> socket.socket:
        if self._control is not None:
            self._control.close()
        # A program of its own: the server has threads, and must not fork.
        self._control, far = socket.socketpair()
        with far:
            # It gets nothing of the server's: no CAIRN_ variable, for there are secrets in them; no terminal's Ctrl-C;
            # and by `command_of` no module from the folder that the server was started in.
            self._nursery = subprocess.Popen(  # noqa: S603 - our own program, and two numbers
                command_of("cairn_server.sync.checks.worker_nursery", [str(far.fileno()), str(self._memory_bytes)]),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                pass_fds=[far.fileno()],
                start_new_session=True,
                env={n: v for n, v in os.environ.items() if not n.startswith("CAIRN_")} | {"OPENBLAS_NUM_THREADS": "1"},
            )
        threading.Thread(target=_log_lines, args=(self._nursery.stderr,), daemon=True).start()
        return self._control


def _log_lines(stream: IO[bytes]) -> None:
    """Log what a nursery and its workers write to standard error, until all are gone: the log has one form."""
    with stream:
        for line in stream:
            log.warning("worker: %s", line.decode(errors="replace").rstrip())


def _too_costly(what: str) -> BadInputError:
    return BadInputError("too_costly", f"checking this commit takes {what}; make several commits of it")
