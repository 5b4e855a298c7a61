"""Status that a robot reports when it syncs, and the table that people see of it."""

from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import map_commit, robot_in
from tests.fixtures.server.stores import one_server

from cairn_client.cli.arguments import shown_age
from cairn_client.cli.maps.branch_table import branch_table
from cairn_client.http.api import MapApi
from cairn_client.robot import status_report
from cairn_map.commits.commit import ScanPose
from cairn_map.wire.messages import BranchInfo, RobotStatus


def branch_of(server: LiveServer, name: str = "mole") -> BranchInfo:
    with MapApi(server.url) as api:
        return next(branch for branch in api.branches(MAP) if branch.branch == name)


@one_server("the other one knows where a robot stands a second later")
def test_a_robot_tells_its_status_with_every_sync(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as mole:
        mole.status.battery, mole.status.note = 0.5, "in the yard"
        map_commit(mole, 1)
        mole.sync()
        mole.sync()
        status = branch_of(server).status
        assert status is not None
        assert (status.mode, status.waiting, status.battery, status.note) == ("high-end", 0, 0.5, "in the yard")
        assert status.pose is not None
        assert status.pose.t_map_rig == tuple(scan_of(1).T_map_rig[:3, 3])
        assert branch_of(server).incarnation == mole.replica.author.incarnation
        mole.observe(scan_of(2))
        commit = mole.commit()
        assert commit is not None
        mole.status.send(mole.replica, mole._api, MAP, branch="mole", mode=mole.mode)
        status = branch_of(server).status
        assert status is not None
        assert (status.waiting, status.waiting_bytes) == (1, len(commit.data))
        with MapApi(server.url) as api:
            api.put_view(MAP, "mole", b"\xff\xd8\xff picture")
            assert api.view(MAP, "mole") == b"\xff\xd8\xff picture"


def test_a_status_is_told_when_it_says_something_new_or_is_a_minute_old(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with robot_in(tmp_path, server.map_url) as mole:
        map_commit(mole, 1)
        told: list[RobotStatus] = []
        put_status = mole._api.put_status

        def noted(name: str, branch: str, status: RobotStatus) -> None:
            put_status(name, branch, status)
            told.append(status)

        monkeypatch.setattr(mole._api, "put_status", noted)
        for _ in range(3):
            mole.sync()
        assert len(told) == 1
        mole.status.note = "at the stairs"
        mole.sync()
        assert [status.note for status in told] == ["", "at the stairs"]
        for later_s, count in ((59.0, 2), (61.0, 3), (-5.0, 4)):  # the clock may be set back, too
            monkeypatch.setattr(status_report.time, "time", lambda later_s=later_s: told[1].time_s + later_s)
            mole.sync()
            assert len(told) == count


def test_a_status_that_is_not_taken_does_not_stop_the_sync(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as mole:
        for battery in (0.5, 7.0):  # the second is none
            mole.status.battery = battery
            map_commit(mole, int(battery))
            assert mole.sync().pushed == 1
        status = branch_of(server).status
        assert status is not None and status.battery == 0.5


def test_the_table_shows_lag_age_and_pose() -> None:
    pose = ScanPose(time_s=1.0, t_map_rig=(1.0, -2.0, 0.4), q_map_rig=(0.0, 0.0, 0.7071068, 0.7071068), sigma_m=0.05)
    status = RobotStatus(time_s=90.0, pose=pose, waiting=2, waiting_bytes=2500, battery=0.8, note="at the\nstairs")
    common = {"sensors": [], "cursor": None, "incarnation": "0" * 16}
    branches = [
        BranchInfo.model_validate(
            {"branch": "mole", "mode": "high-end", "behind": 7, "behind_bytes": 1500, "last_seen_s": 90.0}
            | common
            | {"status": status}
        ),
        BranchInfo.model_validate(
            {"branch": "bat", "mode": "low-end", "behind": None, "last_seen_s": 100.0 - 7200.0} | common
        ),
    ]
    head, mole, bat = branch_table(branches, now_s=100.0)
    assert head.split()[:6] == ["robot", "mode", "seen", "behind", "bytes", "waiting"]
    for text in ("mole", "10 s", " 7 ", "1.5 kB", "2 (2.5 kB)", "80%", "1.00, -2.00, 0.40 ±0.05; 90°", "at the stairs"):
        assert text in mole
    assert bat.split() == ["bat", "low-end", "2", "h", "cells", "-", "-", "-", "-"]
    assert [shown_age(s) for s in (-1, 119, 120, 7200, 172_800)] == ["0 s", "119 s", "2 min", "2 h", "2 d"]
