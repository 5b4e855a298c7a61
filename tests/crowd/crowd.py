"""Robots that only speak the protocol: each with a connection that stays open, in rounds as `cairn_client` has them.

    every so often    missing from the own cursor; once a minute one scan before it, and a status after it

Rounds of all robots are spread evenly over the time between two, and so are their pushes over the minute. A robot
that was late does not catch up: it skips rounds, which are counted.
"""

import asyncio
import base64
import json
import time
from dataclasses import dataclass

from tests.bench.pushing import Bodies
from tests.crowd.figures import Seen, Times
from tests.crowd.link import BadAnswerError, Link, Told
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_server.http.middleware.token_first import TOKEN_PREFIX
from cairn_server.http.routes.live import PROTOCOL
from cairn_server.http.routes.sync import COMMIT_MEDIA_TYPE

INCARNATION = "0" * 16  # what `Bodies` writes
LAST_FETCHES_AT_ONCE = 8
JOINS_MAX = 50
"""Most requests of a first fetch: one ends early when the map's head moves between two of its parts."""


@dataclass(frozen=True, slots=True)
class Crowd:
    """How many there are, and how often they do what."""

    robots: int
    listeners: int
    seconds: float
    sync_s: float = 2.0
    push_s: float = 60.0

    @property
    def join_s(self) -> float:
        """They come one after the other in this time."""
        return min(20.0, self.seconds / 4)

    @property
    def pushes_each(self) -> int:
        """Rounds between two pushes of one robot."""
        return max(1, round(self.push_s / self.sync_s))


