"""A part of the map, and replies of few bytes, from a real server."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, cells_of, seen
from tests.fixtures.client.robots import evidence_of, map_commit, robot_in
from tests.fixtures.client.team import Team

from cairn_client.cli.robots import command as robot_command
from cairn_client.http.api import MapApi
from cairn_client.replica.limits import Limits
from cairn_client.sync.scope import BoxMetres, Scope
from cairn_client.sync.sync import ROUNDS_MAX
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Cell, cell_key, cell_of_key
from cairn_map.wire.frames import CELL_HEAD, CellFrame
from cairn_map.wire.messages import MissingRequest, Mode, More

EDGE_M = GEOMETRY.cell_edge_m
EVERY_CELL = {Cell(i, j, 0) for i in range(-5, 5) for j in range(7)}
BOX_M = ((-2 * EDGE_M, 0.0, 0.0), (1.5 * EDGE_M, 3 * EDGE_M, 0.1))
IN_BOX = {Cell(i, j, 0) for i in (-2, -1, 0, 1) for j in (0, 1, 2)}


@pytest.fixture
def large(server: LiveServer, tmp_path: Path) -> Iterator[LiveServer]:
    """A map of more cells than a fetch has rounds."""
    team = Team(server, tmp_path)
    team["owl"].commit({cell_key(cell): seen(1, 2, 3, kelvin_steps=5) for cell in EVERY_CELL})
    team.push("owl")
    yield server
    team.close()


def cells_seen(robot: object) -> set[Cell]:
    return {cell_of_key(key) for key in robot.map.packed()}  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["high-end", "low-end", "viewer"])
def test_a_robot_with_a_box_fetches_the_cells_in_it_and_no_others(
    large: LiveServer, tmp_path: Path, mode: Mode
) -> None:
    with robot_in(tmp_path, large.map_url, mode=mode, scope=Scope(box_m=BOX_M)) as robot:
        for _ in range(2):
            robot.sync()
            assert cells_seen(robot) == IN_BOX
        in_box_bytes = robot.traffic.down_bytes
    with robot_in(tmp_path, large.map_url, mode=mode) as robot:
        robot.sync()
        assert cells_seen(robot) == EVERY_CELL
        assert robot.traffic.down_bytes > 2 * in_box_bytes


def test_low_end_a_box_and_a_wish_go_together(large: LiveServer, tmp_path: Path) -> None:
    scope = Scope(box_m=BOX_M, wanted=lambda cell: cell.i == 1)
    with robot_in(tmp_path, large.map_url, mode="low-end", scope=scope) as robot:
        robot.sync()
        assert cells_seen(robot) == {cell for cell in IN_BOX if cell.i == 1}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["high-end", "low-end"])
def test_own_commits_outside_the_box_are_not_kept_for_ever(server: LiveServer, tmp_path: Path, mode: Mode) -> None:
    far_m = ((50.0, 50.0, 50.0), (51.0, 51.0, 51.0))
    limits = Limits(keep_acked_s=0)
    with robot_in(tmp_path, server.map_url, mode=mode, scope=Scope(box_m=far_m), limits=limits) as robot:
        commit = commit_id_from_text(map_commit(robot, 1))
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        assert robot.replica.commit_data(commit) is None
    with robot_in(tmp_path, server.map_url, mode=mode) as robot:  # and without a box all of it comes
        robot.sync()
        assert cells_of(robot.map) == cells_of(evidence_of(1))


@pytest.mark.slow
def test_small_replies_bring_the_whole_map_however_many_they_are(large: LiveServer, tmp_path: Path) -> None:
    assert len(EVERY_CELL) > ROUNDS_MAX
    with robot_in(tmp_path, large.map_url, scope=Scope(reply_bytes_max=1)) as robot:
        assert robot.sync().frames == 3 * len(EVERY_CELL) + 2  # header, one cell, `more`; and at last header, `done`
        assert cells_seen(robot) == EVERY_CELL
    with robot_in(tmp_path, large.map_url, name="fox", scope=Scope(reply_bytes_max=1500)) as robot:
        assert 4 <= robot.sync().frames - len(EVERY_CELL) < len(EVERY_CELL)
        assert cells_seen(robot) == EVERY_CELL


def test_a_reply_ends_with_the_cell_that_passes_the_limit(large: LiveServer) -> None:
    limit_bytes = 1000
    with MapApi(large.url) as api:
        frames = list(api.missing(MAP, "fox", MissingRequest(size_bytes_max=limit_bytes)))
    sizes = [CELL_HEAD.size + len(frame.payload) for frame in frames if isinstance(frame, CellFrame)]
    assert isinstance(frames[-1], More)
    assert sum(sizes[:-1]) <= limit_bytes < sum(sizes)


@pytest.mark.parametrize("mode", ["viewer", "low-end"])
def test_the_command_pulls_a_box(
    large: LiveServer, tmp_path: Path, mode: str, capsys: pytest.CaptureFixture[str]
) -> None:
    box = ",".join(str(value) for corner in BOX_M for value in corner)
    small = ["--reply-bytes", "500"] if mode == "viewer" else []
    command = ["sync", str(tmp_path / "copy"), "--map", large.map_url, "--mode", mode, "--box", box, *small]
    assert robot_command.main(command) == 0
    assert f"{len(IN_BOX)} cells" in capsys.readouterr().out


def test_a_limit_of_bytes_says_nothing_to_a_low_end_robot(tmp_path: Path) -> None:
    command = ["sync", str(tmp_path), "--map", "http://127.0.0.1:9/maps/lab", "--mode", "low-end"]
    with pytest.raises(BadInputError, match="low-end fetches cells"):
        robot_command.main([*command, "--reply-bytes", "500"])


@pytest.mark.parametrize("box_m", [((0, 0, 0), (1, 1, 0)), ((1, 0, 0), (0, 1, 1)), ((0, 0, 0), (1, 1, float("nan")))])
def test_a_box_without_an_inside_is_refused(box_m: BoxMetres) -> None:
    with pytest.raises(BadInputError, match="lowest and its highest"):
        Scope(box_m=box_m)


def test_a_box_reaches_no_farther_than_the_grid(large: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, large.map_url, scope=Scope(box_m=((-1e9,) * 3, (1e9,) * 3))) as robot:
        robot.sync()
        assert cells_seen(robot) == EVERY_CELL
