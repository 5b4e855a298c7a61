"""SYNC.md's rules for a client, one by one, with frames made by hand."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.made import (
    GEOMETRY,
    NOTHING,
    A,
    B,
    added,
    cell_frame,
    committed,
    covering,
    cursor,
    done,
    exchanged,
    foreign,
    header,
    opened,
    seen,
)

from cairn_client.http.http_link import Link
from cairn_client.replica.replica import Replica
from cairn_client.sync.exchange import Exchange
from cairn_client.sync.responses import FetchedCell
from cairn_client.sync.sync import fetch_cells, fetch_missing, push_commits
from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import ConflictError, DamagedDataError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import cell_of_key
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_map.wire.messages import CellEntry, CellIndex, MissingRequest

C1, C2, C3 = cursor(1), cursor(2), cursor(3)
X, Y, Z = seen(1, 2, kelvin_steps=7), seen(2, 100), seen(300, kelvin_steps=9)


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


def at(replica: Replica, to: Cursor, evidence: Evidence, coverage: VersionVector = EMPTY) -> None:
    """Bring cell A to a state."""
    start = replica.default_cursor
    frame = cell_frame(FrameKind.FULL, to, evidence, start=start)
    assert exchanged(replica, header(to, coverage), frame, done(to)).is_done


def linked(server: object) -> Link:
    """A link to what has some of the methods of `MapApi`."""
    return Link(server, "lab", branch="mole")  # type: ignore[arg-type]


# Rule 3: a header, frames that lead to its state, an end


def test_a_reply_without_header_is_refused(mole: Replica) -> None:
    with pytest.raises(DamagedDataError):
        exchanged(mole, cell_frame(FrameKind.FULL, C1, X))


def test_a_frame_that_leads_to_another_state_than_its_header_is_refused(mole: Replica) -> None:
    with pytest.raises(DamagedDataError):
        exchanged(mole, header(C1), cell_frame(FrameKind.FULL, C2, X))


def test_an_end_at_another_state_than_its_header_is_refused(mole: Replica) -> None:
    with pytest.raises(DamagedDataError):
        exchanged(mole, header(C1), done(C2))


def test_frames_after_a_second_header_belong_to_its_state(mole: Replica) -> None:
    frames = [cell_frame(FrameKind.FULL, C1, X), header(C2, covering(foreign(1)))]
    frames += [cell_frame(FrameKind.FULL, C2, Y, key=B), done(C2)]  # type: ignore[list-item]
    assert exchanged(mole, header(C1, covering(foreign(0))), *frames).is_done  # type: ignore[arg-type]
    assert (mole.cells[A].cursor, mole.cells[B].cursor, mole.default_cursor) == (C1, C2, C2)
    assert (foreign(0) in mole.cells[A].coverage, foreign(0) in mole.cells[B].coverage) == (True, False)


# Rule 5: the guard


@pytest.mark.parametrize("kind", [FrameKind.FULL, FrameKind.DELTA, FrameKind.STATE, FrameKind.RESET])
@pytest.mark.parametrize("start", [None, C1, cursor(2, branch=1)])
def test_a_frame_for_another_cursor_changes_nothing(mole: Replica, kind: FrameKind, start: Cursor | None) -> None:
    at(mole, C2, X, covering(foreign(0)))
    before = mole.cells[A]
    blocks = [4] if kind is FrameKind.STATE else None
    frame = cell_frame(kind, C3, added(X, Z), start=start, payload=Z, blocks=blocks)
    exchange = exchanged(mole, header(C3, covering(foreign(1))), frame)
    assert mole.cells[A] == before
    assert mole.view.evidence(A) == X
    exchange.take(done(C3))
    assert not exchange.is_done
    assert mole.default_cursor == C2


def test_a_frame_that_comes_twice_counts_once(mole: Replica) -> None:
    at(mole, C1, X)
    frame = cell_frame(FrameKind.DELTA, C2, added(X, Y), start=C1, payload=Y)
    exchanged(mole, header(C2), frame, frame)
    assert mole.view.evidence(A) == added(X, Y)


# Rules 6 and 7: applying, coverage, the view


def test_the_view_is_the_base_and_the_commits_it_lacks(mole: Replica) -> None:
    committed(mole, Y)
    at(mole, C1, X, covering(foreign(0)))
    assert mole.view.evidence(A) == added(X, Y)


def test_a_commit_in_the_coverage_of_its_cell_is_not_added_again(mole: Replica) -> None:
    commit = committed(mole, Y)
    at(mole, C1, added(X, Y), covering(commit.id))
    assert mole.view.evidence(A) == added(X, Y)


def test_coverage_counts_for_each_cell_alone(mole: Replica) -> None:
    commit = mole.commit({A: Y, B: Y})
    frame = cell_frame(FrameKind.FULL, C1, added(X, Y), key=A)
    exchanged(mole, header(C1, covering(commit.id)), frame)  # cut: cell B has not come
    assert mole.view.evidence(A) == added(X, Y)
    assert mole.view.evidence(B) == Y


def test_coverage_is_replaced_and_never_merged(mole: Replica) -> None:
    commit = committed(mole, Y)
    at(mole, C1, added(X, Y), covering(commit.id))
    # A restored server, proven by another cursor, does not have the commit any more.
    exchanged(mole, header(cursor(1, branch=1)), cell_frame(FrameKind.RESET, cursor(1, branch=1), X, start=C1))
    frame = cell_frame(FrameKind.FULL, cursor(1, branch=1), X, start=None)
    exchanged(mole, header(cursor(1, branch=1)), frame)
    assert mole.view.evidence(A) == added(X, Y)
    assert commit.id not in mole.cells[A].coverage


def test_coverage_speaks_of_the_ids_of_others_too(mole: Replica) -> None:
    at(mole, C1, X, covering(foreign(0), foreign(5)))
    assert foreign(5) in mole.cells[A].coverage


def test_a_delta_adds_the_own_commits_that_it_leaves_out(mole: Replica) -> None:
    at(mole, C1, X)
    commit = committed(mole, Y)
    frame = cell_frame(FrameKind.DELTA, C2, added(X, Y, Z), start=C1, payload=Z, own_excluded=True)
    exchanged(mole, header(C2, covering(commit.id)), frame)
    assert mole.cells[A].cursor == C2
    assert mole.base_evidence(A) == mole.view.evidence(A) == added(X, Y, Z)


def test_a_delta_adds_only_the_own_commits_between_its_two_states(mole: Replica) -> None:
    first = committed(mole, X)
    at(mole, C1, X, covering(first.id))
    second, third = committed(mole, Y), committed(mole, Z)
    frame = cell_frame(FrameKind.DELTA, C2, added(X, Y), start=C1, payload=NOTHING, own_excluded=True)
    exchanged(mole, header(C2, covering(first.id, second.id)), frame)
    assert mole.base_evidence(A) == added(X, Y)
    assert mole.view.evidence(A) == added(X, Y, Z)
    assert third.id not in mole.cells[A].coverage


def test_a_delta_that_leaves_nothing_out_is_added_as_it_is(mole: Replica) -> None:
    at(mole, C1, X)
    commit = committed(mole, Y)
    frame = cell_frame(FrameKind.DELTA, C2, added(X, Y), start=C1, payload=Y)
    exchanged(mole, header(C2, covering(commit.id)), frame)
    assert mole.cells[A].cursor == C2


def test_a_delta_speaks_of_the_incarnation_that_asked(mole: Replica) -> None:
    at(mole, C1, X)
    commit = committed(mole, Y)
    exchange = Exchange(mole)
    mole.outbox.new_incarnation("while the answer was under way")
    exchange.take(header(C2, covering(commit.id)))
    exchange.take(cell_frame(FrameKind.DELTA, C2, added(X, Y), start=C1, payload=NOTHING, own_excluded=True))
    assert mole.cells[A].cursor == C2


@pytest.mark.parametrize("after", [added(X, Y), X])
def test_a_delta_without_the_bytes_of_an_own_commit_asks_for_the_whole_cell(mole: Replica, after: Evidence) -> None:
    at(mole, C1, X)
    commit = committed(mole, Y)
    mole.outbox.forget([commit.id])
    frame = cell_frame(FrameKind.DELTA, C2, after, start=C1, payload=NOTHING, own_excluded=True)
    exchanged(mole, header(C2, covering(commit.id)), frame)
    assert mole.cells[A].cursor is None
    assert mole.base_evidence(A) == X
    assert [cursor for cursor, _ in Exchange(mole).request().groups] == [None]


@pytest.mark.parametrize("kind", [FrameKind.DELTA, FrameKind.STATE])
def test_a_frame_that_does_not_lead_to_its_fingerprint_is_rolled_back(mole: Replica, kind: FrameKind) -> None:
    at(mole, C1, X)
    blocks = [4] if kind is FrameKind.STATE else None
    exchanged(mole, header(C2), cell_frame(kind, C2, added(X, Y), start=C1, payload=Z, blocks=blocks))
    assert mole.cells[A].cursor is None
    assert mole.view.evidence(A) == mole.base_evidence(A) == X


def test_a_whole_cell_that_does_not_have_its_fingerprint_is_reported(mole: Replica) -> None:
    at(mole, C1, X)
    exchange = exchanged(mole, header(C2), cell_frame(FrameKind.FULL, C2, Y, start=C1, payload=Z))
    assert exchange.damaged == [A]
    assert mole.cells[A].cursor == C1
    assert mole.view.evidence(A) == X


def test_a_state_frame_overwrites_its_blocks_and_a_present_zero_means_zero(mole: Replica) -> None:
    at(mole, C1, seen(1, 63, 64, 130, kelvin_steps=5))
    after = seen(2, 130, kelvin_steps=5)  # block 0 changed, block 1 became empty, block 2 stayed
    frame = cell_frame(FrameKind.STATE, C2, after, start=C1, payload=seen(2, kelvin_steps=5), blocks=[0, 1])
    exchanged(mole, header(C2), frame)
    assert mole.base_evidence(A) == after
    assert mole.cells[A].cursor == C2


def test_a_frame_with_another_cell_in_it_is_refused(mole: Replica) -> None:
    frame = cell_frame(FrameKind.FULL, C1, X, key=A)
    foreign_payload = encode_cell(B, X, GEOMETRY).data
    exchange = exchanged(mole, header(C1), type(frame)(**{**_fields(frame), "payload": foreign_payload}))
    assert exchange.damaged == [A]
    assert mole.cells[A].cursor is None
    assert len(mole.view.evidence(A)) == 0


# Rule 8: the end


def test_the_end_moves_cells_without_a_frame(mole: Replica) -> None:
    at(mole, C1, X)
    commit = committed(mole, Y, B)
    assert exchanged(mole, header(C2, covering(foreign(1))), done(C2, (A, X))).is_done
    assert (mole.cells[A].cursor, mole.default_cursor) == (C2, C2)
    assert foreign(1) in mole.cells[A].coverage
    assert mole.view.evidence(B) == Y
    assert commit.id in mole.push_set()


def test_the_end_moves_nothing_if_the_sum_does_not_agree(mole: Replica) -> None:
    at(mole, C1, X)
    exchange = exchanged(mole, header(C2), done(C2, (A, Y)))
    assert not exchange.is_done
    assert exchange.must_compare
    assert (mole.cells[A].cursor, mole.default_cursor) == (C1, C1)


def test_the_end_moves_nothing_if_a_cell_has_moved_since_the_request(mole: Replica) -> None:
    at(mole, C1, X)
    exchange = Exchange(mole)
    with mole.changing() as base:
        base.move([A], to=C3, coverage=EMPTY)
    exchange.take(header(C2))
    exchange.take(done(C2, (A, X)))
    assert not exchange.is_done
    assert mole.cells[A].cursor == C3


def test_the_end_of_a_box_moves_no_cell_outside_of_it(mole: Replica) -> None:
    at(mole, C1, X)
    exchanged(mole, header(C1), cell_frame(FrameKind.FULL, C1, Y, key=B, start=C1), done(C1, (A, X)))
    exchange = Exchange(mole, box=(cell_of_key(A), cell_of_key(A)))
    exchange.take(header(C2, covering(foreign(1))))
    exchange.take(done(C2, (A, X)))
    assert exchange.is_done
    assert (mole.cells[A].cursor, mole.cells[B].cursor, mole.default_cursor) == (C2, C1, C1)
    assert (foreign(1) in mole.cells[A].coverage, foreign(1) in mole.cells[B].coverage) == (True, False)
    request = Exchange(mole).request()
    assert (request.cursor, request.groups) == (str(C1), [(str(C2), [cell_of_key(A)])])


def test_a_cut_reply_keeps_its_frames_and_no_more(mole: Replica) -> None:
    at(mole, C1, X)
    exchange = exchanged(mole, header(C2), cell_frame(FrameKind.FULL, C2, Y, key=B, start=C1))
    assert not exchange.is_done
    assert (mole.cells[A].cursor, mole.cells[B].cursor, mole.default_cursor) == (C1, C2, C1)
    assert Exchange(mole).request().groups == [(str(C2), [cell_of_key(B)])]


def test_comparing_names_every_cell(mole: Replica) -> None:
    at(mole, C1, X)
    request = Exchange(mole, compare=True).request()
    assert request.compare
    assert [cursor for cursor, _ in request.groups] == [str(C1)]


# Rule 9: reset


def test_a_reset_to_the_same_fingerprint_takes_the_cursor_and_replaces_coverage(mole: Replica) -> None:
    commit = committed(mole, Y)
    at(mole, C1, X, covering(foreign(0), commit.id))
    to = cursor(1, branch=1)
    exchange = exchanged(mole, header(to, covering(foreign(0))), cell_frame(FrameKind.RESET, to, X, start=C1), done(to))
    assert exchange.is_done
    assert mole.cells[A].cursor == to
    assert commit.id not in mole.cells[A].coverage
    assert mole.view.evidence(A) == added(X, Y)  # the server lost the commit, so it is shown as one's own again


def test_a_reset_to_another_fingerprint_keeps_showing_the_base_and_asks_for_the_whole(mole: Replica) -> None:
    at(mole, C1, X)
    to = cursor(1, branch=1)
    exchanged(mole, header(to), cell_frame(FrameKind.RESET, to, Y, start=C1), done(to))
    assert mole.view.evidence(A) == X
    assert mole.cells[A].cursor is None


def test_a_reset_of_a_cell_that_the_server_does_not_know_asks_for_the_whole(mole: Replica) -> None:
    at(mole, C1, X)
    to = cursor(0, branch=1)
    exchanged(mole, header(to), cell_frame(FrameKind.RESET, to, NOTHING, start=C1), done(to))
    assert mole.cells[A].cursor is None


def test_a_reset_of_a_cell_that_is_not_held_asks_for_the_whole(mole: Replica) -> None:
    at(mole, C1, X)
    to = cursor(1, branch=1)
    exchanged(mole, header(to), cell_frame(FrameKind.RESET, to, Y, key=B, start=C1))
    assert mole.cells[B].cursor is None


def test_a_reset_of_an_emptied_cell_that_is_not_held_covers_what_was_taken_out(mole: Replica) -> None:
    at(mole, C1, X)
    commit = committed(mole, Y, B)  # pushed, folded and retracted, all unseen
    to = cursor(3, branch=1)
    frame = cell_frame(FrameKind.RESET, to, NOTHING, key=B, start=C1)
    exchanged(mole, header(to, covering(commit.id)), frame)
    assert not len(mole.view.evidence(B))


class OtherServer:
    """Another log, which says so to every robot that comes with a cursor."""

    def __init__(self, coverage: VersionVector) -> None:
        self.coverage = coverage
        self.pushed: list[CommitId] = []

    def push(self, name: str, commit: object, **beside: str | None) -> None:
        self.pushed.append(commit.id)  # type: ignore[attr-defined]

    def missing(self, name: str, branch: str, request: MissingRequest, **options: object) -> Iterator[object]:
        if request.cursor or any(cursor for cursor, _ in request.groups):
            raise ConflictError("other_log", "the cursor belongs to another server's log")
        to = Cursor(bytes(16), 0, bytes(16))
        yield header(to, self.coverage)
        yield done(to)


def test_another_log_takes_the_base_away_and_offers_every_commit_anew(mole: Replica) -> None:
    commit = committed(mole, Y)
    mole.acknowledge(commit.id)
    at(mole, C1, added(X, Y), covering(commit.id))
    assert mole.push_set() == []
    server = OtherServer(covering(commit.id))  # perhaps with other bytes, so that it must be asked
    linked(server).hold(fetch_missing(mole))
    assert mole.view.evidence(A) == Y
    linked(server).hold(push_commits(mole))
    assert server.pushed == [commit.id]


# Rule 12: the outbox


def test_an_acknowledged_commit_is_still_shown_and_still_kept(mole: Replica) -> None:
    commit = committed(mole, Y)
    mole.acknowledge(commit.id)
    at(mole, C1, X)
    assert mole.view.evidence(A) == added(X, Y)
    assert mole.commits == [commit.id]


def kept_after(
    mole: Replica, *, cells: list[int], covered: list[int], is_stable: bool = True, is_acked: bool = True
) -> bool:
    """True if the outbox keeps a commit of some cells after a reply that covers it in some of them."""
    commit = mole.commit(dict.fromkeys(cells, Y))  # type: ignore[misc]
    if is_acked:
        mole.acknowledge(commit.id)
    vector = covering(commit.id)
    frames = [cell_frame(FrameKind.FULL, C1, Y, key=key) for key in covered]  # type: ignore[arg-type]
    exchanged(mole, header(C1, vector, stable=vector if is_stable else EMPTY), *frames)
    mole.forget_stable_commits()
    return commit.id in mole.commits


def test_a_commit_that_is_stable_and_covered_everywhere_leaves_the_outbox(mole: Replica) -> None:
    assert not kept_after(mole, cells=[A, B], covered=[A, B])
    assert mole.view.evidence(A) == Y


def test_a_commit_that_is_not_stable_stays(mole: Replica) -> None:
    assert kept_after(mole, cells=[A, B], covered=[A, B], is_stable=False)


def test_a_commit_that_is_not_covered_in_one_of_its_cells_stays(mole: Replica) -> None:
    assert kept_after(mole, cells=[A, B], covered=[A])


def test_a_commit_whose_bytes_the_server_never_acknowledged_stays(mole: Replica) -> None:
    assert kept_after(mole, cells=[A], covered=[A], is_acked=False)


def test_what_is_covered_counts_for_wanted_cells_only(mole: Replica) -> None:
    commit = mole.commit({A: Y, B: Y})
    mole.acknowledge(commit.id)
    vector = covering(commit.id)
    exchanged(mole, header(C1, vector, stable=vector), cell_frame(FrameKind.FULL, C1, Y))
    assert mole.forget_stable_commits(wanted=lambda cell: cell == cell_of_key(A)) == 1


def test_what_a_newer_header_lacks_is_pushed_again(mole: Replica) -> None:
    commit = committed(mole, Y)
    mole.acknowledge(commit.id)
    at(mole, C1, Y, covering(commit.id))
    assert mole.push_set() == []
    exchanged(mole, header(cursor(0, branch=1)))  # the server was restored
    assert mole.push_set() == [commit.id]


# Rule 13: a disk that was rolled back


def test_a_tip_beyond_the_last_number_means_a_new_incarnation(mole: Replica) -> None:
    committed(mole, Y)
    old = mole.author
    exchanged(mole, header(C1, tip=(5, bytes(32))))
    assert mole.author != old
    assert committed(mole, Z).id == CommitId(mole.author, 0)


def test_a_tip_with_other_bytes_means_a_new_incarnation(mole: Replica) -> None:
    committed(mole, Y)
    old = mole.author
    exchanged(mole, header(C1, tip=(0, bytes(32))))
    assert mole.author != old


def test_a_tip_that_is_known_means_nothing(mole: Replica) -> None:
    commit = committed(mole, Y)
    committed(mole, Z)
    old = mole.author
    exchanged(mole, header(C1, tip=(0, commit.sha)))
    assert mole.author == old


class TakenIds:
    """A server that takes nothing under some ids, because it has other bytes there or an administrator closed them."""

    def __init__(self, taken: set[CommitId], kind: str = "id_taken") -> None:
        self.taken = taken
        self.kind = kind
        self.pushed: list[CommitId] = []

    def push(self, name: str, commit: object, **beside: str | None) -> None:
        commit_id: CommitId = commit.id  # type: ignore[attr-defined]
        if commit_id in self.taken:
            raise ConflictError(self.kind, "other bytes")
        self.pushed.append(commit_id)


def test_commits_whose_ids_are_taken_are_renamed_and_pushed_and_the_others_keep_theirs(mole: Replica) -> None:
    commits = [committed(mole, evidence) for evidence in (X, Y, Z)]
    old = mole.author
    server = TakenIds({commits[0].id, commits[1].id})
    assert linked(server).hold(push_commits(mole)).pushed == len(commits)
    assert server.pushed == [CommitId(mole.author, 0), CommitId(mole.author, 1), CommitId(old, 2)]
    assert mole.view.evidence(A) == added(X, Y, Z)
    assert mole.push_set() == []


def test_commits_of_a_closed_incarnation_get_new_ids_but_not_those_that_a_server_once_had(mole: Replica) -> None:
    commits = [committed(mole, evidence) for evidence in (X, Y)]
    mole.acknowledge(commits[0].id)
    at(mole, C1, NOTHING)  # the server was restored, and lacks it again
    report = linked(server := TakenIds({commit.id for commit in commits}, "author_closed")).hold(push_commits(mole))
    assert {commit: error.kind for commit, error in report.refused.items()} == {commits[0].id: "author_closed"}
    assert server.pushed == [CommitId(mole.author, 0)] and mole.author != commits[0].id.author
    assert mole.view.evidence(A) == added(X, Y)


def test_an_unacknowledged_commit_is_pushed_though_another_one_of_its_id_is_covered(mole: Replica) -> None:
    commit = committed(mole, Y)
    at(mole, C1, X, covering(commit.id))
    assert mole.push_set() == [commit.id]


# Rule 14: low-end


class Cells:
    """A server of one cell, for a low-end robot."""

    def __init__(self, to: Cursor, evidence: Evidence, coverage: VersionVector, *, listed: bool = True) -> None:
        self.to, self.evidence, self.coverage, self.listed = to, evidence, coverage, listed
        self.digest = encode_cell(A, evidence, GEOMETRY).digest.hex()
        self.index_digest = self.digest
        self.asked = 0

    def cell_index(self, name: str, author: object = None, **more: object) -> CellIndex:
        entry = CellEntry(
            cell=cell_of_key(A),
            size_bytes=1,
            digest=self.index_digest,
            lm=1,
            fingerprint=fingerprint(self.evidence, A).hex(),
            voxels=1,
        )
        return CellIndex(header=header(self.to, self.coverage), cells=[entry] if self.listed else [])

    def cell(self, name: str, cell: object, *, etag: str | None = None) -> FetchedCell:
        self.asked += 1
        found = f'"{self.digest}"'
        body = None if etag == found else encode_cell(A, self.evidence, GEOMETRY).data
        return FetchedCell(body, found, self.to, self.coverage, fingerprint(self.evidence, A))


def fetch(mole: Replica, server: Cells) -> int:
    return linked(server).hold(fetch_cells(mole)).cells_fetched


def test_a_cell_that_did_not_change_is_not_asked_for_again(mole: Replica) -> None:
    assert fetch(mole, Cells(C1, X, EMPTY)) == 1
    unchanged = Cells(C2, X, covering(foreign(0)))
    assert fetch(mole, unchanged) == unchanged.asked == 0
    assert mole.cells[A].cursor == C2
    assert foreign(0) in mole.cells[A].coverage


def test_an_answer_not_modified_moves_cursor_and_coverage(mole: Replica) -> None:
    fetch(mole, Cells(C1, X, EMPTY))
    commit = committed(mole, Y)
    # Between the index and the cell, the commit was folded and taken out again: the bytes are what they were.
    unchanged = Cells(C3, X, covering(commit.id))
    unchanged.index_digest = "0" * 64
    assert fetch(mole, unchanged) == 0
    assert unchanged.asked == 1
    assert mole.cells[A].cursor == C3
    assert mole.view.evidence(A) == X


def test_a_low_end_view_is_the_cell_and_the_own_ids_that_it_lacks(mole: Replica) -> None:
    first, second = committed(mole, Y), committed(mole, Z)
    fetch(mole, Cells(C1, added(X, Y), covering(first.id)))
    assert mole.view.evidence(A) == added(X, Y, Z)
    assert second.id in mole.push_set()


def test_a_cell_that_a_restored_server_does_not_have_is_not_shown_for_ever(mole: Replica) -> None:
    fetch(mole, Cells(C2, X, covering(foreign(0))))
    fetch(mole, Cells(cursor(1, branch=1), X, EMPTY, listed=False))
    assert not len(mole.view.evidence(A))


def test_another_server_takes_the_cells_of_a_low_end_robot_away(mole: Replica) -> None:
    commit = committed(mole, Y, B)
    mole.acknowledge(commit.id)
    fetch(mole, Cells(C1, X, covering(commit.id)))
    fetch(mole, Cells(Cursor(bytes(16), 0, bytes(16)), X, covering(commit.id), listed=False))
    assert not len(mole.view.evidence(A))
    assert mole.view.evidence(B) == Y
    assert mole.push_set() == [commit.id]


def test_a_cell_that_is_not_what_the_server_says_is_refused(mole: Replica) -> None:
    server = Cells(C1, X, EMPTY)
    server.evidence = Y
    broken = Cells(C1, X, EMPTY)
    broken.cell = lambda name, cell, etag=None: FetchedCell(  # type: ignore[method-assign]
        encode_cell(A, Y, GEOMETRY).data, '"0"', C1, EMPTY, fingerprint(X, A)
    )
    with pytest.raises(DamagedDataError):
        fetch(mole, broken)
    assert A not in mole.cells


# Rule 15: what is at rest


def test_a_cell_that_was_damaged_at_rest_is_asked_for_anew(tmp_path: Path) -> None:
    mole = opened(tmp_path / "mole")
    commit = committed(mole, Y)
    at(mole, C1, X)
    with mole.store.transaction():
        mole.store.put_cell(A, mole.cells[A], body=encode_cell(A, added(X, X), GEOMETRY).data)
    mole.close()
    mole = opened(tmp_path / "mole")
    assert mole.cells[A].cursor is None
    assert mole.view.evidence(A) == Y
    assert commit.id in mole.commits
    mole.close()


def test_a_cell_whose_bytes_cannot_be_read_does_not_stop_the_robot(tmp_path: Path) -> None:
    mole = opened(tmp_path / "mole")
    at(mole, C1, X)
    with mole.store.transaction():
        mole.store.put_cell(A, mole.cells[A], body=b"rubbish")
    mole.close()
    mole = opened(tmp_path / "mole")
    assert mole.cells[A].cursor is None
    exchanged(mole, header(C2), cell_frame(FrameKind.FULL, C2, added(X, Y)))
    assert mole.view.evidence(A) == added(X, Y)
    mole.close()


def _fields(frame: CellFrame) -> dict[str, object]:
    return {field.name: getattr(frame, field.name) for field in dataclasses.fields(frame)}
