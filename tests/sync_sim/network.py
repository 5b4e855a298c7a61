"""Links between robots and the server: each message late, and some lost, doubled, cut or damaged."""

from collections.abc import Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

from tests.sync_sim.events import Events
from tests.sync_sim.robot import SimRobot
from tests.sync_sim.server import SimServer

from cairn_client.sync.requests import Ask, GetMissing, NextFrame
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.wire.frames import Frame
from cairn_map.wire.resumed_replies import Replies, Reply

TIMEOUT_S = 8.0


@dataclass(slots=True)
class Weather:
    """How often what goes wrong."""

    lost: float = 0.0
    doubled: float = 0.0
    cut: float = 0.0
    damaged: float = 0.0
    delay_s: float = 0.1


class Network:
    """One server's links."""

    def __init__(self, events: Events, server: SimServer, random: Random) -> None:
        self.weather = Weather()
        self.offline: set[str] = set()
        self._events = events
        self._server = server
        self._random = random
        self._replies: dict[tuple[str, int], Iterator[Frame | CairnError]] = {}
        """Of rounds, the reply that is coming in."""
        self._memories: dict[str, Replies] = {}
        """What each robot remembers of its replies."""

    def ask(self, robot: SimRobot, number: int, ask: Ask[Any]) -> None:
        """Send a request of a round; the robot hears of it in a while, one way or the other."""
        if isinstance(ask, NextFrame):
            self._hand_over(robot, number)
            return
        self._replies.pop((robot.name, number), None)
        answered = [False]
        reply: Reply | None = None
        if isinstance(ask, GetMissing):
            reply = self._memories.setdefault(robot.name, Replies()).reply_to(ask.request)
            ask = GetMissing(reply.request)

        def give_up() -> None:
            if not answered[0] and robot.is_in(number):
                answered[0] = True
                robot.failed(number, UnreachableError("no_link", "no answer in time"))

        def hear(answer: Any) -> None:
            if not answered[0] and robot.is_in(number):
                answered[0] = True
                self._hear(robot, number, reply, answer)

        self._events.after(TIMEOUT_S, give_up)
        for _ in range(1 + self._is(self.weather.doubled)):
            if not self._is_gone(robot):
                self._later(lambda: self._arrive(robot, ask, hear))

    def _arrive(self, robot: SimRobot, ask: Ask[Any], hear: Any) -> None:
        """A request is at the server."""
        try:
            answer = self._server.answer(robot.name, ask)
        except CairnError as exc:
            answer = exc
        if not self._is_gone(robot):
            self._later(lambda: hear(answer))

    def _hear(self, robot: SimRobot, number: int, reply: Reply | None, answer: Any) -> None:
        if isinstance(answer, CairnError):
            robot.failed(number, answer)
        elif reply is not None:
            self._replies[robot.name, number] = self._frames(reply, answer)
            self._hand_over(robot, number)
        else:
            robot.answered(number, answer)

    def _hand_over(self, robot: SimRobot, number: int) -> None:
        """The next frame of a reply, some time later."""
        reply = self._replies[robot.name, number]

        def hand_over() -> None:
            if robot.is_in(number):
                frame = next(reply, None)
                if isinstance(frame, CairnError):
                    robot.failed(number, frame)
                else:
                    robot.answered(number, frame)

        self._later(hand_over)

    def _frames(self, reply: Reply, data: bytes) -> Iterator[Frame | CairnError]:
        """What is read of a reply until it ends: whole, or cut at any byte, or damaged at any."""
        if not data:
            yield from reply.again()
            return
        if self._is(self.weather.damaged):
            at = self._random.randrange(len(data))
            data = data[:at] + bytes([data[at] ^ (1 << self._random.randrange(8))]) + data[at + 1 :]
        if self._is(self.weather.cut):
            data = data[: self._random.randrange(len(data))]
        try:
            yield from reply.frames([data])
        except CairnError as exc:
            yield exc

    def _later(self, event: Any) -> None:
        self._events.after(self._random.random() * self.weather.delay_s, event)

    def _is_gone(self, robot: SimRobot) -> bool:
        return robot.name in self.offline or self._is(self.weather.lost)

    def _is(self, share: float) -> bool:
        return self._random.random() < share
