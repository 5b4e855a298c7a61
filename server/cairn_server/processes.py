"""Child processes of the server: they die with their parent, and are spoken to in length-prefixed messages."""

import ctypes
import os
import signal
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

LENGTH = struct.Struct("<Q")


PR_SET_PDEATHSIG = 1
STANDARD_STREAMS = 3


def fork(work: Callable[[Connection], None]) -> tuple[Connection, int]:
    """Fork a process that does this work over a link until it returns; only before there are threads.

    Returns:
        This end of the link, and the number of the process.
    """
    ours, theirs = socket.socketpair()
    parent = os.getpid()
    pid = os.fork()
    if pid == 0:
        # The child: never returns from here, whatever happens.
        try:
            die_with_parent(parent)
            # Ends of the links to other children: a link must end when its owner closes it.
            os.closerange(STANDARD_STREAMS, theirs.fileno())
            os.closerange(theirs.fileno() + 1, os.sysconf("SC_OPEN_MAX"))
            for number in (
                signal.SIGINT,
                signal.SIGTERM,
                signal.SIGHUP,
            ):  # sent to the whole group: the server ends first, in order
                signal.signal(number, signal.SIG_IGN)
            work(Connection(theirs.detach()))
        finally:
            os._exit(0)
    theirs.close()
    return Connection(ours.detach()), pid


def used_bytes(pid: int | None = None) -> int:
    """Memory of a process (None: this one) and of all its children: what pages shared among them take counts once.

    It is the proportional set size; the resident one of a process whose own the kernel does not tell.
    """
    total, waiting = 0, [os.getpid() if pid is None else pid]
    while waiting:
        folder = Path(f"/proc/{waiting.pop()}")
        with suppress(OSError):  # it has ended
            try:
                lines = (folder / "smaps_rollup").read_text().splitlines()
                total += sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))
            except OSError:
                total += int((folder / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            for children in folder.glob("task/*/children"):
                waiting += map(int, children.read_text().split())
    return total


def send(channel: socket.socket, data: bytes) -> None:
    """Send a length, and as many bytes."""
    channel.sendall(LENGTH.pack(len(data)))
    channel.sendall(data)


def received(channel: socket.socket) -> bytes | None:
    """Bytes that `send` sent; None if the other side closed instead."""
    head = _exactly(channel, LENGTH.size)
    return None if head is None else _exactly(channel, LENGTH.unpack(head)[0])


def _exactly(channel: socket.socket, size_bytes: int) -> bytes | None:
    data = bytearray(size_bytes)
    view, at = memoryview(data), 0
    while at < size_bytes:
        got = channel.recv_into(view[at:])
        if not got:
            return None
        at += got
    return bytes(data)


def die_with_parent(parent: int) -> None:
    """End this process as soon as its parent, the process of this number, ends in any way."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    if os.getppid() != parent:
        os._exit(0)  # the parent died meanwhile
