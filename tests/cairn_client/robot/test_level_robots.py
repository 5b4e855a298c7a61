"""A level layer through a real server: robots end with the map that corrected poses would have given."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of

from cairn_client.folders.map_folder import open_map
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.commits.commit import Commit
from cairn_map.evidence.grid import level_geometry
from cairn_map.wire.layer_messages import AddLayer
from cairn_map.wire.messages import CreateMap

TWIN = "twin"
UPWARDS = np.array([[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]])


def robot_in(folder: Path, url: str, name: str) -> Robot:
    return Robot(RIG, url, directory=folder / name, name=name, integrator=INTEGRATOR, keep_scans_bytes=10**7)


def measured(robot: Robot, seed: int, T_map_rig: np.ndarray | None = None) -> Commit:
    """A commit of two equal scans: a height takes two votes."""
    scan = scan_of(seed)
    for _ in range(2):
        robot.observe(scan if T_map_rig is None else replace(scan, T_map_rig=T_map_rig))
    commit = robot.commit()
    assert commit is not None
    return commit


@pytest.mark.parametrize("epoch_s", [None, 60])
def test_a_level_is_the_one_without_what_was_retracted_and_with_what_was_amended(
    server: LiveServer, tmp_path: Path, epoch_s: int | None
) -> None:
    with MapApi(server.url) as api:
        api.create_map(TWIN, CreateMap(geometry=GEOMETRY))
        for name in (MAP, TWIN):
            api.add_layer(name, AddLayer(name="ground", geometry=level_geometry(), epoch_s=epoch_s))
    url, moved = f"{server.url}/maps/{MAP}.ground", UPWARDS @ scan_of(2).T_map_rig
    with robot_in(tmp_path, url, "mole") as mole, robot_in(tmp_path, url, "crow") as crow:
        wrong, drifted, _ = (measured(mole, seed) for seed in (1, 2, 3))
        mole.sync(until_folded=True)
        crow.sync()
        before = mole.map.digest()
        assert crow.map.digest() == before
        mole.amend(drifted, [moved] * 2)
        mole.retract(wrong)
        mole.sync(until_folded=True)
        crow.sync()
        with robot_in(tmp_path, f"{server.url}/maps/{TWIN}.ground", "wren") as wren:
            measured(wren, 2, moved)
            measured(wren, 3)
            wren.sync(until_folded=True)
            assert mole.map.digest() == crow.map.digest() == wren.map.digest() != before
            expected = wren.snapshot().elevation()
    found = open_map(url).elevation()
    for name, values in expected.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], values)
    assert found.votes.sum() > 0
