"""Signed commits from one place to another and back: two servers, or a server and a robot that carries for others.

A round asks both places what they hold, and hands over the difference. Nothing is remembered from one round to the
next that matters: so order, repetition, other relays, circles, and servers that were restored or replaced change
nothing but how much there is to hand over. A relay cannot read what it hands over into being anything else: the
signatures are checked by who takes it.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from itertools import islice

from cairn_client.asks import Ask, Conversation
from cairn_map.commit import split_commit
from cairn_map.errors import CairnError, ConflictError, DamagedDataError, DeniedError, NotFoundError, UnreachableError
from cairn_map.ids import Author, CommitId
from cairn_map.relay_end import Held, SignedCommit

AT_ONCE = 1000
"""Commits handed over, in each direction, before both places are asked anew."""
REST_S = 600.0
"""A commit that could not be handed over is tried again after this."""
RESTING_MAX = 100_000


class Side(Enum):
    """The two places of a round."""

    HERE = "here"
    THERE = "there"


@dataclass(frozen=True, slots=True)
class AskHeld(Ask[Held]):
    """What a place holds."""

    side: Side


@dataclass(frozen=True, slots=True)
class TakeCommit(Ask[SignedCommit]):
    """A commit, whole."""

    side: Side
    id: CommitId


@dataclass(frozen=True, slots=True)
class GiveCommit(Ask[None]):
    """Keep this commit; answered when it is kept for good."""

    side: Side
    commit: SignedCommit


@dataclass(slots=True)
class Resting:
    """What could not be handed over, and is left alone for a while; only saves traffic."""

    rest_s: float = REST_S
    clock_s: Callable[[], float] = time.monotonic
    _until_s: dict[tuple[Side, CommitId], float] = field(default_factory=dict)

    def add(self, to: Side, commit: CommitId) -> None:
        """It could not be handed over to this side."""
        if len(self._until_s) >= RESTING_MAX:
            self._until_s.clear()
        self._until_s[to, commit] = self.clock_s() + self.rest_s

    def has(self, to: Side, commit: CommitId) -> bool:
        """Whether it is too early to try again."""
        return self._until_s.get((to, commit), float("-inf")) > self.clock_s()


@dataclass(slots=True)
class RelayReport:
    """What one round did."""

    moved: dict[Side, int] = field(default_factory=lambda: dict.fromkeys(Side, 0))
    """Commits handed over, by the side that they came to."""
    gone: list[CommitId] = field(default_factory=list)
    """Not kept any more where they were to come from: the other map lacks them."""
    unsigned: list[CommitId] = field(default_factory=list)
    refused: list[tuple[CommitId, CairnError]] = field(default_factory=list)
    split: list[Author] = field(default_factory=list)
    """Authors of whom the two sides have other bytes under the same ids."""
    has_more: bool = False
    """There was too much for one round."""


def relay_round(resting: Resting) -> Conversation[RelayReport]:
    """Hand over what either side lacks and the other has.

    Raises:
        UnreachableError: a link broke; what was handed over stays so.
        DeniedError: a server does not know this relay.
    """
    report = RelayReport()
    held = {}
    for side in Side:
        held[side] = yield from AskHeld(side)
    report.split = _split(held[Side.HERE], held[Side.THERE])
    yield from _hand_over(Side.HERE, Side.THERE, held, resting, report)
    yield from _hand_over(Side.THERE, Side.HERE, held, resting, report)
    return report


def _hand_over(
    source: Side, target: Side, held: dict[Side, Held], resting: Resting, report: RelayReport
) -> Conversation[None]:
    lacking = (commit for commit in _lacking(held[source], held[target]) if not resting.has(target, commit))
    for commit_id in islice(lacking, AT_ONCE):
        try:
            commit = yield from TakeCommit(source, commit_id)
        except (ConflictError, NotFoundError, DamagedDataError):
            if commit_id not in held[target].vector:  # else it is only wanted again, and not lacking
                report.gone.append(commit_id)
            resting.add(target, commit_id)
            continue
        if commit.signatures is None:
            report.unsigned.append(commit_id)
            resting.add(target, commit_id)
            continue
        try:
            yield from _give(source, target, commit)
        except UnreachableError:
            raise
        except CairnError as exc:
            if isinstance(exc, DeniedError) and exc.kind != "not_allowed":
                raise
            report.refused.append((commit_id, exc))
            resting.add(target, commit_id)
        else:
            report.moved[target] += 1
    report.has_more |= next(lacking, None) is not None


def _give(source: Side, target: Side, commit: SignedCommit) -> Conversation[None]:
    """Hand over one commit, and before it what it takes out, if the target forgot that (SYNC.md rule 11)."""
    try:
        yield from GiveCommit(target, commit)
    except ConflictError as exc:
        if exc.kind != "evidence_gone":
            raise
        for named in split_commit(commit.data)[0].retracted_ids:
            try:
                yield from GiveCommit(target, (yield from TakeCommit(source, named)))
            except (ConflictError, NotFoundError):
                continue
        yield from GiveCommit(target, commit)


def _lacking(source: Held, target: Held) -> Iterator[CommitId]:
    """What the source could give, each author's oldest first."""
    yield from source.vector.minus(target.vector)
    yield from (commit for commit in target.wanted if commit in source.vector)


def _split(here: Held, there: Held) -> list[Author]:
    """Authors of whom both have the same ids, and not the same commits."""
    return [
        author
        for author, total in here.sums.items()
        if there.sums.get(author, total) != total
        and here.vector.intervals.get(author) == there.vector.intervals.get(author)
    ]
