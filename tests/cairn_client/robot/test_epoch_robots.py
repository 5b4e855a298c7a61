"""Robots on a real server's map with epochs: commits of one epoch each, equal maps, the present first for who joins."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import robot_in

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.robot.robot import Robot
from cairn_client.sync.sync import fetch_present
from cairn_map.commits.commit import split_commit
from cairn_map.epochs.epoch import epoch_of
from cairn_map.wire.messages import CreateMap

EPOCH_S = 1


@pytest.fixture
def url(server: LiveServer) -> Iterator[str]:
    with MapApi(server.url) as api:
        api.create_map("epochs", CreateMap(geometry=GEOMETRY, epoch_s=EPOCH_S))
    yield f"{server.url}/maps/epochs"


def robot_on(folder: Path, url: str, name: str) -> Robot:
    """A robot that has learnt the map's epochs and the server's time."""
    robot = robot_in(folder, url, name=name, geometry=None)
    robot.sync()
    return robot


def test_scans_of_several_epochs_become_a_commit_of_each(url: str, tmp_path: Path) -> None:
    with robot_on(tmp_path, url, "mole") as mole:
        scans = [scan_of(seed) for seed in (1, 2, 3)]
        times = [scan.time_s for scan in scans]
        assert len({epoch_of(time_s, EPOCH_S) for time_s in times}) == len(times)
        commits = [mole.observe(scan) for scan in scans]
        assert commits[0] is None
        assert all(commits[1:])
        mole.commit()
        metas = [split_commit(mole.replica.commit_data(commit) or b"")[0] for commit in mole.replica.commits]
    assert [meta.epoch for meta in metas] == [epoch_of(time_s, EPOCH_S) for time_s in times]


def test_who_joins_sees_the_present_before_the_rows_and_ends_equal(url: str, tmp_path: Path) -> None:
    with robot_on(tmp_path, url, "mole") as mole:
        for seed in (5, 3, 1, 4):  # some of them old news
            mole.observe(scan_of(seed))
            mole.commit()
        mole.sync(until_folded=True)
        mole.sync()
        with robot_in(tmp_path, url, name="bat", geometry=None) as bat, MapApi(mole._api.origin) as api:
            assert Link(api, "epochs", branch="bat").hold(fetch_present(bat.replica)) == len(mole.map)
            assert len(bat.map) == 0
            known = mole.snapshot().voxels_in()
            first, now = bat.snapshot(), mole.snapshot()
            assert np.array_equal(first.state_at(known.centres_m), now.state_at(known.centres_m))
            # The rows come, and take the place of what was shown.
            bat.sync()
            assert bat.map == mole.map
            assert np.array_equal(bat.snapshot().log_odds_at(known.centres_m), now.log_odds_at(known.centres_m))
