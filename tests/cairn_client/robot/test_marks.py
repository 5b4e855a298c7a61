"""Marks of robots: kept without a link, pushed, seen by others, changed, taken out, refused with a reason."""

from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, A, cells_of, seen
from tests.fixtures.client.robots import NOWHERE, map_commit, robot_in
from tests.fixtures.map.made import made_cursor
from tests.fixtures.map.marks import mark

from cairn_client.http.api import MapApi
from cairn_client.replica import mark_copy
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import BadInputError, CairnError, ConflictError, NotFoundError, UnreachableError
from cairn_map.wire.mark_messages import MarkEntry, MarkPage, MarkRequest, MarkText, edited_twice
from cairn_map.wire.messages import CreateMap
from cairn_server.store.sqlite import changes

WREN = "wren.0123456789abcdef"
PLACE = (0.5, -0.25, 1.0)


def names(robot: object) -> list[str]:
    return [entry.mark.name for entry in robot.marks()]  # type: ignore[attr-defined]


def test_a_mark_is_kept_without_a_link_and_seen_by_another_robot_once_both_synced(
    server: LiveServer, tmp_path: Path
) -> None:
    with robot_in(tmp_path, NOWHERE) as robot:
        made = robot.mark("hot pipe", PLACE, kind="hot_spot", extent_m=(0.1, 0.1, 2.0), note="78 degrees")
        assert (robot.waiting, cells_of(robot.map)) == (1, {})
        with pytest.raises(UnreachableError):  # it never had the server's
            robot.marks()
        robot.close(flush_s=0)
    with robot_in(tmp_path, server.map_url) as robot, robot_in(tmp_path, server.map_url, name="wren") as other:
        # Its own is there before the server has it.
        assert [entry.mark_key.commit for entry in robot.marks()] == [made.id]
        assert names(other) == []
        map_commit(robot, 1)
        robot.sync(until_folded=True)
        assert not robot.waiting
        assert names(other) == []  # as of its last round
        other.sync()
        (entry,) = other.marks()
        assert (entry.key, entry.author, entry.mark.place_m, entry.mark.note) == (
            *(f"{made.id}:0", "mole", PLACE, "78 degrees"),
        )
        assert other.marks((0, -1, 0, 1, 1, 1)) == [entry] and other.marks((2, 2, 2, 3, 3, 3)) == []
        with pytest.raises(BadInputError) as refused:
            other.marks((1, 1, 1, 0, 0, 0))
        assert refused.value.kind == "bad_box"
    # Without a link, and in another process, it shows what it had.
    with robot_in(tmp_path, NOWHERE, name="wren") as other:
        assert other.marks() == [entry]


