"""Signed commits from one place to another and back: two servers, or a server and a robot that carries for others.

A round asks both places what they hold, and hands over the difference. Nothing is remembered from one round to the
next that matters: so order, repetition, other relays, circles, and servers that were restored or replaced change
nothing but how much there is to hand over. A relay cannot read what it hands over into being anything else: the
signatures are checked by the side that takes it.
"""

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from itertools import islice

from cairn_client.replica.replica import BAD_CLOCK
from cairn_client.sync.requests import Ask, Conversation
from cairn_client.sync.uploads import CAME_IN_PART
from cairn_map.commits.commit import split_commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import CairnError, ConflictError, DeniedError, NotFoundError, UnreachableError
from cairn_map.wire.relay_peer import Held, SignedCommit

log = logging.getLogger(__name__)

NAMED_MAX = 3
"""Commits that one line of the log names."""
PAUSE_S = 60.0
"""Pause from which on a server's wish for one is logged; a server that wants a shorter one is only busy."""
AT_ONCE = 1000
"""Commits handed over, in each direction, before both places are asked again."""
REST_S = 600.0
"""Seconds after which commits that could not be handed over are tried again, once all others were."""
NOT_ITS_FAULT = ("quota", "disk_full")
"""Kinds of errors by which a server takes no commit at all for now."""


class RelaySide(Enum):
    """The two places of a round."""

    HERE = "here"
    THERE = "there"


@dataclass(frozen=True, slots=True)
class AskHeld(Ask[Held]):
    """Question for what a place holds."""

    side: RelaySide


@dataclass(frozen=True, slots=True)
class TakeCommit(Ask[SignedCommit]):
    """Question for a commit with its bytes and signatures."""

    side: RelaySide
    id: CommitId


@dataclass(frozen=True, slots=True)
class GiveCommit(Ask[None]):
    """Push of a commit; answered when it is kept for good."""

    side: RelaySide
    commit: SignedCommit


class Why(Enum):
    """Reason for which a commit was not handed over."""

    GONE = "gone"
    """The source does not keep its bytes any more."""
    UNSIGNED = "unsigned"
    REFUSED = "refused"
    EARLY = "early"
    """The target does not trust its time, or it is still to come there (`bad_clock`): later."""
    BROKEN = "broken"
    """The link broke at it twice before any part of it came, or the server could not take it, though both places had
    just answered."""


FOR_A_WHILE = (Why.REFUSED, Why.EARLY, Why.BROKEN)
"""Reasons for which it is not tried again before all others were, and `rest_s` has passed."""
FOR_GOOD = (Why.GONE, Why.UNSIGNED)
"""Reasons for which a commit is not requested again while its source still names it."""


@dataclass(slots=True)
class Undelivered:
    """Commits that could not be handed over, and are not tried for a while; a few intervals for each author.

    This saves traffic, and lets later commits pass.
    """

    rest_s: float = REST_S
    clock_s: Callable[[], float] = time.monotonic
    # By side and reason: commits that were tried in vain.
    _found: defaultdict[tuple[RelaySide, Why], VersionVector] = field(
        default_factory=lambda: defaultdict(lambda: EMPTY)
    )
    # Where the link to a side broke last: a second break at the same commit is blamed on the commit.
    _broke_at: dict[RelaySide, CommitId] = field(default_factory=dict)
    # When a side takes commits again, as it said itself; and when `_found` is tried again.
    _pauses_until_s: dict[RelaySide, float] = field(default_factory=dict)
    _until_s: dict[RelaySide, float] = field(default_factory=dict)

    def add(self, to: RelaySide, why: Why, commit: CommitId) -> None:
        """Note that a commit could not be handed over to this side."""
        self._found[to, why] = self._found[to, why].with_commits([commit])

    def broke(self, to: RelaySide, commit: CommitId, error: UnreachableError) -> None:
        """Note that the link broke at a commit, or that the server said when it may take more."""
        # Something of it came, so the next try goes on from there: the commit is not to blame.
        if error.kind == CAME_IN_PART:
            self._broke_at.pop(to, None)
        else:
            if self._broke_at.get(to) == commit and error.kind not in NOT_ITS_FAULT:
                self.add(to, Why.BROKEN, commit)
            self._broke_at[to] = commit
        # No server's wish keeps commits back for longer than a failure would.
        if error.retry_after_s:
            self._pauses_until_s[to] = self.clock_s() + min(error.retry_after_s, self.rest_s)

    def pauses(self, to: RelaySide) -> bool:
        """True if this side wants no more for now."""
        return self._pauses_until_s.get(to, float("-inf")) > self.clock_s()

    def is_refused(self, to: RelaySide) -> bool:
        """True if this side refused commits that it lacks."""
        return bool(self._found[to, Why.REFUSED].intervals)

    def may_come_later(self, to: RelaySide) -> bool:
        """True if this side lacks commits that it might take once the link or the server is better."""
        return self.pauses(to) or any(self._found[to, why].intervals for why in (Why.EARLY, Why.BROKEN))

    def lacking(self, source: Held, target: Held, to: RelaySide) -> Iterator[CommitId]:
        """Commits that the source could give and that are worth a try, each author's oldest first."""
        lacking = source.vector.minus(target.vector)
        for why in FOR_GOOD:  # of these, what the source still names: if it was replaced, it may have them again
            self._found[to, why] = known = lacking.minus(lacking.minus(self._found[to, why]))
            lacking = lacking.minus(known)
        tried = [self._found[to, why] for why in FOR_A_WHILE]
        for known in tried:
            lacking = lacking.minus(known)
        yield from lacking
        # Evidence that a server asks for again (rule 11) is in its vector, so no difference of vectors names it.
        for commit in target.wanted:
            if commit in source.vector and not any(commit in known for known in tried):
                yield commit

    def all_tried(self, to: RelaySide, report: "RelayReport") -> None:
        """Note that nothing is left to hand over to this side; every `rest_s` report what it lacks, and begin again."""
        # Only when nothing else is left, so that what failed never holds up what was not tried.
        if self._until_s.setdefault(to, self.clock_s() + self.rest_s) > self.clock_s():
            return
        del self._until_s[to]
        report.has_more |= self.may_come_later(to)
        self._found |= {(to, why): EMPTY for why in FOR_A_WHILE}
        report.kept_back |= {(to, why): self._found[to, why] for why in FOR_GOOD if self._found[to, why].intervals}


