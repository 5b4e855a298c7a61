"""A connection that stays open, as little work as can be: HTTP/1.1 and frames as bytes.

Who asks shares the processors with who is asked. So an answer is read into one buffer, and of its frames only the
lengths, the first one's cursor and the last one's kind are looked at; what the frames say is checked by robots that
are whole (`whole_robots`).
"""

import asyncio
import re
import socket
from collections import Counter
from dataclasses import dataclass
from typing import Self

from cairn_map.evidence.grid import CellKey
from cairn_map.wire.frames import MAGIC, PREFIX, CellFrame, FrameKind, frames_of

ANSWER_S = 60.0
CHUNK_BYTES = 1 << 18
LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.IGNORECASE)
CHUNKED = re.compile(rb"\r\ntransfer-encoding: *chunked", re.IGNORECASE)
TO = re.compile(rb'\{"to":"([^"]+)"')
CHECKSUM_BYTES = 4


class BadAnswerError(Exception):
    """An answer that no server should give; its text is the kind of error."""


@dataclass(frozen=True, slots=True)
class Told:
    """What a reply to `missing` says, as far as it was looked at."""

    cursor: str
    kinds: Counter[FrameKind]
    brought: tuple[CellKey, ...] | None
    """Cells of a reply that ended before all of them were sent; None: it was whole."""

    @classmethod
    def by(cls, reply: bytes | bytearray) -> Self:
        """A whole reply.

        Raises:
            BadAnswerError: it does not begin with a header, or ends neither with `done` nor with `more`.
        """
        start = len(MAGIC) + 1
        to = TO.match(reply, start + PREFIX.size)
        if to is None or not reply.startswith(MAGIC) or reply[start + PREFIX.size - 1] != FrameKind.HEADER:
            raise BadAnswerError("no header")
        kinds: Counter[FrameKind] = Counter()
        last, at = 0, start
        while at + PREFIX.size <= len(reply):
            size, last = PREFIX.unpack_from(reply, at)
            kinds[FrameKind(last)] += 1
            at += PREFIX.size + size + CHECKSUM_BYTES
        if at != len(reply) or last not in (FrameKind.DONE, FrameKind.MORE):
            raise BadAnswerError("no end of the frames")
        brought = None
        if last == FrameKind.MORE:
            brought = tuple(frame.cell for frame in frames_of(bytes(reply)) if isinstance(frame, CellFrame))
        return cls(to[1].decode(), kinds, brought)


class Link:
    """One connection."""

    def __init__(self, port: int, token: str) -> None:
        self.token = token
        self._port = port
        self._socket: socket.socket | None = None
        self.received_bytes = self.sent_bytes = 0

    async def open(self) -> None:
        """Connect."""
        self._socket = socket.socket()
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.get_running_loop().sock_connect(self._socket, ("127.0.0.1", self._port))

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()

    async def ask(self, method: str, path: str, body: bytes, *, media_type: str = "application/json") -> bytearray:
        """The body of an answer that is no error.

        Raises:
            BadAnswerError: another status than 200, 201 or 204, named by it.
            OSError: the connection is lost, or nothing came for too long.
        """
        head = (
            f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{self._port}\r\nAuthorization: Bearer {self.token}\r\n"
            f"Content-Type: {media_type}\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        async with asyncio.timeout(ANSWER_S):
            status, answer = await self._exchange(head.encode() + body)
        if status not in (200, 201, 204):
            raise BadAnswerError(f"{method} {status} {_kind(answer)}")
        return answer

    async def _exchange(self, request: bytes) -> tuple[int, bytearray]:
        assert self._socket is not None
        loop, link = asyncio.get_running_loop(), self._socket
        await loop.sock_sendall(link, request)
        self.sent_bytes += len(request)
        data = bytearray()
        while (end := data.find(b"\r\n\r\n")) < 0:
            data += _some(await loop.sock_recv(link, CHUNK_BYTES))
        if CHUNKED.search(data, 0, end):
            body = await self._chunks(data[end + 4 :])
            self.received_bytes += end + 4 + len(body)
            return int(data[9:12]), body
        found = LENGTH.search(data, 0, end)
        body = bytearray(int(found[1]) if found else 0)
        at = len(data) - end - 4
        body[:at] = data[end + 4 :]
        with memoryview(body) as view:
            while at < len(body):
                count = await loop.sock_recv_into(link, view[at : at + CHUNK_BYTES])
                if not count:
                    raise ConnectionResetError("cut off")
                at += count
        self.received_bytes += end + 4 + len(body)
        return int(data[9:12]), body

    async def _chunks(self, data: bytearray) -> bytearray:
        """The body of an answer that comes in chunks; `data` is what came with its head."""
        assert self._socket is not None
        loop, link, body, at = asyncio.get_running_loop(), self._socket, bytearray(), 0
        while True:
            while (end := data.find(b"\r\n", at)) < 0:
                data += _some(await loop.sock_recv(link, CHUNK_BYTES))
            size = int(data[at:end], 16)
            at = end + 2 + size + 2
            while len(data) < at:
                data += _some(await loop.sock_recv(link, CHUNK_BYTES))
            if not size:
                return body
            body += memoryview(data)[end + 2 : at - 2]


def _some(data: bytes) -> bytes:
    if not data:
        raise ConnectionResetError("closed")
    return data


def _kind(answer: bytearray) -> str:
    found = re.search(rb'"kind": ?"(\w+)"', answer)
    return found[1].decode() if found else ""
