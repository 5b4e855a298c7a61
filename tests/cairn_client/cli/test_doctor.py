import itertools
import json
import select
import socket
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import MAP, LiveServer
from tests.fixtures.client.made import A, opened, seen
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.replicas import SharedMemoryStore

from cairn_client.cli.doctor.checks import CheckResult, clock_check, grid_check
from cairn_client.cli.doctor.command import main
from cairn_client.cli.doctor.site import checks_of
from cairn_client.folders.map_copy import clone
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import geometry_for
from cairn_map.wire.access_messages import ServerInfo, SiteInfo


def told(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, dict[str, dict[str, str]]]:
    """Exit code, and checks by what they are of."""
    code = main([*argv, "--json"])
    return code, {check["what"]: check for check in json.loads(capsys.readouterr().out)}


def test_an_installation_is_checked_without_a_server(capsys: pytest.CaptureFixture[str]) -> None:
    code, checks = told(capsys)
    assert code == 0
    assert {"python", "cairn", "extra robot", "extra server", "kernels", "disk"} == checks.keys()
    assert all(check["advice"] for check in checks.values() if check["verdict"] != "ok")


def test_more_addresses_after_a_live_robot_s_door_are_refused() -> None:
    with pytest.raises(BadInputError, match="http://base:8750") as refused:
        main(["ws://127.0.0.1:9", "http://base:8750"])
    assert refused.value.kind == "bad_option"


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


# Servers behind an address


@contextmanager
def behind_one_address(*lives: Live) -> Iterator[str]:
    """URL of a proxy that gives each connection to the next of these servers."""

    class Turns(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            with socket.create_connection(("127.0.0.1", next(ports))) as there:
                ends = {self.request: there, there: self.request}
                while ends:
                    for ready in select.select(list(ends), [], [])[0]:
                        data = ready.recv(1 << 16)
                        if not data:
                            return
                        ends[ready].sendall(data)

    ports = itertools.cycle([live.port for live in lives])
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Turns) as proxy:
        threading.Thread(target=proxy.serve_forever).start()
        try:
            yield f"http://127.0.0.1:{proxy.server_address[1]}"
        finally:
            proxy.shutdown()


def signed_in(*lives: Live) -> None:
    """Return when each server of a shared store knows of the others."""
    for live in lives:
        live.service.site.sign()


def test_servers_that_share_a_store_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = SharedMemoryStore()
    with (
        Live(tmp_path / "a", store=store, folding="elsewhere") as one,
        Live(tmp_path / "b", store=store) as other,
        behind_one_address(one, other) as url,
    ):
        signed_in(one, other)
        code, checks = told(capsys, url)
        assert code == 0
        assert "shared; 2 of its servers answered here" in checks["store"]["found"]
        assert checks["servers"]["found"].startswith("2: 2 answer, 1 fold; version ")
        assert checks["folding"]["found"] == "no commit waits; nothing was folded yet"
        assert checks["clocks"]["verdict"] == "ok"
        row = one.new_map()
        one.push(row, pushed(0, 0))
        one.folded(row)
        signed_in(other)
        assert "the last fold was " in told(capsys, url)[1]["folding"]["found"]


def test_servers_that_share_no_store_behind_one_address_are_the_gravest_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        Live(tmp_path / "a") as one,
        Live(tmp_path / "b") as other,
        behind_one_address(one, other) as url,
    ):
        code, checks = told(capsys, url)
        assert (code, checks["store"]["verdict"]) == (1, "fail")
        assert checks["store"]["found"].startswith("2 stores answer behind http")
        assert "missing at the others" in checks["store"]["advice"]
        alone = f"http://127.0.0.1:{one.port}"
        assert told(capsys, alone)[1]["store"]["verdict"] == "ok"
        assert told(capsys, alone, f"http://127.0.0.1:{other.port}")[1]["store"]["verdict"] == "fail"


def test_a_site_where_no_server_folds_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Live(tmp_path / "a", store=SharedMemoryStore(), folding="elsewhere") as live:
        live.push(live.new_map(), pushed(0, 0))
        code, checks = told(capsys, f"http://127.0.0.1:{live.port}")
        assert (code, checks["folding"]["verdict"]) == (1, "fail")
        assert checks["folding"]["found"].startswith("no server folds; the oldest commit has waited for ")
        assert "--fold-only" in checks["folding"]["advice"]


def test_what_differs_between_servers_is_warned_of() -> None:
    def server(number: int, **facts: object) -> ServerInfo:
        sound = {"answers": True, "folds": True, "version": "1.0", "clock_ahead_s": 0.0, "folded_s": None, "heard_s": 1}
        return ServerInfo.model_validate({"id": f"{number:016x}", **sound, **facts})

    def found(*servers: ServerInfo, waiting_s: float = 0.0) -> dict[str, str]:
        site = SiteInfo(store="shared", store_id="a", server_id="b", servers=[*servers], waiting_s=waiting_s)
        return {check.what: check.verdict.value for check in checks_of([("http://a", site)])}

    sound = {"store": "ok", "servers": "ok", "folding": "ok", "clocks": "ok"}
    assert found(server(0), server(1)) == sound
    assert found(server(0), server(1, version="2.0")) == sound | {"servers": "warn"}
    assert found(server(0), server(1, clock_ahead_s=-9.0)) == sound | {"clocks": "warn"}
    assert found(server(0, folds=False), server(1), waiting_s=500.0) == sound | {"folding": "warn"}