@dataclass(slots=True)
class RelayReport:
    """Counts of one relay round's work."""

    moved: dict[RelaySide, int] = field(default_factory=lambda: dict.fromkeys(RelaySide, 0))
    """Commits handed over, by the side that they came to."""
    kept_back: dict[tuple[RelaySide, Why], VersionVector] = field(default_factory=dict)
    """Commits that a side lacks for good, gone or unsigned: only the new ones, and now and then all."""
    refused: list[tuple[CommitId, CairnError]] = field(default_factory=list)
    early: list[tuple[CommitId, CairnError]] = field(default_factory=list)
    """Commits that a side does not take yet, since their time is to come there or cannot be judged."""
    split: list[Author] = field(default_factory=list)
    """Authors of whom the two sides have other bytes under the same ids."""
    later: UnreachableError | None = None
    """Error of a server that takes no more for now, and says when; None if none did."""
    cut: UnreachableError | None = None
    """Error of a link that broke in the middle; the caller waits a little."""
    has_more: bool = False
    """True if there was too much for one round."""
    is_all_there: bool = False
    """True if all commits that can travel from here came there."""

    def keep_back(self, to: RelaySide, why: Why, commit: CommitId) -> None:
        """Note that a side lacks a commit for good."""
        self.kept_back[to, why] = self.kept_back.get((to, why), EMPTY).with_commits([commit])


def relay_round(resting: Undelivered) -> Conversation[RelayReport]:
    """Hand over what either side lacks and the other has; where one direction breaks off, the other has its turn.

    Raises:
        UnreachableError: a place does not say what it holds.
        DeniedError: a server does not know this relay.
    """
    report = RelayReport()
    held = yield from _ask_both(report)
    # From here to there, then back; a direction that breaks off does not stop the other.
    yield from _hand_over(RelaySide.HERE, RelaySide.THERE, held, resting, report)
    report.is_all_there = not (report.has_more or report.cut or resting.may_come_later(RelaySide.THERE))
    yield from _hand_over(RelaySide.THERE, RelaySide.HERE, held, resting, report)
    return report


def copy_round(resting: Undelivered) -> Conversation[RelayReport]:
    """Hand over what the other side lacks, and take nothing back.

    Raises:
        UnreachableError: a place does not say what it holds.
        DeniedError: a server does not know this relay.
    """
    report = RelayReport()
    held = yield from _ask_both(report)
    # One direction only: a copy may be of a map that its own robots go on with.
    yield from _hand_over(RelaySide.HERE, RelaySide.THERE, held, resting, report)
    return report


def _ask_both(report: RelayReport) -> Conversation[dict[RelaySide, Held]]:
    """Ask what both sides hold."""
    held = {}
    for side in RelaySide:
        held[side] = yield from AskHeld(side)
    # Whether they hold other bytes under the same ids: then a robot's disk was rolled back between its visits to both.
    report.split = _split(held[RelaySide.HERE], held[RelaySide.THERE])
    return held