def test_a_robot_changes_and_takes_out_its_own(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        first = robot.mark("lamp", PLACE)
        changed = robot.mark("lamp, off", PLACE, instead_of=first)
        assert names(robot) == ["lamp, off"]
        robot.sync(until_folded=True)
        assert names(robot) == ["lamp, off"]
        # By its first name, too: what stands for it goes.
        robot.retract(first.id)
        assert names(robot) == []
        robot.sync(until_folded=True)
        assert names(robot) == []
        with pytest.raises(ConflictError) as refused:
            robot.retract(changed)
        assert refused.value.kind == "taken_back"


def test_an_operators_mark_reaches_a_robot_that_brings_it_back_to_a_server_that_lost_it(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with MapApi(server.url) as api, robot_in(tmp_path, server.map_url) as robot:
        request = MarkRequest(mark=MarkText(kind="door", name="north door", place_m=PLACE))
        receipt = api.put_mark(MAP, request)
        server.wait_for_fold()
        monkeypatch.setattr(server.service.sync.replies._stable, "of", lambda snapshot: EMPTY)
        robot.sync()
        kept = [commit for commit in robot.replica.commits if commit.author.robot == "operator"]
        assert list(map(str, kept)) == [receipt.commit]
        data = robot.replica.commit_data(kept[0])
        assert data is not None and [mark.name for mark in open_commit(data)[0].meta.marks] == ["north door"]
        assert robot.replica.seal(kept[0]) is not None
        assert names(robot) == ["north door"]


def test_an_edit_by_an_operator_and_one_by_its_robot_are_both_shown(server: LiveServer, tmp_path: Path) -> None:
    with MapApi(server.url) as api, robot_in(tmp_path, server.map_url) as robot:
        first = robot.mark("lamp", PLACE)
        robot.sync(until_folded=True)
        text = MarkText(kind="lamp", name="lamp of the hall", place_m=PLACE)
        api.put_mark(MAP, MarkRequest(of=f"{first.id}:0", mark=text))
        robot.mark("lamp, off", PLACE, instead_of=first)
        robot.sync(until_folded=True)
        server.wait_for_fold()
        found = robot.marks()
        assert sorted(entry.mark.name for entry in found) == ["lamp of the hall", "lamp, off"]
        assert edited_twice(found) == {entry.key for entry in found}


def test_marks_go_to_maps_with_epochs_as_well(server: LiveServer, tmp_path: Path) -> None:
    with MapApi(server.url) as api:
        info = api.create_map("hours", CreateMap(geometry=api.map_info(MAP).geometry, epoch_s=60))
    with robot_in(tmp_path, f"{server.url}/maps/hours", geometry=info.layer) as robot:
        robot.mark("lamp", PLACE)
        robot.replica.commit({A: seen(1)})
        robot.sync(until_folded=True)
        assert names(robot) == ["lamp"]


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"name": ""}, "bad_mark"),
        ({"name": "two\nlines"}, "bad_mark"),
        ({"kind": "Hot"}, "bad_mark"),
        ({"at_m": (float("inf"), 0, 0)}, "bad_place"),
        ({"at_m": (1e8, 0, 0)}, "bad_place"),
        ({"instead_of": "wren.0123456789abcdef.0"}, "not_own"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_lost(tmp_path: Path, fields: dict[str, object], kind: str) -> None:
    with robot_in(tmp_path) as robot:
        map_commit(robot, 1)
        with pytest.raises(BadInputError) as refused:
            robot.mark(**{"name": "lamp", "at_m": PLACE} | fields)  # type: ignore[arg-type]
        assert (refused.value.kind, robot.waiting) == (kind, 1)
        robot.mark("lamp", PLACE)
        assert robot.waiting == 2
        robot.close(flush_s=0)


def test_each_change_of_a_mark_takes_the_place_of_the_last_one_under_any_of_its_names(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        first = robot.mark("lamp", PLACE)
        second = robot.mark("lamp, off", PLACE, instead_of=first)
        third = robot.mark("lamp, hot", PLACE, instead_of=first)
        assert (second.meta.retracted_ids, third.meta.retracted_ids) == ((first.id,), (second.id,))
        # The server has another commit under that id (SYNC.md rule 13).
        alone = robot.mark("door", PLACE)
        renamed = robot.replica.rename(alone.id)
        assert robot.mark("door, open", PLACE, instead_of=alone).meta.retracted_ids == (renamed,)
        alone = robot.mark("stairs", PLACE)
        renamed = robot.replica.rename(alone.id)
        assert robot.retract(alone).meta.retracted_ids == (renamed,)
        with pytest.raises(ConflictError) as gone:
            robot.mark("stairs", PLACE, instead_of=alone)
        assert gone.value.kind == "taken_back"
        measured = map_commit(robot, 1)
        with pytest.raises(NotFoundError) as refused:
            robot.mark("lamp", PLACE, instead_of=measured)
        assert refused.value.kind == "no_mark"
        robot.close(flush_s=0)


@pytest.mark.parametrize(
    "refusal", [BadInputError("too_many_marks", "it has 3"), ConflictError("older_servers", "some are older")]
)
def test_after_a_mark_was_refused_no_other_tears_the_numbers_further(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: CairnError
) -> None:
    def refuse(commit: object, held: int) -> None:
        raise refusal

    with robot_in(tmp_path, server.map_url) as robot:
        with monkeypatch.context() as full:
            full.setattr(changes, "check_marks", refuse)
            first = robot.mark("lamp", PLACE)
            robot.sync()
            with pytest.raises(ConflictError, match=str(first.id)) as refused:
                robot.mark("door", PLACE)
            assert refused.value.kind == refusal.kind
        map_commit(robot, 1)
        robot.sync()
        assert robot.waiting == 1
        robot.close(flush_s=0)
    # A new start tries it again, and then marks go on.
    with robot_in(tmp_path, server.map_url) as robot:
        robot.sync()
        robot.mark("door", PLACE)
        robot.sync()
        assert not robot.waiting


def test_a_copy_that_is_full_leaves_marks_out_says_so_once_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(mark_copy, "MARKS_MAX", 3)

    def page(seq: int, *keys: str, removed: tuple[str, ...] = ()) -> MarkPage:
        entries = [MarkEntry(key=f"{WREN}.{key}", mark=mark()) for key in keys]
        cursor = str(made_cursor(seq))
        return MarkPage(cursor=cursor, from_start=seq == 1, more=False, marks=entries, removed=list(removed))

    with robot_in(tmp_path) as robot:
        copy = robot.replica.marks
        pages = [page(1, "0:0", "0:1"), page(2, "1:0", "2:0"), page(3, "3:0", removed=(f"{WREN}.0",)), page(4, "4:0")]
        counts = []
        for each in pages:
            copy.take(each)
            assert copy.cursor == each.cursor
            counts.append(len(copy.entries()))
        assert counts == [2, 3, 2, 3]
        copy.take(page(5, "5:0"))
        assert [record.levelname for record in caplog.records if "left out" in record.message] == ["WARNING"]
