"""Signed commits from one place to another and back: two servers, or a server and a robot that carries for others.

A round asks both places what they hold, and hands over the difference. Nothing is remembered from one round to the
next that matters: so order, repetition, other relays, circles, and servers that were restored or replaced change
nothing but how much there is to hand over. A relay cannot read what it hands over into being anything else: the
signatures are checked by who takes it.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from itertools import islice

from cairn_client.sync.requests import Ask, Conversation
from cairn_client.sync.uploads import CAME_IN_PART
from cairn_map.commits.commit import split_commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import CairnError, ConflictError, DeniedError, NotFoundError, UnreachableError
from cairn_map.wire.relay_peer import Held, SignedCommit

AT_ONCE = 1000
"""Commits handed over, in each direction, before both places are asked anew."""
REST_S = 600.0
"""So often what could not be handed over is tried again, once all else was."""
NOT_ITS_FAULT = ("quota", "disk_full")
"""Why a server takes nothing for now, whatever it is."""


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


class Why(Enum):
    """Why a commit was not handed over."""

    GONE = "gone"
    """Not kept any more where it was to come from."""
    UNSIGNED = "unsigned"
    REFUSED = "refused"
    BROKEN = "broken"
    """Twice the link broke at it before any part of it came, or the server could not take it, though both places had
    just answered."""


FOR_GOOD = (Why.GONE, Why.UNSIGNED)
"""Not asked for again while the place that it was to come from still names it."""


@dataclass(slots=True)
class Resting:
    """What could not be handed over, and is left alone for a while; a few intervals for each author, however many.

    It saves traffic, and lets what comes after it go by.
    """

    rest_s: float = REST_S
    clock_s: Callable[[], float] = time.monotonic
    _found: defaultdict[tuple[Side, Why], VersionVector] = field(default_factory=lambda: defaultdict(lambda: EMPTY))
    _broke_at: dict[Side, CommitId] = field(default_factory=dict)
    _pauses_until_s: dict[Side, float] = field(default_factory=dict)
    _until_s: dict[Side, float] = field(default_factory=dict)

    def add(self, to: Side, why: Why, commit: CommitId) -> None:
        """It could not be handed over to this side."""
        self._found[to, why] = self._found[to, why].with_commits([commit])

    def broke(self, to: Side, commit: CommitId, error: UnreachableError) -> None:
        """The link broke at it, or the server said when it may be able to take more."""
        if error.kind == CAME_IN_PART:
            self._broke_at.pop(to, None)
        else:
            if self._broke_at.get(to) == commit and error.kind not in NOT_ITS_FAULT:
                self.add(to, Why.BROKEN, commit)
            self._broke_at[to] = commit
        if error.retry_after_s:
            self._pauses_until_s[to] = self.clock_s() + min(error.retry_after_s, self.rest_s)

    def pauses(self, to: Side) -> bool:
        """Whether this side wants no more for now."""
        return self._pauses_until_s.get(to, float("-inf")) > self.clock_s()

    def may_come_later(self, to: Side) -> bool:
        """Whether this side lacks what it might have once the link or the server is better."""
        return self.pauses(to) or bool(self._found[to, Why.BROKEN].intervals)

    def lacking(self, source: Held, target: Held, to: Side) -> Iterator[CommitId]:
        """What the source could give and is worth a try, each author's oldest first."""
        lacking = source.vector.minus(target.vector)
        for why in FOR_GOOD:  # of these, what the source still names: if it was replaced, it may have them again
            self._found[to, why] = known = lacking.minus(lacking.minus(self._found[to, why]))
            lacking = lacking.minus(known)
        tried = [self._found[to, why] for why in (Why.REFUSED, Why.BROKEN)]
        for known in tried:
            lacking = lacking.minus(known)
        yield from lacking
        for commit in target.wanted:
            if commit in source.vector and not any(commit in known for known in tried):
                yield commit

    def all_tried(self, to: Side, report: "RelayReport") -> None:
        """Nothing is left to hand over to this side; every `rest_s` say all that it lacks, and begin again."""
        if self._until_s.setdefault(to, self.clock_s() + self.rest_s) > self.clock_s():
            return
        del self._until_s[to]
        report.has_more |= self.may_come_later(to)
        self._found[to, Why.REFUSED] = self._found[to, Why.BROKEN] = EMPTY
        report.kept_back |= {(to, why): self._found[to, why] for why in FOR_GOOD if self._found[to, why].intervals}


