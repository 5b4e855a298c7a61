"""Fetch-missing: SYNC.md's rules, the server's half, each against an asker made of dictionaries."""

from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.fetching import ask_missing, fetch
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.stores import one_server
from tests.naive.asker import KEY_FAR, NaiveAsker, cell_frames, fingerprint_sum

from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.frames import FrameKind, frames_of
from cairn_map.wire.messages import Done, MissingRequest, More, ReplyHeader
from cairn_server.folding import read_cache
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import Contribution
from cairn_server.sync import cell_changes, missing


@settings(max_examples=9)
@given(st.data())
def test_an_asker_that_comes_now_and_then_always_ends_with_the_server_s_map(live: Live, data: st.DataObject) -> None:
    row = live.new_map()
    kinds = data.draw(st.sampled_from([("delta", "full"), ("state", "full"), ("delta", "state", "full"), ()]))
    asker = NaiveAsker(data.draw(st.sampled_from([MOLE, WREN, None])), asks_for=kinds)
    commits = [pushed(n, data.draw(st.integers(0, 5)), author) for author in (MOLE, WREN) for n in range(4)]
    steps = data.draw(st.lists(st.sampled_from(["push", "push", "retract", "fetch"]), max_size=12))
    waiting = list(data.draw(st.permutations(commits)))
    there = []
    gone = []
    for step in [*steps, "fetch"]:
        if step == "push" and waiting:
            there.append(commit := waiting.pop())
            live.push(row, commit)
            if commit.id.author == asker.author:
                asker.own[commit.id.n] = commit
        elif step == "retract":
            gone.append(data.draw(st.sampled_from(commits)))
            live.retract(row, gone[-1])
        elif step == "fetch":
            fetch(live, row, asker)
            assert asker.map() == read(live.cells(row)) == sum_of(c for c in there if c not in gone)


def test_a_small_change_of_a_large_cell_comes_as_delta_and_the_first_fetch_whole(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    for n in range(12):
        live.push(row, pushed(n, n, WREN))
    fetch(live, row, asker)
    assert set(asker.kinds) == {FrameKind.FULL}
    asker.kinds.clear()
    live.push(row, pushed(12, 1, WREN))
    frames = cell_frames(fetch(live, row, asker))
    assert set(asker.kinds) == {FrameKind.DELTA}
    assert frames.keys() == pushed(12, 1).cells.keys()


def test_a_delta_that_is_larger_than_the_cell_gives_way_to_the_cell(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 1, WREN))
    fetch(live, row, asker)
    asker.kinds.clear()
    live.retract(row, pushed(0, 1, WREN))
    fetch(live, row, asker)
    assert set(asker.kinds) == {FrameKind.FULL}
    assert asker.map() == {}


