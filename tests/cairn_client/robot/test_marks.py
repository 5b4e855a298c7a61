"""Marks of robots: kept without a link, pushed, seen by others, changed, taken out, refused with a reason."""

from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, A, cells_of, seen
from tests.fixtures.client.robots import NOWHERE, map_commit, robot_in

from cairn_client.http.api import MapApi
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import BadInputError, ConflictError, UnreachableError
from cairn_map.wire.mark_messages import MarkRequest, MarkText, edited_twice
from cairn_map.wire.messages import CreateMap

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
