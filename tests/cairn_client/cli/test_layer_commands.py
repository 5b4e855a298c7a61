"""Layers on the command line: added, listed, and taken wherever a map is."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer, wait_until
from tests.fixtures.client.made import GEOMETRY, MAP, seen
from tests.fixtures.client.robot_program import RIG, scan_of
from tests.fixtures.commands import cairn

from cairn_client.folders.map_folder import layers_of, open_layers, open_map
from cairn_client.folders.state_folder import opened_replica
from cairn_client.http.api import MapApi
from cairn_client.main import main
from cairn_client.robot.layer_folders import lend_keys
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import NotFoundError, UnreachableError
from cairn_map.evidence.grid import cell_key
from cairn_map.files.cell_folder import read_cells, read_head
from cairn_map.queries.occupancy_states import State
from cairn_map.wire.messages import Retract, Retracted


def sweep_of(points: np.ndarray[tuple[int, int], np.dtype[np.float64]], time_s: float) -> Scan:
    """A sweep of points without order, seen from 2 m above the origin."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    own = (points - pose[:3, 3]).astype(np.float32)
    range_m = np.full((3, 4), np.nan, np.float32)
    return Scan(time_s=1.5e9 + time_s, T_map_rig=pose, range_camera="tof", range_m=range_m, points_m=own)


def test_a_layer_is_added_listed_and_mapped_into_drawn_and_saved(server: LiveServer, tmp_path: Path) -> None:
    url = f"{server.map_url}.fine"
    said = cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    assert said.splitlines()[0].startswith(f"layer fine of map {MAP}: voxels of 1 cm, ")
    assert said.splitlines()[1] == f"robots map into it at {url}"
    with MapApi(server.url) as api:
        (evidence, fine) = api.layers(MAP)
        assert fine.geometry.channels == evidence.geometry.channels == GEOMETRY.channels
    assert "[empty_map]" in cairn("map", "export", server.map_url, "--ply", "m.ply", folder=tmp_path, code=3)

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


def test_points_are_read_in_the_finest_layer_that_knows_them(server: LiveServer, tmp_path: Path) -> None:
    cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    for name, url, places in (("far", server.map_url, (0, 9, 300)), ("near", f"{server.map_url}.fine", (1, 2, 70))):
        with Robot(None, url, directory=tmp_path / name, name=name) as robot:
            robot.replica.commit({cell_key((0, 0, 0)): seen(*places)})
            robot.sync(until_folded=True)
    layers = open_layers(server.map_url)
    assert layers.names == ("fine", "evidence")
    fine, coarse = (layers[name].voxels_in().centres_m for name in layers.names)
    points = [*fine.tolist(), *coarse.tolist(), [50.0, 50.0, 50.0]]

    def asked(url: str, *options: str) -> list[dict[str, Any]]:
        texts = [",".join(map(str, point)) for point in points]
        found: list[dict[str, Any]] = json.loads(
            cairn("map", "query", url, "points", *texts, "--json", *options, folder=tmp_path)
        )
        return found

    found = asked(server.map_url)
    assert [each["point_m"] for each in found] == points
    assert [each["layer"] for each in found] == [name or "evidence" for name in layers.names_at(points)]
    assert {each["layer"] for each in found[:3]} == {"fine"}
    assert (found[5]["layer"], found[5]["state"] != "unknown", found[-1]["state"]) == ("evidence", True, "unknown")
    said = cairn("map", "query", server.map_url, "points", "0.005,0.005,0.005", "9,9,9", folder=tmp_path)
    assert "layer evidence, voxels of 0.05 m:" in said
    # One layer alone: by its name, or by its URL.
    for name in layers.names:
        url = server.map_url if name == "evidence" else f"{server.map_url}.{name}"
        alone = asked(server.map_url, "--layer", name)
        assert "layer" not in alone[0]
        assert [each["state"] for each in alone] == [
            State(state).name.lower() for state in layers[name].state_at(points)
        ]
        assert name == "evidence" or asked(url) == alone
    said = cairn(*("map", "query", server.map_url, "points", "0,0,0", "--layer", "far"), folder=tmp_path, code=3)
    assert "no layer 'far' of map" in said
    assert "cairn map layer add" in said
    assert "take the map's own URL" in cairn(
        *("map", "query", f"{server.map_url}.fine", "points", "0,0,0", "--layer", "far"), folder=tmp_path, code=1
    )


