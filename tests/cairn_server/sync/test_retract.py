"""Retract: exactly as if it had never been pushed."""

import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.ids import OPERATOR, Author
from cairn_map.errors import DeniedError
from cairn_map.evidence.grid import cell_of_key
from cairn_map.wire.messages import Retract
from cairn_server.access.auth import Caller, Role
from cairn_server.sync.retracting import seal_of


@settings(max_examples=9)
@given(st.data())
def test_a_retract_of_any_commits_before_between_or_after_equals_never_having_pushed_them(
    live: Live, data: st.DataObject
) -> None:
    commits = [pushed(n, data.draw(st.integers(0, 5)), author) for author in (MOLE, WREN) for n in range(3)]
    gone = data.draw(st.lists(st.sampled_from(commits), unique_by=id, min_size=1))
    row = live.new_map()
    for step in data.draw(st.permutations([*commits, "retract", "retract"])):
        if isinstance(step, str):
            assert live.retract(row, *gone).status_code == 201
        else:
            live.push(row, step)
        if data.draw(st.booleans()):
            live.folded(row)
    kept = [commit for commit in commits if commit not in gone]
    other = live.new_map()
    for commit in kept:
        live.push(other, commit)
    assert live.cells(row) == live.cells(other)
    assert read(live.cells(row)) == sum_of(kept)


def test_retract_twice_subtracts_once(live: Live) -> None:
    row = live.new_map()
    commits = [pushed(n, 4) for n in range(2)]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)
    for _ in range(2):
        live.retract(row, commits[0])
        live.folded(row)
    assert read(live.cells(row)) == sum_of(commits[1:])
    assert [entry["kind"] for entry in live.http.get(f"/maps/{row.name}/log").json()] == ["+", "+", "+", "-", "+"]


def test_the_log_names_the_token_that_asked_for_a_retract(live: Live) -> None:
    row = live.new_map()
    commit = pushed(0, 0)
    live.push(row, commit)
    request = Retract(commits=[str(commit.id)], note="the head was knocked")
    live.service.sync.retracts.retract(row, request, by=Caller(Role.OPERATOR, name="anna"))
    live.folded(row)
    entries = live.http.get(f"/maps/{row.name}/log").json()
    assert [(entry["via"], entry["note"]) for entry in entries if entry["retracts"]] == [("anna", request.note)]
    assert {entry["via"] for entry in entries if not entry["retracts"]} == {None}


def test_retract_of_a_robot_takes_out_what_it_pushed_and_nothing_else(live: Live) -> None:
    row = live.new_map()
    mine, others = [pushed(n, n, MOLE) for n in range(3)], [pushed(n, n, WREN) for n in range(3)]
    for commit in (*mine, *others):
        live.push(row, commit)
    answer = live.retract(row, robot="mole", note="its lens was dirty")
    assert answer.json()["commits"] == [str(commit.id) for commit in mine]
    assert read(live.cells(row)) == sum_of(others)
    live.push(row, late := pushed(3, 4, MOLE))
    assert read(live.cells(row)) == sum_of([*others, late])


def test_a_retracted_commit_pushed_again_is_known_and_changes_nothing(live: Live) -> None:
    row = live.new_map()
    commit = pushed(0, 1)
    live.push(row, commit)
    live.retract(row, commit)
    live.folded(row)
    assert live.push(row, commit).status_code == 200
    assert live.cells(row) == {}


def test_an_emptied_cell_is_served_empty_and_an_unseen_one_is_not_found(live: Live) -> None:
    row = live.new_map()
    commit = pushed(0, 0)
    live.push(row, commit)
    live.retract(row, commit)
    live.folded(row)
    key = next(iter(commit.cells))
    answer = live.http.get(f"/maps/{row.name}/main/cells/{cell_of_key(key)}")
    assert answer.status_code == 200
    assert len(decode_cell(answer.content).evidence) == 0
    unseen = next(key for key in KEYS if key not in commit.cells)
    answer = live.http.get(f"/maps/{row.name}/main/cells/{cell_of_key(unseen)}")
    assert (answer.status_code, kind_of(answer)) == (404, "no_cell")


def test_an_amend_replaces_what_it_names(live: Live) -> None:
    row = live.new_map()
    first = pushed(0, 1)
    amend = pushed(1, 2, retracts=[first])
    for commit in (amend, first):
        assert live.push(row, commit).status_code == 201
    assert read(live.cells(row)) == sum_of([first, amend])


