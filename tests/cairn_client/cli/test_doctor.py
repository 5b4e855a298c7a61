import json
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import MAP, LiveServer
from tests.fixtures.client.made import A, opened, seen
from tests.fixtures.server.live import Live

from cairn_client.cli.doctor import main
from cairn_client.cli.doctor_checks import CheckResult, clock_check, grid_check
from cairn_client.folders.map_copy import clone
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.evidence.grid import geometry_for


def told(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, dict[str, dict[str, str]]]:
    """Exit code, and checks by what they are of."""
    code = main([*argv, "--json"])
    return code, {check["what"]: check for check in json.loads(capsys.readouterr().out)}


def test_an_installation_is_checked_without_a_server(capsys: pytest.CaptureFixture[str]) -> None:
    code, checks = told(capsys)
    assert code == 0
    assert {"python", "cairn", "extra robot", "extra server", "kernels", "disk"} == checks.keys()
    assert all(check["advice"] for check in checks.values() if check["verdict"] != "ok")


def test_the_way_to_a_map_is_checked(server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Robot(None, server.map_url, directory=tmp_path / "mole", name="mole") as robot:
        robot.replica.commit({A: seen(1, 2, 3)})
        robot.sync()
    server.wait_for_fold()
    code, checks = told(capsys, server.map_url)
    assert code == 0
    for what in ("server", "protocol", "clock", "ready", "token", "speed"):
        assert checks[what]["verdict"] == "ok", checks[what]
    assert "1 cells, 1 commits" in checks["token"]["found"]
    assert "not measured" in checks["speed"]["found"]  # 159 bytes say nothing of a link


def test_a_copy_is_checked_and_so_is_the_way_to_its_server(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clone(server.map_url, tmp_path / "copy", token=None)
    code, checks = told(capsys, str(tmp_path / "copy"))
    assert (code, checks["folder"]["verdict"], checks["token"]["verdict"]) == (0, "ok", "ok")
    server.stop()
    assert main([str(tmp_path / "copy")]) == 1
    shown = capsys.readouterr().out
    assert "fail  server" in shown
    assert "-> start it, or look at the network between" in shown


def test_what_is_wrong_is_told_with_the_next_step(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, checks = told(capsys, f"{server.url}/maps/nothing")
    assert (code, checks["map"]["verdict"]) == (1, "fail")
    assert "cairn map ls" in checks["map"]["advice"]
    code, checks = told(capsys, str(tmp_path / "nobody"))
    assert (code, checks["folder"]["verdict"]) == (1, "fail")
    opened(tmp_path / "mole").close()
    (tmp_path / "mole" / "robot.sqlite").write_bytes(b"no database" * 1000)
    code, checks = told(capsys, str(tmp_path / "mole"))
    assert (code, checks["folder"]["verdict"]) == (1, "fail")
    assert "damaged_store" in checks["folder"]["found"]


@pytest.mark.slow
def test_a_folder_in_use_is_no_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    replica = opened(tmp_path / "mole")
    code, checks = told(capsys, str(tmp_path / "mole"))
    replica.close()
    assert (code, checks["folder"]["verdict"]) == (0, "warn")


def test_a_token_that_is_not_good_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Live(tmp_path / "server", admin_token="a" * 32) as live:
        url = f"http://127.0.0.1:{live.port}"
        code, checks = told(capsys, url, "--token", "b" * 32)
        assert (code, checks["token"]["verdict"]) == (1, "fail")
        assert "--token" in checks["token"]["advice"]
        assert told(capsys, url, "--token", "a" * 32)[0] == 0


@pytest.mark.parametrize(
    ("offset_s", "verdict"),
    [
        (0.4, CheckResult.OK),
        (-4.0, CheckResult.OK),
        (30.0, CheckResult.WARN),
        (-7200.0, CheckResult.FAIL),
        (None, CheckResult.WARN),
    ],
)
def test_clocks_may_differ_by_seconds_but_not_by_hours(offset_s: float | None, verdict: CheckResult) -> None:
    assert clock_check(offset_s, 0.01).verdict is verdict


def test_clocks_that_differ_by_less_than_is_measured_agree() -> None:
    """A server on the same machine had "-0.4 s from ours": the seconds of its Date are whole."""
    assert clock_check(-0.9, 0.01).found == "the server's agrees with ours, to within 1.0 s"
    assert "+1.2 s from ours, to within 1.0 s" in clock_check(1.2, 0.01).found


def test_a_folders_grid_is_compared_with_its_maps(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A map made anew under the same name has another grid: the robot's waiting commits do not fit it."""
    clone(server.map_url, tmp_path / "copy", token=None)
    code, checks = told(capsys, str(tmp_path / "copy"))
    assert (code, checks["grid"]["verdict"]) == (0, "ok")
    with MapApi(server.url) as api:
        found = grid_check(api, MAP, geometry_for(voxel_edge_m=0.5))
    assert found.verdict is CheckResult.FAIL
    assert "the folder has voxels of 0.5 m" in found.found
    assert "keep the folder" in found.advice