def test_what_was_taken_out_is_subtracted_in_a_delta_even_alone(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    commits = [pushed(n, n, WREN) for n in range(12)]
    for commit in commits:
        live.push(row, commit)
    fetch(live, row, asker)
    asker.kinds.clear()
    live.retract(row, commits[0])
    fetch(live, row, asker)
    assert set(asker.kinds) == {FrameKind.DELTA}
    assert asker.map() == sum_of(commits[1:])


def test_what_one_commit_did_to_a_cell_is_decoded_once_for_askers_at_all_states(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, decoded = live.new_map(), Counter[tuple[CommitId, CellKey]]()
    stored_diff = read_cache.stored_diff

    def counted(snapshot: Snapshot, key: CellKey, contribution: Contribution) -> Evidence:
        decoded[contribution.commit, key] += 1
        return stored_diff(snapshot, key, contribution)

    monkeypatch.setattr(read_cache, "stored_diff", counted)
    commits = [pushed(n, n, WREN) for n in range(12)] + [pushed(n, 1, WREN) for n in range(12, 16)]
    askers = [NaiveAsker(MOLE) for _ in range(3)]
    for commit in commits[:12]:
        live.push(row, commit)
    for commit, asker in zip(commits[12:], [*askers, None], strict=True):
        if asker is not None:
            fetch(live, row, asker)
            asker.kinds.clear()
        live.push(row, commit)
    for asker in askers:
        fetch(live, row, asker)
        assert set(asker.kinds) == {FrameKind.DELTA}
        assert asker.map() == sum_of(commits)
    assert decoded == {(commit.id, key): 1 for commit in commits[12:] for key in commit.cells}


def test_what_is_pending_is_not_stable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Live(tmp_path, stable_after_s=0) as own:
        row = own.new_map()
        own.push(row, pushed(0, 0))
        own.folded(row)
        monkeypatch.setattr(own.service._fold_thread, "_fold_group", lambda *arguments: 0)
        own.push(row, pushed(1, 1))
        header = frames_of(ask_missing(own, row, NaiveAsker(MOLE).request()).content)[0]
        assert isinstance(header, ReplyHeader)
        assert header.stable == {str(MOLE): [[0, 0]]}


def test_own_commits_are_left_out_of_a_delta_but_not_their_retract(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 1, WREN))
    fetch(live, row, asker)
    asker.own[0] = pushed(0, 1)
    live.push(row, asker.own[0])
    own = cell_frames(fetch(live, row, asker))
    assert [(frame.payload, frame.own_excluded) for frame in own.values()] == [(b"", True)] * 2
    live.retract(row, asker.own[0])
    fetch(live, row, asker)
    assert asker.map() == sum_of([pushed(0, 1, WREN)])


def test_a_delta_that_leaves_one_asker_s_commits_out_is_sent_to_no_other(live: Live) -> None:
    row = live.new_map()
    askers = {author: NaiveAsker(author) for author in (MOLE, WREN, None)}
    commits = [pushed(n, n, author) for n in range(6) for author in (MOLE, WREN)]
    for commit in commits:
        live.push(row, commit)
    for asker in askers.values():
        fetch(live, row, asker)
        asker.kinds.clear()
    news = [pushed(6, 0, MOLE), pushed(6, 3, WREN)]
    for commit in news:
        live.push(row, commit)
        askers[commit.id.author].own[commit.id.n] = commit
    for asker in askers.values():
        fetch(live, row, asker)
        assert set(asker.kinds) == {FrameKind.DELTA}
        assert asker.map() == sum_of([*commits, *news])


def test_the_same_robot_in_another_incarnation_gets_its_old_evidence_back(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 1, WREN))
    asker = NaiveAsker(WREN._replace(incarnation=MOLE.incarnation))
    fetch(live, row, asker)
    live.push(row, pushed(1, 1, WREN))
    fetch(live, row, asker)
    assert asker.map() == sum_of([pushed(0, 1, WREN), pushed(1, 1, WREN)])


def test_an_asker_without_an_author_is_not_told_that_anything_was_left_out(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(None)
    for n in range(6):
        live.push(row, pushed(n, 1, WREN))
    fetch(live, row, asker)
    live.push(row, pushed(6, 1, WREN))
    frames = cell_frames(fetch(live, row, asker)).values()
    assert {(frame.kind, frame.own_excluded) for frame in frames} == {(FrameKind.DELTA, False)}


def test_who_cannot_use_a_delta_gets_the_cell_whole(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    for n in range(6):
        live.push(row, pushed(n, 1, WREN))
    fetch(live, row, asker)
    live.push(row, pushed(6, 1, WREN))
    live.folded(row)
    frames = cell_frames(frames_of(ask_missing(live, row, asker.request(kinds=["full"])).content))
    assert {frame.kind for frame in frames.values()} == {FrameKind.FULL}


@pytest.mark.parametrize("wrong", ["future", "foreign chain"])
def test_a_cursor_that_cannot_be_proven_is_answered_with_resets_for_every_cell(live: Live, wrong: str) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 0, WREN))
    fetch(live, row, asker)
    true = cursor_from_text(str(asker.cursor))
    false = Cursor(true.log_id, true.seq + 1, true.chain) if wrong == "future" else Cursor(true.log_id, 1, bytes(16))
    request = MissingRequest.model_validate(
        {"cursor": str(false), "cells": [{"cell": cell_of_key(KEY_FAR), "cursor": str(false)}]}
    )
    frames = frames_of(ask_missing(live, row, request).content)
    found = cell_frames(frames)
    assert {frame.kind for frame in found.values()} == {FrameKind.RESET}
    assert found.keys() == {*pushed(0, 0).cells, KEY_FAR}
    assert found[KEY_FAR].fingerprint == ZERO
    assert {frame.from_cursor for frame in found.values()} == {false}


