"""A TCP proxy that behaves like a bad link, in a thread of its own; seeded by whoever draws its faults.

robot ---- proxy: delay, bandwidth, loss, a cut after n bytes ---- server
"""

import asyncio
import math
import re
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from random import Random
from types import TracebackType
from typing import Literal, Self

PACKET_BYTES = 1460
WHOLE_BYTES = 1 << 16
FIRST_AGAIN_S = 0.2
"""A lost packet is sent again after this, and then after twice as long (TCP's least on Linux)."""
RESET = struct.pack("ii", 1, 0)
"""SO_LINGER: what is not sent is thrown away, and the other side is told so."""
REQUEST = re.compile(rb"[A-Z]+ /\S* HTTP/1\.1")
Cut = Literal["close", "half", "reset"]


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens to one connection."""

    delay_s: float = 0.0
    """One way."""
    loss: float = 0.0
    """Share of packets that must be sent again."""
    up_bytes: float = float("inf")
    """Cut after so many bytes of the robot's."""
    down_bytes: float = float("inf")
    """Cut after so many bytes of the server's."""
    answers: float = float("inf")
    """Cut before this one of the server's answers, so that it is lost whole."""
    cut: Cut = "close"
    """close: both sides see the end. half: the robot does, the server goes on for a while. reset: what is under way
    is gone."""


NO_FAULT = Fault()


class _Way:
    """One direction of the link: one packet after the other, at its rate."""

    def __init__(self, bytes_per_s: float, random: Random) -> None:
        self._bytes_per_s = bytes_per_s
        self._random = random
        self._free_s = 0.0
        self.size_bytes = 0
        """Carried so far, each byte once."""
        self.air_bytes = 0
        """The same with what was sent again."""

    async def carry(self, size_bytes: int, fault: Fault) -> None:
        """Wait until so many bytes are over."""
        loop = asyncio.get_running_loop()
        again_s = FIRST_AGAIN_S
        while True:
            self.air_bytes += size_bytes
            if self._free_s < loop.time():  # a burst begins: the packets behind its first one are on their way with it
                self._free_s = loop.time() + fault.delay_s
            self._free_s += size_bytes / self._bytes_per_s
            wait_s = self._free_s - loop.time()
            if wait_s > 0:
                await asyncio.sleep(wait_s)
            if self._random.random() >= fault.loss:
                self.size_bytes += size_bytes
                return
            await asyncio.sleep(again_s)
            again_s *= 2


class FaultProxy:
    """Listens on a free port of its own and passes on to the server's, which may change."""

    def __init__(
        self,
        port: int,
        *,
        fault: Callable[[], Fault] = lambda: NO_FAULT,
        bytes_per_s: float = float("inf"),
        random: Random | None = None,
    ) -> None:
        """`fault` is called for each connection, `bytes_per_s` is shared by all of them, each way."""
        self.server_port = port
        self.fault = fault
        self.is_down = False
        """Refuse everything."""
        self.connections = self.cuts = 0
        self.requests: list[bytes] = []
        """First lines of what the robot asked, in order."""
        random = random or Random(0)
        self.up, self.down = _Way(bytes_per_s, random), _Way(bytes_per_s, random)
        self._packet_bytes = PACKET_BYTES if bytes_per_s < float("inf") else WHOLE_BYTES
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._run, name="fault-proxy")
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    @property
    def size_bytes(self) -> int:
        """Carried both ways, heads of HTTP and all."""
        return self.up.size_bytes + self.down.size_bytes

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        async with await asyncio.start_server(self._connected, sock=self._listener):
            await self._stop.wait()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        self.connections += 1
        fault = self.fault()
        server: asyncio.StreamWriter | None = None
        with suppress(OSError, asyncio.CancelledError):
            if not self.is_down:
                answers, server = await asyncio.open_connection("127.0.0.1", self.server_port)
                await self._pass_on((reader, server), (answers, writer), fault)
        for end in (writer, server):
            if end is not None:
                end.close()

    async def _pass_on(
        self,
        up: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        down: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        fault: Fault,
    ) -> None:
        ways = [
            asyncio.create_task(self._pump(*up, self.up, fault, fault.up_bytes)),
            asyncio.create_task(self._pump(*down, self.down, fault, fault.down_bytes)),
        ]
        try:
            done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            if any(way.exception() is None and way.result() for way in done):
                self.cuts += 1
                if fault.cut == "half":
                    down[1].write_eof()
                    await asyncio.sleep(0.05)
                elif fault.cut == "reset":
                    for _, end in (up, down):
                        end.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: _Way, fault: Fault, left: float
    ) -> bool:
        """Pass bytes on until one side ends (False) or it is time for the cut (True)."""
        left = math.floor(left) if math.isfinite(left) else left
        answers = 0
        while data := await reader.read(self._packet_bytes):
            if left < len(data):
                data = data[: int(left)]
            left -= len(data)
            if way is self.up and (asked := REQUEST.match(data)):
                self.requests.append(asked[0])
            if way is self.down and data.startswith(b"HTTP/1.1 "):
                answers += 1
                if answers >= fault.answers:
                    return True
            if data:
                await way.carry(len(data), fault)
                writer.write(data)
                await writer.drain()
            if left <= 0:
                return True
        return False
