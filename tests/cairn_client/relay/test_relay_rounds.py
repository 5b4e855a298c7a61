"""Rounds of a relay: an obstacle rests while all else passes, nothing is asked for ever, and no direction waits."""

import pytest

from cairn_client.cli import relay as relay_command
from cairn_client.relay import round as relay
from cairn_client.relay.link import hold_between
from cairn_client.relay.round import RelayReport, RelaySide, Undelivered, Why, relay_round
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import ConflictError, NotFoundError, UnreachableError
from cairn_map.wire.relay_peer import Held, SignedCommit

AUTHOR = Author(RobotName("mole"), Incarnation("0" * 16))
EARLY = UnreachableError("bad_clock", "of the future", 3600.0)
CUT, BUSY = UnreachableError("no_link", "cut"), UnreachableError("quota", "enough for today", 3000.0)


def ids(*numbers: int) -> set[CommitId]:
    return {CommitId(AUTHOR, n) for n in numbers}


class Place:
    """A map in memory."""

    def __init__(self, *numbers: int) -> None:
        self.has = ids(*numbers)
        self.gone: set[CommitId] = set()
        self.unsigned: set[CommitId] = set()
        self.breaks_at: dict[CommitId, UnreachableError] = {}
        self.asked: list[CommitId] = []

    def held(self) -> Held:
        return Held(vector=EMPTY.with_commits(self.has))

    def commit(self, commit: CommitId) -> SignedCommit:
        self.asked.append(commit)
        if commit in self.gone:
            raise ConflictError("evidence_gone", "")
        if commit not in self.has:
            raise NotFoundError("no_commit", "")
        return SignedCommit(commit, b"", None if commit in self.unsigned else "signed")

    def push(self, commit: SignedCommit) -> None:
        if commit.id in self.breaks_at:
            raise self.breaks_at[commit.id]
        self.has.add(commit.id)

    def has_attachments(self) -> bool:
        return False


class Clock:
    """Time as a test wants it."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def resting(clock: Clock) -> Undelivered:
    return Undelivered(clock_s=clock)


def rounds(here: Place, there: Place, resting: Undelivered, count: int = 1) -> RelayReport:
    """Report of the last of some rounds."""
    for _ in range(count):
        report = hold_between(relay_round(resting), here, there)
    return report


def test_what_is_gone_or_unsigned_is_asked_for_once_and_told_now_and_then(
    resting: Undelivered, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay, "AT_ONCE", 2)
    here, there = Place(*range(8)), Place(9)
    here.gone, here.unsigned = ids(0, 1, 2, 3, 4), ids(5)
    assert [rounds(here, there, resting).has_more for _ in range(4)] == [True, True, True, False]
    assert there.has == ids(6, 7, 9)
    assert 9 in {commit.n for commit in here.has}
    clock.now_s += 10_000
    report = rounds(here, there, resting)
    assert {why: len(found) for (_, why), found in report.kept_back.items()} == {Why.GONE: 5, Why.UNSIGNED: 1}
    assert not rounds(here, there, resting).kept_back
    assert len(here.asked) == 8


def test_a_place_that_was_replaced_is_asked_again(resting: Undelivered) -> None:
    here, there = Place(0, 1), Place()
    here.gone = ids(0)
    rounds(here, there, resting)
    here.has = ids(1)
    rounds(here, there, resting)
    here.has, here.gone = ids(0, 1), set()
    rounds(here, there, resting)
    assert there.has == ids(0, 1)


def test_a_commit_that_breaks_every_round_lets_others_go_by_and_is_not_forgotten(
    resting: Undelivered, clock: Clock
) -> None:
    here, there = Place(0, 1, 2), Place(7)
    there.breaks_at = dict.fromkeys(ids(1), CUT)
    first = rounds(here, there, resting)
    assert (first.cut, here.has, there.has) == (CUT, ids(0, 1, 2, 7), ids(0, 7))
    last = rounds(here, there, resting, 2)
    assert (last.cut, last.is_all_there, there.has) == (None, False, ids(0, 2, 7))
    there.breaks_at.clear()
    clock.now_s += 10_000
    assert not rounds(here, there, resting).is_all_there
    assert rounds(here, there, resting).is_all_there
    assert there.has == here.has


def test_commits_of_the_future_wait_while_all_others_pass_and_count_as_not_there(
    resting: Undelivered, clock: Clock
) -> None:
    here, there = Place(*range(5)), Place(7)
    there.breaks_at = dict.fromkeys(ids(1, 3), EARLY)
    first = rounds(here, there, resting)
    assert (first.cut, first.later, first.refused, first.is_all_there) == (None, None, [], False)
    assert [commit.n for commit, _ in first.early] == [1, 3]
    assert (here.has, there.has) == (ids(*range(5), 7), ids(0, 2, 4, 7))
    here.asked.clear()
    again = rounds(here, there, resting)
    assert (again.early, again.is_all_there, here.asked) == ([], False, []), "they are not sent again at once"
    there.breaks_at.clear()
    clock.now_s += 10_000
    rounds(here, there, resting, 2)
    assert rounds(here, there, resting).is_all_there
    assert there.has == here.has


def test_a_quota_pauses_its_direction_only_and_skips_nothing(resting: Undelivered, clock: Clock) -> None:
    here, there = Place(0, 1), Place()
    there.breaks_at = dict.fromkeys(ids(0), BUSY)
    assert rounds(here, there, resting).later is BUSY
    there.has |= ids(8)
    assert not rounds(here, there, resting).is_all_there
    assert (here.has, here.asked) == (ids(0, 1, 8), sorted(ids(0)))
    for _ in range(3):
        clock.now_s += 10_000
        rounds(here, there, resting)
    assert there.has == ids(8)


def test_a_command_that_hands_over_once_ends_whatever_is_gone_or_breaks(
    resting: Undelivered, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay, "AT_ONCE", 2)
    monkeypatch.setattr(relay_command.time, "sleep", lambda seconds: None)
    here, there = Place(*range(9)), Place()
    here.gone = ids(0, 1, 2, 3)
    there.breaks_at = dict.fromkeys(ids(5), CUT)
    total = relay_command._once(here, there, resting, map_name="lab", where="there")
    assert there.has == ids(4, 6, 7, 8)
    assert total.moved[RelaySide.THERE] == 4
    assert resting.may_come_later(RelaySide.THERE)
    with pytest.raises(UnreachableError):
        there.breaks_at = dict.fromkeys(ids(*range(20, 40)), CUT)
        relay_command._once(Place(*range(20, 40)), there, Undelivered(), map_name="lab", where="there")