class CrowdRobot:
    """One of them."""

    def __init__(self, port: int, token: str, map_name: str, number: int, bodies: Bodies, seen: Seen) -> None:
        self.name = f"robot{number}"
        self.cursor: str | None = None
        self.link = Link(port, token)
        self._number = number
        self._path = f"/maps/{map_name}"
        self._bodies = bodies
        self._seen = seen
        self._pushed = 0
        self._held: dict[CellKey, str] = {}
        """Cursors of cells that came in replies which ended early, until one comes whole."""

    async def join(self) -> None:
        """Register, and fetch the whole map."""
        await self.link.open()
        body = json.dumps({"robot": self.name, "incarnation": INCARNATION}).encode()
        answer = await self.link.ask("POST", f"{self._path}/branches", body)
        self.link.token = json.loads(answer)["token"]
        start_s = time.perf_counter()
        for _ in range(JOINS_MAX):
            await self.fetch(Times())
            if self.cursor is not None:
                self._seen.joins.seconds.append(time.perf_counter() - start_s)
                return
        raise BadAnswerError("no end of the first fetch")

    async def live(self, crowd: Crowd, phase_s: float, end_s: float) -> None:
        """Rounds until the end, at times after `phase_s` that are whole multiples of `sync_s`."""
        # Robots with neighbouring numbers have rounds right after each other, so each pushes in another round.
        offset = self._number % crowd.pushes_each
        number = int((time.perf_counter() - phase_s) // crowd.sync_s) + 1
        due_s = phase_s + number * crowd.sync_s
        while due_s < end_s:
            await asyncio.sleep(due_s - time.perf_counter())
            try:
                has_moved = number % crowd.pushes_each == offset
                if has_moved:
                    await self.push()
                await self.fetch(self._seen.fetches)
                if has_moved:
                    await self.report()
            except (BadAnswerError, OSError) as exc:
                self._seen.errors[_named(exc)] += 1
                await self._again()
            number, due_s = number + 1, due_s + crowd.sync_s
            while due_s < time.perf_counter() - crowd.sync_s:
                number, due_s = number + 1, due_s + crowd.sync_s
                self._seen.skipped += 1

    async def push(self) -> None:
        """One scan, under an id of its own."""
        data = self._bodies.body(self.name, self._pushed, diff=self._number * 7 + self._pushed)
        commit = f"{self.name}.{INCARNATION}.{self._pushed}"
        start_s = time.perf_counter()
        await self.link.ask("PUT", f"{self._path}/commits/{commit}", data, media_type=COMMIT_MEDIA_TYPE)
        now_s = time.perf_counter()
        self._seen.pushes.seconds.append(now_s - start_s)
        self._seen.pushed_s.append(now_s)
        self._pushed += 1

    async def fetch(self, times: Times) -> None:
        """What is missing."""
        request = {
            "author": f"{self.name}.{INCARNATION}",
            "cursor": self.cursor,
            "since": "cursor" if self.cursor else None,
            "kinds": ["delta", "state", "full"],
            "cells": [{"cell": cell_of_key(key), "cursor": cursor} for key, cursor in self._held.items()],
        }
        start_s = time.perf_counter()
        reply = await self.link.ask("POST", f"{self._path}/branches/{self.name}/missing", json.dumps(request).encode())
        times.seconds.append(time.perf_counter() - start_s)
        told = Told.by(reply)
        if self.cursor is not None and _order(told.cursor) < _order(self.cursor):
            raise BadAnswerError("the head went back")
        self._seen.frames.update(told.kinds)
        if told.brought is None:
            self.cursor, self._held = told.cursor, {}
        else:
            self._held |= dict.fromkeys(told.brought, told.cursor)

    async def report(self) -> None:
        """Where it is and how it does."""
        pose = {"time_s": time.time(), "t_map_rig": [1.0, 2.0, 0.4], "q_map_rig": [0.0, 0.0, 0.0, 1.0]}
        status = {"time_s": time.time(), "pose": pose, "mode": "high-end", "battery": 0.5}
        start_s = time.perf_counter()
        await self.link.ask("PUT", f"{self._path}/branches/{self.name}/status", json.dumps(status).encode())
        self._seen.reports.seconds.append(time.perf_counter() - start_s)

    async def _again(self) -> None:
        """A connection may be anywhere after an error; take another."""
        self.link.close()
        try:
            await self.link.open()
        except OSError as exc:
            self._seen.errors[_named(exc)] += 1


async def live_together(crowd: Crowd, robots: list[CrowdRobot], seen: Seen, *, start_s: float) -> None:
    """All robots' rounds, from one joining after the other to the end."""
    end_s = start_s + crowd.seconds

    async def one(number: int, robot: CrowdRobot) -> None:
        joins_s = start_s + crowd.join_s * number / crowd.robots
        await asyncio.sleep(joins_s - time.perf_counter())
        try:
            await robot.join()
        except (BadAnswerError, OSError) as exc:
            seen.errors[f"join: {_named(exc)}"] += 1
            return
        # Where its rounds would be, had it been there from the start: so they are spread evenly.
        phase_s = start_s + crowd.sync_s * number / crowd.robots
        await robot.live(crowd, phase_s, end_s)

    await asyncio.gather(*(one(number, robot) for number, robot in enumerate(robots)))


async def fetch_all(robots: list[CrowdRobot], seen: Seen, head: str) -> int:
    """Everybody's last fetch, when nothing is pushed any more; how many stand at the head then."""
    places = asyncio.Semaphore(LAST_FETCHES_AT_ONCE)

    async def one(robot: CrowdRobot) -> bool:
        async with places:
            robot.link.close()  # the server may have cut it meanwhile: nothing came for long
            try:
                await robot.link.open()
                await robot.fetch(Times())
            except (BadAnswerError, OSError) as exc:
                seen.errors[f"last fetch: {_named(exc)}"] += 1
            return robot.cursor == head

    return sum(await asyncio.gather(*(one(robot) for robot in robots)))


async def listen(port: int, map_name: str, token: str, seen: Seen) -> None:
    """A browser that shows what happens, until it is cancelled."""
    shown = base64.urlsafe_b64encode(token.encode()).decode().rstrip("=")
    offered = [Subprotocol(PROTOCOL), Subprotocol(TOKEN_PREFIX + shown)]
    url = f"ws://127.0.0.1:{port}/maps/{map_name}/live"
    try:
        async with connect(url, subprotocols=offered, compression=None) as socket:
            async for text in socket:
                event = json.loads(text)
                seen.events[event["type"]] += 1
                if event["type"] == "head":
                    seen.heads.append((time.perf_counter(), _order(event["cursor"])))
            seen.errors[f"live: closed {socket.close_code}"] += 1
    except (WebSocketException, OSError) as exc:
        seen.errors[f"live: {_named(exc)}"] += 1


def _order(cursor: str) -> int:
    return int(cursor.split(".")[1])


def _named(exc: Exception) -> str:
    return str(exc) if isinstance(exc, BadAnswerError) else type(exc).__name__