def test_a_single_cell_with_a_false_cursor_is_reset_alone(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 0, WREN))
    fetch(live, row, asker)
    key = next(iter(pushed(0, 0).cells))
    true = cursor_from_text(str(asker.cursor))
    asker.cursors[key] = str(Cursor(true.log_id, true.seq, bytes(16)))
    found = cell_frames(frames_of(ask_missing(live, row, asker.request()).content))
    assert {k: frame.kind for k, frame in found.items()} == {key: FrameKind.RESET}


def test_a_cursor_of_another_log_is_gone(live: Live) -> None:
    row, other = live.new_map(), live.new_map()
    cursor = live.http.get(f"/maps/{other.name}").json()["cursor"]
    for request in (
        MissingRequest(cursor=cursor),
        MissingRequest.model_validate({"cells": [{"cell": (0, 0, 0), "cursor": cursor}]}),
    ):
        answer = ask_missing(live, row, request)
        assert (answer.status_code, kind_of(answer)) == (410, "other_log")


def test_compare_answers_every_cell_with_its_fingerprint_and_no_bytes(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 0, WREN))
    fetch(live, row, asker)
    frames = frames_of(ask_missing(live, row, asker.request(compare=True)).content)
    found = cell_frames(frames)
    assert {(frame.kind, frame.payload) for frame in found.values()} == {(FrameKind.RESET, b"")}
    index = live.http.get(f"/maps/{row.name}/main/cells").json()["cells"]
    assert sorted(frame.fingerprint.hex() for frame in found.values()) == sorted(cell["fingerprint"] for cell in index)


def test_a_listed_cell_that_nobody_saw_comes_as_an_empty_one(live: Live) -> None:
    row = live.new_map()
    request = MissingRequest.model_validate({"cells": [{"cell": cell_of_key(KEY_FAR), "cursor": None}]})
    frames = frames_of(ask_missing(live, row, request).content)
    asker = NaiveAsker(None)
    asker.cursors[KEY_FAR] = None
    assert asker.take(frames)
    assert asker.base == {KEY_FAR: {}}


def test_done_sums_the_fingerprints_of_the_cells_without_a_frame(live: Live) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 0, WREN))
    everything = fingerprint_sum(fetch(live, row, asker))
    done = fetch(live, row, asker)[-1]
    assert isinstance(done, Done)
    assert done.rest == everything.hex()
    # With frames for some cells: they and the rest are all that a newcomer gets.
    live.push(row, pushed(1, 1, WREN))
    frames = fetch(live, row, asker)
    done = frames[-1]
    assert isinstance(done, Done)
    assert done.rest_fingerprint != ZERO
    assert fingerprint_sum(frames) + done.rest_fingerprint == fingerprint_sum(fetch(live, row, NaiveAsker(None)))


