"""Layers on the command line: added, listed, and taken wherever a map is."""

import json
from pathlib import Path

from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, seen
from tests.fixtures.commands import cairn

from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.evidence.grid import cell_key
from cairn_map.files.cell_folder import read_cells, read_head


def test_a_layer_is_added_listed_and_mapped_into_drawn_and_saved(server: LiveServer, tmp_path: Path) -> None:
    url = f"{server.map_url}.fine"
    said = cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    assert said.splitlines()[0].startswith(f"layer fine of map {MAP}: voxels of 1 cm, ")
    assert said.splitlines()[1] == f"robots map into it at {url}"
    with MapApi(server.url) as api:
        (evidence, fine) = api.layers(MAP)
        assert fine.geometry.channels == evidence.geometry.channels == GEOMETRY.channels

    with Robot(None, url, directory=tmp_path / "near", name="near") as robot:
        robot.replica.commit({cell_key((0, 0, 0)): seen(1, 2, 70)})
        robot.sync(until_folded=True)
    table = [line.split() for line in cairn("map", "layer", "list", server.map_url, folder=tmp_path).splitlines()]
    assert [(row[0], row[-1]) for row in table[1:]] == [("evidence", server.map_url), ("fine", url)]
    assert table[2][1:3] == ["1", "cm"]
    listing = json.loads(cairn("map", "layer", "list", server.map_url, "--json", folder=tmp_path))
    assert [(each["map"], each["cells"]) for each in listing] == [(MAP, 0), (f"{MAP}.fine", 1)]

    # As any map: facts, cells, the robots on it; and its cells are prior data for a map on that grid.
    assert "near" not in cairn("map", "info", server.map_url, folder=tmp_path)
    assert cairn("map", "info", url, folder=tmp_path).startswith(f"map {MAP}.fine: voxels of 1 cm")
    assert f"{MAP}.fine " in cairn("map", "ls", server.url, folder=tmp_path)
    cells = tmp_path / "cells"
    cairn("map", "export", url, "--cells", str(cells), folder=tmp_path)
    head = read_head(cells)
    assert (head.geometry, len(list(read_cells(cells, head.layer)))) == (fine.geometry, 1)
    cairn("map", "create", f"{server.url}/maps/copy", "--from", url, folder=tmp_path)
    with MapApi(server.url) as api:
        assert (api.map_info("copy").geometry, api.map_info("copy").name) == (fine.geometry, "copy")


def test_what_is_no_layer_is_refused_with_the_next_step(server: LiveServer, tmp_path: Path) -> None:
    def refused(*arguments: str, code: int = 1) -> str:
        return cairn("map", "layer", "add", *arguments, folder=tmp_path, code=code)

    cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    assert "other_layer" in refused(server.map_url, "fine", "--voxel", "0.02", code=4)
    assert "take another name" in refused(server.map_url, "evidence", "--voxel", "0.01")
    assert "bad_layer" in refused(server.map_url, "Not this", "--voxel", "0.01")
    assert "layer of map" in refused(f"{server.map_url}.fine", "finer", "--voxel", "0.005")
    assert "MAP.LAYER" in refused(f"{server.map_url}.No", "finer", "--voxel", "0.005")
