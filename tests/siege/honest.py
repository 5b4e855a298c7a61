"""Honest robots and a probe, and how long each of them waits."""

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import httpx
from tests.fixtures.server.access import bearer
from tests.fixtures.server.pushes import pushed

from cairn_map.commits.ids import Author, Incarnation, RobotName

EVERY_S = 0.1


@dataclass(slots=True)
class Waits:
    """Seconds that answers took, by kind, and answers that were none."""

    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    failed: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def at(self, kind: str, share: float) -> float:
        """Quantile."""
        found = sorted(self.seconds[kind])
        return found[min(len(found) - 1, int(share * len(found)))] if found else math.nan


class HonestLoad:
    """Robots that push and ask what they miss ten times a second, and a probe of /healthz over fresh connections."""

    def __init__(self, url: str, tokens: dict[str, str], *, verify: str | bool = True) -> None:
        self._url = url
        self._tokens = tokens
        self._verify = verify
        self._numbers: dict[str, int] = defaultdict(int)

    def live(self, seconds: float) -> Waits:
        """All that they saw in so many seconds."""
        waits, end_s = Waits(), time.monotonic() + seconds
        threads = [threading.Thread(target=self._robot, args=(name, waits, end_s)) for name in self._tokens]
        threads.append(threading.Thread(target=self._probe, args=(waits, end_s)))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return waits

    def _robot(self, name: str, waits: Waits, end_s: float) -> None:
        author = Author(RobotName(name), Incarnation("0123456789abcdef"))
        with self._client(bearer(self._tokens[name])) as http:
            while time.monotonic() < end_s:
                commit = pushed(self._numbers[name], self._numbers[name] % 5, author)
                push = partial(http.put, f"/maps/lab/commits/{commit.id}", content=commit.data)
                self._numbers[name] += self._timed(waits, "push", push)
                self._timed(waits, "missing", lambda: http.post(f"/maps/lab/branches/{name}/missing", json={}))
                time.sleep(EVERY_S)

    def _probe(self, waits: Waits, end_s: float) -> None:
        while time.monotonic() < end_s:
            with self._client({}) as http:
                self._timed(waits, "healthz", lambda: http.get("/healthz"))
            time.sleep(EVERY_S)

    def _client(self, headers: dict[str, str]) -> httpx.Client:
        return httpx.Client(base_url=self._url, headers=headers, timeout=20, verify=self._verify)

    @staticmethod
    def _timed(waits: Waits, kind: str, ask: Callable[[], httpx.Response]) -> bool:
        """Ask once, and once more over a new connection if the idle one was cut; True if it was answered well."""
        start_s = time.monotonic()
        for _ in range(2):
            try:
                answer = ask()
            except httpx.TransportError as exc:
                what = type(exc).__name__
                continue
            waits.seconds[kind].append(time.monotonic() - start_s)
            what = "" if answer.status_code < 300 else str(answer.status_code)
            break
        if what:
            waits.failed[f"{kind} {what}"] += 1
        return not what
