import json
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, A, B, cells_of, seen
from tests.fixtures.client.robots import push_diffs
from tests.fixtures.map.made import SMALL

from cairn_client.cli.maps import clone as clone_command
from cairn_client.cli.maps import command as map_command
from cairn_client.cli.maps import diff as diff_command
from cairn_client.cli.maps import pull as pull_copy_command
from cairn_client.folders.map_copy import clone, pull
from cairn_client.folders.map_folder import open_map
from cairn_client.folders.state_folder import opened_replica
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.errors import BadInputError, ConflictError, NotFoundError, UnreachableError
from cairn_map.wire.messages import CreateMap


def shown(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().out


@pytest.mark.slow
def test_a_clone_has_the_map_and_a_pull_what_changed(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 3)}, {B: seen(5)})
    copy = tmp_path / "copy"
    assert clone_command.main([server.map_url, str(copy)]) == 0
    assert f"{copy}: 2 cells, 4 known voxels, 2 commits" in shown(capsys)
    assert pull_copy_command.main([str(copy)]) == 0
    assert shown(capsys) == f"{copy}: up to date\n"
    push_diffs(server, tmp_path / "mole", {A: seen(7, 8)})
    assert pull_copy_command.main([str(copy)]) == 0
    assert f"{copy}: 1 of 2 cells changed by 1 commits" in shown(capsys)
    with opened_replica(copy) as pulled, opened_replica(tmp_path / "mole") as mole:
        assert cells_of(pulled.view) == cells_of(mole.view)


@pytest.mark.slow
def test_diff_tells_a_copy_that_is_behind_from_one_that_is_not(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 3)})
    copy = tmp_path / "copy"
    clone(server.map_url, copy, token=None)
    assert diff_command.main([str(copy)]) == 0
    assert shown(capsys) == "equal: 1 cells, 3 voxels\n"
    push_diffs(server, tmp_path / "mole", {A: seen(9), B: seen(5)})
    assert diff_command.main([str(copy)]) == 1
    text = shown(capsys)
    assert "only in B       1 cell: -1,0,2" in text
    assert "other content   1 cell: 0,0,0" in text
    assert "commits         0 only in A, 1 only in B" in text
    assert diff_command.main([str(copy), str(tmp_path / "mole"), "--json"]) == 1
    found = json.loads(shown(capsys))
    assert (found["equal"], found["only_a"], found["only_b"], found["other"]) == (False, [], [[-1, 0, 2]], [[0, 0, 0]])
    assert (found["a"]["voxels"], found["b"]["voxels"]) == (3, 5)
    pull(copy)
    assert diff_command.main([str(copy), str(tmp_path / "mole")]) == 0


def test_commits_that_wait_are_part_of_a_robots_map(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1)})
    with opened_replica(tmp_path / "mole") as replica:
        replica.commit({B: seen(4)})
    assert diff_command.main([str(tmp_path / "mole"), server.map_url]) == 1
    text = shown(capsys)
    assert "only in A       1 cell: -1,0,2" in text
    assert "commits         1 only in A, 0 only in B" in text


def test_a_folder_of_cells_can_be_compared_but_knows_no_commits(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2)}, {B: seen(3)})
    map_command.main(["export", server.map_url, "--cells", str(tmp_path / "cells")])
    capsys.readouterr()
    assert diff_command.main([str(tmp_path / "cells"), server.map_url, "--json"]) == 0
    found = json.loads(shown(capsys))
    assert (found["a"]["size_bytes"], found["a"]["commits"]) == (found["b"]["size_bytes"], None)
    next((tmp_path / "cells").glob("-1*.cell")).unlink()
    assert diff_command.main([str(tmp_path / "cells"), server.map_url]) == 1


def test_maps_with_other_grids_are_not_compared(server: LiveServer, tmp_path: Path) -> None:
    assert SMALL != GEOMETRY
    with MapApi(server.url) as api:
        api.create_map("other", CreateMap(geometry=SMALL))
    with pytest.raises(BadInputError) as caught:
        diff_command.main([server.map_url, f"{server.url}/maps/other"])
    assert caught.value.kind == "other_geometry"


def test_a_copy_is_not_made_over_something_else(server: LiveServer, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    clone(server.map_url, copy, token=None)
    with pytest.raises(ConflictError, match="cairn pull"):
        clone(server.map_url, copy, token=None)
    push_diffs(server, tmp_path / "mole", {A: seen(1)})
    with pytest.raises(BadInputError, match="cairn robot sync"):
        pull(tmp_path / "mole")
    with pytest.raises(BadInputError) as caught:
        pull(tmp_path / "nobody")
    assert caught.value.kind == "no_state_folder"
    assert not (tmp_path / "nobody").exists()


def test_a_clone_that_lost_its_link_is_finished_by_a_pull(server: LiveServer, tmp_path: Path) -> None:
    """The server goes after it said what the map's grid is, and comes back later."""
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2)})
    copy = tmp_path / "copy"
    with Robot(None, server.map_url, directory=copy, name="copy-1", mode="viewer"):
        pass  # the folder of a clone of which nothing came yet, but for its URL
    server.stop()
    with pytest.raises(UnreachableError):
        pull(copy)
    server.start()
    assert pull(copy).voxels == 2


def test_a_map_of_a_server_is_opened_within_its_memory_limit_and_refused_beyond(
    server: LiveServer, tmp_path: Path
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 3)}, {B: seen(*range(512))})
    assert open_map(server.map_url).model == open_map(server.map_url, memory_bytes_max=1 << 20).model
    for memory_bytes_max in (1, 1000):
        with pytest.raises(BadInputError) as caught:
            open_map(server.map_url, memory_bytes_max=memory_bytes_max)
        assert caught.value.kind == "too_large" and "memory_bytes_max" in caught.value.message


def test_a_clone_that_cannot_begin_leaves_the_disk_as_it_was(server: LiveServer, tmp_path: Path) -> None:
    wrong = {f"{server.url}/maps/none": NotFoundError, "http://127.0.0.1:1/maps/lab": UnreachableError}
    place = tmp_path / "place"
    (empty := place / "empty").mkdir(parents=True)
    for url, error in wrong.items():
        for folder in (place / "new", empty):
            with pytest.raises(error):
                clone(url, folder, token=None)
    assert [path.name for path in place.rglob("*")] == ["empty"]
    clone(server.map_url, place / "new", token=None)
    clone(server.map_url, empty, token=None)


def test_a_clone_that_was_cut_off_is_finished_by_a_pull(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 3)})
    copy = tmp_path / "copy"

    def cut(*_: object, **__: object) -> None:
        raise UnreachableError("no_link", "the link is cut")

    with monkeypatch.context() as link:
        link.setattr(Robot, "sync", cut)
        with pytest.raises(UnreachableError):
            clone(server.map_url, copy, token=None)
    assert pull(copy).cells == 1