def test_rays_slices_and_files_are_of_the_finest_layer_that_knows_each_place(
    server: LiveServer, tmp_path: Path
) -> None:
    cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    for name, url, places in (("far", server.map_url, (0, 9, 300)), ("near", f"{server.map_url}.fine", (1, 2, 70))):
        with Robot(None, url, directory=tmp_path / name, name=name) as robot:
            robot.replica.commit({cell_key((0, 0, 0)): seen(*places, kelvin_steps=9)})
            robot.sync(until_folded=True)
    layers = open_layers(server.map_url)

    def asked(*words: str) -> Any:
        return json.loads(cairn("map", "query", server.map_url, *words, "--json", folder=tmp_path))

    x, y, _ = layers["fine"].occupied_in().centres_m[0].tolist()
    origin, way = [x, y, -1.0], [0.0, 0.0, 1.0]
    texts = [",".join(map(str, each)) for each in (origin, way)]
    ends = layers.cast_rays([origin], [way], max_range_m=9.0)
    found = asked("ray", *texts)
    assert (found["hit"], found["layer"]) == (bool(ends.hit[0]), ends.names[0])
    assert found["distance_m"] == pytest.approx(float(ends.distance_m[0]))
    alone = asked("ray", *texts, "--layer", "evidence")
    assert ("layer" in alone, "voxel" in alone) == (False, True)
    nearest = layers.nearest_occupied([origin], radius_m=5.0)
    (found,) = asked("nearest", texts[0])
    assert (found["layer"], found["distance_m"]) == (nearest.names[0], pytest.approx(float(nearest.distance_m[0])))
    assert "layer" not in asked("nearest", texts[0], "--unknown")[0]
    box = "--box=0,0,0,0.1,0.1,0.1"
    assert asked("slice", "0.005", box)["edge_m"] == asked("height", box)["edge_m"] == 0.01
    assert asked("slice", "0.005", box, "--layer", "evidence")["edge_m"] == 0.05

    # Files of the whole map have each place once, and say how large it is; a layer alone is as it was.
    ply, npz, one = (tmp_path / name for name in ("m.ply", "m.npz", "one.ply"))
    said = cairn("map", "export", server.map_url, "--ply", str(ply), "--npz", str(npz), folder=tmp_path)
    occupied = {name: len(voxels) for name, voxels in layers.occupied_in().items()}
    for name, count in occupied.items():
        assert f"  layer {name}: {count} voxels" in said
    head = ply.read_bytes().partition(b"end_header")[0].decode()
    assert f"element vertex {sum(occupied.values())}\n" in head
    assert "property float edge\n" in head
    with np.load(npz) as arrays:
        assert {*zip(arrays["layer"].tolist(), arrays["edge_m"].tolist(), strict=True)} == {
            ("evidence", 0.05),
            ("fine", 0.01),
        }
        assert len(arrays["temperature_mean"]) == len(arrays["layer"])
    cairn("map", "export", server.map_url, "--ply", str(one), "--layer", "fine", folder=tmp_path)
    head = one.read_bytes().partition(b"end_header")[0].decode()
    assert (f"element vertex {len(layers['fine'].occupied_in())}\n" in head, "edge" in head) == (True, False)


