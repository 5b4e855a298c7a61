"""Only the last version is stored: evidence goes when it is old, and nothing is ever summed up without it."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.fetching import fetch
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.naive.asker import NaiveAsker, cell_frames

from cairn_map.commits.commit import Commit
from cairn_map.wire.frames import FrameKind
from cairn_map.wire.messages import WANTED_MAX
from cairn_server.store.store_rows import MapRow

NOW = float("inf")


def forget(live: Live, row: MapRow, before_s: float = NOW) -> int:
    live.folded(row)
    return live.service.store.forget_evidence(row, before_s=before_s, limit=100)


def fetched(live: Live, row: MapRow, commit: Commit) -> object:
    answer = live.http.get(f"/maps/{row.name}/commits/{commit.id}")
    return answer.content if answer.status_code == 200 else kind_of(answer)


def test_a_commit_is_read_as_it_was_pushed_until_its_evidence_goes(live: Live) -> None:
    row, commits = live.new_map(), [pushed(n, n) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    before = live.cells(row)
    answer = live.http.get(f"/maps/{row.name}/commits/{commits[0].id}")
    assert (answer.content, answer.headers["ETag"]) == (commits[0].data, f'"{commits[0].sha.hex()}"')
    assert answer.headers["Content-Type"] == "application/vnd.cairn.commit" and "Cairn-Seal" not in answer.headers
    assert forget(live, row, before_s=0.0) == 0
    assert forget(live, row) == 3
    assert forget(live, row) == 0
    assert [fetched(live, row, commit) for commit in (commits[0], pushed(7, 0))] == ["evidence_gone", "no_commit"]
    assert live.cells(row) == before
    entries = live.http.get(f"/maps/{row.name}/log").json()
    assert [(entry["id"], entry["sha"], entry["cells"]) for entry in entries] == [
        (str(commit.id), commit.sha.hex(), len(commit.cells)) for commit in commits
    ]


@pytest.mark.slow
@settings(max_examples=12)
@given(st.data())
def test_whoever_comes_after_evidence_went_still_ends_with_the_map(live: Live, data: st.DataObject) -> None:
    row = live.new_map()
    kinds = data.draw(st.sampled_from([("delta", "full"), ("delta", "state", "full")]))
    asker = NaiveAsker(MOLE, asks_for=kinds)
    there: list[Commit] = []
    for step in data.draw(st.lists(st.sampled_from(["push", "push", "forget", "fetch"]), min_size=4, max_size=14)):
        if step == "push":
            author = MOLE if len(there) % 2 else WREN
            there.append(pushed(len(there), data.draw(st.integers(0, 4)), author))
            live.push(row, there[-1])
            if author == MOLE:
                asker.own[there[-1].id.n] = there[-1]
        elif step == "forget":
            forget(live, row)
        else:
            fetch(live, row, asker)
            assert asker.map() == sum_of(there)
    fetch(live, row, asker)
    assert asker.map() == read(live.cells(row)) == sum_of(there)


def test_no_delta_is_made_of_what_is_left_when_a_part_is_gone(live: Live) -> None:
    row, asker = live.new_map(), NaiveAsker(MOLE)
    for n in range(12):
        live.push(row, pushed(n, n, WREN))
    fetch(live, row, asker)
    kinds = []
    for n, is_part_gone in ((12, True), (14, False)):
        live.push(row, pushed(n, 1, WREN))
        if is_part_gone:
            forget(live, row)
        live.push(row, pushed(n + 1, 1, WREN))
        asker.kinds.clear()
        assert cell_frames(fetch(live, row, asker))
        kinds.append(set(asker.kinds))
    assert kinds == [{FrameKind.FULL}, {FrameKind.DELTA}]


def test_what_is_gone_is_retracted_once_its_bytes_are_pushed_again(live: Live) -> None:
    row, commits = live.new_map(), [pushed(n, 3) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    forget(live, row)
    assert kind_of(live.retract(row, commits[1])) == "evidence_gone"
    amend = pushed(3, 1, retracts=[commits[1]])
    assert kind_of(live.push(row, amend)) == "evidence_gone"
    assert read(live.cells(row)) == sum_of(commits)
    assert live.push(row, commits[1]).status_code == 200
    assert fetched(live, row, commits[1]) == commits[1].data
    assert live.push(row, amend).status_code == 201
    assert read(live.cells(row)) == sum_of([*commits, amend])
    assert live.retract(row, commits[1]).status_code == 201, "what is out already needs no evidence"


def wanted(live: Live, row: MapRow) -> list[str]:
    told: list[str] = live.http.get(f"/maps/{row.name}/main/cells").json()["header"]["wanted"]
    return told


def test_evidence_that_a_refused_retract_needs_is_wanted_until_it_comes(live: Live) -> None:
    row, commits = live.new_map(), [pushed(n, 3) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    forget(live, row)
    assert wanted(live, row) == []
    amend = pushed(3, 1, retracts=[commits[1]])
    assert kind_of(live.push(row, amend)) == "evidence_gone"
    assert wanted(live, row) == [str(commits[1].id)]
    assert kind_of(live.retract(row, commits[2])) == "evidence_gone"
    assert wanted(live, row) == [str(commits[1].id), str(commits[2].id)]
    live.push(row, commits[1])
    assert wanted(live, row) == [str(commits[2].id)]
    assert forget(live, row) == 0, "whoever needs it comes soon"
    assert live.push(row, amend).status_code == 201


def test_what_one_robot_s_retracts_need_does_not_push_out_what_another_s_and_an_operator_s_need(live: Live) -> None:
    row, tiny = live.new_map(), {KEYS[0]: random_evidence(0, SMALL, voxels=1, air=0)}
    many = [pushed(n, 0, WREN, cells=tiny) for n in range(WANTED_MAX + 1)]
    needed, asked = pushed(0, 1, MOLE), many[0]
    for commit in (needed, *many):
        assert live.push(row, commit).status_code == 201
    while forget(live, row):
        pass
    assert kind_of(live.retract(row, asked)) == "evidence_gone"
    assert kind_of(live.push(row, pushed(1, 1, MOLE, retracts=[needed]))) == "evidence_gone"
    assert kind_of(live.push(row, pushed(len(many), 1, WREN, retracts=many))) == "evidence_gone"
    told = wanted(live, row)
    assert {str(needed.id), str(asked.id)} < set(told)
    assert str(many[-1].id) in told
    assert len(told) <= WANTED_MAX
    live.push(row, asked)
    assert str(asked.id) not in wanted(live, row)


def test_bytes_that_come_again_count_as_new_and_those_of_a_retracted_commit_change_nothing(live: Live) -> None:
    row, commit, gone = live.new_map(), pushed(0, 1), pushed(1, 2)
    for each in (commit, gone):
        live.push(row, each)
    live.retract(row, gone)
    assert forget(live, row) == 2
    for each in (commit, gone):
        assert live.push(row, each).status_code == 200
    assert [fetched(live, row, each) for each in (commit, gone)] == [commit.data, "evidence_gone"]
    with live.service.store.snapshot(row) as snapshot:
        folded = snapshot.log(after_seq=0, limit=9)
    assert [entry.kind for entry in folded] == ["+", "+", "+", "-"]
    assert read(live.cells(row)) == sum_of([commit])


def test_evidence_that_a_waiting_commit_takes_out_is_kept(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row, commit = live.new_map(), pushed(0, 1)
    live.push(row, commit)
    live.folded(row)
    monkeypatch.setattr(live.service._fold_thread, "_fold_group", lambda *arguments: 0)
    live.push(row, pushed(1, 2, retracts=[commit]))
    assert live.service.store.forget_evidence(row, before_s=NOW, limit=100) == 0
    monkeypatch.undo()
    live.service._fold_thread.wake()
    assert read(live.cells(row)) == sum_of([commit, pushed(1, 2, retracts=[commit])])


def test_with_no_time_to_keep_it_evidence_goes_as_soon_as_it_is_folded(tmp_path: Path) -> None:
    with Live(tmp_path, keep_evidence_s=0.0) as live:
        row, commits = live.new_map(), [pushed(n, n) for n in range(4)]
        for commit in commits:
            live.push(row, commit)
        until(lambda: {fetched(live, row, c) for c in commits} == {"evidence_gone"}, "all of it went")
        assert read(live.cells(row)) == sum_of(commits)
