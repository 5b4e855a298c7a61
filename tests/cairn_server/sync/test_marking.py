"""Marks over HTTP: listed in pages and boxes, added, changed and removed by operators, pushed by robots, refused."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.map.marks import mark, mark_commit
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_map.commits.commit import META_BYTES_MAX, Commit, CommitMeta, make_commit
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.commits.mark import MARKS_MAX
from cairn_map.wire.mark_messages import MarkPage, edited_twice
from cairn_server.store import shares
from cairn_server.store.store_rows import MapRow

DOOR = {"kind": "door", "name": "north door", "place_m": [1.5, -2.0, 1.0], "extent_m": [0.9, 0.1, 2.0]}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder: Path = tmp_path_factory.mktemp("guarded-marks")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


def page(live: Live, row: MapRow, **params: Any) -> MarkPage:
    live.folded(row)
    answer = live.http.get(f"/maps/{row.name}/main/marks", params=params)
    assert answer.status_code == 200, answer.text
    return MarkPage.model_validate_json(answer.content)


def names(found: MarkPage) -> list[str]:
    return [entry.mark.name for entry in found.marks]


def put(live: Live, row: MapRow, body: dict[str, Any], **options: Any) -> Any:
    answer = live.http.post(f"/maps/{row.name}/main/marks", json=body, **options)
    assert answer.status_code == 201, answer.text
    return answer.json()


def test_an_operator_adds_changes_and_removes_a_mark(live: Live) -> None:
    row = live.new_map()
    added = put(live, row, {"mark": DOOR})
    first = page(live, row)
    entry = first.marks[0]
    assert (entry.key, entry.mark.name, entry.mark.place_mm) == (added["key"], "north door", (1500, -2000, 1000))
    assert (entry.mark.by, first.from_start, first.more, first.removed) == ("local", True, False, [])

    # At once, before anything is folded again.
    changed = put(live, row, {"of": added["key"], "mark": DOOR | {"note": "locked"}})
    changed = put(live, row, {"of": changed["key"], "mark": DOOR | {"note": "open"}})
    second = page(live, row, after=first.cursor)
    assert [(each.key, each.mark.note) for each in second.marks] == [(changed["key"], "open")]
    assert (second.from_start, added["commit"] in second.removed, edited_twice(second.marks)) == (False, True, set())

    gone = put(live, row, {"of": changed["key"]})
    assert gone["key"] is None
    assert (names(page(live, row)), page(live, row, after=second.cursor).removed) == ([], [changed["commit"]])
    answer = live.http.post(f"/maps/{row.name}/main/marks", json={"of": changed["key"]})
    assert (answer.status_code, kind_of(answer), "changed or removed" in answer.text) == (404, "no_mark", True)
    lines = [line for line in live.http.get("/audit").json() if line["what"] == "mark" and row.name in line["detail"]]
    assert len(lines) == 4


@pytest.mark.parametrize("epoch_s", [None, 60])
def test_a_robot_pushes_marks_to_maps_of_either_kind(live: Live, epoch_s: int | None) -> None:
    row = live.new_map(epoch_s=epoch_s)
    made = mark_commit(0, mark(), mark("door"), author=MOLE)
    assert live.push(row, made).status_code == 201
    assert live.push(row, made).json()["state"] == "known"
    assert names(page(live, row)) == ["lamp", "door"]
    assert [entry.author for entry in page(live, row).marks] == ["mole", "mole"]
    # As it was pushed, for relays and robots; and no cell knows of it.
    live.http.headers["Cairn-Format"] = "2"
    fetched = live.http.get(f"/maps/{row.name}/commits/{made.id}")
    assert (fetched.content, live.cells(row)) == (made.data, {})
    # An operator changes one of the two: the other stays its author's.
    door = page(live, row).marks[1]
    put(live, row, {"of": door.key, "mark": DOOR})
    assert [(entry.mark.name, entry.author) for entry in page(live, row).marks] == [
        ("lamp", "mole"),
        ("north door", "local"),
    ]
    # And takes one out, whose neighbour stays.
    put(live, row, {"of": page(live, row).marks[0].key})
    assert names(page(live, row)) == ["north door"]


def test_marks_outlive_evidence_that_is_not_kept_and_can_be_changed_and_handed_over_after(live: Live) -> None:
    row = live.new_map()
    evidence, made = pushed(0, 0, MOLE), mark_commit(1, mark(), mark("door"), author=MOLE)
    for commit in (evidence, made, mark_commit(0, mark("gone"), author=WREN)):
        live.push(row, commit).raise_for_status()
        live.folded(row)
    live.retract(row, mark_commit(0, mark("gone"), author=WREN)).raise_for_status()
    live.folded(row)
    # Of four commits one has evidence: marks, and what took one out, are none.
    assert live.service.store.forget_evidence(row, before_s=float("inf"), limit=99) == 1
    assert kind_of(live.http.get(f"/maps/{row.name}/commits/{evidence.id}")) == "evidence_gone"
    assert live.http.get(f"/maps/{row.name}/commits/{made.id}").content == made.data
    assert names(page(live, row)) == ["lamp", "door"]
    put(live, row, {"of": f"{made.id}:1", "mark": DOOR})
    live.folded(row)
    assert names(page(live, row)) == ["lamp", "north door"]
    assert live.push(row, made).json()["state"] == "known"


def test_two_edits_of_one_mark_that_were_made_apart_are_both_shown(live: Live) -> None:
    row = live.new_map()
    for commit in (
        mark_commit(0, mark(), author=MOLE),
        mark_commit(1, mark("lamp, off"), author=MOLE, retracts=(f"{MOLE}.0",)),
        mark_commit(2, mark("lamp, hot"), author=MOLE, retracts=(f"{MOLE}.0",)),
        mark_commit(0, mark(), author=WREN),
    ):
        assert live.push(row, commit).status_code == 201
    found = page(live, row)
    assert sorted(names(found)) == ["lamp", "lamp, hot", "lamp, off"]
    assert edited_twice(found.marks) == {f"{MOLE}.1:0", f"{MOLE}.2:0"}


def test_pages_have_every_mark_once_and_a_box_its_own(live: Live) -> None:
    row = live.new_map()
    for n in range(5):
        live.push(row, mark_commit(n, *[mark(f"{n}.{k}", at_m=(n, k, 0)) for k in range(3)], author=MOLE))
    live.folded(row)
    found, after = [], None
    while True:
        part = page(live, row, limit=4, **({"after": after} if after else {}))
        found += names(part)
        if not part.more:
            break
        after = part.cursor
    assert sorted(found) == sorted(f"{n}.{k}" for n in range(5) for k in range(3))
    assert names(page(live, row, box="1,1,-1,2,9,1")) == ["1.1", "1.2", "2.1", "2.2"]
    assert names(page(live, row, box="-1e30,0,0,1e30,0,0")) == [f"{n}.0" for n in range(5)]


def test_a_cursor_of_another_log_begins_again(live: Live) -> None:
    row, other = live.new_map(), live.new_map()
    put(live, row, {"mark": DOOR})
    live.folded(row)
    assert page(live, row, after=page(live, row).cursor).from_start is False
    found = page(live, row, after=page(live, other).cursor)
    assert (found.from_start, names(found)) == (True, ["north door"])


@pytest.mark.parametrize(
    ("commit", "kind", "said"),
    [
        (mark_commit(0, mark(by="ada"), author=MOLE), "bad_mark", "own name"),
        (mark_commit(0, mark(at_m=(2e8, 0, 0)), author=MOLE), "bad_place", "ends"),
        (mark_commit(0, mark(), author="main.0123456789abcdef"), "reserved_name", "main"),
    ],
)
def test_a_commit_with_marks_that_no_robot_may_make_is_refused(
    live: Live, commit: Commit, kind: str, said: str
) -> None:
    row = live.new_map()
    answer = live.push(row, commit)
    assert (answer.status_code, kind_of(answer)) == (400, kind)
    assert said in answer.json()["detail"]
    assert page(live, row).marks == []


def test_too_many_marks_in_a_commit_are_refused_with_the_next_step(live: Live) -> None:
    row = live.new_map()
    made = mark_commit(0, *[mark()] * MARKS_MAX, author=MOLE)
    one = made.text.index(b"[{") + 1, made.text.index(b"},{") + 2
    text = made.text.replace(b"[{", b"[" + made.text[slice(*one)] + b"{", 1)
    data = made.data[:5] + len(text).to_bytes(4, "little") + text + bytes(4)
    answer = live.http.put(f"/maps/{row.name}/commits/{made.id}", content=data)
    assert (answer.status_code, kind_of(answer), "several" in answer.text) == (400, "too_many_marks", True)
    assert live.push(row, made).status_code == 201


@pytest.mark.parametrize(
    ("body", "status", "kind"),
    [
        ({}, 422, "bad_message"),
        ({"mark": None}, 422, "bad_message"),
        ({"mark": DOOR, "move": True}, 422, "bad_message"),
        ({"mark": DOOR | {"kind": "North Door"}}, 400, "bad_mark"),
        ({"mark": DOOR | {"name": "bell\x07"}}, 400, "bad_mark"),
        ({"mark": DOOR | {"name": "n" * 65}}, 400, "bad_mark"),
        ({"mark": DOOR | {"note": "n" * 1025}}, 400, "bad_mark"),
        ({"mark": DOOR | {"place_m": [1e9, 0, 0]}}, 400, "bad_place"),
        ({"mark": DOOR | {"extent_m": [-1, 0, 0]}}, 400, "bad_place"),
        ({"mark": DOOR | {"place_m": [0, 0]}}, 422, "bad_message"),
        ({"mark": DOOR | {"time_ms": 5}}, 422, "bad_message"),
        ({"of": "north door"}, 400, "bad_id"),
        ({"of": f"{MOLE}.7:0"}, 404, "no_mark"),
    ],
)
def test_what_an_operator_cannot_mean_is_refused_and_changes_nothing(
    live: Live, body: dict[str, Any], status: int, kind: str
) -> None:
    row = live.new_map()
    answer = live.http.post(f"/maps/{row.name}/main/marks", json=body)
    assert (answer.status_code, kind_of(answer)) == (status, kind)
    assert page(live, row).marks == []


def test_evidence_is_no_mark_and_a_retract_of_it_is_none(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    answer = live.http.post(f"/maps/{row.name}/main/marks", json={"of": f"{MOLE}.0"})
    assert (answer.status_code, kind_of(answer)) == (404, "no_mark")
    assert live.http.get(f"/maps/{row.name}/main/marks", params={"box": "1,2,3"}).status_code == 400
    assert live.http.get(f"/maps/{row.name}/main/marks", params={"after": "here"}).status_code == 400


def test_readers_look_robots_mark_as_themselves_and_operators_mark(guarded: Live) -> None:
    row = guarded.new_map()
    path = f"/maps/{row.name}/main/marks"
    tokens = {"mole": robot_token(guarded, row, "mole")}
    for role in ("reader", "operator"):
        answer = guarded.http.put(
            f"/tokens/{role}-{row.name}", json={"role": role, "map": row.name}, headers=bearer(ADMIN)
        )
        tokens[role] = answer.json()["token"]
    status = {who: guarded.http.post(path, json={"mark": DOOR}, headers=bearer(token)) for who, token in tokens.items()}
    assert {who: answer.status_code for who, answer in status.items()} == {"mole": 403, "reader": 403, "operator": 201}
    assert kind_of(status["reader"]) == "not_allowed"
    for author, expected in ((MOLE, 201), (WREN, 403)):
        commit = mark_commit(0, mark(), author=author)
        answer = guarded.push(row, commit, headers=bearer(tokens["mole"]))
        assert answer.status_code == expected
    # A robot takes out what is its own, and nobody else's.
    operators = CommitMeta.model_validate_json(_operators(guarded, row).text)
    for retracts, expected in (((operators.id,), 403), ((f"{MOLE}.0",), 201)):
        answer = guarded.push(row, mark_commit(1, author=MOLE, retracts=retracts), headers=bearer(tokens["mole"]))
        assert answer.status_code == expected
    guarded.folded(row)
    for token in tokens.values():
        found = MarkPage.model_validate_json(guarded.http.get(path, headers=bearer(token)).content)
        assert [(entry.mark.name, entry.mark.by) for entry in found.marks] == [("north door", f"operator-{row.name}")]
    assert guarded.http.get(path).status_code == 401


def _operators(live: Live, row: MapRow) -> Commit:
    live.folded(row)
    found = MarkPage.model_validate_json(live.http.get(f"/maps/{row.name}/main/marks", headers=bearer(ADMIN)).content)
    commit = next(entry.mark_key.commit for entry in found.marks if entry.mark_key.commit.author.robot == "operator")
    data = live.http.get(f"/maps/{row.name}/commits/{commit}", headers=bearer(ADMIN)).content
    return open_commit(data)[0]


def test_an_operators_mark_comes_back_to_a_server_that_lost_it_by_its_seal_alone(live: Live) -> None:
    row = live.new_map()
    receipt = put(live, row, {"mark": DOOR})
    live.folded(row)
    fetched = live.http.get(f"/maps/{row.name}/commits/{receipt['commit']}")
    assert fetched.headers["Cairn-Seal"] and fetched.headers["Cairn-Signature"]
    assert make_commit(open_commit(fetched.content)[0].meta, {}, SMALL).data == fetched.content
    header = {"Cairn-Seal": fetched.headers["Cairn-Seal"]}
    assert live.push(row, open_commit(fetched.content)[0], headers=header).json()["state"] == "known"


def test_a_refused_mark_of_an_operator_leaves_his_author_and_his_numbers(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = live.new_map()
    before = commit_id_from_text(put(live, row, {"mark": DOOR})["commit"])
    with monkeypatch.context() as full:
        full.setattr(shares, "MARKS_OF_SERVERS_MAX", 1)
        answer = live.http.post(f"/maps/{row.name}/main/marks", json={"mark": DOOR})
        assert (answer.status_code, kind_of(answer)) == (400, "too_many_marks")
    after = commit_id_from_text(put(live, row, {"mark": DOOR})["commit"])
    assert after == CommitId(before.author, before.n + 1)


def test_every_commit_of_marks_that_is_taken_leaves_an_operator_room_to_change_one(live: Live) -> None:
    row = live.new_map()
    long = mark(note="\u20ac" * 1024)
    most = (META_BYTES_MAX - 4096) // (len(long.to_json().encode()) + 1)
    answer = live.push(row, mark_commit(0, *[long] * most, author=MOLE))
    assert (answer.status_code, kind_of(answer), "several" in answer.text) == (413, "too_large", True)
    assert live.push(row, mark_commit(0, *[long] * (most - 5), author=MOLE)).status_code == 201
    changed = put(live, row, {"of": f"{MOLE}.0:1", "mark": DOOR | {"note": "\U0001f6aa" * 1024}})
    put(live, row, {"of": changed["key"]})
    assert len(page(live, row).marks) == most - 6