def test_robots_map_into_the_layer_that_an_option_or_an_operator_names(server: LiveServer, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "room", RIG, name="room") as writer:
        for seed in (1, 2):
            writer.add(scan_of(seed))
    for name in ("wide", "wider"):
        cairn("map", "layer", "add", server.map_url, name, "--voxel", "0.2", folder=tmp_path)

    def replayed(*options: str, code: int = 0) -> str:
        words = ("robot", "replay", "room", "--map", server.map_url, "--name", "mole", *options)
        return cairn(*words, folder=tmp_path, code=code)

    def cells() -> dict[str, int]:
        with MapApi(server.url) as api:
            return {layer.name: layer.cells for layer in api.layers(MAP)}

    # A layer that is there, in a folder of its own; one name, one key: the folders lend it to one another.
    said = replayed("--layer", "far", code=3)
    assert "no layer 'far' of map" in said
    assert "cairn map layer add" in said
    assert "cairn map layer add" in replayed("--layer", "far", "--voxel", "0.1", code=3)
    assert [path.name for path in tmp_path.glob("cairn-*")] == []
    replayed("--layer", "wide")
    assert {name for name, count in cells().items() if count} == {"wide"}
    replayed()
    assert {name for name, count in cells().items() if count} == {"evidence", "wide"}
    assert sorted(path.name for path in tmp_path.glob("cairn-*")) == ["cairn-mole", "cairn-mole.wide"]

    # As operators say.
    assign = ("map", "layer", "assign", server.map_url, "mole")
    assert "no layers" in replayed("--assigned", code=3)
    said = cairn(*assign, "--contributes", "evidence,wider", "--inside", "wider=0,0,0,1,1,1", folder=tmp_path)
    assert said == "mole maps into evidence, wider in a box\n"
    assert "--layer" in replayed("--assigned", code=1)
    # Of what one layer everywhere is not, the command leaves nothing out without a word.
    cairn(*assign, "--contributes", "wider", "--outside", "wider=0,0,0,1,1,1", folder=tmp_path)
    assert "wider outside of a box" in replayed("--assigned", code=1)
    cairn(*assign, "--contributes", "wider", "--fetches", "wide", folder=tmp_path)
    listed = cairn("map", "layer", "assigned", server.map_url, folder=tmp_path)
    assert listed == "mole maps into wider; fetches wide\n"
    assert "(wider; fetches wide) is not one layer" in replayed("--assigned", code=1)
    cairn(*assign, "--contributes", "wider", folder=tmp_path)
    replayed("--assigned")
    assert all(cells().values())
    for options, kind in (
        (("--contributes", "far"), "no_map"),
        (("--contributes", "wide", "--fetches", "wide"), "bad_layer"),
        (("--contributes", "wide", "--inside", "wider=0,0,0,1,1,1"), "bad_option"),
        ((), "bad_option"),
        (("--none", "--fetches", "wide"), "bad_option"),
        (("--none", "--inside", "wider=0,0,0,1,1,1"), "bad_option"),
        (("--contributes", "wide,wide"), "bad_layer"),
        (("--contributes", "wide", "--inside", "wide=0,0,0,1,1,1", "--inside", "wide=2,0,0,3,1,1"), "bad_option"),
    ):
        assert f"[{kind}]" in cairn(*assign, *options, folder=tmp_path, code=3 if kind == "no_map" else 1)
    cairn(*assign, "--none", folder=tmp_path)
    assert "(none" in cairn("map", "layer", "assigned", server.map_url, folder=tmp_path)

    # Without a link it is the layer of the robot's folder; of several folders none is guessed.
    server.stop()
    assert "3 folders of mole are here" in replayed("--assigned", "--again", code=5)
    said = replayed("--assigned", "--again", "--state", "cairn-mole.wider")
    assert f"{server.map_url}.wider: no link to it" in said