@dataclass(slots=True)
class RelayReport:
    """What one round did."""

    moved: dict[Side, int] = field(default_factory=lambda: dict.fromkeys(Side, 0))
    """Commits handed over, by the side that they came to."""
    kept_back: dict[tuple[Side, Why], VersionVector] = field(default_factory=dict)
    """What a side lacks for good: gone, or unsigned. Only what is new, and now and then all."""
    refused: list[tuple[CommitId, CairnError]] = field(default_factory=list)
    split: list[Author] = field(default_factory=list)
    """Authors of whom the two sides have other bytes under the same ids."""
    later: UnreachableError | None = None
    """A server takes no more for now, and says when."""
    cut: UnreachableError | None = None
    """A link broke in the middle; whoever holds the rounds waits a little."""
    has_more: bool = False
    """There was too much for one round."""
    is_all_there: bool = False
    """All that can travel from here came there."""

    def keep_back(self, to: Side, why: Why, commit: CommitId) -> None:
        """A side lacks it."""
        self.kept_back[to, why] = self.kept_back.get((to, why), EMPTY).with_commits([commit])


def relay_round(resting: Resting) -> Conversation[RelayReport]:
    """Hand over what either side lacks and the other has; where one direction breaks off, the other has its turn.

    Raises:
        UnreachableError: a place does not say what it holds.
        DeniedError: a server does not know this relay.
    """
    report = RelayReport()
    held = {}
    for side in Side:
        held[side] = yield from AskHeld(side)
    report.split = _split(held[Side.HERE], held[Side.THERE])
    yield from _hand_over(Side.HERE, Side.THERE, held, resting, report)
    report.is_all_there = not (report.has_more or report.cut or resting.may_come_later(Side.THERE))
    yield from _hand_over(Side.THERE, Side.HERE, held, resting, report)
    return report


def _hand_over(
    source: Side, target: Side, held: dict[Side, Held], resting: Resting, report: RelayReport
) -> Conversation[None]:
    if resting.pauses(target):
        return
    lacking = resting.lacking(held[source], held[target], target)
    for commit_id in islice(lacking, AT_ONCE):
        try:
            why = yield from _move(source, target, commit_id)
        except UnreachableError as exc:
            resting.broke(target, commit_id, exc)
            if exc.retry_after_s:
                report.later = exc
            else:
                report.cut = exc
            return
        except CairnError as exc:
            if isinstance(exc, DeniedError) and exc.kind != "not_allowed":
                raise
            report.refused.append((commit_id, exc))
            why = Why.REFUSED
        if why is None:
            report.moved[target] += 1
        elif commit_id in held[target].vector:  # only wanted again, and not lacking
            resting.add(target, Why.REFUSED, commit_id)
        else:
            resting.add(target, why, commit_id)
            if why in FOR_GOOD:
                report.keep_back(target, why, commit_id)
    if next(lacking, None) is None:
        resting.all_tried(target, report)
    else:
        report.has_more = True


def _move(source: Side, target: Side, commit_id: CommitId) -> Conversation[Why | None]:
    """Hand over one commit; or why it cannot be."""
    try:
        commit = yield from TakeCommit(source, commit_id)
    except ConflictError as exc:
        if exc.kind != "evidence_gone":
            raise
        return Why.GONE
    if commit.signatures is None:
        return Why.UNSIGNED
    yield from _give(source, target, commit)
    return None


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


def _split(here: Held, there: Held) -> list[Author]:
    """Authors of whom both have the same ids, and not the same commits."""
    return [
        author
        for author, total in here.sums.items()
        if there.sums.get(author, total) != total
        and here.vector.intervals.get(author) == there.vector.intervals.get(author)
    ]
