"""The attacks, each a process of its own: it goes on until it is killed.

$ python -m tests.siege.attacks missing 8750 TOKEN
"""

import asyncio
import json
import random
import resource
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import cache

MAP = "lab"
AUTHOR = "mole.0123456789abcdef"
PATIENCE_S = 5.0
"""So long an attacker waits for an answer before it cuts its link."""
PAUSE_S, SILENT_PAUSE_S = 1.0, 15.0
"""Between two requests of one link: an attack is to cost the server more than the attacker, who shares its processors.
Who only connects does so again when a server that counts nothing would cut it."""


async def talk(port: int, data: bytes, *, wait_s: float) -> None:
    """Send, wait, and cut the link, whatever comes back."""
    with suppress(OSError, asyncio.IncompleteReadError, TimeoutError):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            writer.write(data)
            async with asyncio.timeout(wait_s):
                await writer.drain()
                while await reader.read(1 << 16):
                    pass
        finally:
            writer.transport.abort()


def request(method: str, path: str, token: str, body: bytes = b"", *, size_bytes: int | None = None) -> bytes:
    """Bytes of a request, whose body may be announced longer than it is."""
    size_bytes = len(body) if size_bytes is None else size_bytes
    lines = (
        f"{method} /maps/{MAP}/{path} HTTP/1.1",
        "Host: 127.0.0.1",
        f"Authorization: Bearer {token}",
        "Content-Type: application/json",
        "Connection: close",
        f"Content-Length: {size_bytes}",
    )
    return "\r\n".join((*lines, "", "")).encode() + body


@cache
def long_list(first: int, *, compare: bool) -> bytes:
    """Body that lists 100 000 cells that nobody ever saw; made once: the server is to pay, not who attacks."""
    cells = [[n % 300 + first, n // 300, 7] for n in range(100_000)]
    return json.dumps({"groups": [[None, cells]], "compare": compare}).encode()


async def missing(port: int, token: str) -> None:
    """Cells that nobody ever saw, by a robot's token."""
    body = long_list(random.randrange(4), compare=False)
    await talk(port, request("POST", "branches/mole/missing", token, body), wait_s=PATIENCE_S)


async def fingerprints(port: int, token: str) -> None:
    """The same, for fingerprints only, which all come in one reply."""
    body = long_list(random.randrange(4), compare=True)
    await talk(port, request("POST", "branches/mole/missing", token, body), wait_s=PATIENCE_S)


async def pictures(port: int, token: str) -> None:
    """A large picture that nobody asked for before, by a reader's token."""
    where = f"x={random.random()}&y=-3&z=0.5&range_m=50&width=1280&height=960&format=npz"
    await talk(port, request("GET", f"main/render?{where}", token), wait_s=60)


async def bodies(port: int, token: str) -> None:
    """A push of 64 MB that never ends."""
    size_bytes = 1 << 26
    path = f"commits/{AUTHOR}.{random.randrange(1 << 30)}"
    data = request("PUT", path, token, bytes(size_bytes - 1), size_bytes=size_bytes)
    await talk(port, data, wait_s=30)


async def junk(port: int, token: str) -> None:
    """15 MB of JSON, by a token that may not use the route, or may."""
    body = b'{"groups":[[null,[' + b"[1,2,3]," * 1_800_000 + b"[1,2,3]]]]}"
    await talk(port, request("POST", "branches/mole/missing", token, body), wait_s=PATIENCE_S)


async def silent(port: int, token: str) -> None:
    """Half a request line and no token."""
    await talk(port, b"GET /heal", wait_s=60)


async def handshake(port: int, token: str) -> None:
    """The first bytes of a TLS handshake."""
    await talk(port, b"\x16\x03\x01", wait_s=60)


Attack = Callable[[int, str], Coroutine[None, None, None]]
ATTACKS: dict[str, tuple[Attack, int, str]] = {
    "missing": (missing, 44, "robot"),
    "fingerprints": (fingerprints, 44, "robot"),
    "pictures": (pictures, 60, "reader"),
    "bodies": (bodies, 24, "robot"),
    "junk": (junk, 4, "reader"),
    "own junk": (junk, 4, "robot"),
    "silent": (silent, 700, "nobody"),
    "silent tls": (handshake, 700, "nobody"),
}
"""Each with the number of its connections, and whose token it shows."""


async def attack(name: str, port: int, token: str) -> None:
    """All connections of one attack, each begun again when it ends."""
    once, count, _ = ATTACKS[name]

    async def again_and_again() -> None:
        while True:
            await once(port, token)
            await asyncio.sleep(SILENT_PAUSE_S if once in (silent, handshake) else PAUSE_S)

    await asyncio.gather(*(again_and_again() for _ in range(count)))


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    asyncio.run(attack(sys.argv[1], int(sys.argv[2]), sys.argv[3]))