def test_a_commit_named_twice_is_retracted_once(live: Live) -> None:
    row = live.new_map()
    commit = pushed(0, 1)
    live.push(row, commit)
    answer = live.http.post(f"/maps/{row.name}/retracts", json={"commits": [str(commit.id)] * 2, "robot": "mole"})
    assert answer.json()["commits"] == [str(commit.id)]


def test_a_robot_with_more_commits_than_one_retract_can_name_is_retracted_by_several(
    live: Live, monkeypatch: object
) -> None:
    monkeypatch.setattr("cairn_server.sync.retracting.RETRACTS_MAX", 2)  # type: ignore[attr-defined]
    row = live.new_map()
    commits = [pushed(n, n) for n in range(5)]
    for commit in commits:
        live.push(row, commit)
    answer = live.retract(row, robot="mole")
    assert answer.json()["commits"] == [str(commit.id) for commit in commits]
    assert live.cells(row) == {}


def test_nothing_and_retracts_cannot_be_retracted(live: Live) -> None:
    row = live.new_map()
    assert kind_of(live.retract(row)) == "nothing_to_retract"
    assert kind_of(live.retract(row, robot="nobody")) == "nothing_to_retract"
    target = f"operator.{live.service.sync.retracts.commits.operator}.0"
    answer = live.http.post(f"/maps/{row.name}/retracts", json={"commits": [target]})
    assert kind_of(answer) == "not_retractable"


def test_commits_are_meant_by_robot_rig_and_time_and_a_preview_changes_nothing(live: Live) -> None:
    row = live.new_map()
    old, new = "ab" * 32, "cd" * 32
    commits = [
        pushed(n, n, author, rig=rig) for author, rig in ((MOLE, old), (WREN, old), (WREN, new)) for n in range(2)
    ]
    commits[4:] = [pushed(n + 2, n, WREN, rig=new) for n in range(2)]
    times_s = []
    for commit in commits:
        live.push(row, commit)
        times_s.append(time.time())
    names = [str(commit.id) for commit in commits]

    def meant(**fields: object) -> list[int]:
        answer = live.retract(row, preview=True, **fields)
        assert answer.status_code in (201, 404), answer.text
        return [names.index(name) for name in answer.json().get("commits", [])]

    assert meant(rig=old) == [0, 1, 2, 3]
    assert meant(robot="wren", rig=old) == [2, 3]
    assert meant(pushed_after_s=times_s[2]) == [3, 4, 5]
    assert meant(robot="wren", pushed_after_s=times_s[2], pushed_before_s=times_s[4]) == [3, 4]
    assert meant(captured_after_s=1.5e9 + 1.5) == [4, 5]  # the n-th commit's last scan is at 1.5e9 + n
    assert meant(captured_before_s=1.5e9 - 1) == meant(robot="nobody") == []
    assert read(live.cells(row)) == sum_of(commits)
    answer = live.retract(row, robot="wren", rig=new)
    assert answer.json()["commits"] == names[4:]
    assert read(live.cells(row)) == sum_of(commits[:4])


def test_a_retract_may_be_pushed_back_by_anybody_with_this_map_s_seal_on_it_and_by_nobody_without(live: Live) -> None:
    row, commit = live.new_map(), pushed(0, 1)
    live.push(row, commit)
    name = live.retract(row, commit).json()["id"]
    live.folded(row)
    answer = live.http.get(f"/maps/{row.name}/commits/{name}")
    seal = answer.headers["Cairn-Seal"]
    service, robot = live.service, Caller(Role.ROBOT, "mole")
    for wrong in (None, "0" * 64, seal_of(row, commit.sha)):
        with pytest.raises(DeniedError):
            service.sync.pushes.keep(row, robot, name, answer.content, seal=wrong)
    other = live.new_map()
    with pytest.raises(DeniedError):
        service.sync.pushes.keep(other, robot, name, answer.content, seal=seal)
    evidence = pushed(0, 1, Author(OPERATOR, MOLE.incarnation))
    with pytest.raises(DeniedError):
        service.sync.pushes.keep(row, robot, str(evidence.id), evidence.data, seal=seal_of(row, evidence.sha))
    assert not service.sync.pushes.keep(row, robot, name, answer.content, seal=seal)
