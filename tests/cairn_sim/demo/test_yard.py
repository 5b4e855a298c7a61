"""The demo's yard: robots that cross the shed's door map into the layer of the place, and all end with the same map."""

import io
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from tests.fixtures.server.live import Live

from cairn_client.http.api import MapApi
from cairn_map.epochs.epoch import STANDARD_EPOCH_S
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.grid import geometry_for, level_geometry
from cairn_map.wire.layer_messages import AddLayer
from cairn_map.wire.messages import CreateMap
from cairn_sim.demo import yard
from cairn_sim.demo.yard import LAYERS, MAP, SCENE, drive_team, require_equal_maps, yard_plans
from cairn_sim.demo.yard_robot import GROUND, YardRobot
from cairn_sim.robots.record import Plan
from cairn_sim.scene.scene_file import load_scene


def layers_of(member: YardRobot) -> set[str]:
    """Layers with commits of the robot itself."""
    robots = member.robot.robots.items()
    return {layer for layer, robot in robots if any(each.author.robot == member.name for each in robot.replica.commits)}


def test_a_robot_that_cannot_be_opened_leaves_no_other_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[YardRobot] = []

    def second_fails(name: str, plan: Plan, map_url: str, folder: Path) -> YardRobot:
        if opened:
            raise UnreachableError("store_failed", "the disk is full")
        opened.append(YardRobot(name, plan, map_url, folder))
        return opened[0]

    monkeypatch.setattr(yard, "YardRobot", second_fails)
    with Live(tmp_path / "server") as server:
        monkeypatch.setattr(yard, "demo_server", lambda _: nullcontext(f"http://127.0.0.1:{server.port}"))
        with pytest.raises(UnreachableError, match="disk is full"):
            yard.show_yard(tmp_path, Console(file=io.StringIO()), voxel_edge_m=0.16)
        with pytest.raises(BadInputError) as refused:
            opened[0].robot.commit()
    assert refused.value.kind == "robot_closed"


def test_robots_that_cross_the_door_map_into_the_layer_of_the_place_and_all_maps_are_equal(tmp_path: Path) -> None:
    plans = yard_plans(load_scene(SCENE), 1, (2, 1))
    ways = {"rover": replace(plans["rover"], first_stop=29), "mole": replace(plans["mole"], last_stop=4)}
    said = io.StringIO()
    console = Console(file=said, width=200)
    with Live(tmp_path / "server") as server, MapApi(f"http://127.0.0.1:{server.port}") as api:
        api.create_map(MAP, CreateMap(geometry=geometry_for(voxel_edge_m=0.16), epoch_s=STANDARD_EPOCH_S))
        api.add_layer(MAP, AddLayer(name=GROUND, geometry=level_geometry(), epoch_s=STANDARD_EPOCH_S))
        map_url = f"http://127.0.0.1:{server.port}/maps/{MAP}"
        team = [YardRobot(name, plan, map_url, tmp_path / "robots") for name, plan in ways.items()]
        try:
            rover, mole = team
            assert mole.measure()
            assert mole.progress.place == "in the shed"
            assert layers_of(mole) == {EVIDENCE}
            assert rover.measure()
            assert rover.progress.place == "outdoors"
            assert layers_of(rover) == {GROUND}
            drive_team(team, api, console)
            require_equal_maps(team, api, console)
            for member in team:
                assert not member.measure()
                assert layers_of(member) == {EVIDENCE, GROUND}
                assert all(len(robot.map) for robot in member.robot.robots.values())
            # The two layers meet in the door.
            assert mole.robot.snapshot().names_at([[-13.0, 5.0, -1.07]]) == [EVIDENCE]
            assert set(LAYERS) == set(mole.robot.snapshot().names)
        finally:
            for member in team:
                member.close()
    assert "all equal: server, rover and mole hold the same" in said.getvalue()