def test_a_long_reply_ends_with_more_and_the_next_request_goes_on(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(missing, "REPLY_BYTES_MAX", 1)
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    commits = [pushed(n, n, WREN) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)
    replies = 1
    while not asker.take(frames := frames_of(ask_missing(live, row, asker.request()).content)):
        assert isinstance(frames[-1], More)
        assert len(frames) == 3
        replies += 1
    assert replies == 4
    assert asker.map() == sum_of(commits)


def test_many_entries_are_not_even_tried_as_a_delta(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    asker = NaiveAsker(MOLE)
    live.push(row, pushed(0, 0, WREN))
    fetch(live, row, asker)
    monkeypatch.setattr(cell_changes, "DELTA_ENTRIES_MAX", 2)
    for n in range(1, 4):
        live.push(row, pushed(n, 0, WREN))
    found = cell_frames(fetch(live, row, asker))
    assert {frame.kind for frame in found.values()} == {FrameKind.FULL}


@one_server("the name of its operator is its own")
def test_the_header_tells_what_a_robot_may_conclude(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    commits = [pushed(n, n) for n in (0, 1)]
    for commit in commits:
        live.push(row, commit)
    live.retract(row, commits[0])
    live.folded(row)
    header = frames_of(ask_missing(live, row, NaiveAsker(MOLE).request()).content)[0]
    assert isinstance(header, ReplyHeader)
    assert header.vector[str(MOLE)] == [[0, 1]]
    assert header.tip == (1, commits[1].sha.hex())
    assert header.stable == {}
    assert header.retracts == [f"operator.{live.service.sync.retracts.commits.operator}.0"]
    monkeypatch.setattr(live.service._fold_thread, "_fold_group", lambda *arguments: 0)
    live.push(row, pushed(2, 2))
    header = frames_of(ask_missing(live, row, NaiveAsker(MOLE).request()).content)[0]
    assert isinstance(header, ReplyHeader)
    assert header.pending == {str(MOLE): [[2, 2]]}
    assert header.vector[str(MOLE)] == [[0, 1]]
    monkeypatch.undo()
    live.service._fold_thread.wake()


def test_a_cell_named_twice_is_refused(live: Live) -> None:
    row = live.new_map()
    cells = [{"cell": (0, 0, 0), "cursor": None}] * 2
    assert kind_of(ask_missing(live, row, MissingRequest.model_validate({"cells": cells}))) == "bad_message"


def test_a_box_limits_frames_and_what_done_speaks_of(live: Live) -> None:
    row, asker = live.new_map(), NaiveAsker(MOLE)
    for n in range(3):
        live.push(row, pushed(n, n, WREN))
    live.folded(row)
    inside = [key for key in KEYS if cell_of_key(key).i >= 0]
    box = ((0, -1, -1), (1, 0, 9))
    frames = frames_of(ask_missing(live, row, asker.request(box=box)).content)
    assert cell_frames(frames).keys() == set(inside) < set(KEYS)
    head = cursor_from_text(frames[0].to)  # type: ignore[union-attr]
    assert isinstance(frames[-1], Done) and frames[-1].rest_fingerprint == ZERO
    frames = frames_of(ask_missing(live, row, asker.request(cursor=str(head), box=box)).content)
    with live.service.store.snapshot(row) as snapshot:
        total = sum((cell.fingerprint for cell in snapshot.cells() if cell.key in inside), ZERO)
    assert cell_frames(frames) == {}
    assert isinstance(frames[-1], Done) and frames[-1].rest_fingerprint == total


def test_an_asker_with_a_byte_budget_gets_the_cells_one_after_the_other(live: Live) -> None:
    row, asker = live.new_map(), NaiveAsker(MOLE)
    commits = [pushed(n, n, WREN) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)
    sizes = []
    while not asker.take(frames := frames_of(ask_missing(live, row, asker.request(size_bytes_max=1)).content)):
        sizes.append(len(cell_frames(frames)))
    assert sizes == [1, 1, 1]
    assert asker.map() == sum_of(commits)


def test_who_holds_nothing_gets_no_cell_of_which_all_was_taken_out(live: Live) -> None:
    row, commit = live.new_map(), pushed(0, 0)
    live.push(row, commit)
    live.folded(row)
    held = NaiveAsker(WREN, asks_for=("delta", "full"))
    fetch(live, row, held)
    live.retract(row, commit)
    live.folded(row)
    frames = list(frames_of(live.http.post(f"/maps/{row.name}/branches/mole/missing", json={}).content))
    assert [type(frame) for frame in frames] == [ReplyHeader, Done]
    assert isinstance(frames[-1], Done) and frames[-1].rest == ZERO.hex()
    fetch(live, row, held)
    assert not any(held.map().values())