def _hand_over(
    source: RelaySide, target: RelaySide, held: dict[RelaySide, Held], resting: Undelivered, report: RelayReport
) -> Conversation[None]:
    if resting.pauses(target):
        return
    # A part of what lacks: both sides are asked again soon, because other relays work at the same time.
    lacking = resting.lacking(held[source], held[target], target)
    for commit_id in islice(lacking, AT_ONCE):
        try:
            why = yield from _move(source, target, commit_id)
        # A break ends this direction; a refusal, like a commit that is gone or early, lets the next one go by.
        except UnreachableError as exc:
            if exc.kind != BAD_CLOCK:
                resting.broke(target, commit_id, exc)
                if exc.retry_after_s:
                    report.later = exc
                else:
                    report.cut = exc
                return
            report.early.append((commit_id, exc))
            why = Why.EARLY
        except CairnError as exc:
            if isinstance(exc, DeniedError) and exc.kind not in ("not_allowed", "not_admitted"):
                raise
            report.refused.append((commit_id, exc))
            why = Why.REFUSED
        # The outcome of this commit: there; or not there, and then left alone until all others were tried.
        if why is None:
            report.moved[target] += 1
        elif commit_id in held[target].vector:  # only wanted again, and not lacking
            resting.add(target, Why.REFUSED, commit_id)
        else:
            resting.add(target, why, commit_id)
            if why in FOR_GOOD:
                report.keep_back(target, why, commit_id)
    # The iterator goes on behind `islice`: one more commit means that this direction is not done.
    if next(lacking, None) is None:
        resting.all_tried(target, report)
    else:
        report.has_more = True


def _move(source: RelaySide, target: RelaySide, commit_id: CommitId) -> Conversation[Why | None]:
    """Hand over one commit; the reason if it cannot be, else None."""
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


def _give(source: RelaySide, target: RelaySide, commit: SignedCommit) -> Conversation[None]:
    """Hand over one commit, and before it what it takes out, if the target forgot that (SYNC.md rule 11)."""
    try:
        yield from GiveCommit(target, commit)
    except ConflictError as exc:
        if exc.kind != "evidence_gone":
            raise
        # First the evidence that this commit takes out, as far as the source still has it; then the commit again.
        for named in split_commit(commit.data)[0].retracted_ids:
            try:
                yield from GiveCommit(target, (yield from TakeCommit(source, named)))
            except (ConflictError, NotFoundError):
                continue
        yield from GiveCommit(target, commit)


def _split(here: Held, there: Held) -> list[Author]:
    """Authors of whom both have the same ids, and not the same commits."""
    # Sums compare only where both have the same ids of an author; a difference is then one of bytes (rule 13).
    return [
        author
        for author, total in here.sums.items()
        if there.sums.get(author, total) != total
        and here.vector.intervals.get(author) == there.vector.intervals.get(author)
    ]


SAID = {
    Why.GONE: "are not kept any more where they are, so one of the two maps is without them; start the server that "
    "lacks them from a copy of the other (cairn serve backup, restore)",
    Why.UNSIGNED: "are not signed and stay where they are: their robots are of an older version",
}


def log_report(report: RelayReport, map_name: str, *, there: str) -> None:
    """Log a round: one line for each thing that an operator may have to know, none if nothing happened."""
    taken, given = report.moved[RelaySide.HERE], report.moved[RelaySide.THERE]
    if taken or given:
        log.info("map %s: %d commits to %s, %d from there", map_name, given, there, taken)
    for (_, why), commits in report.kept_back.items():
        log.error("map %s: %d commits (%s) %s", map_name, len(commits), _names(commits), SAID[why])
    if report.later and (report.later.retry_after_s or 0.0) >= PAUSE_S:
        log.warning("map %s: no more for now, %s", map_name, report.later.message)
    if report.refused:
        commit, error = report.refused[0]
        log.error("map %s: %d commits refused, such as %s: %s", map_name, len(report.refused), commit, error.message)
    if report.early:
        commit, error = report.early[0]
        log.warning("map %s: %d commits wait, such as %s: %s", map_name, len(report.early), commit, error.message)
    if report.split:
        log.error(
            "map %s: the two servers have other commits under the same ids, of %s: such a robot's disk was rolled "
            "back. Compare `cairn map log` of both; a retract of these ids makes the maps equal again",
            map_name,
            _names(report.split),
        )


def _names(found: Iterable[object]) -> str:
    some = [str(one) for one in islice(found, NAMED_MAX + 1)]
    return ", ".join(some[:NAMED_MAX]) + (" ..." if len(some) > NAMED_MAX else "")
