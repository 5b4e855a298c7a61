"""What carries commits in a simulation: relays between two places, over links that fail, and bags that robots carry."""

from collections.abc import Callable
from random import Random
from typing import Any

from tests.sync_sim.events import Events
from tests.sync_sim.network import TIMEOUT_S, Weather
from tests.sync_sim.server import SimServer

from cairn_client.relay.link import answer_of
from cairn_client.relay.round import GiveCommit, RelayReport, RelaySide, Undelivered, relay_round
from cairn_client.sync.requests import Ask, Conversation
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import CairnError, NotFoundError, UnreachableError
from cairn_map.wire.relay_peer import Held, MapEnd, SignedCommit
from cairn_server.access.auth import Caller, Role
from cairn_server.operations.upstream import OwnEnd

FIELD = Caller(Role.RELAY, name="field")


class SimEnd:
    """A server of a simulation as a relay's place, whatever service stands for it now."""

    def __init__(self, server: SimServer) -> None:
        self._server = server

    def held(self) -> Held:
        return OwnEnd(self._server.service, self._server.row).held()

    def commit(self, commit: CommitId) -> SignedCommit:
        return OwnEnd(self._server.service, self._server.row).commit(commit)

    def push(self, commit: SignedCommit) -> None:
        self._server.hand_over(commit, by=FIELD)


class Bag:
    """What a robot carries, in memory."""

    def __init__(self) -> None:
        self.commits: dict[CommitId, SignedCommit] = {}

    def held(self) -> Held:
        return Held(vector=EMPTY.with_commits(self.commits))

    def commit(self, commit: CommitId) -> SignedCommit:
        if commit not in self.commits:
            raise NotFoundError("no_commit", f"{commit} is not carried")
        return self.commits[commit]

    def push(self, commit: SignedCommit) -> None:
        self.commits[commit.id] = commit


class SimRelay:
    """Rounds between two places, one at a time."""

    def __init__(self, events: Events, random: Random, weather: Callable[[], Weather], here: MapEnd, there: MapEnd):
        self._events = events
        self._random = random
        self._weather = weather
        self._ends = {RelaySide.HERE: here, RelaySide.THERE: there}
        self._round: Conversation[RelayReport] | None = None
        self.report: RelayReport | None = None
        """Of the last whole round."""

    @property
    def is_busy(self) -> bool:
        """Whether a round is under way."""
        return self._round is not None

    def start(self) -> None:
        """Begin a round, unless one is under way."""
        if self._round is None:
            self._round = conversation = relay_round(Undelivered(rest_s=0.0, clock_s=lambda: self._events.now_s))
            self._advance(conversation, lambda: next(conversation))

    def stop(self) -> None:
        """It ends without a word."""
        self._round = None

    def _advance(self, conversation: Conversation[RelayReport], step: Callable[[], Ask[Any]]) -> None:
        try:
            ask = step()
        except StopIteration as end:
            self.report, self._round = end.value, None
        except UnreachableError:
            self._round = None
        else:
            self._send(conversation, ask)

    def _send(self, conversation: Conversation[RelayReport], ask: Ask[Any]) -> None:
        weather, heard = self._weather(), [False]

        def hear(answer: Any) -> None:
            if heard[0] or self._round is not conversation:
                return
            heard[0] = True
            if isinstance(answer, CairnError):
                self._advance(conversation, lambda: conversation.throw(answer))
            else:
                self._advance(conversation, lambda: conversation.send(answer))

        def arrive() -> None:
            answer = self._answer(ask)
            if not self._is(weather.lost):
                self._events.after(self._random.random() * weather.delay_s, lambda: hear(answer))

        self._events.after(TIMEOUT_S, lambda: hear(UnreachableError("no_link", "no answer in time")))
        for _ in range(1 + self._is(weather.doubled)):
            if not self._is(weather.lost):
                self._events.after(self._random.random() * weather.delay_s, arrive)

    def _answer(self, ask: Ask[Any]) -> Any:
        try:
            if isinstance(ask, GiveCommit) and self._is(self._weather().damaged):
                forged = tampered(ask.commit, self._random)
                answer_of(self._ends, GiveCommit(ask.side, forged))
                is_bag = isinstance(self._ends[ask.side], Bag)
                assert is_bag or open_commit(forged.data)[0].sha == open_commit(ask.commit.data)[0].sha
                if is_bag:  # whoever carries looks at nothing; the next server will
                    self._ends[ask.side].push(ask.commit)
                return None
            return answer_of(self._ends, ask)
        except CairnError as exc:
            return exc

    def _is(self, share: float) -> bool:
        return self._random.random() < share


def tampered(commit: SignedCommit, random: Random) -> SignedCommit:
    """The same with one bit changed."""
    at = random.randrange(len(commit.data))
    data = commit.data[:at] + bytes([commit.data[at] ^ (1 << random.randrange(8))]) + commit.data[at + 1 :]
    return SignedCommit(commit.id, data, commit.signatures)
