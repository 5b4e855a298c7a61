import json
import threading
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, A, seen

from cairn_client.cli.maps import watch as watch_command
from cairn_client.cli.maps.branch_table import branch_table
from cairn_client.cli.maps.watch import lines_of
from cairn_client.http.api import MapApi
from cairn_client.http.backoff import Backoff
from cairn_client.http.live_listener import Lost, listen
from cairn_client.robot.robot import Robot
from cairn_client.sync.responses import one_line, shown_text
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import NotFoundError
from cairn_map.wire.live_events import Hello, LiveEvent, LogGrew
from cairn_map.wire.messages import BranchInfo, RobotStatus


def commit(server: LiveServer, folder: Path) -> None:
    with Robot(None, server.map_url, directory=folder, name="mole") as robot:
        robot.replica.commit({A: seen(1)})
        robot.sync()
    server.wait_for_fold()


def stop(server: LiveServer) -> None:
    """Stop a server that somebody listens to."""
    server.service.live.close()
    server.stop()


def test_listening_goes_on_after_a_cut_from_where_it_was(server: LiveServer, tmp_path: Path) -> None:
    found: list[LiveEvent | Lost] = []
    with MapApi(server.url) as api:
        stream = listen(api, MAP, backoff=Backoff(first_s=0.01, last_s=0.05))
        found.append(next(stream))
        stop(server)
        found.append(next(stream))
        server.start()
        commit(server, tmp_path / "mole")
        while not isinstance(found[-1], LogGrew):
            found.append(next(stream))
        stream.close()
    first, lost, *rest = found
    assert isinstance(first, Hello)
    assert isinstance(lost, Lost)
    assert any(isinstance(event, Hello) and event.resumed for event in rest)
    assert [entry.cells for entry in found[-1].entries] == [1]
    shown = [line for event in found for line in lines_of(event)]
    assert shown[0] == "lab is at 0, robots: none"
    assert any(line.startswith("folded  mole.") and "1 cells" in line for line in shown)


def test_watch_prints_events_as_lines_of_json(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pusher = threading.Thread(target=commit, args=(server, tmp_path / "mole"))
    pusher.start()
    assert watch_command.main([server.map_url, "--json", "--events", "3"]) == 0
    pusher.join()
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(events) == 3
    assert (events[0]["type"], events[0]["map"]) == ("hello", MAP)


def test_a_map_that_is_not_there_cannot_be_watched(server: LiveServer) -> None:
    with pytest.raises(NotFoundError):
        watch_command.main([f"{server.url}/maps/nothing"])


def test_what_a_robot_says_of_itself_stays_within_its_line() -> None:
    pose = ScanPose(time_s=0.0, t_map_rig=(1e308, 0.0, 0.0), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    status = RobotStatus(time_s=0.0, pose=pose, note="fine\n15:04:10  folded  wren.0123456789abcdef.0\u2028\x1b[2J")
    branch = BranchInfo(
        branch="mole", mode="high-end", sensors=[], cursor=None, behind=None, last_seen_s=0, status=status
    )
    assert all(len(line.splitlines()) == 1 and len(line) < 200 for line in branch_table([branch]))
    assert shown_text(one_line(status.note)) == one_line(status.note)


@pytest.mark.parametrize(
    "hidden", ["\x1b", "\x9b", "\u202e", "\u061c", "\u200b", "\ufeff", "\U000e0041", "\ue000", "\u00ad"]
)
def test_what_steers_or_does_not_show_is_replaced(hidden: str) -> None:
    assert shown_text(f"mole{hidden} \té\n") == "mole\N{REPLACEMENT CHARACTER} \té\n"
    assert shown_text("Grüße, 地図, 21 °C 👋") == "Grüße, 地図, 21 °C 👋"
