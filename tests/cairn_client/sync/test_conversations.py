"""Next request of a robot after each answer; no link, no server."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.made import GEOMETRY, A, committed, covering, cursor, exchanged, header, opened, seen

from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import EARLY_S, REST_S, RefusedPushes, Replica
from cairn_client.replica.replica_store import BaseCell
from cairn_client.sync.requests import GetMissing, NextFrame, Push
from cairn_client.sync.sync import fetch_missing, push_commits
from cairn_map.commits.commit import Commit, CommitMeta, make_commit
from cairn_map.commits.ids import OPERATOR, Author, CommitId, Incarnation
from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, UnreachableError
from cairn_map.evidence.fingerprint import ZERO

X, Y, Z = seen(1, 2), seen(2, 100), seen(300)
OPERATORS = Author(OPERATOR, Incarnation("00000000000000aa"))


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


def retract_of(*targets: CommitId) -> Commit:
    names = tuple(str(target) for target in targets)
    meta = CommitMeta(id=str(CommitId(OPERATORS, 0)), geometry=GEOMETRY.digest().hex(), retracts=names)
    return make_commit(meta, {}, GEOMETRY)


def amending(replica: Replica, target: CommitId) -> Commit:
    return replica.commit({A: Z}, CommitFacts(retracts=(target,), note="amend"))


def signed(replica: Replica, commit: Commit) -> Push:
    return Push(commit, signatures=replica.outbox.signatures(commit))


def test_commits_are_pushed_oldest_first_and_each_is_acknowledged_by_its_answer(mole: Replica) -> None:
    first, second = committed(mole, X), committed(mole, Y)
    conversation = push_commits(mole)
    assert next(conversation) == signed(mole, first)
    assert mole.push_set() == [first.id, second.id]
    assert conversation.send(None) == signed(mole, second)
    assert mole.push_set() == [second.id]
    with pytest.raises(StopIteration) as end:
        conversation.send(None)
    assert end.value.value.pushed == 2


def test_a_link_that_breaks_ends_the_round_and_keeps_what_was_not_answered(mole: Replica) -> None:
    commit = committed(mole, X)
    conversation = push_commits(mole)
    next(conversation)
    with pytest.raises(UnreachableError):
        conversation.throw(UnreachableError("no_link", "cut"))
    assert mole.push_set() == [commit.id]


def refused(replica: Replica, *answers: CairnError | None) -> dict[CommitId, CairnError]:
    """Commits that a round reports as refused, in which the server answers so to as many pushes."""
    conversation = push_commits(replica)
    with pytest.raises(StopIteration) as end:
        next(conversation)
        for answer in answers:
            conversation.throw(answer) if answer else conversation.send(None)
    found: dict[CommitId, CairnError] = end.value.value.refused
    return found


def test_a_commit_that_is_refused_for_its_bytes_rests_for_an_hour(mole: Replica) -> None:
    now_s = 0.0
    mole.refusals = RefusedPushes(steady_s=lambda: now_s)
    first, no = committed(mole, X), BadInputError("too_much_evidence", "no")
    assert refused(mole, no) == {first.id: no}
    second = committed(mole, Y)
    assert refused(mole, None) == {first.id: no}, "only the second one was sent"
    assert mole.push_set() == [first.id] and mole.kept_commit(second.id) is not None
    now_s = REST_S
    assert refused(mole, no) == {first.id: no}
    assert refused(mole) == {first.id: no}
    mole.forget_server()
    assert refused(mole, None, None) == {}


def test_a_commit_of_the_future_lets_others_go_by_and_rests_until_its_time_has_come(mole: Replica) -> None:
    now_s = 0.0
    mole.refusals = RefusedPushes(steady_s=lambda: now_s)
    early, other, untold = committed(mole, X), committed(mole, Y), committed(mole, X)
    no, later = UnreachableError("bad_clock", "the future", 600.0), UnreachableError("bad_clock", "no trust")
    assert refused(mole, no, None, later) == {early.id: no, untold.id: later}
    assert refused(mole) == {early.id: no, untold.id: later}, "neither is sent again at once"
    now_s = EARLY_S
    assert refused(mole, None) == {early.id: no}
    now_s = 600.0
    assert mole.kept_commit(early.id) is not None and mole.kept_commit(other.id) is not None
    assert refused(mole, None) == {}, "with the same id and bytes"


@pytest.mark.parametrize(
    "answer", [BadInputError("http", "307"), ConflictError("id_gone", "no"), DamagedDataError("internal", "500")]
)
def test_a_refusal_that_tells_nothing_of_the_bytes_is_tried_again(mole: Replica, answer: CairnError) -> None:
    commit = committed(mole, X)
    for _ in range(2):
        assert refused(mole, answer) == {commit.id: answer}


def test_frames_are_asked_for_one_by_one(mole: Replica) -> None:
    conversation = fetch_missing(mole)
    assert isinstance(next(conversation), GetMissing)
    assert conversation.send(header(cursor(1))) == NextFrame()


def test_an_operator_s_retract_is_pushed_back_with_its_seal_after_what_it_names(mole: Replica) -> None:
    commit = committed(mole, X)
    mole.acknowledge(commit.id)
    exchanged(mole, header(cursor(1), covering(commit.id)))
    retract = retract_of(commit.id)
    mole.keep_sealed(retract, "the seal")
    conversation = push_commits(mole)
    assert next(conversation) == Push(retract, "the seal")
    evidence_gone = ConflictError("evidence_gone", "push it again")
    assert conversation.throw(evidence_gone) == signed(mole, commit)
    assert conversation.send(None) == Push(retract, "the seal")


def test_what_a_header_wants_again_is_pushed_once_though_it_is_covered(mole: Replica) -> None:
    commits = [committed(mole, evidence) for evidence in (X, Y)]
    for commit in commits:
        mole.acknowledge(commit.id)
    told = header(cursor(1), covering(*(commit.id for commit in commits)))
    exchanged(mole, told)
    assert mole.push_set() == []
    exchanged(mole, told.model_copy(update={"wanted": [str(commits[1].id)]}))
    assert mole.push_set() == [commits[1].id]
    mole.acknowledge(commits[1].id)
    assert mole.push_set() == []


def test_a_viewer_pushes_nothing_but_operators_retracts(mole: Replica) -> None:
    committed(mole, X)
    retract = retract_of(CommitId(mole.author, 0))
    mole.keep_sealed(retract, "the seal")
    conversation = push_commits(mole, sealed_only=True)
    assert next(conversation) == Push(retract, "the seal")
    with pytest.raises(StopIteration):
        conversation.send(None)


@pytest.mark.parametrize("is_restarted", [False, True])
def test_what_a_kept_amend_names_is_kept_though_it_is_stable_and_covered(
    mole: Replica, tmp_path: Path, is_restarted: bool
) -> None:
    first = committed(mole, X)
    mole.acknowledge(first.id)
    amend = amending(mole, first.id)
    if is_restarted:
        mole.close()
        mole = opened(tmp_path / "mole")
    vector = covering(first.id)
    exchanged(mole, header(cursor(1), vector, stable=vector))
    with mole.changing() as base:
        base.hold_nothing(A, BaseCell(cursor(1), vector, ZERO))
    assert mole.forget_stable_commits() == 0
    assert mole.commits == [first.id, amend.id]
    mole.acknowledge(amend.id)
    vector = covering(first.id, amend.id)
    exchanged(mole, header(cursor(2), vector, stable=vector))
    with mole.changing() as base:
        base.hold_nothing(A, BaseCell(cursor(2), vector, ZERO))
    assert mole.forget_stable_commits() == 1
    assert mole.forget_stable_commits() == 1
    assert mole.commits == []
    mole.close()
