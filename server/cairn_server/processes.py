"""Child processes of the server: they die with their parent, and are spoken to in length-prefixed messages."""

import ctypes
import os
import signal
import socket
import struct

LENGTH = struct.Struct("<Q")


PR_SET_PDEATHSIG = 1


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