def test_what_a_robot_mapped_is_taken_out_of_all_layers_by_one_command(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cairn("map", "layer", "add", server.map_url, "fine", "--voxel", "0.01", folder=tmp_path)
    cairn("map", "layer", "add", server.map_url, "wide", "--voxel", "0.2", folder=tmp_path)
    urls = {"evidence": server.map_url, "fine": f"{server.map_url}.fine"}
    for name in ("mole", "wren"):
        for layer, url in urls.items():
            if layer == "fine":  # one name, one key: the folder for the second layer has the first one's
                with opened_replica(tmp_path / f"{name}-evidence") as first:
                    lend_keys(first, tmp_path / f"{name}-fine")
            with Robot(None, url, directory=tmp_path / f"{name}-{layer}", name=name) as robot:
                robot.replica.commit({cell_key((0, 0, 0)): seen(1 if name == "mole" else 2)})
                robot.sync(until_folded=True)
    retract = ("map", "retract", server.map_url)
    asked = cairn(*retract, "--robot", "mole", "--all-layers", "--dry-run", folder=tmp_path)
    assert [line for line in asked.splitlines() if not line.startswith("  ")] == [
        f"would take out 1 commits of {name} (nothing was done):" for name in (MAP, f"{MAP}.fine")
    ]
    assert "bad_option" in cairn(
        *retract, "--commit", "mole.0011223344556677.0", "--all-layers", folder=tmp_path, code=1
    )
    # A receipt is printed when its layer is done, whatever becomes of the next; the same command goes on there.
    ask = MapApi.retract

    def broken(api: MapApi, name: str, request: Retract) -> Retracted:
        if name == f"{MAP}.fine":
            raise UnreachableError("no_link", "the link broke")
        return ask(api, name, request)

    with monkeypatch.context() as patched:
        patched.setattr(MapApi, "retract", broken)
        assert main([*retract, "--robot", "mole", "--all-layers"]) == 5
    assert f"takes out 1 commits of {MAP}:\n  mole." in capsys.readouterr().out
    said = cairn(*retract, "--robot", "mole", "--all-layers", folder=tmp_path)
    assert said.count(f"takes out 1 commits of {MAP}.fine:") == said.count("takes out") == 1
    again = cairn(*retract, "--robot", "mole", "--all-layers", folder=tmp_path, code=3)
    assert "nothing_to_retract" in again
    wait_until(lambda: all(len(open_map(url).voxels_in()) == 1 for url in urls.values()))


def test_a_server_of_before_has_maps_of_one_layer() -> None:
    class Before:
        def layers(self, name: str) -> None:
            raise NotFoundError("no_route", "Not Found")

    assert layers_of(Before(), "lab") == {"evidence": "lab"}  # type: ignore[arg-type]


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


def test_a_level_is_added_mapped_into_and_read_as_the_ground(server: LiveServer, tmp_path: Path) -> None:
    url = f"{server.map_url}.ground"
    said = cairn("map", "layer", "add", server.map_url, "ground", "--kind", "level", folder=tmp_path)
    assert said.startswith(
        f"layer ground of map {MAP}: voxels of 20 cm and 5 cm height, cells of 12.8 m, channels height"
    )
    assert "20 cm flat" in cairn("map", "layer", "list", server.map_url, folder=tmp_path)
    # A ground that rises by 10 cm a metre, seen twice, and a post on it.
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0.1, 3, 0.2), np.arange(0.1, 2, 0.2)))
    ground = np.stack([x, y, 0.1 * x], axis=1)
    post = np.array([[1.5, 0.9, z] for z in np.arange(0.2, 1.2, 0.1)])
    with Robot(RIG, url, directory=tmp_path / "mole", name="mole") as robot:
        for time_s in (1.0, 2.0):
            robot.observe(sweep_of(np.concatenate([ground, post]), time_s))
        robot.commit()
        robot.sync(until_folded=True)
        own = robot.snapshot().elevation()
    seen = open_map(url).elevation()
    assert np.array_equal(own.height_m, seen.height_m, equal_nan=True)
    columns = np.rint((ground[:, :2] - seen.origin_m) / 0.2).astype(int)
    assert np.abs(seen.height_m[columns[:, 1], columns[:, 0]] - ground[:, 2]).max() <= 0.005
    # The command, its files, and what a level does not answer.
    png, npz = tmp_path / "g.png", tmp_path / "g.npz"
    asked = ("map", "query", url, "elevation")
    lines = cairn(*asked, "--png", str(png), "--npz", str(npz), folder=tmp_path).splitlines()
    assert "150 known" in lines[0]
    assert lines[2] == "99% of the known columns are passable"
    assert png.read_bytes().startswith(b"\x89PNG")
    with np.load(npz) as arrays:
        assert np.nanmax(arrays["obstacle_m"]) == pytest.approx(0.95, abs=0.06)
    found = json.loads(cairn(*asked, "--json", "--box=0,0,-1,1,1,1", folder=tmp_path))
    assert np.array(found["height_m"], float).shape == (5, 5)
    assert "not_level" in cairn("map", "query", server.map_url, "elevation", folder=tmp_path, code=1)
    assert "level_layer" in cairn("map", "query", url, "ray", "0,0,1", "1,0,0", folder=tmp_path, code=1)
    assert "level_layer" in cairn("map", "export", url, "--ot", str(tmp_path / "g.ot"), folder=tmp_path, code=1)
    render = ("map", "render", url, "-o", str(tmp_path / "r.png"), "--from=0,0,2", "--to=1,0,0")
    assert "unknown_channel" in cairn(*render, folder=tmp_path, code=1)
    cairn(*render, "--layer", "difficulty", "--npz", str(tmp_path / "r.npz"), folder=tmp_path)
    cairn("map", "export", url, "--cells", str(tmp_path / "cells"), folder=tmp_path)
    at_home = ("map", "render", str(tmp_path / "cells"), *render[3:], "--layer", "difficulty")
    served = (tmp_path / "r.png").read_bytes()
    assert "of them on the map" in cairn(*at_home, folder=tmp_path)
    assert (tmp_path / "r.png").read_bytes() == served
    with np.load(tmp_path / "r.npz") as arrays:
        assert np.nanmax(arrays["difficulty"]) > 1  # the obstacle
    assert "not_level" in cairn("map", "render", server.map_url, *render[3:], "--layer=slope", folder=tmp_path, code=1)


def test_a_level_that_cannot_be_is_refused(server: LiveServer, tmp_path: Path) -> None:
    def refused(*options: str) -> str:
        return cairn("map", "layer", "add", server.map_url, "ground", *options, folder=tmp_path, code=1)

    assert "needs --voxel" in refused()
    assert "goes with --kind level" in refused("--voxel", "0.2", "--height-step", "0.05")
    assert "leave out --channels" in refused("--kind", "level", "--channels", "colour")
    assert "height step" in refused("--kind", "level", "--height-step", "0.3")
